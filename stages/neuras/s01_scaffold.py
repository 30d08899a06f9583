"""Stage scaffold: a mesh of moderate quality that the textures lie on (section 3.1).

Reads a capture's given mesh, or its points and cameras; writes one record "mesh". The mesh is clustered, decimated by QSlim
and culled. Culling by the source cameras alone leaves holes a lane farther, so virtual cameras beside them look too.
A map stage of one item, so that the limits on time and memory hold for the native libraries.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added
from pipeline.errors import Reject, UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_json

if TYPE_CHECKING:
    from pipeline.store import Artifact, Draft
    from stages.neuras.records import CaptureInfo, FrameRecord, Mesh


SPARED = 25  # faces of a piece of a given mesh from which on it is decimated
SPACINGS = 3  # of points without a sensor: a surface reaches at least so far from them
NONE = (np.zeros((0, 3)), np.zeros((0, 3)))  # points and where they were seen from
SURFEL = 1.25  # side of a surfel, in voxels: neighbours overlap a little
THROUGH = 10  # beams through a surfel for one that ends there: leaves let some pass, where a passer-by stood all but one do


class ScaffoldConfig(StageConfig):
    """Lengths end in ``_m``: metres, or nominal metres where the capture's unit is unknown (``CaptureInfo.metre``)."""

    # auto: given mesh, else Poisson, terrain under a flight
    source: Literal["auto", "given", "poisson", "terrain", "distance_field"] = "auto"
    voxel_m: float = Field(0.08, gt=0)  # points are thinned to one per voxel
    neighbours: int = Field(12, ge=4, le=64)  # of a point, for its normal
    depth: int = Field(11, ge=5, le=13)  # levels of Poisson's octree
    trim_m: float = Field(0.6, gt=0)  # reconstructed surface farther than this from all points goes
    cell_m: float = added(0.2, legacy=0.2, gt=0)  # edge of the cubes that are marched through a distance field
    carve: bool = True  # drop what LiDAR beams went through
    carve_m: float = Field(0.3, gt=0)  # a beam may meet the surface so much before its end
    # at most so many small squares, at LiDAR points that the surface passes by: leaves, wires, poles
    surfels: int = added(100_000, legacy=0, ge=0)
    longest_m: float = Field(40.0, gt=0)  # longest side of a triangle of terrain, seen from above: bare ground has few points
    outlier_m: float = Field(8.0, gt=0)  # points of terrain so far above or below their neighbours go
    weld_m: float = Field(0.02, gt=0)  # vertices in one cell of this size become one
    faces: int | None = Field(150_000, ge=100)  # about this many after QSlim; null: all
    speck_faces: int = Field(25, ge=0)  # connected pieces of fewer faces go
    speck_m: float = Field(0.5, ge=0)  # of a given mesh only those that are no larger: a wall may have two faces
    cull: bool = True  # drop faces that no camera sees
    cull_rays: int = Field(2, ge=1, le=4)  # rays through a pixel, in both directions
    cull_shifts_m: tuple[float, ...] = (-4.0, -2.0, 2.0, 4.0)  # virtual cameras to the right of the source cameras
    cull_rings: int = Field(1, ge=0, le=5)  # rings of faces kept around what is seen


class Scaffold(MapStage):
    name: ClassVar[str] = "scaffold"
    version: ClassVar[int] = 3
    inputs: ClassVar[tuple[str, ...]] = ("capture",)
    Config: ClassVar[Any] = ScaffoldConfig
    reasons: ClassVar[dict[str, str]] = {"empty": "no face is left: points too sparse, or cameras that see nothing of it"}
    limits: ClassVar[dict[str, float]] = {"cpu_s": 7200.0, "wall_s": 14400.0, "memory_gb": 20.0}

    def slug(self, config: ScaffoldConfig) -> str:
        return "all" if config.faces is None else f"{max(config.faces // 1000, 1)}k"

    def items(self, config: ScaffoldConfig, inputs: Inputs) -> Iterable[Item]:
        return [Item("mesh")]

    def max_workers(self, config: ScaffoldConfig, environment: dict[str, Any]) -> int:
        return 1

    def open(self, config: ScaffoldConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        from stages.graphics.geometry import one_thread

        one_thread()
        return config, inputs["capture"]

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        from stages.neuras.records import CaptureInfo, Mesh, frames
        from stages.neuras.surfaces import simplify, visibility
        from stages.neuras.surfaces.surfels import nearest

        config, capture = worker
        info = CaptureInfo.of(capture)
        views = list(frames(capture, "train"))
        mesh, source, beams = _surface(config, capture, info, views)
        faces, given = {"source": len(mesh.faces)}, source["source"] == "given"
        largest = config.speck_m * info.metre if given else np.inf
        mesh = simplify.weld(mesh, config.weld_m * info.metre)
        faces["welded"] = len(mesh.faces)
        if config.faces is not None and len(mesh.faces) > config.faces:
            mesh = simplify.collapse(mesh, config.faces, SPARED if given else 0)
        faces["collapsed"] = len(mesh.faces)
        if config.surfels and len(mesh.faces):  # before surfels are, since specks would take their places
            mesh = simplify.without_specks(mesh, config.speck_faces, largest)
        surfels = _surfels(config, info, mesh, *beams)
        if config.cull and len(mesh.faces):
            shifts = [shift * info.metre for shift in config.cull_shifts_m]
            cameras = visibility.cameras_beside((view.camera for view in views), shifts)
            seen = visibility.seen(Mesh.joined(mesh, surfels), cameras, config.cull_rays)
            mesh, surfels = (
                visibility.kept_faces(part, visible, rings)
                for part, visible, rings in (
                    (mesh, seen[: len(mesh.faces)], config.cull_rings),
                    (surfels, seen[len(mesh.faces) :], 1),  # both halves of a square
                )
            )
            faces["seen"] = len(mesh.faces) + len(surfels.faces)
        if len(mesh.faces):
            mesh = simplify.without_specks(mesh, config.speck_faces, largest)
        if config.surfels:
            surfels = nearest(surfels, [view.camera.position for view in views], config.surfels)
            faces["surfels"] = len(surfels.faces)
            mesh = Mesh.joined(mesh, surfels)
        if not len(mesh.faces):
            raise Reject("empty", f"faces after each step: {faces}")
        meta = {"source": source, "faces": faces | {"kept": len(mesh.faces)}, "vertices": len(mesh.vertices)}
        arrays = pack_arrays({"vertices": mesh.vertices, "faces": mesh.faces})
        yield Record(item.id, {"mesh.npz": arrays, "mesh.json": pack_json(meta)})

    def finish(self, config: ScaffoldConfig, inputs: Inputs, draft: Draft) -> None:
        for row in draft.rows():
            draft.note("summary", unpack_json(draft.read(row.id).members["mesh.json"]))


def _surface(
    config: ScaffoldConfig, capture: Artifact, info: CaptureInfo, views: list[FrameRecord]
) -> tuple[Mesh, dict[str, Any], tuple[np.ndarray, np.ndarray]]:
    """The mesh to simplify, how it came about, and the points (P, 3) that it should hold, with where each was seen from: none
    where the mesh is not of LiDAR's."""
    from stages.neuras.records import given_mesh
    from stages.neuras.surfaces import reconstruct, visibility

    given = given_mesh(capture)
    looking = np.mean([-view.camera.camera_to_world[:3, 2] for view in views], axis=0)
    source = config.source
    if source == "auto":
        from_above = float(looking @ np.array(info.up)) < -0.5
        source = "given" if given is not None else "terrain" if from_above and info.points == "sfm" else "poisson"
    if source == "given":
        if given is None:
            raise UserError("scaffold.source=given, and the capture has no mesh: capture.mesh=FILE, or scaffold.source=poisson")
        return given, {"source": "given"}, NONE
    points, viewers = _points(capture, views)
    if len(points) < 100:
        raise UserError(f"the capture has {len(points)} points, too few for a surface: give it a mesh (capture.mesh=FILE)")
    voxel = config.voxel_m * info.metre
    beams = points, viewers
    points, viewers = reconstruct.thin(points, voxel, viewers)
    stated = {"source": source, "points": len(points)}
    if source == "terrain":
        longest, outlier = config.longest_m * info.metre, config.outlier_m * info.metre
        return reconstruct.terrain(points, np.array(info.up), longest, outlier), stated, NONE
    point_normals = reconstruct.normals(points, viewers, config.neighbours)
    trim = config.trim_m * info.metre
    cell = config.cell_m * info.metre
    if info.points == "sfm":  # these are as dense as the photos' detail, whatever a metre is
        reach = max(trim, SPACINGS * reconstruct.spacing(points))
        trim, cell = reach, cell * reach / trim
    if source == "distance_field":
        mesh = reconstruct.distance_field(points, point_normals, cell, trim)
    else:
        mesh = reconstruct.poisson(points, point_normals, config.depth, trim)
    if config.carve and info.points == "lidar":
        closed = len(mesh.faces)
        mesh = visibility.carved(mesh, *beams, config.carve_m * info.metre)
        stated["carved"] = closed - len(mesh.faces)
    return mesh, stated, beams if info.points == "lidar" else NONE


def _surfels(config: ScaffoldConfig, info: CaptureInfo, mesh: Mesh, points: np.ndarray, sensors: np.ndarray) -> Mesh:
    """Squares at the points (P, 3) that lie a voxel and more beside the mesh, turned to their ``sensors`` (P, 3)."""
    from stages.graphics.geometry import measure
    from stages.neuras.surfaces import reconstruct, visibility
    from stages.neuras.surfaces.surfels import at_points

    voxel = config.voxel_m * info.metre
    if not config.surfels or not len(points) or not len(mesh.faces):
        return at_points(*NONE, voxel)
    places, viewers = reconstruct.thin(points, voxel, sensors)
    beside = measure.distances(places, mesh.vertices, mesh.faces) > voxel
    beside &= np.linalg.norm(viewers - places, axis=1) > voxel  # the sensor's own place is no surface
    squares = at_points(places[beside], viewers[beside], SURFEL * voxel)
    if config.carve and len(squares.faces):
        counts = visibility.beams_at(squares, points, sensors, config.carve_m * info.metre)
        passed, stopped = (of_face.reshape(-1, 2).sum(axis=1) for of_face in counts)
        solid = passed <= THROUGH * np.maximum(stopped, 1)
        squares = visibility.kept_faces(squares, np.repeat(solid, 2), 0)
    return squares


def _points(capture: Artifact, views: list[FrameRecord]) -> tuple[np.ndarray, np.ndarray]:
    """All points (P, 3), and where each was seen from (P, 3): its sweep's sensor, or the nearest camera."""
    from scipy.spatial import cKDTree

    from stages.neuras.records import point_sets

    positions = np.array([view.camera.position for view in views])
    points, viewers = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for record in point_sets(capture):
        these = record.points[np.isfinite(record.points).all(axis=1)].astype(np.float64)
        points.append(these)
        if record.sensor is None:
            viewers.append(positions[cKDTree(positions).query(these)[1]])
        else:
            viewers.append(np.broadcast_to(record.sensor, these.shape))
    return np.concatenate(points), np.concatenate(viewers)
