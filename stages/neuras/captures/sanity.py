"""Whether cameras, surface and photos belong together: what is wrong with a whole capture is told before hours go into it.

Every check ends in a UserError that says what was measured and what to do. The last one looks at the photos: a point of the
surface has about the same brightness in all of them, if the poses are right. Positions in another unit than the surface are
told by a factor under which the photos agree far better. What is compared is detail alone, because streets look alike from
everywhere: dark below and bright above.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image
from scipy.ndimage import uniform_filter

from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.neuras.captures import poses
from stages.neuras.captures.lenses import bilinear
from stages.neuras.records import FrameRecord

POINTS = 20_000  # of the surface that are looked at
FEWEST_POINTS = 50  # fewer say nothing
ONE_PLACE = 1e-6  # of the distance to the surface: cameras nearer to each other than this stand at one place
FARTHEST = 30.0  # radii of the surface, from its middle
LEAST_SHARED = 0.05  # of what a camera sees, seen by another one too
FACTORS = (1e-3, 1e-2, 0.0254, 0.1, 0.3048, 1.0, 3.2808, 10.0, 39.37, 100.0, 1e3)  # of a unit that was taken for another
PHOTOS, LEAST_POINTS = 12, 200  # that are compared, and points that two of them see
SIDE, DETAIL = 240, 15  # pixels along a small photo, and along the window whose mean is taken away
GOOD, BETTER, AS_GOOD = 0.3, 0.15, 0.05  # correlation that a factor must reach, by which it must win, and that is no difference


def check(views: Sequence[FrameRecord], surface: np.ndarray, read: Callable[[str], FrameRecord]) -> None:
    """Raises UserError. views: of training; they need no pictures. surface: (P, 3) world. read: a frame by its id."""
    cameras = [view.camera for view in views]
    if len(cameras) < 2:  # whatever is wrong, it is not that they stand together
        return
    positions = np.array([camera.position for camera in cameras])
    surface = surface[:: max(len(surface) // POINTS, 1)].astype(np.float64)
    centre = np.median(surface, axis=0) if len(surface) else positions.mean(axis=0) + 1.0
    distance = float(np.median(np.linalg.norm(positions - centre, axis=1)))
    if np.ptp(positions, axis=0).max() <= ONE_PLACE * distance:
        raise UserError(
            f"all {len(views)} training cameras stand at one place, so nothing has a depth: "
            "the poses were not exported, or the camera only turned; walk around the place, and register the images again"
        )
    if len(surface) < FEWEST_POINTS:
        return
    factor = _unit(views, surface, read)
    if factor != 1:
        raise UserError(
            f"the poses seem to be in another unit than the points or the mesh: the photos agree if all positions of cameras "
            f"are taken times {factor:g}; scale the positions, never the rotations, or the surface by {1 / factor:g}"
        )
    seen = np.array([poses.in_view([camera], surface) for camera in cameras])
    if not seen.any():
        raise UserError(
            "no training camera sees the points or the mesh: they lie in another frame, or the poses look the other way; "
            "look at files/contact.png of a run without them, and export both from one program"
        )
    radius = float(np.percentile(np.linalg.norm(surface - centre, axis=1), 90))
    if distance > FARTHEST * radius:
        raise UserError(
            f"the points or the mesh lie far from the cameras: {distance / radius:,.0f} times their own radius away; "
            "poses and surface must be in one frame and one unit: scale or move one of them"
        )
    shared = _shared(seen)
    if shared < LEAST_SHARED:
        raise UserError(
            f"the training frames hardly overlap: {100 * shared:.0f} % of what one sees is seen by another too; "
            "take images closer to each other, or keep more of them (capture.every, capture.nth, capture.split)"
        )


def _shared(seen: np.ndarray) -> float:
    """The median camera's share of the points it sees that another one sees too. seen: (cameras, points) bool."""
    twice = seen.sum(axis=0) > 1
    return float(np.median([twice[row].mean() for row in seen if row.any()]))


def _unit(views: Sequence[FrameRecord], surface: np.ndarray, read: Callable[[str], FrameRecord]) -> float:
    """The factor of the cameras' positions under which photos agree; 1 unless another is much better."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(PHOTOS, len(views))).round().astype(int))
    photos = [_Photo(read(views[index].id)) for index in chosen]
    apart = (len(photos) + 1) // 3 or 1  # neighbours of a drive look alike under any factor
    agreed = {}
    for factor in FACTORS:
        looks = [photo.at(surface, factor) for photo in photos]
        pairs = list(zip(looks, looks[apart:], strict=False))
        shared = [int(_both(*pair).sum()) for pair in pairs]
        likeness = [_correlation(*pair) for pair, number in zip(pairs, shared, strict=True) if number >= LEAST_POINTS]
        if len(likeness) >= len(pairs) / 2:
            agreed[factor] = float(np.median(likeness))
        elif factor == 1 and np.median(shared) >= FEWEST_POINTS:
            return 1.0  # they see the surface, and too little of it to know
    best = max(agreed.values(), default=0.0)
    if best < GOOD or best < agreed.get(1.0, 0.0) + BETTER:
        return 1.0
    return min((factor for factor, value in agreed.items() if value > best - AS_GOOD), key=lambda factor: abs(np.log(factor)))


class _Photo:
    """The detail of a small grey photo, with its camera."""

    def __init__(self, frame: FrameRecord):
        camera, image = frame.camera, Image.fromarray(frame.image()).convert("L")
        scale = min(1.0, SIDE / max(image.size))
        size = tuple(max(round(side * scale), 2) for side in image.size)
        counts = Image.fromarray(frame.counts()).resize(size, Image.Resampling.NEAREST)
        self.camera = camera.resized(*size)
        grey = np.array(image.resize(size, Image.Resampling.BOX), np.float32)
        self.pixels = np.dstack([grey - uniform_filter(grey, DETAIL), np.array(counts, np.float32)])

    def at(self, points: np.ndarray, factor: float) -> np.ndarray:
        """(P,) brightness, NaN where the photo does not show the point, if the camera stood ``factor`` times as far out."""
        pose = self.camera.camera_to_world.copy()
        pose[:3, 3] *= factor
        camera = Camera(**{**vars(self.camera), "camera_to_world": pose})
        pixels, ahead = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = (ahead > 0) & ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(axis=1)
        found = np.full(len(points), np.nan)
        grey, counts = bilinear(self.pixels, pixels[inside]).T
        found[inside] = np.where(counts > 0.99, grey, np.nan)
        return found


def _both(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.isfinite(one) & np.isfinite(other)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of the points that both show; 0 where one is all alike."""
    both = _both(one, other)
    a, b = one[both] - one[both].mean(), other[both] - other[both].mean()
    length = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / length) if length > 1e-6 else 0.0
