"""Inference for users: `Renderer` for programs, ``lightmill predict`` for people.

Reads a scene or mesh file (``stages.renderformer.inference.scene_files``) or a record, and a checkpoint; gives linear HDR
images, writes EXR, PNG and MP4 files. One design choice: frames are made, checked and written one by one, whether there is
one or a thousand.
"""

from __future__ import annotations

import itertools
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError
from stages.renderformer.inference.predict import light_passes, predict_frames

if TYPE_CHECKING:
    from stages.renderformer.inference.room import Room
    from stages.renderformer.records import SceneRecord

PRETRAINED = Path(__file__).resolve().parents[3] / "model" / "pretrained"  # the checkpoint that ships, if one does
MAX_SIDE = 8192  # pixels


class LimitWarning(UserWarning):
    """A scene is beyond what the checkpoint was trained with: it is rendered all the same."""


# --- checkpoints --------------------------------------------------------------------------------------------------------------


def shipped_checkpoint() -> Path:
    """The folder of the model that ships with the project."""
    if not (PRETRAINED / "config.json").is_file():
        raise UserError(
            "no model ships with this version: train one (`make train`) and give --checkpoint train, or give "
            "--checkpoint FOLDER with a released checkpoint (config.json, model.safetensors)"
        )
    return PRETRAINED


def checkpoint_folder(reference: Path | str | None, store: Path | str = "store") -> Path:
    """A released-format checkpoint folder as given, or that of a train artifact in the store; None: the one that ships."""
    if reference is None:
        return shipped_checkpoint()
    folder = Path(reference)
    if (folder / "config.json").is_file():
        return folder
    if folder.is_dir() and not (folder / "manifest.json").is_file():
        raise UserError(f"{reference} is no checkpoint folder: it has no config.json (and no model.safetensors beside it)")
    if folder.is_file():
        raise UserError(f"{reference} is a file: a checkpoint is the folder that holds config.json and model.safetensors")
    if folder.is_absolute() and not folder.exists():  # not the name of an artifact
        raise UserError(f"{reference} does not exist: give a released checkpoint's folder, or a train artifact")
    from pipeline.store import Store

    artifact = Store(store).resolve(str(reference))
    if artifact.stage != "train":
        raise UserError(
            f"{reference} is an artifact of stage {artifact.stage}: give one of stage train, or a checkpoint folder"
        )
    return artifact.file("checkpoint")


# --- images -------------------------------------------------------------------------------------------------------------------


class Renderer:
    """A trained network that renders scenes.

    checkpoint: a released-format folder, or a train artifact (``"train"``: the newest in ``store``); None: what ships.
    device: cpu, cuda or auto.
    """

    def __init__(self, checkpoint: Path | str | None = None, device: str = "auto", store: Path | str = "store"):
        from model.renderformer import checkpoint as files
        from stages.graphics.device import choose_device
        from stages.renderformer.inference.limits import resolution_limit, triangle_limit

        self.folder = checkpoint_folder(checkpoint, store)
        self.device = choose_device(device, "--device")
        self.model, self.trained_with = files.load(self.folder)
        self.triangles = triangle_limit(self.trained_with)  # of a scene; beyond, expect worse images
        self.resolution = resolution_limit(self.trained_with)  # pixels per side, what is rendered unless told otherwise

    def load(self, path: Path | str, triangles: int | None = None, room: Room | None = None) -> SceneRecord:
        """A scene file, or a mesh file in its room, decimated to what the network was trained with (or to ``triangles``)."""
        from stages.renderformer.inference.room import LEAST_TRIANGLES
        from stages.renderformer.inference.scene_files import load_scene

        return load_scene(path, triangles or max(self.triangles, LEAST_TRIANGLES), room)

    def render(
        self, scene: SceneRecord | Path | str, view: int = 0, resolution: int | tuple[int, int] | None = None,
        composite_lights: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """(H, W, 3) float32 linear radiance of one camera; the arguments as of `frames`."""
        return next(self.frames(scene, [view], resolution, composite_lights))

    def frames(
        self, scene: SceneRecord | Path | str, views: Sequence[int] | None = None,
        resolution: int | tuple[int, int] | None = None, composite_lights: bool = False,
    ) -> Iterator[np.ndarray]:  # fmt: skip
        """(H, W, 3) float32 linear radiance of each of the cameras ``views`` (None: all), in order, as they are asked for.

        resolution: pixels per side, or (height, width), multiples of 8 (of 64 with a Swin view stage); None: what the
        network was trained with. composite_lights: one pass per light, summed: exact for a path tracer (light transport is
        linear), and for a network a way to more lights than it was trained with. Warns (`LimitWarning`) of each limit of
        the training data that the scene is beyond.
        """
        from stages.renderformer.inference.limits import beyond_limits
        from stages.renderformer.inference.scene_files import check_lit

        scene = self.load(scene) if isinstance(scene, (str, Path)) else scene
        count = len(scene.fov_deg)
        views = range(count) if views is None else views
        for view in views:
            if not 0 <= view < count:
                raise UserError(f"view {view} of {scene.id} does not exist: it has cameras 0 to {count - 1}")
        if composite_lights:
            check_lit(scene, scene.id)
        size = self._size(self.resolution if resolution is None else resolution)
        for sentence in beyond_limits(scene, views, size, self.trained_with, composite_lights):
            warnings.warn(f"{scene.id}: {sentence}", LimitWarning, stacklevel=2)
        return self._frames(scene, views, size, composite_lights)

    def _size(self, resolution: int | tuple[int, int]) -> tuple[int, int]:
        """(height, width), as the network can have it."""
        size = (resolution, resolution) if isinstance(resolution, int) else (int(resolution[0]), int(resolution[1]))
        multiple = self.model.config.resolution_multiple
        for side in size:
            if side % multiple or not multiple <= side <= MAX_SIDE:
                near = min(max(side // multiple, 1) * multiple, MAX_SIDE - multiple)
                raise UserError(
                    f"resolution {side} must be a multiple of {multiple} pixels for this checkpoint, at most {MAX_SIDE:,}: "
                    f"for example {near} or {near + multiple}"
                )
        return size

    def _frames(
        self, scene: SceneRecord, views: Sequence[int], size: tuple[int, int], composite_lights: bool
    ) -> Iterator[np.ndarray]:
        passes = list(light_passes(scene)) if composite_lights else [(scene, 1.0)]
        predicted = [predict_frames(self.model, lit, views, size, self.device) for lit, _ in passes]
        for layers in zip(*predicted, strict=True):
            frame = sum(np.float32(share) * layer for layer, (_, share) in zip(layers, passes, strict=True))
            if not np.isfinite(frame).all():
                raise UserError(f"{self.folder} predicts NaN or infinity for {scene.id}: its training has diverged")
            yield frame


# --- the command --------------------------------------------------------------------------------------------------------------


def predict(
    scene_path: Path | str,
    checkpoint: Path | str | None,
    out: Path,
    resolution: int | tuple[int, int] | None = None,
    view: int | str = 0,
    device: str = "auto",
    *,
    frames: int | None = None,
    arc_deg: float | None = None,
    fps: int = 24,
    tonemap: str = "none",
    exposure: float | None = 1.0,
    composite_lights: bool = False,
    triangles: int | None = None,
    room: Room | None = None,
    store: Path | str = "store",
) -> list[Path]:
    """Render a scene or mesh file; returns the files written (``OUT-0.exr``, ... where there are several images).

    frames: an orbit of so many around camera ``view`` instead of the view itself (``stages.renderformer.inference.orbit``).
    The suffix of ``out`` decides: .exr holds linear radiance, .png a picture (`to_picture`), .mp4 a video of all frames
    beside a folder with their PNGs. exposure: factor of a picture's radiance; None: chosen by the first frame, for all.
    """
    from stages.graphics.tonemap import TONE_MAPPERS
    from stages.renderformer.inference.orbit import orbit

    if out.suffix.lower() not in (".exr", ".png", ".mp4"):
        raise UserError(f"{out}: the output must end in .exr (linear), .png or .mp4")
    if not out.parent.is_dir():
        raise UserError(f"the folder {out.parent} does not exist: make it first")
    if out.suffix.lower() == ".mp4":
        earlier_frames(out.with_suffix(""))
    if tonemap not in TONE_MAPPERS:
        raise UserError(f"tone mapper {tonemap!r} is unknown: {', '.join(TONE_MAPPERS)}")
    if fps < 1:
        raise UserError(f"{fps} frames per second: give at least 1")
    renderer = Renderer(checkpoint, device, store)
    scene = renderer.load(scene_path, triangles, room)
    count = len(scene.fov_deg)
    if view == "all" and frames is not None:
        raise UserError("an orbit starts at one camera: give --view N instead of --view all")
    if view != "all" and not (isinstance(view, int) and 0 <= view < count):
        raise UserError(f"view {view} of {scene_path} does not exist: it has cameras 0 to {count - 1}, or say all")
    if frames is not None:
        scene = orbit(scene, frames, view, arc_deg)
    views = None if view == "all" or frames is not None else [view]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LimitWarning)
        images = renderer.frames(scene, views, resolution, composite_lights)
    for note in scene.meta.get("notes", ()):
        print(f"note: {note}", file=sys.stderr)
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    return write_frames(out, images, views is None, fps, tonemap, exposure)


def write_frames(
    out: Path, images: Iterable[np.ndarray], several: bool, fps: int = 24, tonemap: str = "none", exposure: float | None = 1.0
) -> list[Path]:
    """Write (H, W, 3) linear images as they come, as ``predict`` says; returns the files."""
    from stages.graphics.exr import write_rgb
    from stages.graphics.tonemap import exposure_for, to_picture
    from stages.graphics.video import write_video

    images = iter(images)
    if exposure is None:
        first = next(images)
        exposure, images = exposure_for(first), itertools.chain([first], images)
    kind, written = out.suffix.lower(), []

    def pictures(place: Callable[[int], Path]) -> Iterator[np.ndarray]:
        for index, image in enumerate(images):
            picture = to_picture(image, exposure, tonemap)
            write_png(place(index), picture)
            written.append(place(index))
            yield picture

    if kind == ".mp4":
        folder = out.with_suffix("")
        earlier = earlier_frames(folder)
        folder.mkdir(exist_ok=True)
        write_video(out, pictures(lambda index: folder / f"{index:04}.png"), fps)
        for path in set(earlier) - set(written):  # of a longer video of that name
            path.unlink()
        return [out, *written]

    def place(index: int) -> Path:
        return out.with_name(f"{out.stem}-{index}{out.suffix}") if several else out

    if kind == ".png":
        for _ in pictures(place):
            pass
        return written
    for index, image in enumerate(images):
        written.append(place(index))
        write_rgb(written[-1], image)
    return written


def earlier_frames(folder: Path) -> list[Path]:
    """What a video's folder holds of an earlier one. UserError if it holds anything else."""
    if not folder.exists():
        return []
    if not folder.is_dir():
        raise UserError(f"{folder} is a file, and the video's frames go into a folder of that name: give another -o")
    entries = sorted(folder.iterdir())
    for path in entries:
        if not re.fullmatch(r"[0-9]{4,}\.png", path.name):
            raise UserError(f"{folder} is for the video's frames and holds {path.name}: give another -o, or empty it")
    return entries


def write_png(path: Path, picture: np.ndarray) -> None:
    """(H, W, 3) uint8 as a PNG file, which appears whole or not at all."""
    from PIL import Image

    try:
        with atomic_path(path) as temporary:
            Image.fromarray(picture).save(temporary, format="png")
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error}): give a file in an existing folder") from error
