"""A drive through a baked scene: a path's pictures, as a video or as a folder of PNGs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.atomic import write_atomic
from pipeline.errors import UserError
from pipeline.store import Artifact, Store
from stages.graphics.cameras import Camera
from stages.graphics.page import png
from stages.graphics.video import write_video
from stages.neuras.baking.drawing import Drawing
from stages.neuras.evaluation import paths
from stages.neuras.evaluation.renderers import Reference, Scene, as_bytes
from stages.neuras.records import frames

OTHER = (".avi", ".gif", ".mkv", ".mov", ".webm", ".png", ".jpg", ".jpeg")  # a file of a kind that is not written
LANE = 3.0  # metres, of a report's lane change
WIDEST, WIDEST_SLOW = 1280, 480  # pixels of a report's videos, by OpenGL and by torch
RendererName = Literal["auto", "opengl", "torch"]


@dataclass(frozen=True)
class Trip:
    """What to show. trajectory: a file of poses, shown as they are; None: the capture's path, smoothed to ``frames`` pictures.

    shift: metres to the right of the path (nominal ones where the unit is unknown). size: width and height in pixels;
    None: the lens's own. ``frames`` None: as many as there are poses, or 4 seconds.
    """

    trajectory: Path | None = None
    shift: float = 0.0
    frames: int | None = None
    size: tuple[int, int] | None = None
    fps: int = 24

    def cameras(self, capture: Artifact, metre: float) -> list[Camera]:
        driven = paths.driven(frames(capture))
        if self.trajectory is not None:
            cameras = paths.read(self.trajectory, driven[0])[: self.frames]
        else:
            cameras = paths.smooth(driven, self.frames or 4 * self.fps)
        cameras = paths.beside(cameras, self.shift * metre)
        return cameras if self.size is None else [paths.framed(camera, *self.size) for camera in cameras]


def scene_of(store: Store, reference: str) -> tuple[Scene, Artifact]:
    """The scene and the capture behind an artifact of stage bake (or of a later stage)."""
    artifact = store.resolve(reference)
    if artifact.stage not in ("bake", "evaluate") or "atlas" not in artifact.manifest["preimage"]["inputs"]:
        raise UserError(f"{artifact.name} is no baked scene: give one of stage bake (`lightmill ls neuras/bake` lists them)")
    inputs = {"bake": artifact} if artifact.stage == "bake" else {}
    for role in ("capture", "atlas", "fit", "bake"):
        if role in inputs:
            continue
        found = store.by_key(artifact.manifest["preimage"]["inputs"][role])
        if found is None:
            raise UserError(f"{artifact.name}: the store no longer has its {role}; run its line again")
        inputs[role] = found
    return Scene.of(inputs), inputs["capture"]


def open_renderer(scene: Scene, name: RendererName) -> tuple[Drawing | Reference, str]:
    """The renderer of that name and a line about it. auto: the baked shader by OpenGL, or torch where there is none."""
    if name == "torch":
        return scene.reference(), "drawn by torch"
    try:
        return scene.drawing(), "drawn by the baked shader"
    except UserError as error:
        if name == "opengl":
            raise
        return scene.reference(), f"drawn by torch, slowly: {error}"


def pictures(renderer: Drawing | Reference, cameras: Iterable[Camera]) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 of each camera."""
    return (as_bytes(renderer.render(camera)) for camera in cameras)


def write(out: Path, images: Iterable[np.ndarray], fps: int) -> int:
    """An MP4 where ``out`` ends so, else a folder of frame_0000.png and so on; returns how many pictures there were.

    A video has an even size: an odd last row or column goes.
    """
    if out.suffix == ".mp4":
        return write_video(out, (image[: len(image) // 2 * 2, : image.shape[1] // 2 * 2] for image in images), fps)
    if out.suffix.lower() in OTHER:
        raise UserError(f"{out}: the output is FILE.mp4, or a folder for PNGs")
    count = 0
    for image in images:
        write_atomic(out / f"frame_{count:04d}.png", png(image))
        count += 1
    return count


def drive(store: Store, reference: str, trip: Trip, out: Path, renderer_name: RendererName = "auto") -> list[str]:
    """Render the trip; returns lines for people."""
    scene, capture = scene_of(store, reference)
    cameras: Sequence[Camera] = trip.cameras(capture, scene.info.metre)
    renderer, line = open_renderer(scene, renderer_name)
    try:
        count = write(out, pictures(renderer, cameras), trip.fps)
    finally:
        renderer.close()
    return [f"{count} frames of {cameras[0].width} x {cameras[0].height}, {line}", str(out)]


def videos(scene: Scene, capture: Artifact, count: int, opengl: bool, folder: Path) -> dict[str, Path]:
    """A video of ``count`` pictures along the drive, and one through a lane change, by caption; none where count is 0."""
    if not count:
        return {}
    along = paths.smooth(paths.driven(frames(capture)), count)
    width = min(along[0].width, WIDEST if opengl else WIDEST_SLOW)
    along = [paths.framed(camera, width, round(width * camera.height / camera.width)) for camera in along]
    over = paths.beside(along, paths.lane_change(count, LANE * scene.info.metre))
    clips = {"along the drive": ("drive.mp4", along), f"{LANE:g} m over to the right, and back": ("lane_change.mp4", over)}
    renderer, _ = open_renderer(scene, "opengl" if opengl else "torch")
    try:
        for name, cameras in clips.values():
            write(folder / name, pictures(renderer, cameras), fps=24)
    finally:
        renderer.close()
    return {caption: folder / name for caption, (name, _) in clips.items()}
