"""Trains a small network on made-up batches, alone or under torchrun: ``ranks.py FOLDER ddp|fsdp [STOP]``.

STOP: the step at which every process dies, as if killed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from model.renderformer.config import ModelConfig  # noqa: E402
from model.renderformer.network import RenderFormer  # noqa: E402
from model.renderformer.recipe import FitConfig  # noqa: E402
from model.renderformer.training import fit  # noqa: E402
from model.training.parallel import join  # noqa: E402
from tests.model.synthetic import batch  # noqa: E402
from tests.model.test_config import MICRO  # noqa: E402

STEPS, SCENES = 50, 4  # scenes of the global batch


def main() -> None:
    folder, parallel, *dies_at = sys.argv[1:]
    torch.set_num_threads(1)
    with join("cpu") as group:
        share = SCENES // group.world

        def batches(start: int, stop: int):
            for step in range(start, stop):
                if [str(step)] == dies_at:
                    sys.exit("killed")
                whole = batch(step, scenes=SCENES, padded=3)
                first = group.rank * share
                yield {name: value[first : first + share] for name, value in whole.items()}

        torch.manual_seed(0)
        model = RenderFormer(ModelConfig(**MICRO))
        config = FitConfig(
            steps=STEPS, lr=1e-3, warmup=5, optimizer="adamw", gradient_leak=0.0, ema=0.9, parallel=parallel, micro_scenes=1,
            log_every=1, validate_every=10, checkpoint_every=20,
        )  # fmt: skip
        fit(model, config, batches, [batch(1000 + i) for i in range(3)], Path(folder), group, lambda text: None)


if __name__ == "__main__":
    main()
