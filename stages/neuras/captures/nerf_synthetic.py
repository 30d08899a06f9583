"""The synthetic objects of NeRF: ``transforms_{train,val,test}.json`` and rendered images with an alpha channel.

Camera-to-world matrices of OpenGL cameras; ``camera_angle_x`` is the full angle across the width. ``file_path`` has no suffix.
Pictures are shown over white, as all who report on this set do. z is up, the unit is unknown, and there is no mesh.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.neuras.captures import poses
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.pictures import size_of
from stages.neuras.captures.sources import Inventory, Shot, file_in, json_in, shot_of
from stages.neuras.records import Split

FILES: dict[str, Split] = {"train": "train", "val": "validation", "test": "test"}
WHITE = (255, 255, 255)


def read(config: Any, root: Path) -> Inventory:
    """The inventory of the files of all splits that there are."""
    shots = []
    for name, split in FILES.items():
        path = root / f"transforms_{name}.json"
        if path.is_file():
            shots += _shots(root, path, split)
        elif split == "train":
            raise UserError(f"capture.path={str(root)!r} has no {path.name}: give the folder of one object")
    return Inventory(shots, units_from="the set does not say it", up=(0.0, 0.0, 1.0))


def _shots(root: Path, path: Path, split: Split) -> list[Shot]:
    told = json_in(root, path, dict)
    frames = told.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f"{str(path)!r} has no list 'frames'")
    shots = []
    for frame in frames:
        name = f"{Path(str(frame.get('file_path', ''))).as_posix()}.png"
        shot = shot_of(name, partial(_fill, root, frame.get("transform_matrix"), told.get("camera_angle_x")))
        shot.moment, shot.split = name, split
        shots.append(shot)
    return shots


def _fill(root: Path, matrix: Any, angle: Any, shot: Shot) -> None:
    if matrix is None:
        raise Reject("no_pose", "it has no transform_matrix")
    shot.camera_to_world = poses.checked(matrix)
    shot.image, shot.backdrop = file_in(root, shot.name, "image"), WHITE
    if not isinstance(angle, (int, float)) or not 0 < angle < np.pi:
        raise Reject("no_intrinsics", "camera_angle_x is no angle in radians")
    width, height = size_of(shot.image)
    focal = 0.5 * width / np.tan(0.5 * angle)
    shot.lens = Lens(width, height, float(focal), float(focal), width / 2, height / 2)
