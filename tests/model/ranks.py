"""Trains a small network of each kind on made-up batches, alone or under torchrun: ``ranks.py FOLDER ddp|fsdp [die]``.

die: every process stops in the middle of each training, as if killed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from model.renderformer.architectures import build  # noqa: E402
from model.renderformer.config import ModelConfig  # noqa: E402
from model.renderformer.guided.config import GuidedConfig  # noqa: E402
from model.renderformer.recipe import FitConfig  # noqa: E402
from model.renderformer.training import fit  # noqa: E402
from model.training.parallel import Group, join  # noqa: E402
from tests.model.synthetic import batch  # noqa: E402
from tests.model.test_config import MICRO  # noqa: E402
from tests.model.test_guided import SMALL, guided_batch  # noqa: E402

SCENES = 4  # of the global batch
NETWORKS = {"renderformer": ModelConfig(**MICRO), "guided": GuidedConfig(**SMALL)}
STEPS = {"renderformer": (27, 50), "guided": (3, 6)}  # at which it dies, and all of them


class Killed(Exception):
    """Instead of a process's death, after which it could not train the other network."""


def train(network: str, folder: Path, parallel: str, dies: bool, group: Group) -> None:
    share = SCENES // group.world
    dies_at, steps = STEPS[network]

    def make(step: int, padded: int = 0, **sizes: int):
        return guided_batch(step, **sizes) if network == "guided" else batch(step, padded=padded, **sizes)

    def batches(start: int, stop: int):
        for step in range(start, stop):
            if dies and step == dies_at:
                raise Killed
            whole = make(step, scenes=SCENES, padded=3)
            first = group.rank * share
            yield {name: value[first : first + share] for name, value in whole.items()}

    torch.manual_seed(0)
    config = FitConfig(
        steps=steps, lr=1e-3, warmup=5, optimizer="adamw", gradient_leak=0.0, ema=0.9, parallel=parallel, micro_scenes=1,
        log_every=1, validate_every=10, checkpoint_every=20,
    )  # fmt: skip
    validation = [make(1000 + i) for i in range(3)]
    fit(build(NETWORKS[network]), config, batches, validation, folder, group, lambda text: None)


def threads() -> list[str]:
    """Names of this process's threads; none where the system does not tell."""
    return [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]


def main() -> None:
    folder, parallel, *dies = sys.argv[1:]
    torch.set_num_threads(1)
    with join("cpu") as group:
        for network in NETWORKS:
            try:
                train(network, Path(folder) / network, parallel, bool(dies), group)
            except Killed:
                group.wait()
    if any(name.startswith("pt_gloo") for name in threads()):
        sys.exit("gloo's threads outlive the group")
    sys.exit("killed" if dies else 0)


if __name__ == "__main__":
    main()
