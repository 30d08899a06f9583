"""One held-out view: its pictures by every renderer, and what is measured of them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.neuras.exposure import halves, matched
from pipeline.errors import Reject
from pipeline.store import Artifact
from stages.graphics.metrics import SSIM_MIN_SIZE
from stages.neuras.baking.drawing import Drawing
from stages.neuras.evaluation import scores
from stages.neuras.evaluation.renderers import Reference, as_bytes
from stages.neuras.evaluation.warping import Source, Warping
from stages.neuras.records import FrameRecord

GAIN = 4  # of a difference
LEAST = 0.01  # share of a view's pixels that its mask must leave
CACHED = 8  # photos that a worker keeps for warping


@dataclass(frozen=True, eq=False)
class Examiner:
    """Draws and measures views. drawings: the baked shader by texture format; empty without OpenGL. exposure: whether every
    picture takes the photo's exposure, found on the left half, and is scored on the right half alone.
    """

    reference: Reference
    drawings: Mapping[str, Drawing]
    warping: Warping
    scorers: Mapping[str, scores.Scorer]
    depth_tolerance: float
    exposure: bool = False

    def examine(self, frame: FrameRecord) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """What is measured of the view, as plain JSON, and its pictures by name, (H, W, 3) uint8."""
        photo, counts = frame.image(), _counts(frame)
        seen = self.reference.caster.view(frame.camera)
        exact = self.reference.shade(frame.camera, seen)
        warped, covered = self.warping.render(frame.camera)
        drawn = {kind: drawing.render(frame.camera) for kind, drawing in self.drawings.items()}
        pictures = {"ours": as_bytes(exact), "warping": as_bytes(warped)}
        if drawn:
            pictures["shader"] = as_bytes(drawn["fp16"])
        if self.exposure:
            known, counts = (counts & half for half in halves(counts.shape))
            pictures = {name: matched(picture, photo, known) for name, picture in pictures.items()}
        errors = None
        if frame.depth is not None:
            depths = (seen.depth, frame.depth)
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
            "agreement": {kind: scores.agreement(picture, exact) for kind, picture in drawn.items()},
            "unseen_by_warping": round(float(1 - np.mean(covered)), 6),
        }
        return facts, {**pictures, "photo": photo, "difference": difference(photo, pictures["ours"], counts)}


def warping(capture: Artifact, reference: Reference, radius: float, nearest: int) -> Warping:
    """Warping from a capture's training photos, each read when it is needed."""
    ids = capture.ids("train")
    cameras = [FrameRecord.from_record(capture.read(id)).camera for id in ids]

    @functools.lru_cache(CACHED)
    def source(index: int) -> Source:
        frame = FrameRecord.from_record(capture.read(ids[index]))
        image = frame.image().astype(np.float32) / 255
        return Source(frame.camera, image, frame.counts(), reference.caster.view(frame.camera))

    return Warping(reference.caster, cameras, source, radius, nearest)


def difference(photo: np.ndarray, picture: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the absolute difference times ``GAIN``; black where pixels do not count."""
    apart = np.abs(photo.astype(int) - picture) * GAIN
    return np.where(counts[..., None], np.minimum(apart, 255), 0).astype(np.uint8)


def _counts(frame: FrameRecord) -> np.ndarray:
    """The frame's mask; Reject where it leaves almost nothing of what SSIM averages over."""
    counts = frame.counts()
    border = SSIM_MIN_SIZE // 2
    if counts[border:-border, border:-border].mean() < LEAST:
        raise Reject("masked", f"{100 * counts.mean():.1f} % of its pixels are left")
    return counts
