"""A simulated LiDAR: turns of many beams from the driven lane, fans of beams from a flight, or beams at an object.

No turn is within CLEAR of a held-out frame: a surface that was measured from there would flatter the test.
"""

from __future__ import annotations

import numpy as np

from stages.graphics.casting import Caster
from stages.neuras.records import PointsRecord
from stages.neuras.street.cameras import LANE, OBJECTS, poses, start
from stages.neuras.street.city import City
from stages.neuras.street.settings import StreetConfig

CLEAR = 1.0  # metres
LEAD = 6.0  # metres that the car drives before the first frame and after the last
ABOVE = 1.9  # metres of the sensor above the road
ELEVATION = (-25.0, 20.0)  # degrees, of the lowest and the highest beam
REACH = {"street": 100.0, "drone": 180.0, "object": 100.0}  # metres
NOISE = {"street": 0.02, "drone": 0.02, "object": 0.003}  # metres, standard deviation along a beam
LOST = {"matt": 0.02, "satin": 0.02, "gloss": 0.3, "metal": 0.1}  # share of beams that do not return
RATE = 10.0  # turns a second


def sensors(config: StreetConfig) -> np.ndarray:
    """(N, 3) where each turn is taken from."""
    frames = poses(config)
    held_out = np.array([pose.camera.position for pose in frames if pose.split in ("test", "validation")])
    if config.preset != "street":
        places = np.array([pose.camera.position for pose in frames if pose.split == "train"])
        return places[_clear(places, held_out)]
    step = config.speed / RATE
    x = start(config) + step * np.arange(-int(LEAD / step), int((config.drive + LEAD) / step) + 1)
    places = np.stack([x, np.full_like(x, LANE), np.full_like(x, ABOVE)], axis=1)
    return places[_clear(places, held_out)]


def _clear(places: np.ndarray, held_out: np.ndarray) -> np.ndarray:
    if not len(held_out):
        return np.ones(len(places), bool)
    return np.linalg.norm(places[:, None] - held_out[None], axis=2).min(axis=1) >= CLEAR


def _beams(config: StreetConfig, sensor: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(B, 3) unit vectors of one turn; of a scan of an object, towards random places in its ball."""
    if config.preset == "object":
        radius, height = OBJECTS[config.object]
        towards = rng.normal(size=(config.beams * config.columns, 3))
        towards *= radius * np.cbrt(rng.random((len(towards), 1))) / np.linalg.norm(towards, axis=1, keepdims=True)
        towards += [0.0, 0.0, height] - sensor
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)
    azimuth = (np.arange(config.columns) + rng.random()) * 2 * np.pi / config.columns
    low, high = ELEVATION if config.preset == "street" else (-90.0, -28.0)
    elevation = np.radians(np.linspace(low, high, config.beams))
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)


def sweep(
    config: StreetConfig, city: City, caster: Caster, id: str, sensor: np.ndarray, rng: np.random.Generator
) -> PointsRecord:
    """One turn from ``sensor`` (3,)."""
    beams = _beams(config, sensor, rng)
    face, _, distance = caster.cast(np.broadcast_to(sensor, beams.shape), beams)
    lost = np.array([LOST[group.kind] for group in city.groups])[city.owners[np.maximum(face, 0)]]
    kept = (face >= 0) & (distance < REACH[config.preset]) & (rng.random(len(beams)) >= lost)
    noisy = distance + rng.normal(0, NOISE[config.preset], len(beams))
    points = sensor + beams[kept] * noisy[kept][:, None]
    return PointsRecord(id, points.astype(np.float32), np.asarray(sensor, np.float32))
