"""Sequences of PandaSet in its own layout.

``camera/NAME/`` holds poses (position and heading wxyz, camera to world, OpenCV camera), intrinsics (pixel centres at whole
numbers), timestamps and numbered JPEGs; ``lidar/`` a sweep per frame as a pickle, in world coordinates. Metres, z up.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.paths import inside
from stages.neuras.captures import pickles, poses
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.pictures import size_of
from stages.neuras.captures.sources import Inventory, PointSet, Shot, file_in, shot_of


def read(config: Any, root: Path) -> Inventory:
    """The inventory of the cameras that ``config.cameras`` names. A sweep shares the moment of the frames of its number."""
    shots = [shot for camera in config.cameras for shot in _shots(root, camera)]
    sweeps = _sweeps(root)
    return Inventory(shots, sweeps, "lidar" if sweeps else "none", "metre", "PandaSet is in metres", (0.0, 0.0, 1.0))


def _shots(root: Path, camera: str) -> list[Shot]:
    folder = root / "camera" / camera
    if "/" in camera or camera.startswith(".") or not folder.is_dir():
        known = sorted(path.name for path in (root / "camera").glob("*") if path.is_dir())
        raise UserError(f"capture.cameras: {str(root)!r} has no camera {camera!r}; it has {', '.join(known) or 'none'}")
    placed, intrinsics = _json(root, folder / "poses.json", list), _json(root, folder / "intrinsics.json", dict)
    times = _json(root, folder / "timestamps.json", list)
    if len(times) != len(placed) or not all(isinstance(time, (int, float)) for time in times):
        raise UserError(f"{folder}: timestamps.json must hold one number for each of the {len(placed)} poses")
    shots = []
    for index, (pose, time) in enumerate(zip(placed, times, strict=True)):
        shot = shot_of(f"camera/{camera}/{index:02d}.jpg", partial(_fill, root, pose, intrinsics))
        shot.moment, shot.time, shot.meta = index, float(time), {"camera": camera}
        shots.append(shot)
    return shots


def _fill(root: Path, pose: Any, intrinsics: dict[str, Any], shot: Shot) -> None:
    position, heading = _pose(pose)
    shot.camera_to_world = poses.from_opencv(poses.rotation_of(heading), position)
    shot.image = file_in(root, shot.name, "image")
    shot.lens = _lens(intrinsics, *size_of(shot.image))


def _sweeps(root: Path) -> list[PointSet]:
    folder = root / "lidar"
    if not (folder / "poses.json").is_file():
        return []
    sensors = _json(root, folder / "poses.json", list)
    sets = []
    for index, pose in enumerate(sensors):
        path = folder / f"{index:02d}.pkl.gz"
        if path.is_file() and inside(path, root):  # some sequences lack a sweep
            sets.append(PointSet(f"{index:02d}", path, partial(_sweep, path, pose), index))
    return sets


def _sweep(path: Path, pose: Any) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) float32 points and (3,) the sensor, world; raises Reject."""
    sensor = np.array(_pose(pose)[0], np.float32)
    columns = pickles.table(path)
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise Reject("unreadable", f"{path.name} has no column {', '.join(missing)}")
    return np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32), sensor


def _pose(told: Any) -> tuple[list[float], list[float]]:
    """(position, heading wxyz) of an entry; raises Reject."""
    try:
        return [float(told["position"][axis]) for axis in "xyz"], [float(told["heading"][axis]) for axis in "wxyz"]
    except (KeyError, TypeError, ValueError):
        raise Reject("no_pose", "its pose has no position x, y, z and heading w, x, y, z") from None


def _lens(told: dict[str, Any], width: int, height: int) -> Lens:
    try:
        lens = Lens(width, height, float(told["fx"]), float(told["fy"]), float(told["cx"]) + 0.5, float(told["cy"]) + 0.5)
    except (KeyError, TypeError, ValueError):
        raise Reject("no_intrinsics", "intrinsics.json has no numbers fx, fy, cx, cy") from None
    if lens.wrong():
        raise Reject("no_intrinsics", f"{lens.wrong()}: the images may have been made smaller than the set's 1920 x 1080")
    return lens


def _json(root: Path, path: Path, kind: type) -> Any:
    if not inside(path, root):
        raise UserError(f"{str(path)!r} leads out of {str(root)!r}")
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"there is no {str(path)!r}: capture=pandaset reads a sequence in PandaSet's own layout") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{str(path)!r} is not JSON: {error}") from None
    if not isinstance(value, kind):
        raise UserError(f"{str(path)!r} does not hold a {kind.__name__}")
    return value
