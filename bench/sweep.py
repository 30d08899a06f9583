"""What a sweep over the rows of a table costs in training: seconds of one core for a step of each row, and for all of them.

    python bench/sweep.py                       # table1_small
    python bench/sweep.py --rows full --threads 1,2    # two rows side by side, or one with two threads?
    python bench/sweep.py priors --store store --repeats 30    # steps of the table's own data, which must be there

Each row with its own model, optimizer, batch size and resolution; made-up scenes of ``--triangles`` triangles, or with
``--store`` the batches of its training, whose decoding then counts. Processor time: the mean over several steps, which the
rows take in turn, so that other programs slow all of them alike. "clock": what passes on the clock, on a quiet machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_WAIT_POLICY"] = "passive"  # threads that wait would count as working

import numpy as np  # noqa: E402
import torch  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model.renderformer.architectures import build  # noqa: E402
from model.renderformer.losses import image_loss  # noqa: E402
from model.renderformer.training import Backward, predict  # noqa: E402
from model.training.optimization import build_optimizers  # noqa: E402
from model.training.parallel import Group  # noqa: E402
from pipeline.store import Store  # noqa: E402
from pipeline.sweep import Job  # noqa: E402
from stages.renderformer.dataset import Batches, Needs, ShardDataset  # noqa: E402
from stages.renderformer.evaluation import ablation, comparison  # noqa: E402
from tests.model.synthetic import batch  # noqa: E402


class Row:
    """A row in training: its network, and what a step of it took so far."""

    def __init__(self, name: str, job: Job, arguments: argparse.Namespace):
        torch.manual_seed(0)
        self.name, self.train = name, job.plan["train"].config
        self.model = build(self.train.model.build()).train()
        self.model.leak_gradient(self.train.gradient_leak)
        train = self.train
        self.updates = build_optimizers(self.model, train.optimizer, train.lr, train.muon_lr, train.weight_decay)
        self.parameters = [p for optimizer in self.updates for group in optimizer.param_groups for p in group["params"]]
        self.batch = batches(job, self.model, arguments)

    def begin(self) -> None:
        """Go about gradients as training does with the number of threads that is set."""
        self.seconds: list[tuple[float, float, float]] = []
        self.backward = Backward(self.loss_of, self.model, self.parameters, self.train, Group(torch.device("cpu")))

    def loss_of(self, part: Any, weight: float) -> torch.Tensor:
        image = torch.from_numpy(np.ascontiguousarray(part["image"]))
        return weight * image_loss(predict(self.model, self.model, part, "cpu", "fp32"), image, None, 0.0)

    def step(self, number: int) -> None:
        """Keeps (processor time, time on the clock, processor time of the optimizer)."""
        data = self.batch(number)
        began, clock = time.process_time(), time.perf_counter()
        self.backward(data)
        middle = time.process_time()
        for optimizer in self.updates:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        ended = time.process_time()
        self.seconds.append((ended - began, time.perf_counter() - clock, ended - middle))

    def report(self, threads: int) -> float:
        """Prints the row; returns the seconds of its whole training. The first step, which also allocates, is left out."""
        seconds, clock, optimizer = np.mean(self.seconds[1:], axis=0)
        parameters = sum(p.numel() for p in self.model.parameters())
        print(
            f"{self.name:<18} {threads:>7} {parameters / 1e6:>10.2f}M {seconds:>8.3f} {clock:>8.3f} {optimizer:>12.3f} "
            f"{self.train.steps:>7,} {seconds * self.train.steps / 60:>11.2f}",
            flush=True,
        )
        return seconds * self.train.steps


def batches(job: Job, model: Any, arguments: argparse.Namespace) -> Callable[[int], Any]:
    """Step -> batch."""
    train = job.plan["train"].config
    if arguments.store is None:
        size = train.batch_scenes, arguments.triangles, train.views_per_scene, job.plan["render"].config.resolution
        return lambda step: batch(0, *size)
    shard = Store(arguments.store).resolve(job.keys["shard"])
    needs = Needs(model.reads_guides, bundle=model.config.resolution_multiple)
    return Batches(ShardDataset(shard, "train", train.max_triangles), train, needs=needs)


def jobs_of(table: str, names: list[str] | None) -> dict[str, Job]:
    return dict((ablation if table in ablation.names() else comparison).jobs_of(table, names, []))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", default="table1_small")
    parser.add_argument("--rows", type=lambda text: text.split(","), help="comma-separated (default: all)")
    parser.add_argument("--threads", default="1", help="comma-separated (default: 1)")
    parser.add_argument("--triangles", type=int, default=430, help="of every made-up scene (default: 430)")
    parser.add_argument("--store", help="read batches from the table's shards in this store")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_flush_denormal(True)
    rows = [Row(name, job, arguments) for name, job in jobs_of(arguments.table, arguments.rows).items()]
    for threads in map(int, arguments.threads.split(",")):
        torch.set_num_threads(threads)
        for row in rows:
            row.begin()
        for number in range(arguments.repeats + 1):
            for row in rows:
                row.step(number)
        print("row                threads  parameters   step s  clock s  optimizer s   steps    all, min")
        total = sum(row.report(threads) for row in rows)
        print(f"{len(rows)} rows with {threads} thread(s) each: {total / 60:.1f} minutes of one core")
    return 0


if __name__ == "__main__":
    sys.exit(main())
