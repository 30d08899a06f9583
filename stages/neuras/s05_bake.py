"""Stage bake: a fitted scene as files that draw in real time (section 3.4).

Reads fit's maps and networks, atlas' mesh and capture's frames; writes ``site/``, a folder that is a complete web site
and holds what another engine needs (``stages.neuras.baking.site`` lists it). One template makes the shaders of both.
With ``residuals`` it draws what training photos know beyond the textures, too (``stages.neuras.baking.residuals``).
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


SOFT_M = 0.05  # metres within which the nearest photos weigh alike


class BakeConfig(StageConfig):
    """Lengths end in ``_m``: metres, or nominal metres where the capture's unit is unknown (``CaptureInfo.metre``)."""

    textures: Literal["fp16", "rgba8"] = "fp16"  # what the loader makes of codes; eight bits take half the memory
    frames: int = Field(60, ge=1)  # at most so many photos on the page, spread over the capture
    largest: int = Field(8192, ge=256)  # texels along a side that devices are expected to take
    tile_m: float | None = added(None, legacy=None, gt=0)  # side of tiles that the page loads as one drives; None: one piece
    residuals: int = added(4, legacy=0, ge=0)  # nearest training photos whose residuals a view adds; 0: none
    # degrees between two rays at which a residual has faded to 1/e; null: found on validation frames, else 5
    residual_angle: float | None = added(None, legacy=5.0, gt=0, lt=90)
    reach_m: float = added(200.0, legacy=200.0, gt=0)  # how far from the camera it loads them


class Bake(RunStage):
    name: ClassVar[str] = "bake"
    version: ClassVar[int] = 5
    inputs: ClassVar[tuple[str, ...]] = ("capture", "atlas", "fit")
    Config: ClassVar[Any] = BakeConfig
    headline: ClassVar[str | None] = "site/index.html"

    def slug(self, config: BakeConfig) -> str:
        return config.textures

    def run(self, config: BakeConfig, inputs: Inputs, draft: Draft) -> list[str]:
        import torch

        from model.neuras.baked import Baked
        from stages.neuras.baking import site
        from stages.neuras.baking.drawing import depth_range
        from stages.neuras.baking.residuals import ANGLES, Residuals
        from stages.neuras.baking.tiles import Tiling, cut
        from stages.neuras.evaluation.renderers import Reference
        from stages.neuras.records import CaptureInfo, fitted_poses, frames, load_atlas, natural, posed

        capture = inputs["capture"]
        baked = Baked.load(inputs["fit"].path / "files")
        atlas = load_atlas(inputs["atlas"].file("atlas.npz"))
        height, width = baked.mesh_size
        if config.tile_m is None and max(width, height) > config.largest:
            levels = f", all {baked.levels} levels in one," if baked.levels > 1 else ""
            raise UserError(
                f"the texture{levels} is {width} x {height} texels, and bake.largest={config.largest}: lower atlas.size or "
                "atlas.max_megatexels, cut the scene in tiles (bake.tile_m=50), or raise bake.largest if devices take more"
            )
        info = CaptureInfo.of(capture)
        views = sorted(posed(frames(capture), fitted_poses(inputs["fit"])), key=lambda view: natural(view.id))
        shown = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, config.frames).round().astype(int))]
        tiles = None
        if config.tile_m is not None:
            tiling = Tiling(config.tile_m * info.metre, config.reach_m * info.metre, config.largest)
            tiles = cut(atlas, baked.pyramid, info.up, [view.camera for view in views], tiling)
        planes = depth_range(atlas.vertices, info.metre, [view.camera.position for view in views])
        folder = draft.files / "site"
        photos, summary = None, {}
        if config.residuals:
            torch.set_num_threads(1)  # of each photo: sums in another order round differently
            scene, exposure = Reference(baked, atlas), inputs["fit"].manifest["config"].get("exposure", False)
            photos = Residuals.make(
                folder,
                scene,
                (view for view in views if view.split == "train"),
                baked.sky_centre,
                planes,
                SOFT_M * info.metre,
                info.radius,
                config.residuals,
                config.residual_angle or ANGLES[0],
                exposure,
            )
            if photos and config.residual_angle is None:
                held_out = [view for view in views if view.split == "validation"]
                summary["residual_angle"] = photos.fit_angle(scene, held_out, baked.sky_centre, exposure) or ANGLES[0]
        sizes = site.write_site(folder, baked, atlas, info, shown, planes, config.textures, tiles, photos)
        draft.note("summary", summary | {"megabytes": {kind: round(size / 1e6, 3) for kind, size in sizes.items()}})
        return sorted(path.relative_to(draft.files).as_posix() for path in draft.files.rglob("*") if path.is_file())
