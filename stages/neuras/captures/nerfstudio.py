"""Captures in nerfstudio's layout: a folder with ``transforms.json``.

Camera-to-world matrices of OpenGL cameras; intrinsics and distortion of the whole file, or of a frame, which wins.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.formats import ply
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.parts import Source
from stages.graphics.geometry.paths import inside
from stages.neuras.captures import poses
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.sources import AXES, FolderConfig, Inventory, PointSet, Shot, file_in, shot_of
from stages.neuras.records import natural

FILE = "transforms.json"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
LISTS = {"train_filenames": "train", "val_filenames": "validation", "test_filenames": "test"}
POINTS = "sparse_pc.ply"
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")  # of the distortion


def read(config: FolderConfig, root: Path) -> Inventory:
    """The inventory of ``transforms.json``."""
    path = root / FILE
    if not path.is_file() or not inside(path, root):
        raise UserError(f"capture.path={str(root)!r} has no {FILE}: capture=nerfstudio reads nerfstudio's layout")
    try:
        told = json.loads(path.read_bytes())
        frames = told["frames"]
        assert isinstance(frames, list) and all(isinstance(frame, dict) for frame in frames)
    except (ValueError, KeyError, TypeError, AssertionError, RecursionError) as error:
        raise UserError(f"{path} is not nerfstudio's layout: it needs a list 'frames' ({error})") from None
    model = told.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise UserError(f"{path}: camera_model {model!r} is not read ({', '.join(MODELS)} are): undistort the images first")
    named = _named(told)
    frames = sorted(frames, key=lambda frame: (_time(frame) or 0.0, natural(str(frame.get("file_path", "")))))
    timed = all(_time(frame) is not None for frame in frames)

    def shot(frame: dict[str, Any]) -> Shot:
        name = str(frame.get("file_path", ""))
        made = shot_of(name, lambda shot: _fill(shot, {**told, **frame}, root))
        made.time, made.split = _time(frame), named.get(Path(name).as_posix()) if named else None
        made.moment = made.time if timed else name
        return made

    shots = [shot(frame) for frame in frames]
    if named:
        shots = [shot for shot in shots if shot.split is not None]  # the set leaves the others out
        if frames and not shots:
            raise UserError(f"{path}: {', '.join(LISTS)} name none of its frames: they must repeat a frame's file_path")
    units, units_from = _units(told)
    sets = _points(config, root, told)
    return Inventory(shots, sets, "sfm" if sets else "none", units, units_from, _up(told))


def _fill(shot: Shot, told: dict[str, Any], root: Path) -> None:
    if "transform_matrix" not in told:
        raise Reject("no_pose", "it has no transform_matrix")
    shot.camera_to_world = poses.checked(told["transform_matrix"])
    shot.lens = _lens(told)
    shot.image = file_in(root, told.get("file_path"), "image")
    if told.get("mask_path"):
        shot.mask = file_in(root, told["mask_path"], "mask")


def _lens(told: dict[str, Any]) -> Lens:
    missing = [name for name in ("fl_x", "w", "h") if told.get(name) is None]
    if missing:
        raise Reject("no_intrinsics", f"{', '.join(missing)} not given, neither by the file nor by the frame")
    try:
        value = {name: float(told[name]) for name in ("fl_x", "fl_y", "cx", "cy", *TERMS) if told.get(name) is not None}
        width, height = (int(float(told[name])) for name in ("w", "h"))
    except (TypeError, ValueError, OverflowError):
        raise Reject("no_intrinsics", "an intrinsic is not a number") from None
    if value.get("k4"):
        raise Reject("no_intrinsics", "k4 is not read: undistort the images first")
    lens = Lens(
        width, height, value["fl_x"], value.get("fl_y", value["fl_x"]), value.get("cx", width / 2), value.get("cy", height / 2),
        tuple(value.get(name, 0.0) for name in ("k1", "k2", "k3")), (value.get("p1", 0.0), value.get("p2", 0.0)),
    )  # fmt: skip
    if lens.wrong():
        raise Reject("no_intrinsics", lens.wrong())
    return lens


def _named(told: dict[str, Any]) -> dict[str, Any]:
    """Split by file name, of the lists that nerfstudio calls so; {} where there are none."""
    found: dict[str, Any] = {}
    for key, split in LISTS.items():
        names = told.get(key) or []
        if not isinstance(names, list):
            raise UserError(f"{FILE}: {key} is not a list of file names")
        for name in names:
            found[Path(str(name)).as_posix()] = split
    return found


def _time(frame: dict[str, Any]) -> float | None:
    time = frame.get("time")
    try:
        return float(time) if isinstance(time, (int, float)) and np.isfinite(float(time)) else None
    except OverflowError:  # an integer of hundreds of digits
        return None


def _units(told: dict[str, Any]) -> tuple[Any, str]:
    """nerfstudio has no field for it; ours, "units", is read where somebody wrote it."""
    said = str(told.get("units", "")).lower()
    if not said:
        return None, f"{FILE} does not say it"
    metre = said in ("m", "metre", "metres", "meter", "meters")
    return "metre" if metre else "arbitrary", f"{FILE}: units {said[:60]!r}"


def _up(told: dict[str, Any]) -> tuple[float, float, float] | None:
    return AXES.get(str(told.get("up", "")))


def _points(config: FolderConfig, root: Path, told: dict[str, Any]) -> list[PointSet]:
    name = told.get("ply_file_path") or (POINTS if (root / POINTS).is_file() else None)
    if name is None:
        return []
    try:
        path = file_in(root, name, "points")
    except Reject as error:
        raise UserError(f"{FILE}: ply_file_path: {error.detail}") from None
    return [PointSet("sfm", path, lambda: (ply_points(path, config.max_bytes), None))]


def ply_points(path: Path, max_bytes: int) -> np.ndarray:
    """(P, 3): the vertices of a PLY; raises Reject."""
    source = Source(path, path.parent, max_bytes, 1 << 40)
    with at(path.name):
        if path.stat().st_size > max_bytes:
            raise Reject("too_large", f"{path.stat().st_size} bytes, at most {max_bytes} are read")
        return ply.read_points(path.read_bytes(), source)
