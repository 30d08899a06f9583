"""Residuals: what single photos know beyond the textures, added where a photo was taken close by.

A texture holds the mean of what all photos say of a place. A photo from nearby knows more: the sheen as it looks from there,
and detail that the mean blurs where mesh or cameras are a little off. A *residual* is a training photo less the fitted scene's
picture from the same camera. A new view adds the residuals of the nearest photos, moved by the depth of the mesh, as warping
moves whole photos. They fade with the angle between the rays that see a point from here and from there. So on the driven
path a view is nearly what warping shows, and far beside it what the textures show.

No part of the paper. ``Residuals.at`` says what is computed; ``shaders.residual_lookup`` is the same in GLSL. Coordinates are
relative to the skyboxes' centre, as everywhere in a site. Files: ``residuals/NAME.png``, bytes b of a residual (b - 128) / 255
in RGB, and ``residuals/NAME.depth.png``, 16-bit codes of the distance that each pixel sees, low byte in R, high byte in G.
"""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import psutil
from PIL import Image

from model.neuras.exposure import matched
from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster, GBuffer
from stages.neuras.records import FRAME, FrameRecord

FOLDER = "residuals"
TOLERANCE = 0.02  # relative difference of depth at which half of a residual is left: all at half of it, none at 1.5 times
BORDER = 0.03  # share of a photo's longer side over which it fades towards its border
LEAST = 0.1  # share of the photos' weights below which residuals fade: none comes or goes at once
NEUTRAL = 128  # byte of no residual
OPEN, MASKED = 0, 65535  # codes of depth: nothing hit, and a pixel that does not count
LAYERS = 8  # photos on the device at a time, those that were wanted last
CACHED = 16  # photos kept in memory
BYTES = 1000  # that torch takes to draw a pixel
ANGLES = (5.0, 10.0, 20.0, 40.0)  # degrees that are tried
ALIKE, UNLIKE = np.cos(np.radians([45.0, 75.0]))  # of the angle between where a view and a photo look
HARMLESS = 0.1  # dB that the angle that is taken may cost held-out frames
JUDGED = 4  # held-out frames that are looked at, at most
GLANCE = 64  # pixels of a frame's longer side that tell whether it sees the mesh


class Renderer(Protocol):
    """The scene by torch, without residuals."""

    caster: Caster

    def render(self, camera: Camera) -> np.ndarray: ...

    def shade(self, camera: Camera, view: GBuffer) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Source:
    """The residual of one photo. values: (H, W, 3) uint8. depths: (H, W) uint16, codes. matrix: (3, 4), from a point of the
    scene to (column * ahead, row * ahead, ahead), in pixels from the image's upper left corner. eye: (3,), where it was taken.
    """

    values: np.ndarray
    depths: np.ndarray
    matrix: np.ndarray
    eye: np.ndarray


class Residuals:
    """All residuals of a site; pictures are read when they are needed. ``about``: the part "residuals" of its ``scene.json``.

    nearest: photos that a view takes. layers: photos on the device at a time. angle: radians at which a residual has faded to
    1/e. near, far: the distances of the first and the last code of depth. size: width and height of the largest picture.
    off_mesh: distance of what rays beside the mesh see, by which alone their angles are told; also what photos that look
    elsewhere count as farther. eyes, looks: (K, 3), where photos were taken, and unit vectors along their optical axes.
    """

    def __init__(self, folder: Path, about: dict[str, Any]):
        if not all(re.fullmatch(r"[\w-]+", source["name"]) for source in about["sources"]):
            raise UserError(
                f"{folder.parent / 'scene.json'} names residuals outside of its folder: it is no site that bake wrote"
            )
        self.about = about
        self._folder, self._sources = folder, about["sources"]
        self.nearest: int = about["nearest"]
        self.layers: int = about["layers"]
        self.angle: float = about["angle"]
        self.near, self.far = about["near"], about["far"]
        self.soft: float = about["soft"]
        self.off_mesh: float = about["off_mesh"]
        self.eyes = np.array([source["eye"] for source in self._sources], float).reshape(-1, 3)
        self.looks = np.array([source["matrix"][2][:3] for source in self._sources], float).reshape(-1, 3)
        self.size = tuple(max(source[name] for source in self._sources) for name in ("width", "height"))
        self.source = functools.lru_cache(CACHED)(self._read)

    @classmethod
    def load(cls, site: Path) -> Residuals | None:
        """Of a baked site; None where it has none."""
        about = json.loads((site / "scene.json").read_bytes()).get("residuals")
        return None if about is None else cls(site / FOLDER, about)

    @classmethod
    def make(
        cls,
        site: Path,
        scene: Renderer,
        frames: Iterable[FrameRecord],
        centre: np.ndarray,
        depth_range: tuple[float, float],
        soft: float,
        off_mesh: float,
        nearest: int,
        angle_deg: float,
        exposure: bool = False,
    ) -> Residuals | None:
        """Write the residuals of the frames' photos to a site; None where there is no photo.

        centre: (3,) of the skyboxes, world. depth_range: distances that codes of depth span, world units. soft: distance, world
        units, within which photos weigh alike. off_mesh, nearest: as of `Residuals`. exposure: whether each photo first takes
        the exposure of the scene's picture, for scenes that were fitted so.
        """
        (site / FOLDER).mkdir(parents=True, exist_ok=True)
        mixed = [frame for frame in frames if min(frame.camera.width, frame.camera.height) > 1]  # of one row nothing is
        write = functools.partial(_write, site / FOLDER, scene, centre, depth_range, exposure)
        with ThreadPoolExecutor(_threads(mixed)) as threads:  # each photo by one of them, so the bytes are the same
            sources = list(threads.map(write, mixed))
        near, far = depth_range
        about = {
            "nearest": min(nearest, len(sources)),
            "layers": min(max(nearest, LAYERS), len(sources)),
            "angle": float(np.radians(angle_deg)),
            "near": near,
            "far": far,
            "soft": soft,
            "off_mesh": off_mesh,
            "sources": sources,
        }
        return cls(site / FOLDER, about) if sources else None

    def fit_angle(
        self, scene: Renderer, frames: Sequence[FrameRecord], centre: np.ndarray, exposure: bool = False
    ) -> float | None:
        """Take the largest of ``ANGLES`` that held-out frames bear, and return it in degrees. Without frames that see the mesh
        nothing changes.

        Photos of a drive are a degree or two apart, those of a flight ten and more. No angle is larger than the median one
        between a frame's rays and those of the nearest photo: beyond that, frames do not tell what it does. Of the others the
        largest serves that costs nothing, since views between photos are nearer to them than a photo that was held out.

        centre: (3,) of the skyboxes, world. exposure: whether pictures take the photos' exposure before they are compared.
        """
        frames = [frame for frame in frames if frame.counts().any() and _sees(scene.caster, frame.camera)]
        if not frames:
            return None
        every = -(-len(frames) // JUDGED)
        errors, apart = zip(*(self._judge(scene, frame, centre, exposure) for frame in frames[::every]), strict=True)
        mean_psnr = -10 * np.log10(np.maximum(errors, 1e-10)).mean(axis=0)
        tried = [number for number, angle in enumerate(ANGLES) if number == 0 or angle <= np.median(apart)]
        best = mean_psnr[tried].max()
        chosen = max(ANGLES[number] for number in tried if mean_psnr[number] >= best - HARMLESS)
        self.angle = self.about["angle"] = float(np.radians(chosen))
        return chosen

    def _judge(self, scene: Renderer, frame: FrameRecord, centre: np.ndarray, exposure: bool) -> tuple[list[float], float]:
        """Of a view with one ray a pixel: the mean squared error with each of ``ANGLES``, and the median angle, in degrees,
        between its rays and those of the nearest photos, whether these see the same or not.
        """
        camera, photo, counts = frame.camera, frame.image(), frame.counts()
        view = scene.caster.view(camera)
        plain, eye, look = scene.shade(camera, view), camera.position - centre, camera.forward
        ways, depth = camera.directions().reshape(-1, 3), view.depth.ravel().astype(float)
        errors = []
        for angle in ANGLES:
            added = self.at(eye, look, ways, depth, float(np.radians(angle)))
            colours = np.clip(plain + added.reshape(plain.shape), 0, 1)
            picture = np.rint(255 * colours).astype(np.uint8)
            if exposure:
                picture = matched(picture, photo, counts)
            errors.append(float(np.square((picture.astype(float) - photo)[counts] / 255).mean()))
        there = depth > 0
        away = (eye + ways[there] * depth[there, None])[:, None] - self.eyes[self.chosen(eye, look)[0]]
        cosines = np.einsum("nki,ni->nk", away, ways[there]) / np.maximum(np.linalg.norm(away, axis=2), 1e-12)
        nearest = np.arccos(np.clip(cosines.max(axis=1), -1, 1))
        return errors, float(np.degrees(np.median(nearest)))

    def _read(self, number: int) -> Source:
        source = self._sources[number]
        values = np.array(Image.open(self._folder / f"{source['name']}.png").convert("RGB"))
        codes = np.array(Image.open(self._folder / f"{source['name']}.depth.png").convert("RGB")).astype(np.uint16)
        if not values.shape[:2] == codes.shape[:2] == (source["height"], source["width"]):
            raise UserError(
                f"{self._folder / source['name']}.png is not of the size that scene.json states: bake the scene again"
            )
        return Source(values, codes[..., 0] + 256 * codes[..., 1], np.array(source["matrix"]), np.array(source["eye"]))

    @property
    def device_bytes(self) -> int:
        """Of both texture arrays, four bytes a pixel each."""
        width, height = self.size
        return 2 * 4 * width * height * self.layers

    def chosen(self, eye: np.ndarray, look: np.ndarray) -> tuple[list[int], np.ndarray]:
        """Numbers of the photos that a view takes, and their weights, which sum to 1.

        eye: (3,), where it is seen from. look: (3,), a unit vector along its optical axis.

        The nearer weighs more. A photo that looks elsewhere, such as another camera's of the same car, counts as up to
        ``off_mesh`` farther. A photo's weight has fallen to 0 where another one takes its place, so nothing jumps.
        """
        elsewhere = np.clip((ALIKE - self.looks @ look) / (ALIKE - UNLIKE), 0, 1)
        distances = np.linalg.norm(self.eyes - eye, axis=1) + self.off_mesh * elsewhere
        order = np.argsort(distances, kind="stable")[: self.nearest + 1]
        closeness = 1 / (distances[order] + self.soft)
        weights = closeness[: self.nearest] - (closeness[self.nearest] if len(order) > self.nearest else 0)
        return order[: self.nearest].tolist(), weights / max(float(weights.sum()), 1e-30)

    def at(
        self, eye: np.ndarray, look: np.ndarray, ways: np.ndarray, depth: np.ndarray, angle: float | None = None
    ) -> np.ndarray:
        """(N, 3) float64, to be added to the colours of rays from ``eye`` (3,) along unit ``ways`` (N, 3).

        look: as of `chosen`.

        depth: (N,), the distance to the mesh, 0 where it is missed; such rays are taken to see something infinitely far.
        angle: radians, in place of the site's own.

            sum_k w_k f_k r_k / max(sum_k w_k, LEAST)    with    w_k = weight * border * agreement

        weight: of ``chosen``. border: from 0 at a photo's outermost pixels to 1 within. agreement: of the distance that the
        photo's nearest pixel sees with the point's. r_k: the residual, bilinear. f_k = exp((cos a - 1) / (1 - cos angle)), with
        the angle a between the two rays that see the point; beside the mesh, a point at the distance ``off_mesh``.
        """
        angle = self.angle if angle is None else angle
        hit = depth > 0
        far = np.where(hit, 1.0, 0.0)
        points = np.where(hit[:, None], eye + ways * depth[:, None], ways)
        total, weights = np.zeros((len(ways), 3)), np.zeros(len(ways))
        for number, weight in zip(*self.chosen(eye, look), strict=True):
            if weight <= 0:
                continue
            source = self.source(number)
            height, width = source.depths.shape
            local = points @ source.matrix[:, :3].T + far[:, None] * source.matrix[:, 3]
            ahead = local[:, 2] > 0
            x, y = np.where(ahead[:, None], local[:, :2] / np.where(ahead, local[:, 2], 1)[:, None], 0).T
            edge = np.minimum(np.minimum(x - 0.5, width - 0.5 - x), np.minimum(y - 0.5, height - 0.5 - y))
            border = np.clip(edge / (BORDER * max(width, height)), 0, 1) * ahead
            x, y = np.clip(x, 0.5, width - 0.5), np.clip(y, 0.5, height - 0.5)
            code = source.depths[np.minimum(y.astype(int), height - 1), np.minimum(x.astype(int), width - 1)]
            away = np.where(hit[:, None], points, eye + ways * self.off_mesh) - source.eye
            distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
            same = np.clip(1.5 - np.abs(self.distance(code) - distance) / (TOLERANCE * distance), 0, 1)
            agrees = np.where(hit, same * ((code != OPEN) & (code != MASKED)), code == OPEN)
            cosine = np.einsum("ij,ij->i", away, ways) / distance
            fade = np.exp((cosine - 1) / (1 - np.cos(angle)))
            share = weight * border * agrees
            total += (share * fade)[:, None] * (_bilinear(source.values, x - 0.5, y - 0.5) - NEUTRAL) / 255
            weights += share
        return total / np.maximum(weights, LEAST)[:, None]

    def distance(self, codes: np.ndarray) -> np.ndarray:
        """What codes of depth stand for."""
        return self.near * (self.far / self.near) ** ((codes.astype(float) - 1) / (MASKED - 2))


def _threads(frames: Sequence[FrameRecord]) -> int:
    """Photos that are drawn at a time: one for each core of ours, and no more than free memory holds."""
    pixels = max((frame.camera.width * frame.camera.height for frame in frames), default=1)
    fitting = psutil.virtual_memory().available // (2 * BYTES * pixels)
    ours = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(max(1, min(ours, fitting)))


def _sees(caster: Caster, camera: Camera) -> bool:
    """Whether rays meet the mesh: a few of them, as held-out frames may be many and large."""
    shrink = max(1, -(-max(camera.width, camera.height) // GLANCE))
    return bool(caster.view(camera.resized(-(-camera.width // shrink), -(-camera.height // shrink))).hit.any())


def _bilinear(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N, 3) of (H, W, 3) at columns and rows within the image."""
    height, width = values.shape[:2]
    column, row = (np.minimum(at.astype(int), size - 2) for at, size in ((x, width), (y, height)))
    right, down = (x - column)[:, None], (y - row)[:, None]
    upper = values[row, column] * (1 - right) + values[row, column + 1] * right
    lower = values[row + 1, column] * (1 - right) + values[row + 1, column + 1] * right
    return upper * (1 - down) + lower * down


def _write(
    folder: Path, scene: Renderer, centre: np.ndarray, depth_range: tuple[float, float], exposure: bool, frame: FrameRecord
) -> dict[str, Any]:
    """Write one photo's two files; returns what ``scene.json`` says of it."""
    name, camera, counts = frame.id.removeprefix(FRAME), frame.camera, frame.counts()
    picture, photo = 255 * scene.render(camera).astype(float), frame.image()
    if exposure and counts.any():
        photo = matched(photo, np.rint(picture).astype(np.uint8), counts)
    values = np.where(counts[..., None], np.clip(np.rint(photo - picture) + NEUTRAL, 0, 255), NEUTRAL)
    near, far = depth_range
    depth = scene.caster.view(camera).depth.astype(float)
    codes = 1 + np.rint((MASKED - 2) * np.log(np.clip(depth, near, far) / near) / np.log(far / near))
    codes = np.where(counts, np.where(depth > 0, codes, OPEN), MASKED).astype(np.uint16)
    Image.fromarray(values.astype(np.uint8)).save(folder / f"{name}.png")
    Image.fromarray(np.stack([codes & 255, codes >> 8, 0 * codes], axis=-1).astype(np.uint8)).save(folder / f"{name}.depth.png")
    eye = camera.position - centre
    return {
        "name": name,
        "width": camera.width,
        "height": camera.height,
        "matrix": _matrix(camera, eye).tolist(),
        "eye": eye.tolist(),
    }


def _matrix(camera: Camera, eye: np.ndarray) -> np.ndarray:
    """As in ``Source``."""
    right, up, back = camera.camera_to_world[:3, :3].T
    rows = np.stack([camera.fx * right - camera.cx * back, -camera.fy * up - camera.cy * back, -back])
    return np.concatenate([rows, -(rows @ eye)[:, None]], axis=1)
