"""train, or a checkpoint that exists already in its place.

``train=given train.checkpoint=FOLDER`` copies a released-format checkpoint folder to where *train* leaves its own, so that
*evaluate* measures somebody's model, on our scenes or on imported ones, with no special case. With every other ``train=...``
this is ``stages.renderformer.s06_train``. One design choice: a given checkpoint is an artifact like a trained one, keyed by
its content.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Tag

from pipeline.config import StageConfig, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs
from stages.renderformer import hub
from stages.renderformer.s06_train import OBJECTS, Train, TrainConfig, check_objects

FILES = ("config.json", "model.safetensors")


class GivenConfig(StageConfig):
    name: Literal["given"] = "given"
    checkpoint: str | None = runtime(
        None
    )  # folder in the released format, or hub:OWNER/NAME; what its files hold is part of the key


def _chosen(data: Any) -> str:
    return "given" if (data.get("name") if isinstance(data, dict) else getattr(data, "name", None)) == "given" else "trained"


class TrainOrGiven(Train):
    Config = Annotated[
        Annotated[GivenConfig, Tag("given")] | Annotated[TrainConfig, Tag("trained")],
        Discriminator(_chosen),
    ]

    def slug(self, config: Any) -> str:
        return "given" if isinstance(config, GivenConfig) else super().slug(config)

    def agree(self, config: Any, configs: Mapping[str, StageConfig]) -> None:
        if not isinstance(config, GivenConfig):
            super().agree(config, configs)

    def identity(self, config: Any, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        if not isinstance(config, GivenConfig):
            return super().identity(config, hash_file)
        return {path.name: hash_file(path) for path in checkpoint_files(config)}

    def estimate(self, config: Any, configs: Mapping[str, StageConfig]) -> list[str]:
        return [] if isinstance(config, GivenConfig) else super().estimate(config, configs)

    def run(self, config: Any, inputs: Inputs, draft: Any) -> list[str]:
        if not isinstance(config, GivenConfig):
            return super().run(config, inputs, draft)
        from model.renderformer import checkpoint

        files = checkpoint_files(config)
        try:
            checkpoint.load(files[0].parent)
        except (ValueError, KeyError) as error:
            raise UserError(f"train.checkpoint={config.checkpoint!r} cannot be used: {error}") from error
        check_objects(f"train.checkpoint={config.checkpoint}", files[0].parent, inputs["shard"], draft.log)
        (draft.files / "checkpoint").mkdir(exist_ok=True)
        for path in files:
            shutil.copyfile(path, draft.files / "checkpoint" / path.name)
        (draft.files / "log.jsonl").write_text("")
        return [f"checkpoint/{name}" for name in FILES]


def checkpoint_files(config: GivenConfig) -> list[Path]:
    """The files of the given checkpoint: config, weights, and the list of its training objects where it has one."""
    if config.checkpoint is None:
        raise UserError("train=given needs a checkpoint: train.checkpoint=FOLDER with config.json and model.safetensors")
    given = config.checkpoint
    folder = hub.checkpoint(given) if hub.is_hub(given) else Path(given).expanduser()
    files = [folder / name for name in FILES]
    for path in files:
        if not path.is_file():
            raise UserError(f"train.checkpoint={config.checkpoint!r} holds no {path.name}: give a released-format folder")
    listed = files[0].parent / OBJECTS
    return [*files, listed] if listed.is_file() else files
