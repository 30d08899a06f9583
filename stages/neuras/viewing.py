"""What the viewer shows of NeuRas' stages: captures with their cameras and points, surfaces, texture charts, the baked page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.store import Artifact, Store, iter_inputs
from stages.graphics.arrays import unpack_arrays, unpack_json
from stages.graphics.cameras import Camera
from stages.graphics.panels import Eye, Facts, Lazy, Pane, Photo, Shown, Space, Surface, Views, general
from stages.neuras.records import FRAME, POINTS, AtlasMesh, CaptureInfo, PointsRecord, load_atlas, scaffold_mesh

MOST_POINTS = 400_000  # of all sweeps together: evenly chosen ones of more


def captured(shown: Shown) -> Iterator[Any]:
    """A capture: its cameras, its points, and the surface that was made from it; a frame: the same, through its camera."""
    scaffold = scaffold_of(shown.store, shown.artifact)
    frame = shown.record_id if shown.record_id is not None and shown.record_id.startswith(FRAME) else None
    yield capture_space(shown.artifact, scaffold, frame, shown.record_id if frame is None else None)
    if frame is not None:
        yield Facts("Frame", unpack_json(shown.record(("frame.json",)).members["frame.json"]))
    yield from general.panels(shown, ["frame.json", "points.npz"])


def capture_space(capture: Artifact, scaffold: Artifact | None, frame: str | None = None, sweep: str | None = None) -> Space:
    """Cameras as frusta, points, and a surface. ``frame``: begin in its camera. ``sweep``: its points alone."""
    info = CaptureInfo.of(capture)
    ids = sorted(id for id in capture.ids() if id.startswith(FRAME))
    eyes = [eye(capture, id) for id in ids]
    surfaces = [] if scaffold is None else [Lazy(lambda: scaffold_surface(scaffold))]
    points = Lazy(lambda: points_of(capture, sweep)) if info.points != "none" else None
    note = "" if scaffold is not None else "No surface was made from this capture yet: run its stage scaffold."
    number = ids.index(frame) if frame is not None else None
    return Space("Cameras, points and surface", [Pane("capture", surfaces, eyes, points)], tuple(info.up), number, note=note)


def eye(capture: Artifact, id: str) -> Eye:
    """A frame's camera, and its photo."""
    values = unpack_json(capture.read(id, ("frame.json",)).members["frame.json"])
    member = next(name for name in capture.row(id).members if name.startswith("image."))
    name = f"{id.removeprefix(FRAME)} ({values['split']})"
    return Eye(name, Camera.from_json(values["camera"]), Lazy(lambda: Photo(capture.name, id, member)))


def points_of(capture: Artifact, sweep: str | None = None) -> np.ndarray:
    """(P, 3) float32 of the sweep, or of all, at most `MOST_POINTS`."""
    ids = [sweep] if sweep is not None else [id for id in capture.ids() if id.startswith(POINTS)]
    points = np.concatenate([PointsRecord.from_record(capture.read(id)).points for id in ids] or [np.zeros((0, 3))])
    return points[:: max(1, -(-len(points) // MOST_POINTS))].astype(np.float32)


def scaffold_of(store: Store, capture: Artifact) -> Artifact | None:
    """The newest surface that was made from the capture."""
    made = store.artifacts(f"{capture.place.removesuffix(capture.stage)}scaffold")
    return next((a for a in reversed(made) if capture.key in a.manifest["preimage"]["inputs"].values()), None)


def scaffold_surface(scaffold: Artifact) -> Surface:
    mesh = scaffold_mesh(scaffold)
    return Surface("scaffold", mesh.vertices, mesh.faces)


def scaffolded(shown: Shown) -> Iterator[Any]:
    """The surface, with the cameras and points that it was made from."""
    capture = shown.input("capture")
    if capture is not None:
        yield capture_space(capture, shown.artifact)
    yield from general.panels(shown, ["mesh.npz"] if capture is not None else [])


def unfolded(shown: Shown) -> Iterator[Any]:
    """Charts in the texture beside the surface that they cover: of all tiles, or of one."""
    if shown.record_id is None:
        atlas = load_atlas(shown.artifact.file("atlas.npz"))
    else:
        arrays = unpack_arrays(shown.record(("tile.npz",)).members["tile.npz"])
        size = {name: arrays[name].item() for name in ("width", "height")}
        atlas = AtlasMesh(**{name: arrays[name] for name in ("vertices", "uvs", "faces", "charts")}, **size)
    yield from atlas_spaces(atlas, up_of(shown))
    yield from general.panels(shown, ["atlas.npz"])


def atlas_spaces(atlas: AtlasMesh, up: tuple[float, float, float]) -> Iterator[Space]:
    charts = {"chart": atlas.charts.astype(np.int32)}
    aspect = atlas.height / atlas.width
    flat = np.stack([atlas.uvs[:, 0], (1 - atlas.uvs[:, 1]) * aspect, np.zeros(len(atlas.uvs))], axis=1)
    texture = Surface(f"{atlas.width} x {atlas.height} texels", flat.astype(np.float32), atlas.faces, labels=charts)
    surface = Surface(f"{len(atlas.faces):,} faces", atlas.vertices, atlas.faces, labels=charts)
    yield Space("Charts in the texture", [Pane("texture", [texture])], (0.0, 1.0, 0.0), flat=True)
    yield Space("Charts on the surface", [Pane("surface", [surface])], up)


def up_of(shown: Shown) -> tuple[float, float, float]:
    """The capture's axis that points up."""
    capture = capture_of(shown.store, shown.artifact)
    return tuple(CaptureInfo.of(capture).up) if capture is not None else (0.0, 0.0, 1.0)


def capture_of(store: Store, artifact: Artifact) -> Artifact | None:
    """The capture at the head of an artifact's line, if it is still in the store."""
    todo = [artifact]
    while todo:
        made = todo.pop()
        if made.stage == "capture":
            return made
        todo += [parent for _, _, parent in iter_inputs(store, made) if parent is not None]
    return None


def evaluated(shown: Shown) -> Iterator[Any]:
    """A view: photo, drawing, difference and scores side by side, then the camera that it was taken from."""
    yield from general.panels(shown)
    capture = capture_of(shown.store, shown.artifact)
    if shown.record_id is not None and capture is not None and shown.record_id in capture:
        yield capture_space(capture, scaffold_of(shown.store, capture), shown.record_id)


VIEWS = Views(
    stages={"capture": captured, "scaffold": scaffolded, "refine": scaffolded, "atlas": unfolded, "evaluate": evaluated}
)
