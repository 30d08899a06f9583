"""render: path-traced views of every scene, light by light (paper section 3.3).

Reads *scene*; writes per scene ``view<i>.exr`` and ``view<i>.aov.exr`` for every kept camera i (``stages.graphics.exr``) and
``meta.json`` with what was noted of all cameras. One design choice: radiance is stored per light, as light transport is linear:
the image under any other choice of intensities and colours is a weighted sum, at no rendering cost.

As in the paper's data, views whose mean radiance is under 0.01 or whose nearest depth is under 0.01 are dropped. Some of the
kept ones, drawn by lot, are rendered a second time: the pairs tell the noise floor (``stages.renderformer.rendering.noise``).
"""

from __future__ import annotations

import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipeline.config import StageConfig, added, runtime
from pipeline.errors import Reject
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.renderformer.rendering.settings import RenderSettings

if TYPE_CHECKING:
    from stages.renderformer.records import ViewRecord


class RenderConfig(StageConfig):
    seed: int = 0
    resolution: int = Field(64, ge=8, le=4096)  # pixels per side; the paper: 256, then 512
    target_error: float = Field(0.002, ge=0)  # of the stored image, mean absolute log10(1 + x), estimated; 0: max_spp at once
    max_spp: int = Field(16, ge=1, le=65536)  # camera paths per pixel, shared by all lights, at most; the paper: 4096
    mode: Literal["physical", "cycles"] = "physical"  # cycles: Blender Cycles' defaults, as far as they can be matched
    max_depth: int = Field(34, ge=2)  # longest path in segments: 34 is 32 bounces besides direct light
    denoise: bool = True  # Open Image Denoise, every light on its own
    lights_visible: bool = False  # whether cameras see lights; reflections always do
    adaptive: bool = added(False, False)  # samples beyond the first 16 go to the pixels that need them
    noise_share: float = Field(0.01, ge=0, le=1)  # of the views, rendered twice to tell the dataset's noise floor
    backend: Literal["auto", "cuda", "llvm", "scalar"] = runtime("auto")  # auto: the best that works here

    def settings(self, seed: int) -> RenderSettings:
        """Of a scene, whose ``seed`` follows from the stage's."""
        names = {field.name for field in fields(RenderSettings)} - {"seed"}
        return RenderSettings(seed=seed, **{name: getattr(self, name) for name in names})


class RenderWorker:
    """The chosen backend, and the scenes."""

    def __init__(self, config: RenderConfig, scenes: Any, backend: dict[str, Any]):
        self.config, self.scenes, self.backend = config, scenes, backend
        threads = os.environ.get("LIGHTMILL_THREADS")  # set by the engine in worker processes
        self.threads = int(threads) if threads else None


class Render(MapStage):
    name = "render"
    version = 6
    inputs = ("scene",)
    Config = RenderConfig
    reasons = {
        "dark": "every view's mean radiance is under 0.01",
        "too_close": "something is nearer than 0.01 scene units in every view",
        "no_view_left": "some views are dark, the others too close",
    }

    def slug(self, config: RenderConfig) -> str:
        return f"{config.mode}-{config.resolution}px-{config.max_spp}spp"

    def identity(self, config: RenderConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        # a version of its own, so that views with even samples keep their keys
        return {"adaptive": 2} if config.adaptive else {}

    def part_size(self, config: RenderConfig, inputs: Inputs) -> int:
        return 4

    def environment(self, config: RenderConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        from stages.graphics.mitsuba.backend import choose

        return choose(config.backend, previous)

    def same_environment(self, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        from stages.graphics.mitsuba.backend import same

        return same(dict(one), dict(other))

    def max_workers(self, config: RenderConfig, environment: dict[str, Any]) -> int | None:
        from stages.graphics.mitsuba.backend import max_workers

        return max_workers(environment)

    def items(self, config: RenderConfig, inputs: Inputs) -> Iterator[Item]:
        for row in inputs["scene"].rows():
            yield Item(row.id, row.group, (("scene", row.id),))

    def open(self, config: RenderConfig, inputs: Inputs, environment: dict[str, Any]) -> RenderWorker:
        return RenderWorker(config, inputs["scene"], environment)

    def process(self, worker: RenderWorker, item: Item) -> Iterator[Record]:
        from stages.graphics.arrays import pack_json
        from stages.renderformer.records import SceneRecord
        from stages.renderformer.rendering.noise import add_pairs
        from stages.renderformer.rendering.render import render_views
        from stages.renderformer.views import encode_view

        config = worker.config
        scene = SceneRecord.from_record(worker.scenes.read(item.id))

        def render(seed: int, views: list[int] | None = None) -> list[ViewRecord]:
            return render_views(scene, config.settings(seed), worker.backend, views, worker.threads)

        views = render(seed_for(config.seed, self.name, item.id))
        statuses = Counter(view.meta["status"] for view in views)
        if not statuses["ok"]:
            reason = next(iter(statuses)) if len(statuses) == 1 else "no_view_left"
            raise Reject(reason, ", ".join(f"{count} {status}" for status, count in sorted(statuses.items())) or "no camera")
        seed = seed_for(config.seed, f"{self.name}/noise", item.id)
        add_pairs(views, lambda indices: render(seed, indices), seed, config.noise_share)
        meta = {"template": scene.meta["template"], "variant": scene.meta["variant"], "lights": scene.n_lights}
        members = {"meta.json": pack_json({**meta, "views": [view.meta for view in views]})}
        for view in views:
            if view.meta["status"] == "ok":
                members |= encode_view(view)
        yield Record(item.id, members)

    def finish(self, config: RenderConfig, inputs: Inputs, draft: Any) -> None:
        """Contact sheets (``stages.renderformer.rendering.sheet``); views, samples and the noise floor in the manifest.

        One pass over the records' small ``meta.json``; images are read of the scenes on the sheets alone.
        """
        from stages.graphics.arrays import unpack_json
        from stages.renderformer.objects.catalogue import spread
        from stages.renderformer.rendering.noise import noise_floor
        from stages.renderformer.rendering.sheet import write_sheets

        statuses: Counter[str] = Counter()
        clamped = over = stalled = 0
        samples, errors = array("q"), array("d")  # of the kept views: compact, there may be millions
        pairs: list[dict[str, Any]] = []
        scenes: dict[tuple[str, str], list[str]] = {}
        for row in draft.rows():
            meta = unpack_json(draft.read(row.id, ("meta.json",)).members["meta.json"])
            scenes.setdefault((meta["template"], meta["variant"]), []).append(row.id)
            for view in meta["views"]:
                statuses[view["status"]] += 1
                clamped += view["clamped"]
                if view["status"] == "ok":
                    samples.append(view["spp"])
                    stalled += view["stalled"]
                    if view["error"] is not None:
                        errors.append(view["error"])
                        over += view["error"] > config.target_error > 0
                if "noise" in view:
                    pairs.append(view["noise"])
        draft.note("views", {**{status: statuses[status] for status in ("ok", "dark", "too_close")}, "clamped_values": clamped})
        draft.note("samples", spread(samples))
        if errors:
            draft.note("estimated_error", spread(errors))
        if samples and config.target_error:
            draft.note("share_over_target_at_max_spp", round((over - stalled) / len(samples), 5))
            draft.note("stalled_views", stalled)  # ended above the target: more samples would not have paid
        if pairs:
            draft.note("noise_floor", noise_floor(pairs))
        else:
            draft.note("noise_floor", f"no view was rendered twice: set render.noise_share above {config.noise_share:g}")
        write_sheets(draft.files, scenes, draft.read)
