"""Stage capture: posed images, points and an optional mesh of one place, whatever they come as.

Reads a folder, or makes up a street; writes frame and points records and ``files/capture.json``. The variants are sources
of one shape (``stages.neuras.captures.sources.Source``), and the stage only dispatches. All end as OpenGL pinholes in a
right-handed world in the capture's own unit: what follows knows no set by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from pipeline.config import StageConfig, added, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import pack_json
from stages.neuras.captures.sources import FEWEST, FolderConfig, FolderSource, Source
from stages.neuras.captures.splits import RuleName
from stages.neuras.records import POINTS, FrameRecord, frames, point_sets, save
from stages.neuras.street.settings import StreetConfig

if TYPE_CHECKING:
    from pipeline.store import Draft


class StreetCaptureConfig(StreetConfig, StageConfig):
    """The embedded default: a street that is made up and path traced."""

    name: Literal["street"] = "street"
    backend: Literal["auto", "cuda", "llvm", "scalar"] = runtime("auto")  # of the path tracer; auto: the best that works here


class NerfstudioConfig(FolderConfig):
    """A folder with transforms.json."""

    name: Literal["nerfstudio"] = "nerfstudio"


class ColmapConfig(FolderConfig):
    """A model of COLMAP, text or binary, and its images."""

    name: Literal["colmap"] = "colmap"
    model: str | None = None  # the model's folder below capture.path; null: sparse/0, sparse or the folder itself
    images: str = "images"  # the images' folder below capture.path


class PandasetConfig(FolderConfig):
    """One sequence of PandaSet in its own layout."""

    name: Literal["pandaset"] = "pandaset"
    cameras: list[str] = Field(["front_camera"], min_length=1)  # folders below camera/
    mask_actors: bool = added(True, legacy=False)  # what moves does not count, and its points go


class BlendedMVSConfig(FolderConfig):
    """A scene of BlendedMVS in its own layout, or one of MVSNet's."""

    name: Literal["blendedmvs"] = "blendedmvs"
    split: RuleName = "random_half"  # as the paper's table 2


class NerfSyntheticConfig(FolderConfig):
    """An object of NeRF's synthetic set in its own layout."""

    name: Literal["nerf_synthetic"] = "nerf_synthetic"


class ImagesConfig(FolderConfig):
    """Photos in a folder, or a video, without poses: pycolmap finds them."""

    name: Literal["images"] = "images"
    video_frames: int = Field(80, ge=3)  # a video is cut into so many, the sharpest of each stretch
    sfm_side: int = Field(1000, ge=100)  # longest side of the pictures that features are looked for in; photos stay


FOLDERS = NerfstudioConfig | ColmapConfig | PandasetConfig | BlendedMVSConfig | NerfSyntheticConfig | ImagesConfig


class Capture(MapStage):
    name: ClassVar[str] = "capture"
    version: ClassVar[int] = 3
    Config: ClassVar[Any] = Annotated[StreetCaptureConfig | FOLDERS, Field(discriminator="name")]
    reasons: ClassVar[dict[str, str]] = {
        "no_pose": "the frame has no camera pose, or one of another shape",
        "left_handed": "the axes of its pose are mirrored",
        "scaled": "the axes of its pose are not of length 1",
        "not_rigid": "the axes of its pose are not at right angles",
        "not_finite": "a number of its pose is infinite or none",
        "no_intrinsics": "focal length, size or distortion is missing or makes no sense",
        "no_image": "the image is missing",
        "no_mask": "the mask that it names is missing",
        "no_points": "a file of points holds none",
        "unreadable": "the file is truncated, malformed or of a kind that is not read",
        "unsafe_path": "it names a file outside the capture's folder",
        "size": "the image has another size than its intrinsics",
        "mask_size": "the mask has another size than the image",
        "too_large": "the file is over the configured limits",
    }
    limits: ClassVar[dict[str, float]] = {"cpu_s": 600.0, "wall_s": 1800.0, "memory_gb": 8.0}

    def slug(self, config: StageConfig) -> str:
        return config.preset if isinstance(config, StreetCaptureConfig) else config.name

    def identity(self, config: StageConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        source = _source(config)
        return source.hashes(hash_file) if isinstance(source, FolderSource) else {}

    def environment(self, config: StageConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        from stages.graphics.mitsuba.backend import choose

        return choose(config.backend, previous) if isinstance(config, StreetCaptureConfig) else {}

    def same_environment(self, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        from stages.graphics.mitsuba.backend import same

        return same(dict(one), dict(other)) if one and other else one == other

    def max_workers(self, config: StageConfig, environment: dict[str, Any]) -> int | None:
        from stages.graphics.mitsuba.backend import max_workers

        return max_workers(environment) if environment else None

    def part_size(self, config: StageConfig, inputs: Inputs) -> int:
        return 4 if isinstance(config, StreetCaptureConfig) else 16  # a path traced frame takes seconds

    def items(self, config: StageConfig, inputs: Inputs) -> Iterable[Item]:
        return [Item(id, group) for id, group in _source(config).items()]

    def prepare(self, config: StageConfig, inputs: Inputs, folder: Path) -> None:
        """The made-up place, or the poses of images that have none: all workers look at it."""
        if isinstance(config, StreetCaptureConfig):
            from stages.neuras.street import source

            source.prepare(config, folder)
        if isinstance(config, ImagesConfig):
            from stages.neuras.captures import images

            images.prepare(config, images.root_of(config.path), folder)

    def open(self, config: StageConfig, inputs: Inputs, environment: dict[str, Any]) -> Source:
        return _source(config)

    def open_prepared(self, config: StageConfig, inputs: Inputs, environment: dict[str, Any], folder: Path) -> Source:
        if not isinstance(config, StreetCaptureConfig):
            return _source(config, folder)
        from stages.graphics.mitsuba import backend
        from stages.neuras.street.source import StreetSource

        backend.activate(environment, threads=1)
        return StreetSource(config, folder)

    def process(self, worker: Source, item: Item) -> Iterator[Record]:
        record = worker.points(item.id) if item.id.startswith(POINTS) else worker.frame(item.id)
        yield record.to_record()

    def finish(self, config: StageConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.neuras.captures import sanity, sheet

        if isinstance(config, ImagesConfig) or getattr(config, "true_mesh", False):
            draft.prepared.mkdir(exist_ok=True)
            self.prepare(config, inputs, draft.prepared)  # a run that took every frame over has not done it
        source = _source(config, draft.prepared)
        info = source.info()
        (draft.files / "capture.json").write_bytes(pack_json(info.to_json()))
        mesh = source.mesh()
        if mesh is not None:
            save(draft.files / "mesh.npz", mesh)
        place = sheet.Place(info, [record.points for record in point_sets(draft)], mesh)
        views = [replace(frame, picture=b"", depth=None) for frame in frames(draft)]  # pictures may be many
        if isinstance(source, FolderSource):
            for note in (*source.inventory.notes, *_notes(views)):
                draft.log(note)
            if len(views) < FEWEST:
                raise UserError(
                    f"{len(views)} of {len(source.shots)} frames are left, at least {FEWEST} are needed: see the reasons why "
                    "the others were rejected"
                )
        shown = [FrameRecord.from_record(draft.read(views[index].id)) for index in sheet.chosen(len(views))]
        (draft.files / "contact.png").write_bytes(sheet.drawn(views, shown, place))
        draft.note("summary", sheet.summary(views, place))
        training = [view for view in views if view.split == "train"]
        if training and isinstance(source, FolderSource):
            sanity.check(training, place.surface(), lambda id: FrameRecord.from_record(draft.read(id)))
        if info.units == "arbitrary":
            nominal = f"a hundredth of the capture's radius, {info.metre:.4g}, stands for a metre"
            draft.log(f"unit unknown ({info.source['units_from']}): {nominal}. If the set is in metres: capture.units=metre")

    def check(self, draft: Draft) -> None:
        if not draft.ids("train"):
            raise UserError("no training frame is left: see the rejected frames' reasons above")


def _notes(views: Sequence[FrameRecord]) -> list[str]:
    """Sentences about what is left of a folder's frames."""
    found = []
    hidden = [view.id for view in views if view.mask is not None and not view.counts().any()]
    if hidden:
        found.append(
            f"masks hide all of {len(hidden)} frames, such as {hidden[0]}: in a mask 0 is ignored and all else counts; "
            "transparency is not read"
        )
    if views and not any(view.split == "test" for view in views):
        found.append("no test frame is left, so nothing can be scored: capture.split=every_other or random_half hold some out")
    return found


def _source(config: StageConfig, prepared: Path | None = None) -> Source:
    """The capture. prepared: the folder that ``prepare`` wrote to; without it images without poses have none, and a street has
    no true mesh.
    """
    from stages.neuras.captures import blendedmvs, colmap, images, nerf_synthetic, nerfstudio, pandaset
    from stages.neuras.street.source import StreetSource

    if isinstance(config, StreetCaptureConfig):
        return StreetSource(config, prepared)
    if isinstance(config, ImagesConfig):
        return FolderSource(config, partial(images.read, prepared=prepared), images.root_of(config.path))
    readers = {
        "nerfstudio": nerfstudio.read,
        "colmap": colmap.read,
        "pandaset": pandaset.read,
        "blendedmvs": blendedmvs.read,
        "nerf_synthetic": nerf_synthetic.read,
    }
    return FolderSource(config, readers[config.name])
