"""One held-out view: its pictures by every renderer, and what is measured of them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.neuras.exposure import halves, matched
from pipeline.errors import Reject
from pipeline.store import Artifact
from stages.graphics.cameras import Camera
from stages.graphics.metrics import SSIM_MIN_SIZE
from stages.neuras.baking.drawing import Drawing
from stages.neuras.evaluation import scores
from stages.neuras.evaluation.renderers import Reference, as_bytes
from stages.neuras.evaluation.warping import Warping
from stages.neuras.rasterizing.photos import Source, nearest
from stages.neuras.records import AtlasMesh, FrameRecord, Mesh, fitted_poses, posed
from stages.neuras.surfaces import photometric

GAIN = 4  # of a difference
LEAST = 0.01  # share of a view's pixels that its mask must leave
CACHED = 8  # photos that a worker keeps for warping


class Photos:
    """A capture's frames, each read when it is needed. Their cameras are those that the scene was fitted with.

    training: ids of the training frames; cameras: theirs, in that order.
    """

    def __init__(self, capture: Artifact, fit: Artifact):
        self._capture, self._poses = capture, fitted_poses(fit)
        self.training = capture.ids("train")
        self.cameras = [self.read(id).camera for id in self.training]

    def read(self, id: str) -> FrameRecord:
        return next(posed([FrameRecord.from_record(self._capture.read(id))], self._poses))


class Aligner:
    """Finds where a held-out photo was taken from, by the nearest training photos and the mesh."""

    def __init__(self, photos: Photos, mesh: AtlasMesh):
        self._photos, self._mesh = photos, Mesh(mesh.vertices, mesh.faces)
        self._settings = photometric.Settings()

    def align(self, camera: Camera, image: np.ndarray, counts: np.ndarray) -> Camera:
        """``counts``: (H, W) bool, the pixels that may be looked at."""
        near = nearest(self._photos.cameras, camera, self._settings.neighbours)
        frames = [self._photos.read(self._photos.training[number]) for number in near]
        photos = [photometric.Photo(frame.camera, frame.image(), frame.counts()) for frame in frames]
        return photometric.align(photometric.Photo(camera, image, counts), self._mesh, photos, self._settings)


@dataclass(frozen=True, eq=False)
class Examiner:
    """Draws and measures views. drawings: the baked shader by texture format; empty without OpenGL. exposure: whether every
    picture takes the photo's exposure, found on the left half. aligner: turns and shifts the view's camera until its left half
    agrees with the training photos; without it the camera is the capture's. With either, the right half alone is scored.
    """

    reference: Reference
    drawings: Mapping[str, Drawing]
    warping: Warping
    scorers: Mapping[str, scores.Scorer]
    depth_tolerance: float
    exposure: bool = False
    aligner: Aligner | None = None

    def examine(self, frame: FrameRecord) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What is measured of the view, as plain JSON, and its pictures by name, (H, W, 3) uint8."""
        photo, counts = frame.image(), _enough(frame.counts(), "it")
        known, unknown = (counts & half for half in halves(counts.shape))
        if self.exposure or self.aligner is not None:
            known, unknown = _enough(known, "its left half"), _enough(unknown, "its right half")
        if self.aligner is not None:
            frame = replace(frame, camera=self.aligner.align(frame.camera, photo, known))
        exact = self.reference.pictures(frame.camera)
        warped, covered = self.warping.render(frame.camera)
        drawn = {kind: drawing.render(frame.camera) for kind, drawing in self.drawings.items()}
        pictures = {name: as_bytes(picture) for name, picture in (*exact.items(), ("warping", warped))}
        if drawn:
            pictures["shader"] = as_bytes(drawn["fp16"])
        if self.exposure:
            pictures = {name: matched(picture, photo, known) for name, picture in pictures.items()}
        if self.exposure or self.aligner is not None:
            counts = unknown
        errors = None
        if frame.depth is not None:
            depths = (self.reference.caster.view(frame.camera).depth, frame.depth)
            errors = scores.error_places(photo, pictures["ours"], counts, *depths, self.depth_tolerance)
        facts = {
            "id": frame.id,
            "split": frame.split,
            "trajectory": frame.trajectory,
            "shift": frame.shift,
            "size": [frame.camera.width, frame.camera.height],
            "counted": round(float(counts.mean()), 6),
            "scores": {method: scores.score(photo, picture, counts, self.scorers) for method, picture in pictures.items()},
            "errors": errors,
            "agreement": {kind: scores.agreement(picture, exact["ours"]) for kind, picture in drawn.items()},
            "unseen_by_warping": round(float(1 - np.mean(covered)), 6),
        }
        return facts, {**pictures, "photo": photo, "difference": difference(photo, pictures["ours"], counts)}


def warping(photos: Photos, reference: Reference, radius: float, nearest: int) -> Warping:
    """Warping from the training photos."""

    @functools.lru_cache(CACHED)
    def source(index: int) -> Source:
        frame = photos.read(photos.training[index])
        image = frame.image().astype(np.float32) / 255
        return Source(frame.camera, image, frame.counts(), reference.caster.view(frame.camera))

    return Warping(reference.caster, photos.cameras, source, radius, nearest, reference.rays)


def difference(photo: np.ndarray, picture: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the absolute difference times ``GAIN``; black where pixels do not count."""
    apart = np.abs(photo.astype(int) - picture) * GAIN
    return np.where(counts[..., None], np.minimum(apart, 255), 0).astype(np.uint8)


def _enough(counts: np.ndarray, of: str) -> np.ndarray:
    """``counts``, a mask; Reject where it leaves almost nothing of what SSIM averages over."""
    border = SSIM_MIN_SIZE // 2
    if counts[border:-border, border:-border].mean() < LEAST:
        raise Reject("masked", f"of {of} the mask leaves {100 * counts.mean():.1f} % of the frame's pixels")
    return counts
