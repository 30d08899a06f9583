"""Stage evaluate: how well a fitted scene shows what it was not fitted to, against multi-view warping (section 4).

Reads capture's held-out and shifted frames, and atlas, fit and bake. Writes one record per frame: the photo, ours by torch,
with and without residuals, ours by the baked shader where OpenGL is, warping, the difference, and ``metrics.json``. ``files/``
gets report.html, metrics.json, timing.json, and videos along the drive and through a lane change. Times are never the same
twice, so they stay out of the records and of metrics.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from pipeline.config import StageConfig, added, report, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.lpips_setting import NONE, LpipsSetting, lpips_networks

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.store import Draft
    from stages.graphics.cameras import Camera
    from stages.neuras.evaluation.renderers import Scene
    from stages.neuras.evaluation.views import Examiner, Photos


class EvaluateConfig(StageConfig):
    splits: tuple[Literal["validation", "test", "shift"], ...] = Field(("test", "shift"), min_length=1)
    warping_views: int = Field(4, ge=1)  # nearest photos that warping takes for a view
    depth_tolerance: float = Field(0.05, gt=0)  # of the mesh, relative to the true depth
    exposure: Literal["none", "half"] = added("none", legacy="none")  # half: found on the left half, scored on the right
    poses: Literal["none", "half"] = added("none", legacy="none")  # half: camera aligned on the left half, scored on the right
    lpips: LpipsSetting = NONE
    lpips_folder: str | None = runtime(None)  # where its weights lie; None: see model.weights
    inception: bool = report(False)  # FID and KID beside the drive
    inception_folder: str | None = runtime(None)  # where its weights lie
    shifts_m: tuple[float, ...] = report((2.0, 3.0))  # of FID and KID where the capture has no frames beside the drive
    gallery: int = report(15, ge=0)  # views shown in the report
    video_frames: int = report(72, ge=0)  # of each video, 0: none
    timing_frames: int = report(3, ge=0)  # frames timed, 0: none
    timing_size: tuple[int, int] = report((1920, 1080))  # width and height in pixels
    page_views: int = report(6, ge=0)  # frames that a browser draws, 0: none


class Evaluate(MapStage):
    name: ClassVar[str] = "evaluate"
    version: ClassVar[int] = 4
    inputs: ClassVar[tuple[str, ...]] = ("capture", "atlas", "fit", "bake")
    Config: ClassVar[Any] = EvaluateConfig
    headline: ClassVar[str | None] = "report.html"
    reasons: ClassVar[dict[str, str]] = {"masked": "its mask leaves almost no pixel to compare"}

    def agree(self, config: EvaluateConfig, configs: Mapping[str, StageConfig]) -> None:
        """Weights that are missing are missed before anything runs."""
        from model.inception import Inception
        from model.lpips import LPIPS

        for network in lpips_networks(config.lpips):
            LPIPS.files(config.lpips_folder, network)
        if config.inception:
            Inception.file(config.inception_folder)

    def slug(self, config: EvaluateConfig) -> str:
        return "-".join(config.splits)

    def part_size(self, config: EvaluateConfig, inputs: Inputs) -> int:
        return 4

    def environment(self, config: EvaluateConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        """What draws by OpenGL, one for the whole artifact: another rounds otherwise. None: nothing does."""
        from stages.neuras.evaluation.renderers import opengl

        if previous is not None and previous["opengl"] is None:
            return previous
        here = opengl()
        if previous is not None and previous["opengl"] != here:
            raise UserError(
                f"this evaluation was begun with {previous['opengl']}, and here is {here or 'no OpenGL'}: "
                "go on with that one, or begin anew with force=evaluate"
            )
        return {"opengl": here}

    def items(self, config: EvaluateConfig, inputs: Inputs) -> Iterator[Item]:
        rows = [row for row in inputs["capture"].rows() if row.group in config.splits]
        if not rows:
            raise UserError(
                f"evaluate.splits={list(config.splits)}: the capture has no such frame; capture.split holds some out"
            )
        return (Item(row.id, row.group) for row in rows)

    def open(self, config: EvaluateConfig, inputs: Inputs, environment: dict[str, Any]) -> tuple[Examiner, Photos]:
        import torch

        from stages.graphics.geometry import one_thread
        from stages.neuras.evaluation.renderers import Scene
        from stages.neuras.evaluation.scores import scorers
        from stages.neuras.evaluation.views import Aligner, Examiner, Photos, warping

        one_thread()
        torch.set_num_threads(1)
        scene, capture = Scene.of(inputs), inputs["capture"]
        reference = scene.reference()
        photos = Photos(capture, inputs["fit"])
        examiner = Examiner(
            reference,
            {} if environment["opengl"] is None else {kind: scene.drawing(kind) for kind in ("fp16", "rgba8")},
            warping(photos, reference, scene.info.radius, config.warping_views),
            scorers(lpips_networks(config.lpips), config.lpips_folder),
            config.depth_tolerance,
            config.exposure == "half",
            Aligner(photos, scene.atlas) if config.poses == "half" else None,
        )
        return examiner, photos

    def process(self, worker: tuple[Examiner, Photos], item: Item) -> Iterator[Record]:
        from stages.graphics.arrays import pack_json
        from stages.graphics.page import png

        examiner, photos = worker
        facts, pictures = examiner.examine(photos.read(item.id))
        yield Record(item.id, {"metrics.json": pack_json(facts), **{f"{name}.png": png(p) for name, p in pictures.items()}})

    def finish(self, config: EvaluateConfig, inputs: Inputs, draft: Draft) -> None:
        from pipeline.store.files import write_json
        from stages.graphics.arrays import unpack_json
        from stages.neuras.evaluation import costs, drive, report
        from stages.neuras.evaluation.renderers import Scene
        from stages.neuras.evaluation.summary import summarise
        from stages.neuras.records import fitted_poses, frames, posed

        views = [unpack_json(draft.read(row.id, ("metrics.json",)).members["metrics.json"]) for row in draft.rows()]
        scene, site = Scene.of(inputs), inputs["bake"].file("site")
        cameras = {
            frame.id: frame.camera for frame in posed(frames(inputs["capture"], *config.splits), fitted_poses(inputs["fit"]))
        }
        drawn_by = (draft.environment() or {})["opengl"]
        summary = summarise(views)
        summary["device"] = costs.device_bytes(scene)
        summary["storage"] = costs.storage(site, scene.baked)
        timing: dict[str, Any] = {}
        missing = report.without_weights(bool(lpips_networks(config.lpips)), config.inception)
        if drawn_by is None:
            missing.append(report.NO_OPENGL)
        elif config.timing_frames:
            some = list(cameras.values())[:: max(1, len(cameras) // config.timing_frames)][: config.timing_frames]
            timing["opengl"] = {"drawn_by": drawn_by, **costs.time_shader(scene, some, config.timing_size)}
        if config.page_views:
            missing += _page(config, scene, site, cameras, summary, timing)
        clips = drive.videos(scene, inputs["capture"], config.video_frames, drawn_by is not None, draft.files)
        about = report.About(inputs, draft.key, config.model_dump(mode="json"), drawn_by)

        def picture(frame: str, name: str) -> bytes:
            return draft.read(frame, (f"{name}.png",)).members[f"{name}.png"]

        if config.inception:
            summary["distributions"] = _distributions(config, scene, inputs, summary, picture)
        write_json(draft.files / "metrics.json", summary)
        write_json(draft.files / "timing.json", timing)
        html = report.page(about, summary, timing, missing, clips, picture)
        (draft.files / "report.html").write_text(html, encoding="utf-8")
        (draft.files / "overview.png").write_bytes(report.overview(summary, picture))
        draft.note("summary", report.headline(summary))
        for line in report.lines(summary):
            draft.log(line)
        draft.log(f"page: {site / 'index.html'}, to be served: python -m http.server --bind 127.0.0.1 -d {site}")

    def check(self, draft: Draft) -> None:
        assert (draft.files / "report.html").is_file(), "evaluate wrote no report"


def _distributions(
    config: EvaluateConfig,
    scene: Scene,
    inputs: Inputs,
    summary: dict[str, Any],
    picture: Callable[[str, str], bytes],
) -> list[dict[str, Any]]:
    """FID and KID of views beside the drive, against the photos along it."""
    from stages.neuras.evaluation import distributions
    from stages.neuras.records import frames

    sets, pictures = distributions.photographed(summary["groups"], picture)
    if not sets:
        along = [split for split in config.splits if split != "shift"]
        sets, pictures = distributions.imagined(scene, inputs, along, config.shifts_m, config.warping_views)
    photos = (frame.image() for frame in frames(inputs["capture"], "train", "validation", "test"))
    return distributions.judge(sets, pictures, photos, config.inception_folder)


def _page(
    config: EvaluateConfig,
    scene: Scene,
    site: Path,
    cameras: dict[str, Camera],
    summary: dict[str, Any],
    timing: dict[str, Any],
) -> list[str]:
    """Add what a browser draws to the summary and how long it takes to the times; returns what is missing."""
    from stages.neuras.evaluation.browsing import compare_page
    from stages.neuras.evaluation.report import no_page

    try:
        page = compare_page(site, scene.reference(), cameras, config.page_views)
    except RuntimeError as error:
        return [no_page(error)]
    summary["page"] = page["views"]
    timing["page"] = {name: page[name] for name in ("size", "ms")}
    return []
