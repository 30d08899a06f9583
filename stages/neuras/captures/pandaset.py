"""Sequences of PandaSet in its own layout.

``camera/NAME/`` holds poses (position and heading wxyz, camera to world, OpenCV camera), intrinsics (pixel centres at whole
numbers), timestamps and numbered JPEGs; ``lidar/`` a sweep per frame as a pickle, in world coordinates;
``annotations/cuboids/`` the boxes of things per frame, likewise. Metres, z up.

The boxes stand where things are when the LiDAR meets them, and the front camera is exposed as it sweeps ahead. The forward
LiDAR comes up to 0.1 s later; things in its view have a box of their own for it.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry import paths
from stages.neuras.captures import pickles, poses
from stages.neuras.captures.actors import Box, inside, outline
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.pictures import size_of
from stages.neuras.captures.sources import Inventory, PointSet, Shot, file_in, json_in, shot_of

COLUMNS = ("position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z", "yaw")
MOTION = "attributes.object_motion"
MARGIN_M = 0.25  # around a box: its edges are rough, and wheels and mirrors stand out
MOST_BOXES = 10_000  # of a frame
SIZE = (1920, 1080)  # of its images, in pixels
MIDDLE = 890  # principal points of the set lie farther right than this: intrinsics that do are for its own size

Boxes = dict[int, list[Box]]  # of actors, by frame


def read(config: Any, root: Path) -> Inventory:
    """The inventory of the cameras that ``config.cameras`` names. A sweep shares the moment of the frames of its number."""
    boxes = _actors(root) if config.mask_actors else {}
    shots = [shot for camera in config.cameras for shot in _shots(root, camera, boxes)]
    unseen = [shot.moment for shot in shots if shot.moment not in boxes] if config.mask_actors else []
    if unseen:
        raise UserError(
            f"{str(root)!r} has no annotations/cuboids/{unseen[0]:02d}.pkl.gz, so what moves in that frame cannot be masked: "
            "unpack the annotations too; capture.mask_actors=false does without"
        )
    sweeps = _sweeps(root, boxes)
    return Inventory(shots, sweeps, "lidar" if sweeps else "none", "metre", "PandaSet is in metres", (0.0, 0.0, 1.0))


def _shots(root: Path, camera: str, boxes: Boxes) -> list[Shot]:
    folder = root / "camera" / camera
    if "/" in camera or camera.startswith(".") or not folder.is_dir():
        known = sorted(path.name for path in (root / "camera").glob("*") if path.is_dir())
        raise UserError(f"capture.cameras: {str(root)!r} has no camera {camera!r}; it has {', '.join(known) or 'none'}")
    placed, intrinsics = json_in(root, folder / "poses.json", list), json_in(root, folder / "intrinsics.json", dict)
    times = json_in(root, folder / "timestamps.json", list)
    if len(times) != len(placed) or not all(isinstance(time, (int, float)) and abs(time) < 1e300 for time in times):
        raise UserError(f"{folder}: timestamps.json must hold one number for each of the {len(placed)} poses")
    shots = []
    for index, (pose, time) in enumerate(zip(placed, times, strict=True)):
        fill = partial(_fill, root, pose, intrinsics, boxes.get(index, []))
        shot = shot_of(f"camera/{camera}/{index:02d}.jpg", fill)
        shot.moment, shot.time, shot.meta = index, float(time), {"camera": camera}
        shots.append(shot)
    return shots


def _fill(root: Path, pose: Any, intrinsics: dict[str, Any], boxes: list[Box], shot: Shot) -> None:
    position, heading = _pose(pose)
    shot.camera_to_world = poses.from_opencv(poses.rotation_of(heading), position)
    shot.image = file_in(root, shot.name, "image")
    shot.lens = _lens(intrinsics, *size_of(shot.image))
    camera = shot.lens.camera(shot.camera_to_world)
    seen = [outline(box.grown(MARGIN_M, MARGIN_M), camera) for box in boxes]  # below: its shadow
    shot.outlines = [polygon.round(2).tolist() for polygon in seen if polygon is not None]


def _sweeps(root: Path, boxes: Boxes) -> list[PointSet]:
    folder = root / "lidar"
    if not (folder / "poses.json").is_file():
        return []
    sensors = json_in(root, folder / "poses.json", list)
    sets = []
    for index, pose in enumerate(sensors):
        path = folder / f"{index:02d}.pkl.gz"
        if path.is_file() and paths.inside(path, root):  # some sequences lack a sweep
            here = [box.grown(MARGIN_M, 0) for box in boxes.get(index, [])]  # the road below stays
            facts = [[box.centre, box.size, box.yaw] for box in here] or None
            sets.append(PointSet(f"{index:02d}", path, partial(_sweep, path, pose, here), index, facts))
    return sets


def _sweep(path: Path, pose: Any, boxes: list[Box]) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) float32 points outside ``boxes``, and (3,) the sensor, world; raises Reject."""
    sensor = np.array(_pose(pose)[0], np.float32)
    columns = pickles.table(path)
    missing = [name for name in "xyz" if name not in columns]
    if missing:
        raise Reject("unreadable", f"{path.name} has no column {', '.join(missing)}")
    points = np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float32)
    return points[~inside(points, boxes)], sensor


def _actors(root: Path) -> Boxes:
    """The boxes of everything that moves in some frame, or waits to: stopped cars, and people though they stand."""
    tables = {}
    for path in sorted((root / "annotations" / "cuboids").glob("[0-9]*.pkl.gz")):
        if paths.inside(path, root) and path.name.split(".")[0].isdecimal():
            tables[int(path.name.split(".")[0])] = _cuboids(path)
    moving = {name for table in tables.values() for name in table["uuid"][_moves(table)]}
    return {
        index: [
            Box(tuple(row[:3]), tuple(row[3:6]), row[6])
            for name, row in zip(table["uuid"], np.stack([table[name] for name in COLUMNS], axis=1).tolist(), strict=True)
            if name in moving and np.isfinite(row).all()
        ]
        for index, table in tables.items()
    }


def _cuboids(path: Path) -> dict[str, np.ndarray]:
    """The columns of a frame's cuboids; UserError where they cannot be used, because actors would stay unseen."""
    try:
        table = pickles.table(path)
    except Reject as error:
        raise UserError(f"{str(path)!r} cannot be read: {error.detail}; capture.mask_actors=false does without") from None
    missing = [name for name in ("uuid", "label", MOTION, "stationary", *COLUMNS) if name not in table]
    if missing or len(table["uuid"]) > MOST_BOXES:
        what = f"no column {', '.join(missing)}" if missing else f"{len(table['uuid'])} boxes"
        raise UserError(
            f"{str(path)!r} has {what}: it is no table of PandaSet's cuboids; capture.mask_actors=false does without"
        )
    return table


def _moves(table: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) bool: rows of what moves, or may at any moment."""
    people = np.array([str(label).startswith(("Pedestrian", "Animal")) for label in table["label"]], bool)
    return (table["stationary"] == 0) | np.isin(table[MOTION].astype(str), ("Moving", "Stopped")) | people


def _pose(told: Any) -> tuple[list[float], list[float]]:
    """(position, heading wxyz) of an entry; raises Reject."""
    try:
        return [float(told["position"][axis]) for axis in "xyz"], [float(told["heading"][axis]) for axis in "wxyz"]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise Reject("no_pose", "its pose has no position x, y, z and heading w, x, y, z") from None


def _lens(told: dict[str, Any], width: int, height: int) -> Lens:
    try:
        lens = Lens(width, height, float(told["fx"]), float(told["fy"]), float(told["cx"]) + 0.5, float(told["cy"]) + 0.5)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise Reject("no_intrinsics", "intrinsics.json has no numbers fx, fy, cx, cy") from None
    why = lens.wrong()
    if why is None and lens.cx > MIDDLE and (width, height) != SIZE:
        why = f"the principal point ({lens.cx:g}, {lens.cy:g}) is for another size than {width} x {height} pixels"
    if why is not None:
        raise Reject("no_intrinsics", f"{why}: the images may have been made smaller than the set's 1920 x 1080")
    return lens
