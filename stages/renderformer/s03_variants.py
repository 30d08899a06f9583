"""Stage 3, scene: sampled scenes, or those of a folder in the released formats (``scene=imported``).

What follows works on either. One design choice: both are variants of one stage, told apart by the config's name, so that
nothing else need know of imported scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any

from pydantic import Discriminator, Tag

from pipeline.stage import Inputs, Item, MapStage, Record
from stages.renderformer.s03_import import ImportConfig, ImportScene
from stages.renderformer.s03_scene import SampleScene, SceneConfig


def _variant(data: Any) -> str:
    name = data.get("name") if isinstance(data, dict) else getattr(data, "name", None)
    return "imported" if name == "imported" else "sampled"


class Scene(MapStage):
    name = "scene"
    version = SampleScene.version
    inputs = SampleScene.inputs
    Config = Annotated[
        Annotated[ImportConfig, Tag("imported")] | Annotated[SceneConfig, Tag("sampled")], Discriminator(_variant)
    ]
    reasons = {**SampleScene.reasons, **ImportScene.reasons}

    @staticmethod
    def variant(config: Any) -> MapStage:
        """The stage that makes scenes of such a config."""
        return ImportScene() if _variant(config) == "imported" else SampleScene()

    def reads(self, config: Any) -> tuple[str, ...]:
        return self.variant(config).reads(config)

    def slug(self, config: Any) -> str:
        return self.variant(config).slug(config)

    def identity(self, config: Any, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        return self.variant(config).identity(config, hash_file)

    def part_size(self, config: Any, inputs: Inputs) -> int:
        return self.variant(config).part_size(config, inputs)

    def items(self, config: Any, inputs: Inputs) -> Iterable[Item]:
        return self.variant(config).items(config, inputs)

    def open(self, config: Any, inputs: Inputs, environment: dict[str, Any]) -> Any:
        stage = self.variant(config)
        return stage, stage.open(config, inputs, environment)

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        stage, opened = worker
        yield from stage.process(opened, item)

    def finish(self, config: Any, inputs: Inputs, draft: Any) -> None:
        self.variant(config).finish(config, inputs, draft)
