"""Scenes of BlendedMVS, or of MVSNet's layout: a text file per camera, and images of the same numbers.

``cams/NNNNNNNN_cam.txt`` holds ``extrinsic``, 4 x 4 world to camera of an OpenCV camera, ``intrinsic``, 3 x 3, and a range of
depths, which is not needed. Pixel centres are at +0.5. ``blended_images/NNNNNNNN.jpg`` (or ``images/``) are the pictures;
``textured_mesh/`` holds the mesh in tiles. The unit is unknown.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.paths import inside
from stages.neuras.captures import poses
from stages.neuras.captures.lenses import Lens
from stages.neuras.captures.pictures import size_of
from stages.neuras.captures.sources import Inventory, Shot, file_in, shot_of

IMAGES = ("blended_images", "images")
SUFFIXES = ("jpg", "png")
MESH = "textured_mesh"
MOST_BYTES = 10_000  # of a camera's file


def read(config: Any, root: Path) -> Inventory:
    """The inventory of the cameras in ``cams``; ``pair.txt`` beside them is none."""
    files = sorted(path for path in (root / "cams").glob("*_cam.txt") if re.fullmatch(r"\d+_cam", path.stem))
    if not files:
        raise UserError(f"capture.path={str(root)!r} has no cams/NNNNNNNN_cam.txt: give the folder of one scene")
    folder = next((name for name in IMAGES if (root / name).is_dir()), None)
    if folder is None:
        raise UserError(f"capture.path={str(root)!r} has neither {' nor '.join(IMAGES)}/: unpack the images beside cams/")
    return Inventory([_shot(root, folder, path) for path in files], units_from="BlendedMVS does not say it", mesh=_tiles(root))


def _shot(root: Path, folder: str, path: Path) -> Shot:
    number = path.stem.removesuffix("_cam")
    names = [f"{folder}/{number}.{suffix}" for suffix in SUFFIXES]
    name = next((name for name in names if (root / name).is_file()), names[0])
    shot = shot_of(name, partial(_fill, root, path))
    shot.moment = name
    return shot


def _fill(root: Path, path: Path, shot: Shot) -> None:
    extrinsic, intrinsic = _matrices(root, path)
    rotation = extrinsic[:3, :3].T
    shot.camera_to_world = poses.from_opencv(rotation, -rotation @ extrinsic[:3, 3])
    shot.image = file_in(root, shot.name, "image")
    shot.lens = Lens(*size_of(shot.image), *intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    if shot.lens.wrong():
        raise Reject("no_intrinsics", f"{shot.lens.wrong()}: do image and camera come from sets of the same resolution?")


def _matrices(root: Path, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(4, 4) extrinsic and (3, 3) intrinsic of a camera's file; raises Reject."""
    if not inside(path, root):
        raise Reject("unsafe_path", f"{path.name} leads out of the capture's folder")
    words = path.read_bytes()[:MOST_BYTES].decode("ascii", errors="replace").split()
    try:
        first, second = words.index("extrinsic") + 1, words.index("intrinsic") + 1
        return (
            np.array(words[first : first + 16], np.float64).reshape(4, 4),
            np.array(words[second : second + 9], np.float64).reshape(3, 3),
        )
    except ValueError:
        raise Reject("no_pose", f"{path.name} has no 16 numbers after 'extrinsic' and 9 after 'intrinsic'") from None


def _tiles(root: Path) -> list[Path]:
    """The tiles of the textured mesh."""
    return sorted(path for path in (root / MESH).rglob("*.obj") if inside(path, root))
