"""Predicted images as files: EXR, PNG and MP4.

Reads linear HDR images one by one and writes each before it takes the next. So an animation's length costs no memory.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError
from stages.graphics.tonemap import TONE_MAPPERS, exposure_for, to_picture

SUFFIXES = (".exr", ".png", ".mp4")


@dataclass(frozen=True)
class Output:
    """The file that images go to, and how they become pictures. UserError where they cannot be written so.

    path: .exr holds linear radiance, .png a picture (`to_picture`). .mp4 is a video of all images; their PNGs lie beside it,
        in a folder of the same name.
    tonemap: name in ``TONE_MAPPERS``, of pictures.
    exposure: factor of a picture's radiance. None: chosen by the first image, for all.
    fps: frames per second of a video.
    """

    path: Path
    tonemap: str = "none"
    exposure: float | None = 1.0
    fps: int = 24

    def __post_init__(self) -> None:
        if self._kind not in SUFFIXES:
            raise UserError(f"{self.path}: the output must end in .exr (linear), .png or .mp4")
        if not self.path.parent.is_dir():
            raise UserError(f"the folder {self.path.parent} does not exist: make it first")
        if self._kind == ".mp4":
            earlier_frames(self._frames_folder)
        if self.tonemap not in TONE_MAPPERS:
            raise UserError(f"tone mapper {self.tonemap!r} is unknown: {', '.join(TONE_MAPPERS)}")
        if self.fps < 1:
            raise UserError(f"{self.fps} frames per second: give at least 1")

    @property
    def _kind(self) -> str:
        return self.path.suffix.lower()

    @property
    def _frames_folder(self) -> Path:
        return self.path.with_suffix("")

    def write(self, images: Iterable[np.ndarray], one_image: bool) -> list[Path]:
        """Write (H, W, 3) linear images as they come; returns the files.

        ``one_image``: the file is ``path`` itself. Else the files are ``OUT-0.exr``, ``OUT-1.exr`` .., unless it is a video.
        """

        def path_of(index: int) -> Path:
            return self.path if one_image else self.path.with_name(f"{self.path.stem}-{index}{self.path.suffix}")

        if self._kind == ".mp4":
            return self._write_video(images)
        if self._kind == ".png":
            return [path for path, _ in self._write_pictures(images, path_of)]
        from stages.graphics.exr import write_rgb

        written = []
        for index, image in enumerate(images):
            write_rgb(path_of(index), image)
            written.append(path_of(index))
        return written

    def _write_video(self, images: Iterable[np.ndarray]) -> list[Path]:
        from stages.graphics.video import write_video

        folder, written = self._frames_folder, []
        earlier = earlier_frames(folder)
        folder.mkdir(exist_ok=True)

        def pictures() -> Iterator[np.ndarray]:
            for path, picture in self._write_pictures(images, lambda index: folder / f"{index:04}.png"):
                written.append(path)
                yield picture

        write_video(self.path, pictures(), self.fps)
        for path in set(earlier) - set(written):  # of a longer video of that name
            path.unlink()
        return [self.path, *written]

    def _write_pictures(
        self, images: Iterable[np.ndarray], path_of: Callable[[int], Path]
    ) -> Iterator[tuple[Path, np.ndarray]]:
        """Write each image as a PNG; yields its path and its (H, W, 3) uint8 pixels."""
        exposure, images = self.exposure, iter(images)
        if exposure is None:
            first = next(images)
            exposure, images = exposure_for(first), itertools.chain([first], images)
        for index, image in enumerate(images):
            picture = to_picture(image, exposure, self.tonemap)
            write_png(path_of(index), picture)
            yield path_of(index), picture


def earlier_frames(folder: Path) -> list[Path]:
    """Frames that an earlier video left in its folder. UserError if the folder holds anything else."""
    if not folder.exists():
        return []
    if not folder.is_dir():
        raise UserError(f"{folder} is a file, and the video's frames go into a folder of that name: give another -o")
    paths = sorted(folder.iterdir())
    for path in paths:
        if not re.fullmatch(r"[0-9]{4,}\.png", path.name):
            raise UserError(f"{folder} is for the video's frames and holds {path.name}: give another -o, or empty it")
    return paths


def write_png(path: Path, picture: np.ndarray) -> None:
    """(H, W, 3) uint8 as a PNG file, which appears whole or not at all."""
    from PIL import Image

    try:
        with atomic_path(path) as temporary:
            Image.fromarray(picture).save(temporary, format="png")
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error}): give a file in an existing folder") from error
