"""What a sweep over the rows of a table costs in training: seconds of one core for a step of each row, and for all of them.

    python bench/sweep.py                       # table1_small
    python bench/sweep.py --rows full --threads 1,2    # two rows side by side, or one with two threads?

Each row with its own model, optimizer, batch size and resolution; made-up scenes of ``--triangles`` triangles. Processor time,
the least of several steps, so that it may run beside other programs. "busy": processor time of the first of the threads, which
on a quiet machine is about what passes on the clock.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ["OMP_WAIT_POLICY"] = "passive"  # threads that wait would count as working

import torch  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model.renderformer.losses import image_loss  # noqa: E402
from model.renderformer.network import RenderFormer  # noqa: E402
from model.renderformer.training import predict  # noqa: E402
from model.training.optimization import build_optimizers  # noqa: E402
from pipeline.config import StageConfig  # noqa: E402
from stages.renderformer.evaluation.ablation import jobs_of  # noqa: E402
from tests.model.synthetic import batch  # noqa: E402


def step_seconds(train: StageConfig, resolution: int, triangles: int, repeats: int) -> tuple[float, float, float]:
    """(processor time, the first thread's, that of the optimizer) of a training step."""
    torch.manual_seed(0)
    model = RenderFormer(train.model.build()).train()
    updates = build_optimizers(model, train.optimizer, train.lr, train.muon_lr, train.weight_decay)
    data = batch(0, train.batch_scenes, triangles, train.views_per_scene, resolution)
    image = torch.from_numpy(data["image"])
    best = (float("inf"),) * 3
    for _ in range(repeats + 1):  # the first one, which also allocates, is never the least
        began, first = time.process_time(), time.thread_time()
        image_loss(predict(model, model, data, "cpu", "fp32"), image, None, 0.0).backward()
        middle = time.process_time()
        for optimizer in updates:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        ended = time.process_time()
        best = min(best, (ended - began, time.thread_time() - first, ended - middle))
    return best


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", default="table1_small")
    parser.add_argument("--rows", type=lambda text: text.split(","), help="comma-separated (default: all)")
    parser.add_argument("--threads", default="1", help="comma-separated (default: 1)")
    parser.add_argument("--triangles", type=int, default=430, help="of every scene (default: 430)")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    jobs = jobs_of(arguments.table, arguments.rows, [])
    print("row                threads  parameters   step s   busy s  optimizer s   steps    all, min")
    for threads in map(int, arguments.threads.split(",")):
        torch.set_num_threads(threads)
        total = 0.0
        for name, job in jobs.items():
            train, resolution = job.plan["train"].config, job.plan["render"].config.resolution
            seconds, busy, optimizer = step_seconds(train, resolution, arguments.triangles, arguments.repeats)
            with torch.device("meta"):
                parameters = sum(p.numel() for p in RenderFormer(train.model.build()).parameters())
            total += seconds * train.steps
            print(
                f"{name:<18} {threads:>7} {parameters / 1e6:>10.1f}M {seconds:>8.2f} {busy:>8.2f} {optimizer:>12.2f} "
                f"{train.steps:>7,} {seconds * train.steps / 60:>11.1f}",
                flush=True,
            )
        print(f"{len(jobs)} rows with {threads} thread(s) each: {total / 60:.1f} minutes of one core")
    return 0


if __name__ == "__main__":
    sys.exit(main())
