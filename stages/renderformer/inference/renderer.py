"""Inference for users: `Renderer` for programs, ``lightmill predict`` for people.

Reads a scene or mesh file (``stages.renderformer.inference.scene_files``) or a record, and a checkpoint. Gives linear HDR
images; ``stages.renderformer.inference.output`` writes them. One design choice: frames are rendered, checked and written
one by one. So an animation of a thousand needs no more memory than a still.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import UserError
from stages.renderformer.hub import checkpoint as hub_checkpoint
from stages.renderformer.hub import is_hub
from stages.renderformer.inference.predict import light_passes, predict_frames
from stages.renderformer.inference.room import LEAST_TRIANGLES, Room
from stages.renderformer.inference.settings import PredictSettings

if TYPE_CHECKING:
    from stages.renderformer.inference.output import Output
    from stages.renderformer.records import SceneRecord

PRETRAINED = Path(__file__).resolve().parents[3] / "model" / "pretrained"  # a folder for each checkpoint that ships
SHIPPED = ("guided", "renderformer")  # their names; the first that is there is used where none is named
SHIPS = "ships:"  # begins a reference to one of them
MAX_SIDE = 8192  # pixels


class LimitWarning(UserWarning):
    """A scene is beyond a limit of the training data. It is rendered all the same."""


# --- checkpoints --------------------------------------------------------------------------------------------------------------


def shipped_checkpoints() -> dict[str, Path]:
    """Name -> folder of the models that ship with the project, the one first that is used where none is named."""
    return {name: PRETRAINED / name for name in SHIPPED if (PRETRAINED / name / "config.json").is_file()}


def shipped_checkpoint(name: str | None = None) -> Path:
    """The folder of the shipped model of that name; None: the first of `shipped_checkpoints`."""
    shipped = shipped_checkpoints()
    if not shipped:
        raise UserError(
            "no model ships with this version: train one (`make train`) and give --checkpoint train, or give "
            "--checkpoint FOLDER with a released checkpoint (config.json, model.safetensors)"
        )
    if name is not None and name not in shipped:
        raise UserError(f"{SHIPS}{name} does not ship with this version: choose from {', '.join(map(SHIPS.__add__, shipped))}")
    return shipped[name or next(iter(shipped))]


def checkpoint_name(folder: Path) -> str:
    """A checkpoint's folder for people."""
    names = [name for name, shipped in shipped_checkpoints().items() if shipped == folder]
    return f"the {names[0]} model that ships" if names else str(folder)


def checkpoint_folder(reference: Path | str | None, store: Path | str = "store") -> Path:
    """The released-format folder of a checkpoint.

    ``reference``: such a folder, ``hub:OWNER/NAME``, ``ships:NAME``, or a train artifact in the store. None: the first model
    that ships. UserError: it is none of these.
    """
    if reference is None:
        return shipped_checkpoint()
    if str(reference).startswith(SHIPS):
        return shipped_checkpoint(str(reference).removeprefix(SHIPS))
    if is_hub(reference):
        return hub_checkpoint(str(reference))
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

    checkpoint: a released-format folder, ``hub:OWNER/NAME``, ``ships:NAME`` (guided, renderformer), or a train artifact
        (``"train"``: the newest in ``store``). None: the first model that ships. device: cpu, cuda or auto.
    triangles, resolution: most triangles of a scene, and pixels per side, that the checkpoint was trained with.
    """

    def __init__(self, checkpoint: Path | str | None = None, device: str = "auto", store: Path | str = "store"):
        from model.renderformer import checkpoint as files
        from stages.graphics.device import choose_device
        from stages.renderformer.inference.limits import resolution_limit, triangle_limit

        self.folder = checkpoint_folder(checkpoint, store)
        self.device = choose_device(device, "--device")
        self.model, self.trained_with = files.load(self.folder)
        self.triangles = triangle_limit(self.trained_with)
        self.resolution = resolution_limit(self.trained_with)

    def load(self, path: Path | str, room: Room | None = None) -> SceneRecord:
        """A scene file, or a mesh file in its room. A room without a limit of triangles gets that of the training data."""
        from stages.renderformer.inference.scene_files import load_scene

        room = room or Room()
        if room.triangles is None:
            room = replace(room, triangles=max(self.triangles, LEAST_TRIANGLES))
        return load_scene(path, room)

    def render(
        self, scene: SceneRecord | Path | str, view: int = 0, resolution: int | tuple[int, int] | None = None,
        composite_lights: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """(H, W, 3) float32 linear radiance of one camera. Arguments are those of `frames`."""
        return next(self.frames(scene, [view], resolution, composite_lights))

    def frames(
        self, scene: SceneRecord | Path | str, views: Sequence[int] | None = None,
        resolution: int | tuple[int, int] | None = None, composite_lights: bool = False,
    ) -> Iterator[np.ndarray]:  # fmt: skip
        """(H, W, 3) float32 linear radiance of each of the cameras ``views`` (None: all), in order, rendered when asked for.

        resolution: pixels of the longer side, or (height, width), multiples of 8 (of 64 with a Swin view stage). None: what
            the network was trained with. All pictures are as wide as the first camera's.
        composite_lights: one pass per light, summed. Light transport is linear, so the sum is exact for a path tracer. A
            network can render more lights in this way than it was trained with.

        Warns (`LimitWarning`) of each limit of the training data that the scene is beyond. UserError: a camera or a
        resolution that does not exist; for ``composite_lights``, a scene without light.
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
        resolution = self.resolution if resolution is None else resolution
        if isinstance(resolution, int) and len(views):
            resolution = scene.picture_size(views[0], resolution, self.model.config.resolution_multiple)
        size = self._size(resolution)
        for sentence in beyond_limits(scene, views, size, self.trained_with, composite_lights):
            warnings.warn(f"{scene.id}: {sentence}", LimitWarning, stacklevel=2)
        return self._frames(scene, views, size, composite_lights)

    def _size(self, resolution: int | tuple[int, int]) -> tuple[int, int]:
        """(height, width). UserError where the network cannot render that."""
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


def predict(
    renderer: Renderer, path: Path | str, output: Output, settings: PredictSettings | None = None, room: Room | None = None
) -> list[Path]:
    """Render a scene or mesh file (``lightmill predict``); returns the files written. Notes and warnings go to stderr."""
    from stages.renderformer.inference.scene_files import print_notes

    settings = settings or PredictSettings()
    scene, views = settings.apply(renderer.load(path, room))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", LimitWarning)
        images = renderer.frames(scene, views, settings.resolution, settings.composite_lights)
    print_notes(scene)
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
    return output.write(images, settings.one_image)
