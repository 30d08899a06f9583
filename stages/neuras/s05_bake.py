"""Stage bake: a fitted scene as files that draw in real time (section 3.4).

Reads fit's maps and networks, atlas' mesh and capture's frames; writes ``site/``, a folder that is a complete web site
and holds what another engine needs (``stages.neuras.baking.site`` lists it). One template makes the shaders of both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added
from pipeline.errors import UserError
from pipeline.stage import Inputs, RunStage

if TYPE_CHECKING:
    from pipeline.store import Draft


class BakeConfig(StageConfig):
    """Lengths end in ``_m``: metres, or nominal metres where the capture's unit is unknown (``CaptureInfo.metre``)."""

    textures: Literal["fp16", "rgba8"] = "fp16"  # what the loader makes of codes; eight bits take half the memory
    frames: int = Field(60, ge=1)  # at most so many photos on the page, spread over the capture
    largest: int = Field(8192, ge=256)  # texels along a side that devices are expected to take
    tile_m: float | None = added(None, legacy=None, gt=0)  # side of tiles that the page loads as one drives; None: one piece
    reach_m: float = added(200.0, legacy=200.0, gt=0)  # how far from the camera it loads them


class Bake(RunStage):
    name: ClassVar[str] = "bake"
    version: ClassVar[int] = 2
    inputs: ClassVar[tuple[str, ...]] = ("capture", "atlas", "fit")
    Config: ClassVar[Any] = BakeConfig
    headline: ClassVar[str | None] = "site/index.html"

    def slug(self, config: BakeConfig) -> str:
        return config.textures

    def run(self, config: BakeConfig, inputs: Inputs, draft: Draft) -> list[str]:
        from model.neuras.baked import Baked
        from stages.neuras.baking import site
        from stages.neuras.baking.drawing import depth_range
        from stages.neuras.baking.tiles import Tiling, cut
        from stages.neuras.records import CaptureInfo, fitted_poses, frames, load_atlas, posed

        capture = inputs["capture"]
        baked = Baked.load(inputs["fit"].path / "files")
        atlas = load_atlas(inputs["atlas"].file("atlas.npz"))
        largest = max(atlas.width, atlas.height)
        if config.tile_m is None and largest > config.largest:
            raise UserError(
                f"the texture is {atlas.width} x {atlas.height} texels, and bake.largest={config.largest}: lower atlas.size or "
                "atlas.max_megatexels, or raise bake.largest for devices that take more"
            )
        info = CaptureInfo.of(capture)
        views = list(posed(frames(capture), fitted_poses(inputs["fit"])))
        shown = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, config.frames).round().astype(int))]
        tiles = None
        if config.tile_m is not None:
            tiling = Tiling(config.tile_m * info.metre, config.reach_m * info.metre, config.largest)
            tiles = cut(atlas, baked.pyramid, info.up, [view.camera for view in shown], tiling)
        planes = depth_range(atlas.vertices, info.metre)
        sizes = site.write_site(draft.files / "site", baked, atlas, info, shown, planes, config.textures, tiles)
        draft.note("summary", {"megabytes": {kind: round(size / 1e6, 3) for kind, size in sizes.items()}})
        return sorted(path.relative_to(draft.files).as_posix() for path in draft.files.rglob("*") if path.is_file())
