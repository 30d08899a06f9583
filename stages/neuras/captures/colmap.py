"""Captures as a model of COLMAP, text or binary, beside its images.

World-to-camera quaternions wxyz of OpenCV cameras; pixel centres at +0.5. Files that COLMAP did not write must not make this
fail in another way than by a UserError: every count is checked against the bytes that are there.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.paths import inside
from stages.neuras.captures import poses
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.sources import Inventory, PointSet, Shot, file_in, mask_of, notes_on_masks, shot_of
from stages.neuras.records import natural

# name, in the order of the binary format's numbers -> number of parameters; those that are read have a lens below
MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12,
    "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}  # fmt: skip
READ = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


@dataclass(frozen=True, eq=False)
class PosedImage:
    """pose: quaternion wxyz and translation, world to camera. pixels: (N, 2) of what was found in it. points: (N,) the
    numbers of their 3-D points, -1 for none."""

    name: str
    camera: int
    pose: tuple[float, ...]
    pixels: np.ndarray
    points: np.ndarray


def read(config: Any, root: Path) -> Inventory:
    """The inventory of a model: ``config.model`` and ``config.images`` are folders below ``root``."""
    folder = model_folder(config.model, root)
    lenses = cameras(folder)
    shots = []
    for image in sorted(images(folder), key=lambda image: natural(image.name)):
        named = f"{config.images}/{image.name}" if config.images else image.name
        shot = shot_of(image.name, partial(_fill, image, lenses.get(image.camera), root, named))
        shot.moment = image.name
        shots.append(shot)
    found = _file(folder, "points3D")
    sets = [] if found is None else [PointSet("sfm", found, lambda: (points(folder, config.max_bytes)[1], None))]
    notes = notes_on_masks(root, shots)
    return Inventory(shots, sets, "sfm" if sets else "none", units_from="COLMAP's models have no unit", notes=notes)


def _fill(image: PosedImage, lens: Lens | None, root: Path, named: str, shot: Shot) -> None:
    """named: the image's file below ``root``."""
    if lens is None:
        raise Reject("no_intrinsics", f"the model has no camera {image.camera}")
    if lens.wrong():
        raise Reject("no_intrinsics", lens.wrong())
    shot.lens, shot.camera_to_world, shot.image = lens, camera_to_world(image), file_in(root, named, "image")
    shot.mask = mask_of(root, image.name)


def model_folder(model: str | None, root: Path) -> Path:
    """The folder with the model's files."""
    for name in (model,) if model else ("sparse/0", "sparse", "."):
        folder = root / name
        if not inside(folder, root):
            raise UserError(f"{str(folder)!r} leads out of {str(root)!r}: the model must lie in the capture's folder")
        if _file(folder, "cameras") and _file(folder, "images"):
            return folder
    where = repr(model) if model else "sparse/0, sparse or the folder itself"
    raise UserError(f"capture.path={str(root)!r} has no model of COLMAP (cameras and images, .bin or .txt) in {where}")


def camera_to_world(image: PosedImage) -> np.ndarray:
    """(4, 4), OpenGL camera; raises Reject."""
    rotation = poses.rotation_of(image.pose[:4]).T
    return poses.from_opencv(rotation, -rotation @ np.array(image.pose[4:]))


def cameras(folder: Path) -> dict[int, Lens]:
    """Lenses by the model's numbers."""
    path = _file(folder, "cameras")
    rows = _binary_cameras(path) if path.suffix == ".bin" else (line.split() for line in _text_lines(path))
    try:
        return {int(row[0]): _lens(*row[1:]) for row in rows}
    except (ValueError, IndexError, TypeError) as error:
        raise UserError(f"{folder}: a line of its cameras makes no sense: {error}") from None


def images(folder: Path) -> list[PosedImage]:
    path = _file(folder, "images")
    return list(_binary_images(path) if path.suffix == ".bin" else _text_images(path))


def points(folder: Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """(P,) int64 numbers and (P, 3) positions of the model's points; raises Reject."""
    path = _file(folder, "points3D")
    if path.stat().st_size > max_bytes:
        raise Reject("too_large", f"{path.name} has {path.stat().st_size} bytes, over capture.max_bytes={max_bytes}")
    try:
        if path.suffix == ".txt":
            rows = [row.split(maxsplit=4)[:4] for row in _text_lines(path)]
            numbers = np.array([int(row[0]) for row in rows], np.int64)
            return numbers, np.array([row[1:4] for row in rows], np.float64).reshape(-1, 3)
        return _binary_points(path)
    except (ValueError, IndexError, UserError) as error:
        raise Reject("unreadable", f"{path.name}: {str(error)[:150]}") from None


def _lens(model: str, width: Any, height: Any, *parameters: Any) -> Lens:
    if model not in READ:
        raise UserError(
            f"COLMAP's camera model {model} is not read ({', '.join(READ)} are): undistort the images "
            "(`colmap image_undistorter`), or map with another model"
        )
    p = [float(value) for value in parameters]
    if len(p) != MODELS[model]:
        raise UserError(f"a camera of COLMAP's model {model} has {len(p)} parameters, not {MODELS[model]}")
    if model.startswith("SIMPLE") or model == "RADIAL":
        fx, fy, cx, cy, rest = p[0], p[0], p[1], p[2], p[3:]
    else:
        fx, fy, cx, cy, rest = p[0], p[1], p[2], p[3], p[4:]
    if model in ("OPENCV", "FULL_OPENCV"):
        radial, tangential = (*rest[:2], *rest[4:]), (rest[2], rest[3])
    else:
        radial, tangential = tuple(rest), (0.0, 0.0)
    return Lens(int(width), int(height), fx, fy, cx, cy, radial, tangential)


def _file(folder: Path, name: str) -> Path | None:
    paths = (folder / f"{name}.bin", folder / f"{name}.txt")
    return next((path for path in paths if path.is_file() and inside(path, folder)), None)


# -- text


def _text_lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.strip() and not line.startswith("#"):
                yield line


def _text_images(path: Path) -> Iterator[PosedImage]:
    """Two lines each; the second, what was found in it, may be empty."""
    with path.open(encoding="utf-8", errors="replace") as file:
        lines = iter([line.rstrip("\n") for line in file if not line.startswith("#")])
    for line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            pose = tuple(float(word) for word in words[1:8])
            camera, name = int(words[8]), words[9].strip()
            found = np.array(next(lines, "").split(), np.float64).reshape(-1, 3)
        except (ValueError, IndexError) as error:
            raise UserError(f"{path}: the line {line[:60]!r} makes no sense: {error}") from None
        yield PosedImage(name, camera, pose, found[:, :2], found[:, 2].astype(np.int64))


# -- binary, little endian


class _Bytes:
    """A file's bytes, read from front to back; UserError past its end."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.bytes(struct.calcsize(layout)))

    def bytes(self, number: int) -> memoryview:
        if number < 0 or self.at + number > len(self.data):
            raise UserError(f"{self.path} ends too early, or is not what COLMAP wrote")
        self.at += number
        return memoryview(self.data)[self.at - number : self.at]

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        raw = bytes(self.bytes(end - self.at if end >= 0 else -1))
        self.at += 1
        return raw.decode("utf-8", errors="replace")

    def count(self, least: int) -> range:
        """As many times as the next number says, of at least ``least`` bytes each."""
        (number,) = self.take("<Q")
        if number * least > len(self.data):
            raise UserError(f"{self.path} states {number} entries in {len(self.data)} bytes")
        return range(number)


def _binary_cameras(path: Path) -> Iterator[tuple[Any, ...]]:
    source = _Bytes(path)
    for _ in source.count(24):
        number, model, width, height = source.take("<iiQQ")
        name = list(MODELS)[model] if 0 <= model < len(MODELS) else f"number {model}"
        yield number, name, width, height, *source.take(f"<{MODELS.get(name, 0)}d")


FOUND = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])


def _binary_images(path: Path) -> Iterator[PosedImage]:
    source = _Bytes(path)
    for _ in source.count(64):
        _, *pose, camera = source.take("<i7di")
        name = source.text()
        found = np.frombuffer(source.bytes(FOUND.itemsize * len(source.count(FOUND.itemsize))), FOUND)
        yield PosedImage(name, camera, tuple(pose), found["pixel"], found["point"])


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    source = _Bytes(path)
    numbers, positions = [], []
    for _ in source.count(43):
        number, x, y, z = source.take("<Q3d")
        source.bytes(11)  # colour and error
        source.bytes(8 * len(source.count(8)))  # the track
        numbers.append(number)
        positions.append((x, y, z))
    return np.array(numbers, np.int64), np.array(positions, np.float64).reshape(-1, 3)
