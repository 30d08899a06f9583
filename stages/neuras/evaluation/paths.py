"""Where a camera goes: along the capture's own path, beside it, from lane to lane, or as a file says."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.neuras.records import FrameRecord, natural

RIGID = 1e-3  # how far a pose's axes may be from length 1 and right angles
LENS = ("fl_x", "fl_y", "cx", "cy", "w", "h")  # what a file may say of the lens, all of it or nothing


def driven(frames: Iterable[FrameRecord]) -> list[Camera]:
    """The cameras of the frames on the driven path, in the order of their times, or of their ids where one has none.

    Of several cameras that drove together, those of the one that looks ahead.
    """
    along = [frame for frame in frames if frame.split != "shift"]
    timed = all(frame.time is not None for frame in along)
    along = sorted(along, key=lambda frame: (frame.time if timed else 0, natural(frame.id)))
    paths: dict[Any, list[Camera]] = {}
    for frame in along:
        paths.setdefault(frame.meta.get("camera"), []).append(frame.camera)
    return max(paths.values(), key=_looks_ahead)


def _looks_ahead(path: Sequence[Camera]) -> float:
    """How far the cameras came in the directions that they look in, world units."""
    return sum(float(a.forward @ (b.position - a.position)) for a, b in zip(path[:-1], path[1:], strict=True))


def smooth(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """``count`` cameras through all of these, at a constant speed, with the lens of the first."""
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    steps = [np.linalg.norm(b.position - a.position) for a, b in zip(cameras[:-1], cameras[1:], strict=True)]
    way = np.concatenate([[0.0], np.cumsum(steps)])
    kept = np.flatnonzero(np.concatenate([[True], np.diff(way) > 1e-9]))
    first = cameras[0]
    if len(kept) == 1:
        return [first] * count
    places = np.linspace(0, way[-1], count)
    positions = PchipInterpolator(way[kept], [cameras[i].position for i in kept])(places)
    turns = Slerp(way[kept], Rotation.from_matrix([cameras[i].camera_to_world[:3, :3] for i in kept]))(places).as_matrix()
    return [_at(first, turn, position) for turn, position in zip(turns, positions, strict=True)]


def beside(cameras: Sequence[Camera], shift: float | Sequence[float]) -> list[Camera]:
    """The cameras moved by ``shift`` to their right, world units, each by its own where there is one for each."""
    shifts = np.broadcast_to(np.asarray(shift, float), len(cameras))
    return [camera.moved(np.array([by, 0.0, 0.0])) for camera, by in zip(cameras, shifts, strict=True)]


def framed(camera: Camera, width: int, height: int) -> Camera:
    """The camera with a picture of another size: as much above and below, more or less at both sides."""
    scale = height / camera.height
    cx = camera.cx * scale + (width - camera.width * scale) / 2
    return replace(camera, width=width, height=height, fx=camera.fx * scale, fy=camera.fy * scale, cx=cx, cy=camera.cy * scale)


def lane_change(count: int, shift: float) -> np.ndarray:
    """(count,) shifts of a path: on the lane, gently over to ``shift``, and back."""
    phase = np.linspace(0, 1, count)
    ramp = np.clip(np.minimum(phase - 0.15, 0.85 - phase) / 0.25, 0, 1)
    return shift * ramp**2 * (3 - 2 * ramp)


def read(path: Path, lens: Camera) -> list[Camera]:
    """The cameras of a JSON file: a list of poses, or ``transforms.json``. UserError where it is malformed.

    A pose is a camera-to-world matrix (4 x 4, or its first three rows) or ``{"transform_matrix": ..}``; the camera looks
    along -z, +y up, in the capture's own world. ``lens``: used unless the file has fl_x, fl_y, cx, cy, w and h.
    """
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON: {error}") from None
    poses = document.get("frames") if isinstance(document, dict) else document
    if not isinstance(poses, list) or not poses:
        raise UserError(f'{path} holds no poses: expected a list of 4 x 4 camera-to-world matrices, or {{"frames": [..]}}')
    if isinstance(document, dict) and any(name in document for name in LENS):
        lens = _lens(path, document, lens)
    cameras = []
    for number, pose in enumerate(poses):
        matrix = _matrix(pose.get("transform_matrix") if isinstance(pose, dict) else pose)
        if isinstance(matrix, str):
            raise UserError(f"{path}: pose {number} {matrix}")
        cameras.append(replace(lens, camera_to_world=matrix))
    return cameras


def _lens(path: Path, document: dict[str, Any], lens: Camera) -> Camera:
    try:
        fx, fy, cx, cy, width, height = (float(document[name]) for name in LENS)
    except (KeyError, TypeError, ValueError):
        raise UserError(f"{path}: give all of {', '.join(LENS)} as numbers, or none") from None
    if not (fx > 0 and fy > 0 and width >= 1 and height >= 1 and np.isfinite([fx, fy, cx, cy, width, height]).all()):
        raise UserError(f"{path}: focal lengths and the image's size must be above 0")
    return replace(lens, width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


def _matrix(pose: Any) -> np.ndarray | str:
    """(4, 4) rigid, or what is wrong with it."""
    try:
        given = np.array(pose, float)
    except (TypeError, ValueError):
        return "is no matrix of numbers"
    if given.shape not in ((3, 4), (4, 4)) or not np.isfinite(given).all():
        return "is no finite 4 x 4 or 3 x 4 matrix"
    matrix = np.eye(4)
    matrix[:3] = given[:3]
    turn = matrix[:3, :3]
    if np.abs(turn.T @ turn - np.eye(3)).max() > RIGID or np.linalg.det(turn) < 0:
        return "is not rigid: its axes must have length 1, stand at right angles and be right-handed"
    return matrix


def _at(camera: Camera, turn: np.ndarray, position: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, position
    return replace(camera, camera_to_world=pose)
