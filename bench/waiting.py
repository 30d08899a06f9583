"""How torch's threads should wait for each other: training speed of each policy, on a quiet machine and beside busy programs.

    python bench/waiting.py                          # table: policy x quiet, busy
    python bench/waiting.py --repeats 5 --seconds 20

A parallel operation ends at a barrier. GNU OpenMP's threads spin there by default, which wastes the cores that the thread they
wait for needs, where more threads want to run than there are cores. "busy": as many endless loops as cores run beside.
Each measurement is a process of its own, because the policy is read once. The policies take turns, so that what else happens
on the machine falls on all of them; the figures are medians, as shares of the default's on the quiet machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

LOOP = "import os\nwhile os.getppid() == {parent}: pass"  # ends with this program, however that ends
ROOT = Path(__file__).resolve().parents[1]
VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME", "OMP_NUM_THREADS")
POLICIES = {
    "default": {},
    "OMP_WAIT_POLICY=passive": {"OMP_WAIT_POLICY": "passive"},
    "GOMP_SPINCOUNT=10000": {"GOMP_SPINCOUNT": "10000"},
    "GOMP_SPINCOUNT=100000": {"GOMP_SPINCOUNT": "100000"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}


def train(variant: str, seconds: float) -> float:
    """Steps per second of the model ``variant`` as its recipe trains it, on made-up scenes of 430 triangles and 64 px."""
    sys.path.insert(0, str(ROOT))
    import torch

    from model.renderformer.losses import image_loss
    from model.renderformer.network import RenderFormer
    from model.renderformer.training import predict
    from model.training.optimization import build_optimizers
    from pipeline.hydra_config import compose
    from stages.renderformer.s06_train import TrainConfig
    from tests.model.synthetic import batch

    settings = compose([f"model={variant}"])["train"]
    config = TrainConfig(**settings)
    torch.manual_seed(0)
    torch.set_flush_denormal(True)
    model = RenderFormer(config.model.build()).train()
    updates = build_optimizers(model, config.optimizer, config.lr, config.muon_lr, config.weight_decay)
    data = batch(0, config.batch_scenes, 430, config.views_per_scene, 64)
    image = torch.from_numpy(data["image"])

    def step() -> None:
        image_loss(predict(model, model, data, "cpu", "fp32"), image, None, 0.0).backward()
        for optimizer in updates:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    step()  # allocates
    began, steps = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        step()
        steps += 1
    return steps / (time.perf_counter() - began)


def measure(policy: dict[str, str], variant: str, seconds: float) -> float:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES} | policy
    command = [sys.executable, __file__, "--model", variant, "--seconds", str(seconds), "--one"]
    return float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="tiny", help="conf/renderformer/model (default: tiny)")
    parser.add_argument("--seconds", type=float, default=6, help="of each measurement (default: 6)")
    parser.add_argument("--repeats", type=int, default=3, help="of each policy, quiet and busy (default: 3)")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(train(arguments.model, arguments.seconds))
        return 0
    speeds: dict[tuple[str, bool], list[float]] = {(name, busy): [] for name in POLICIES for busy in (False, True)}
    cores = os.cpu_count() or 1
    for _ in range(arguments.repeats):
        for busy in (False, True):
            loops = [
                subprocess.Popen([sys.executable, "-c", LOOP.format(parent=os.getpid())]) for _ in range(cores if busy else 0)
            ]
            try:
                for name, policy in POLICIES.items():
                    speeds[name, busy].append(measure(policy, arguments.model, arguments.seconds))
            finally:
                for loop in loops:
                    loop.kill()
                    loop.wait()
    medians = {case: statistics.median(values) for case, values in speeds.items()}
    reference = medians["default", False]
    print(f"default on the quiet machine: {reference:.2f} steps/s of model={arguments.model}\n")
    print(f"{'':<26} {'quiet':>7} {'busy':>7}   least and most")
    for name in POLICIES:
        spread = "  ".join(
            f"{min(v) / reference:.2f}-{max(v) / reference:.2f}" for v in (speeds[name, b] for b in (False, True))
        )
        print(f"{name:<26} {medians[name, False] / reference:>7.2f} {medians[name, True] / reference:>7.2f}   {spread}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
