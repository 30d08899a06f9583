"""Stage atlas: the scaffold unfolded into one texture (section 3.1, xatlas).

Reads scaffold's mesh and capture's cameras; writes the file ``atlas.npz`` (``AtlasMesh``). A map stage over tiles of the mesh:
xatlas' time grows faster than its faces, and tiles unfold side by side. ``finish`` packs them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added
from pipeline.errors import Reject, UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from pipeline.store.files import write_atomic
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays, unpack_json
from stages.neuras.records import scaffold_mesh

if TYPE_CHECKING:
    from pipeline.store import Draft

PLAN = "densities.json"


class AtlasConfig(StageConfig):
    """Texels per pixel: how many texels stand side by side where a training image has one pixel."""

    texels_per_pixel: float = Field(1.0, gt=0, le=8)  # of a tile, against the finer quarter of its pixels
    texels_per_metre: float | None = Field(None, gt=0)  # one density for all, in place of it
    size: int | None = Field(None, ge=64, le=16384)  # a square texture of this side, in place of both
    max_megatexels: float = Field(4.0, gt=0, le=256)  # of the surface; densities are lowered to fit
    padding: int = Field(2, ge=1, le=16)  # texels between charts
    tile_faces: int = Field(4000, ge=100)  # a larger mesh is cut
    charts: Literal["xatlas", "planar"] = added("xatlas", legacy="xatlas")  # planar: quick, for meshes of very many faces


class Atlas(MapStage):
    name: ClassVar[str] = "atlas"
    version: ClassVar[int] = 3
    inputs: ClassVar[dict[str, str]] = {"capture": "capture", "scaffold": "refine"}
    Config: ClassVar[Any] = AtlasConfig
    reasons: ClassVar[dict[str, str]] = {"not_unfolded": "xatlas left faces of the tile without a chart"}
    limits: ClassVar[dict[str, float]] = {"cpu_s": 1800.0, "wall_s": 5400.0, "memory_gb": 8.0}

    def slug(self, config: AtlasConfig) -> str:
        return f"{config.size}px" if config.size else "density"

    def part_size(self, config: AtlasConfig, inputs: Inputs) -> int:
        return 4

    def items(self, config: AtlasConfig, inputs: Inputs) -> Iterable[Item]:
        from stages.neuras.surfaces import unfold

        return [Item(f"tile_{i:04d}") for i in range(len(unfold.tiles(scaffold_mesh(inputs["scaffold"]), config.tile_faces)))]

    def prepare(self, config: AtlasConfig, inputs: Inputs, folder: Path) -> None:
        """Texels per world unit of each tile."""
        from stages.neuras.surfaces import unfold

        mesh = scaffold_mesh(inputs["scaffold"])
        densities = _densities(config, inputs, mesh, unfold.tiles(mesh, config.tile_faces))
        write_atomic(folder / PLAN, pack_json(densities))

    def open_prepared(self, config: AtlasConfig, inputs: Inputs, environment: dict[str, Any], folder: Path) -> Any:
        from stages.graphics.geometry import one_thread
        from stages.neuras.surfaces import unfold

        one_thread()
        mesh = scaffold_mesh(inputs["scaffold"])
        return config, mesh, unfold.tiles(mesh, config.tile_faces), unpack_json((folder / PLAN).read_bytes())

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        from stages.neuras.surfaces import planar, unfold

        config, mesh, tiles, densities = worker
        index = int(item.id.removeprefix("tile_"))
        by = unfold if config.charts == "xatlas" else planar
        tile = by.unfold(mesh, tiles[index], densities[index], config.padding)
        left = tile.charts < 0
        if left.any() and not left.all():  # slivers: the others do without them
            tile = by.unfold(mesh, tiles[index][~left], densities[index], config.padding)
        if (tile.charts < 0).any():
            raise Reject("not_unfolded", f"{int((tile.charts < 0).sum())} of {len(tile.charts)} faces")
        yield Record(item.id, {"tile.npz": pack_arrays({name: np.asarray(value) for name, value in vars(tile).items()})})

    def finish(self, config: AtlasConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.neuras.records import save
        from stages.neuras.surfaces import planar, unfold

        parts = []
        for row in draft.rows():
            arrays = unpack_arrays(draft.read(row.id).members["tile.npz"])
            parts.append(unfold.Tile(**{**arrays, "width": arrays["width"].item(), "height": arrays["height"].item()}))
        if not parts:
            raise UserError("no tile could be unfolded: see the rejects")
        packer = unfold.by_xatlas if config.charts == "xatlas" else planar.pack
        atlas = unfold.pack(parts, config.padding, config.size, packer=packer)
        save(draft.files / "atlas.npz", atlas)
        draft.note(
            "summary",
            {
                "faces": len(atlas.faces),
                "tiles": len(parts),
                "charts": int(atlas.charts.max()) + 1,
                "width": atlas.width,
                "height": atlas.height,
            },
        )


def _densities(config: AtlasConfig, inputs: Inputs, mesh: Any, tiles: list[np.ndarray]) -> list[float]:
    """Texels per world unit of each tile."""
    from stages.graphics.geometry import measure
    from stages.neuras.records import CaptureInfo, frames
    from stages.neuras.surfaces import visibility

    area = np.array([measure.face_areas(mesh.vertices, mesh.faces[rows]).sum() for rows in tiles])
    if config.size is not None:
        fill = 0.65  # of the square; what does not fit is made smaller by ``pack``
        return [float(np.sqrt(fill * config.size**2 / area.sum()))] * len(tiles)
    if config.texels_per_metre is not None:
        densities = np.full(len(tiles), config.texels_per_metre / CaptureInfo.of(inputs["capture"]).metre)
    else:
        pixels = visibility.pixels_per_unit(mesh, (frame.camera for frame in frames(inputs["capture"], "train")))
        finest = np.array([np.quantile(p[p > 0], 0.75) if (p := pixels[rows]).any() else 0.0 for rows in tiles])
        seen = finest[finest > 0]
        if not len(seen):
            raise UserError("no training camera sees the scaffold: is its frame the capture's?")
        densities = config.texels_per_pixel * np.where(finest > 0, finest, seen.min())
    texels = (area * densities**2).sum()
    densities = densities * min(1.0, np.sqrt(config.max_megatexels * 1e6 / texels))
    return [float(np.format_float_positional(d, 6, fractional=False)) for d in densities]
