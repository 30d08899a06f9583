"""Poses of cameras: strangers' matrices and quaternions checked, the upward direction, and the ball that a capture fills."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.cameras import Camera

TOLERANCE = 1e-3  # of a rotation's products; files hold six digits
FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # its camera looks along +z with +y down


def checked(matrix: Any) -> np.ndarray:
    """A camera-to-world matrix (4, 4) or (3, 4), OpenGL camera, as exactly rigid (4, 4) float64; Reject if it is none."""
    try:
        given = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise Reject("no_pose", "its matrix does not hold numbers") from None
    if given.shape not in ((4, 4), (3, 4)):
        raise Reject("no_pose", f"its matrix has the shape {given.shape}, not (4, 4)")
    if not np.isfinite(given).all():
        raise Reject("not_finite", "a number of its pose is infinite or none")
    if len(given) == 4 and not np.allclose(given[3], (0, 0, 0, 1), atol=TOLERANCE):
        raise Reject("not_rigid", f"the last row of its pose is {given[3].tolist()}, not 0 0 0 1")
    rotation = given[:3, :3]
    if np.linalg.det(rotation) < 0:
        raise Reject("left_handed", "its axes are left-handed: one of them points the wrong way")
    lengths = np.linalg.norm(rotation, axis=0)
    if np.abs(lengths - 1).max() > TOLERANCE:
        raise Reject("scaled", f"its axes have lengths {', '.join(f'{x:.4g}' for x in lengths)}, not 1")
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > TOLERANCE:
        raise Reject("not_rigid", "its axes are not at right angles")
    left, _, right = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, given[:3, 3]
    return rigid


def rotation_of(quaternion: Sequence[float]) -> np.ndarray:
    """(3, 3) of a quaternion wxyz of length about 1; Reject if it is none."""
    q = np.array(quaternion, np.float64)
    length = np.linalg.norm(q)
    if not np.isfinite(q).all():
        raise Reject("not_finite", "a number of its pose is infinite or none")
    if abs(length - 1) > 0.01:
        raise Reject("not_rigid", f"its quaternion has the length {length:.4g}, not 1")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def from_opencv(rotation: np.ndarray, position: Sequence[float]) -> np.ndarray:
    """Camera-to-world of an OpenGL camera from that of an OpenCV camera."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return checked(matrix @ FROM_OPENCV)


def upward(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) unit vector against gravity, as people and drones hold cameras: without roll, so all right axes are level.

    Where the cameras turn, up is the direction at right angles to their right axes. Where all look one way that is open:
    then up is the mean of their up axes, or against their view where those cancel (a drone that looks straight down).
    """
    axes = np.array([camera.camera_to_world[:3, :3] for camera in cameras])
    right, above, backwards = axes[:, :, 0], axes[:, :, 1].mean(axis=0), axes[:, :, 2].mean(axis=0)
    guess = above if np.linalg.norm(above) > 0.5 or np.linalg.norm(above) > np.linalg.norm(backwards) else backwards
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    if values[1] > 0.03:  # right axes that turn by over some 14 degrees to both sides
        sure = above + backwards if np.linalg.norm(above + backwards) > 1e-6 else guess
        level = vectors[:, 0]
        guess = level if level @ sure >= 0 else -level
    length = np.linalg.norm(guess)
    return guess / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])


def ball(cameras: Sequence[Camera], seen: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a ball around the cameras and nearly all of the points (P, 3) that one of them sees."""
    positions = np.array([camera.position for camera in cameras])
    visible = seen[in_view(cameras, seen)]
    if len(visible) >= 10:
        low, high = np.percentile(visible, [2, 98], axis=0)
        visible = visible[((visible >= low) & (visible <= high)).all(axis=1)]
    both = np.concatenate([positions, visible])
    centre = (both.min(axis=0) + both.max(axis=0)) / 2
    radius = float(np.linalg.norm(both - centre, axis=1).max())
    return centre, radius if radius > 0 else 1.0


def in_view(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """(P,) bool: whether the point lies in some camera's picture."""
    found = np.zeros(len(points), bool)
    for camera in cameras:
        pixels, ahead = camera.project(points[~found])
        with np.errstate(invalid="ignore"):
            hit = (ahead > 0) & ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(axis=1)
        found[np.flatnonzero(~found)[hit]] = True
    return found
