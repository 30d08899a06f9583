"""The picture of a capture for people: its frames with their splits, and a plan of cameras and what they see."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from stages.neuras.records import CaptureInfo, FrameRecord, Mesh

COLOURS = {"train": "#2a6fb0", "validation": "#3a9a5b", "test": "#d9822b", "shift": "#8a5bb0"}
SHOWN = 20  # pictures
DOTS = 60_000


@dataclass(frozen=True, eq=False)
class Place:
    """What cameras stand in: facts, sets of points (P, 3), and the given mesh."""

    info: CaptureInfo
    points: list[np.ndarray]
    mesh: Mesh | None

    def surface(self) -> np.ndarray:
        """(P, 3) float64: at most some ten thousand of the points, or of the mesh's vertices where there are none."""
        all_points = np.concatenate([np.zeros((0, 3)), *(self.points or ([] if self.mesh is None else [self.mesh.vertices]))])
        return all_points[:: max(len(all_points) // DOTS, 1)]


def chosen(number: int) -> list[int]:
    """Indices of the frames whose pictures are shown, evenly spaced."""
    return np.unique(np.linspace(0, number - 1, min(SHOWN, number)).round().astype(int)).tolist()


def drawn(views: Sequence[FrameRecord], shown: Sequence[FrameRecord], place: Place) -> bytes:
    """A PNG: the pictures of ``shown`` under their splits' colours, and the plan of all ``views``, which need no pictures."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = min(max(round(np.sqrt(len(shown) / 1.3)), 1), 4)
    rows = -(-len(shown) // columns)
    figure = pyplot.figure(figsize=(15, max(1.35 * rows, 5.4)), dpi=100, layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1))
    axes = left.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, view in zip(axes, shown, strict=False):
        axis.imshow(_small(view))
        name = view.id.partition("-")[2][-18:]
        axis.set_title(f"{name} {view.split}", fontsize=7, color="white", pad=3, backgroundcolor=COLOURS[view.split])
    _plan(right.subplots(), views, place)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    pyplot.close(figure)
    return buffer.getvalue()


def summary(views: Sequence[FrameRecord], place: Place) -> dict[str, Any]:
    """What ``show`` tells of the capture."""
    info = place.info
    sizes = Counter(f"{view.camera.width} x {view.camera.height}" for view in views)
    return {
        "frames": dict(sorted(Counter(view.split for view in views).items())),
        "sizes": dict(sorted(sizes.items())),
        "masks": sum(view.mask is not None for view in views),
        "points": sum(map(len, place.points)),
        "mesh_faces": 0 if place.mesh is None else len(place.mesh.faces),
        "units": f"{info.units} ({info.source.get('units_from', 'the source')})",
        "up": [round(x, 3) for x in info.up],
        "radius": round(info.radius, 3),
        "split_rule": info.split_rule,
    }


def _plan(axis: Any, views: Sequence[FrameRecord], place: Place) -> None:
    """Cameras and points from above, the mean view upwards on the page, in metres or in hundredths of the radius."""
    info, surface = place.info, place.surface()
    up = np.array(info.up)
    look = -np.mean([view.camera.camera_to_world[:3, 2] for view in views], axis=0)
    ahead = look - (look @ up) * up
    if np.linalg.norm(ahead) < 0.1:
        ahead = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    ahead /= np.linalg.norm(ahead)
    flat = np.stack([np.cross(ahead, up), ahead], axis=1) / info.metre
    centre = np.array(info.centre)
    if len(surface):
        surface = surface - centre
        height = surface @ up / info.metre
        low, high = np.percentile(height, [2, 98])
        order = np.argsort(height)
        brightest = high + 0.3 * (high - low) + 1e-9
        axis.scatter(*(surface[order] @ flat).T, c=height[order], s=0.5, cmap="gray", vmin=low, vmax=brightest, linewidths=0)
    for split, colour in COLOURS.items():
        these = [view.camera for view in views if view.split == split]
        if these:
            at = (np.array([camera.position for camera in these]) - centre) @ flat
            view_axis = np.array([-camera.camera_to_world[:3, 2] for camera in these]) @ flat * info.metre
            axis.quiver(*at.T, *view_axis.T, color=colour, width=0.003, scale=14, headwidth=3)
            axis.plot(*at.T, ".", color=colour, label=f"{split} ({len(these)})", markersize=6)
    reach = 1.05 * info.radius / info.metre
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    unit = "metres" if info.units == "metre" else "hundredths of the radius (the capture's unit is unknown)"
    axis.set_xlabel(unit, fontsize=8)
    axis.tick_params(labelsize=7)
    axis.set_title("seen from above; arrows: where cameras look", fontsize=9)
    axis.legend(fontsize=8, loc="upper right")


def _small(view: FrameRecord) -> np.ndarray:
    """The frame at a width of 240 pixels; what its mask leaves out is tinted."""
    image, counts = Image.fromarray(view.image()), Image.fromarray(view.counts())
    size = (240, max(round(240 * image.height / image.width), 1))
    pixels = np.array(image.resize(size, Image.Resampling.BOX), np.float64)
    ignored = ~np.array(counts.resize(size, Image.Resampling.NEAREST))
    pixels[ignored] = 0.4 * pixels[ignored] + 0.6 * np.array([200, 40, 120])
    return pixels.astype(np.uint8)
