"""render: path-traced views of every scene, light by light (paper section 3.3).

Reads *scene*; writes per scene ``view<i>.exr`` and ``view<i>.aov.exr`` for every kept camera i (``stages.exr``) and
``meta.json`` with what was noted of all cameras. One design choice: radiance is stored per light, as light transport is linear:
the image under any other choice of intensities and colours is a weighted sum, at no rendering cost.

As in the paper's data, views whose mean radiance is under 0.01 or whose nearest depth is under 0.01 are dropped.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, runtime
from pipeline.errors import Reject
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, MapStage, Record

SHEET_SCENES = 12  # rows of a contact sheet


class RenderConfig(StageConfig):
    seed: int = 0
    resolution: int = Field(64, ge=8, le=4096)  # pixels per side; the paper: 256, then 512
    target_error: float = Field(0.0, ge=0)  # of the stored image, mean absolute log10(1 + x), estimated; 0: max_spp at once
    max_spp: int = Field(16, ge=1, le=65536)  # camera paths per pixel, shared by all lights, at most
    mode: Literal["physical", "cycles"] = "physical"  # cycles: Blender Cycles' defaults, as far as they can be matched
    max_depth: int = Field(34, ge=2)  # longest path in segments: 34 is 32 bounces besides direct light
    denoise: bool = True  # Open Image Denoise, every light on its own
    lights_visible: bool = False  # whether cameras see lights; reflections always do
    backend: Literal["auto", "cuda", "llvm", "scalar"] = runtime("auto")  # auto: the best that works here


class RenderWorker:
    """The chosen backend, and the scenes."""

    def __init__(self, config: RenderConfig, scenes: Any, backend: dict[str, Any]):
        self.config, self.scenes, self.backend = config, scenes, backend
        threads = os.environ.get("LIGHTMILL_THREADS")  # set by the engine in worker processes
        self.threads = int(threads) if threads else None


class Render(MapStage):
    name = "render"
    version = 3
    inputs = ("scene",)
    Config = RenderConfig
    reasons = {
        "dark": "every view's mean radiance is under 0.01",
        "too_close": "something is nearer than 0.01 scene units in every view",
        "no_view_left": "some views are dark, the others too close",
    }

    def slug(self, config: RenderConfig) -> str:
        return f"{config.mode}-{config.resolution}px-{config.max_spp}spp"

    def part_size(self, config: RenderConfig, inputs: Inputs) -> int:
        return 4

    def environment(self, config: RenderConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        from stages.rendering.backend import choose

        return choose(config.backend, previous)

    def items(self, config: RenderConfig, inputs: Inputs) -> Iterator[Item]:
        for row in inputs["scene"].rows():
            yield Item(row.id, row.group, (("scene", row.id),))

    def open(self, config: RenderConfig, inputs: Inputs, environment: dict[str, Any]) -> RenderWorker:
        return RenderWorker(config, inputs["scene"], environment)

    def process(self, worker: RenderWorker, item: Item) -> Iterator[Record]:
        from stages.arrays import pack_json
        from stages.exr import encode_view
        from stages.records import SceneRecord
        from stages.rendering.render import render_views

        config = worker.config
        views = render_views(
            SceneRecord.from_record(worker.scenes.read(item.id)),
            config.resolution,
            max_spp=config.max_spp,
            target_error=config.target_error,
            seed=seed_for(config.seed, self.name, item.id),
            backend=worker.backend,
            mode=config.mode,
            max_depth=config.max_depth,
            denoise=config.denoise,
            lights_visible=config.lights_visible,
            threads=worker.threads,
        )
        statuses = Counter(view.meta["status"] for view in views)
        if not statuses["ok"]:
            reason = next(iter(statuses)) if len(statuses) == 1 else "no_view_left"
            raise Reject(reason, ", ".join(f"{count} {status}" for status, count in sorted(statuses.items())) or "no camera")
        members = {"meta.json": pack_json({"views": [view.meta for view in views]})}
        for view in views:
            if view.meta["status"] == "ok":
                members |= encode_view(view)
        yield Record(item.id, members)

    def finish(self, config: RenderConfig, inputs: Inputs, draft: Any) -> None:
        """``files/contact-<split>.png``, a row per scene, a column per camera; and counts of views in the manifest."""
        from stages.arrays import unpack_json

        statuses: Counter[str] = Counter()
        clamped = 0
        groups: dict[str, list[str]] = {}
        for row in draft.rows():
            groups.setdefault(row.group, []).append(row.id)
            for view in unpack_json(draft.read(row.id).members["meta.json"])["views"]:
                statuses[view["status"]] += 1
                clamped += view["clamped"]
        draft.note("views", {**{status: statuses[status] for status in ("ok", "dark", "too_close")}, "clamped_values": clamped})
        for group, ids in sorted(groups.items()):
            step = max(1, len(ids) // SHEET_SCENES)
            chosen = [draft.read(id) for id in ids[::step][:SHEET_SCENES]]
            contact_sheet(chosen).save(draft.files / f"contact-{group or 'all'}.png")


def contact_sheet(records: list[Record]) -> Any:
    """Views of rendered scenes as one sRGB picture, every scene with its own exposure; dropped views are grey."""
    from PIL import Image

    from stages.arrays import unpack_json
    from stages.exr import decode_lights
    from stages.tonemap import exposure_for, to_picture

    rows = []
    for record in records:
        views = unpack_json(record.members["meta.json"])["views"]
        names = [f"view{view['index']}.exr" for view in views]
        images = {name: decode_lights(record.members[name])[0].sum(axis=0) for name in names if name in record.members}
        exposure = exposure_for(np.concatenate(list(images.values())))
        side = len(next(iter(images.values())))
        row = np.full((side, side * len(names), 3), 128, np.uint8)
        for column, name in enumerate(names):
            if name in images:
                row[:, column * side : (column + 1) * side] = to_picture(images[name], exposure)
        rows.append(row)
    width = max(row.shape[1] for row in rows)
    sheet = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=128) for row in rows]
    return Image.fromarray(np.concatenate(sheet))
