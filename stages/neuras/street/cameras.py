"""Where the cameras stand: a driven lane with held-out frames and lanes beside it, a flight in a grid, or around an object.

Everything here follows from the settings alone, so items are known before the place is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.keys import seed_for
from stages.graphics.cameras import Camera
from stages.neuras.records import Split
from stages.neuras.street.settings import StreetConfig

LANE = -1.0  # metres: y of the driven lane; 3 m to both sides of it no car is parked
HEIGHT = 1.6  # of the camera above the road
OBJECTS = {"car": (2.7, 0.75), "house": (10.6, 7.5), "tree": (3.3, 3.2)}  # metres: radius of a ball, height of its middle
LOWEST, HIGHEST = 5.0, 75.0  # degrees above the horizon, of cameras around an object
VALIDATION_EVERY = 5  # of the held-out frames, one in five chooses settings; the others are the test


@dataclass(frozen=True, eq=False)
class Pose:
    """A frame to be rendered. shift: metres to the right of the drive; time: seconds."""

    id: str
    camera: Camera
    split: Split
    trajectory: str = "drive"
    shift: float = 0.0
    time: float | None = None


def poses(config: StreetConfig) -> list[Pose]:
    """All frames of a capture."""
    return {"street": _street, "drone": _flight, "object": _around}[config.preset](config)


def start(config: StreetConfig) -> float:
    """x of the first frame: the drive lies in the first half of the street."""
    return round(min(40.0, (config.length - config.drive) / 3))


def look(config: StreetConfig, position: np.ndarray, ahead: np.ndarray) -> Camera:
    """A camera at ``position`` that looks along ``ahead`` (3,), world. Its up is the world's, or +y when it looks down."""
    back = -np.asarray(ahead, float) / np.linalg.norm(ahead)
    up = np.array([0.0, 1.0, 0.0]) if abs(back[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, np.asarray(position, float)], axis=1)
    return Camera.from_fov(config.width, config.height, config.fov_deg, matrix)


def _on_lane(config: StreetConfig, x: float, shift: float) -> Camera:
    """A camera of the car: it looks along the street, its heading and height sway a little."""
    yaw, pitch = 0.02 * np.sin(x / 9), 0.02 + 0.008 * np.sin(x / 4)
    position = [x, LANE - shift + 0.12 * np.sin(x / 11), HEIGHT + 0.02 * np.sin(x / 3)]
    return look(config, np.array(position), np.array([np.cos(yaw), np.sin(yaw), pitch]))


def _street(config: StreetConfig) -> list[Pose]:
    first, out = start(config), []
    for number in range(2 * config.training_frames - 1):
        x = first + number * config.spacing
        between = number // 2 % VALIDATION_EVERY == VALIDATION_EVERY // 2
        split: Split = "train" if number % 2 == 0 else "validation" if between else "test"
        out.append(
            Pose(f"frame-drive_{number:04d}", _on_lane(config, x, 0.0), split, time=number * config.spacing / config.speed)
        )
    for shift in config.shifts:
        lane = f"shift_{abs(shift):g}m_{'right' if shift > 0 else 'left'}".replace(".", "_")
        # Between training frames, as the held-out frames are: nowhere beside a training camera.
        steps = np.round(np.linspace(1, 2 * config.training_frames - 3, config.shift_frames) / 2 - 0.5) * 2 + 1
        for number, step in enumerate(steps):
            camera = _on_lane(config, first + step * config.spacing, shift)
            out.append(
                Pose(f"frame-{lane}_{number:04d}", camera, "shift", lane, shift, float(step * config.spacing / config.speed))
            )
    return out


def _flight(config: StreetConfig) -> list[Pose]:
    """Rows over the blocks, each flown once looking down and once at a slant; a random half is held out."""
    count = 2 * config.training_frames
    rows = max(1, round(np.sqrt(count / 2)))
    middle, reach = config.length / 2, min(55.0, config.length / 4)
    cameras = []
    for number in range(count):
        nadir = number % 2 == 0
        row, along = divmod(number // 2, int(np.ceil(count / 2 / rows)))
        share = (
            along / max(1, np.ceil(count / 2 / rows) - 1) if row % 2 == 0 else 1 - along / max(1, np.ceil(count / 2 / rows) - 1)
        )
        position = np.array(
            [middle + reach * (2 * share - 1), middle + reach * (2 * row / max(1, rows - 1) - 1), 62.0 if nadir else 48.0]
        )
        inwards = np.array([middle, middle, 0]) - position
        turn = np.arctan2(inwards[1], inwards[0]) if np.hypot(*inwards[:2]) > 15 else 0.7 * row
        cameras.append(
            look(config, position, np.array([0, 0, -1.0]) if nadir else np.array([np.cos(turn), np.sin(turn), -0.95]))
        )
    order = np.random.default_rng(seed_for(config.seed, "street", "held out")).permutation(count)
    held = {int(number): place for place, number in enumerate(order[: count // 2])}
    out = []
    for number, camera in enumerate(cameras):
        place = held.get(number)
        split: Split = "train" if place is None else "validation" if place % VALIDATION_EVERY == 0 else "test"
        out.append(Pose(f"frame-flight_{number:04d}", camera, split, "flight", time=2.0 * number))
    return out


def _around(config: StreetConfig) -> list[Pose]:
    """Cameras over the upper half of a ball around an object, on a spiral; every other one is held out."""
    radius, height = OBJECTS[config.object]
    middle = np.array([0.0, 0.0, height])
    half = np.tan(np.radians(config.fov_deg / 2)) * min(1.0, config.height / config.width)  # of the narrower side
    away = radius / np.sin(np.arctan(half))
    count = 2 * config.training_frames
    low, high = np.sin(np.radians([LOWEST, HIGHEST]))
    out = []
    for number in range(count):
        up = low + (high - low) * (number + 0.5) / count
        angle = number * np.pi * (3 - np.sqrt(5))  # the golden angle: no two cameras stand above each other
        across = np.sqrt(1 - up * up)
        position = middle + away * np.array([across * np.cos(angle), across * np.sin(angle), up])
        between = number // 2 % VALIDATION_EVERY == VALIDATION_EVERY // 2
        split: Split = "train" if number % 2 == 0 else "validation" if between else "test"
        out.append(Pose(f"frame-around_{number:04d}", look(config, position, middle - position), split, "around"))
    return out
