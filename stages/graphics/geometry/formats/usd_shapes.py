"""What a USD prim that is drawn looks like, as polygons, and where it stands: meshes, shapes by formula, point instancers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.polygons import points_at, triangulate

SECTIONS = 64  # of cylinders, cones and capsules
SUBDIVISIONS = 3  # of an icosahedron, for spheres: 1,280 triangles
CREASE_RADIANS = 0.6  # between faces of a shape, under which they are shaded as one
DEEPEST = 8  # instancers within instancers
TURNS = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}  # a shape along z as one along another axis


@dataclass
class Polygons:
    """Triangles of the polygons of one prim, in its own frame.

    points: (V, 3). counts, index: (P,) corners of each polygon, and the points of all corners. corner: (F, 3) places of the
    triangles' corners in ``index``. face: (F,) the polygon of each. normals: (V, 3) of a shape by formula, else None.
    """

    points: np.ndarray
    counts: np.ndarray
    index: np.ndarray
    corner: np.ndarray
    face: np.ndarray
    normals: np.ndarray | None = None


def placed_prims(stage: Any, time: Any, most: int) -> Iterator[tuple[Any, np.ndarray, bool]]:
    """Each prim that may be drawn, its (4, 4) matrix to the stage's world, and whether it is a copy of an instancer.

    most: copies that one instancer may have; more are a Reject.
    """
    from pxr import Usd, UsdGeom

    cache = UsdGeom.XformCache(time)

    def relative(prim: Any, root: Any) -> np.ndarray:
        if root.IsPseudoRoot():
            return _matrix(cache.GetLocalToWorldTransform(prim))
        return np.eye(4) if prim == root else _matrix(cache.ComputeRelativeTransform(prim, root)[0])

    def below(root: Any, base: np.ndarray, predicate: Any, depth: int) -> Iterator[tuple[Any, np.ndarray, bool]]:
        prims = iter(Usd.PrimRange(root, predicate))
        for prim in prims:
            instancer = UsdGeom.PointInstancer(prim)
            if not instancer:
                yield prim, base @ relative(prim, root), depth > 0
                continue
            prims.PruneChildren()  # prototypes are not drawn themselves
            if instancer.ComputeVisibility(time) != UsdGeom.Tokens.invisible:
                if depth == DEEPEST:
                    raise Reject("unsupported", f"{prim.GetPath()}: over {DEEPEST} instancers within each other")
                for prototype, matrix in _copies(instancer, time, most):
                    active = Usd.TraverseInstanceProxies(Usd.PrimIsActive & Usd.PrimIsLoaded)
                    yield from below(prototype, base @ relative(prim, root) @ matrix, active, depth + 1)

    yield from below(stage.GetPseudoRoot(), np.eye(4), Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate), 0)


def _copies(instancer: Any, time: Any, most: int) -> list[tuple[Any, np.ndarray]]:
    """The prototype of each copy, and its (4, 4) matrix to the instancer's frame."""
    prim = instancer.GetPrim()
    indices = np.asarray(instancer.GetProtoIndicesAttr().Get(time) or [], np.int64)
    if len(indices) > most:
        raise Reject("too_large", f"{prim.GetPath()}: {len(indices)} instances, at most {most} faces are taken")
    paths = instancer.GetPrototypesRel().GetForwardedTargets()
    prototypes = [prim.GetStage().GetPrimAtPath(path) for path in paths]
    if len(indices) and not (indices.min() >= 0 and indices.max() < len(prototypes)):
        raise Reject("unreadable", f"{prim.GetPath()}: prototype {indices.max()} of {len(prototypes)}")
    matrices = instancer.ComputeInstanceTransformsAtTime(time, time, instancer.IncludeProtoXform, instancer.IgnoreMask)
    if len(matrices) != len(indices):
        raise Reject("unreadable", f"{prim.GetPath()}: {len(matrices)} places for {len(indices)} instances")
    mask = instancer.ComputeMaskAtTime(time) or [True] * len(indices)
    kept = [number for number, shown in enumerate(mask) if shown]
    missing = [str(paths[index]) for index in indices[kept] if not prototypes[index]] if kept else []
    if missing:
        raise Reject("unreadable", f"{prim.GetPath()}: its prototype {missing[0][:80]} does not exist")
    return [(prototypes[indices[number]], _matrix(matrices[number])) for number in kept]


def _matrix(matrix: Any) -> np.ndarray:
    """For columns, where USD multiplies rows."""
    return np.asarray(matrix).T


def polygons(prim: Any, time: Any, note: Callable[[str], None]) -> Polygons | None:
    """The polygons of a prim; None where it has none. ``note`` is told what is drawn otherwise, or left out."""
    from pxr import UsdGeom

    if mesh := UsdGeom.Mesh(prim):
        _say_moved(prim, note)
        return _of_mesh(mesh, time)
    kind = str(prim.GetTypeName())
    if kind in SHAPES:
        made = SHAPES[kind](lambda name: prim.GetAttribute(name).Get(time))
        note(f"{prim.GetPath()}: a {kind.lower()}, as {len(made.face):,} triangles")
        return made
    if UsdGeom.Boundable(prim) and kind.endswith(NOT_DRAWN):
        note(f"{prim.GetPath()}: {kind} is left out")
    return None


NOT_DRAWN = ("Curves", "Points", "Patch", "TetMesh", "Volume", "Capsule_1", "Cylinder_1")


def _of_mesh(mesh: Any, time: Any) -> Polygons:
    path = mesh.GetPrim().GetPath()
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    points = np.asarray(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    if counts.sum() != len(index) or (counts < 0).any():
        raise Reject("unreadable", f"{path}: faces of {counts.sum()} corners, but {len(index)} are stated")
    corner, face = triangulate(counts, points_at(points, index))
    order = np.argsort(face, kind="stable")
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(time) or [], np.int64)
    order = order[~np.isin(face[order], holes)]
    return Polygons(points, counts, index, corner[order], face[order])


def _say_moved(prim: Any, note: Callable[[str], None]) -> None:
    if prim.GetAttribute("primvars:skel:jointIndices").HasAuthoredValue():
        note(f"{prim.GetPath()} is moved by a skeleton: it is drawn as its points stand")
    if prim.GetRelationship("skel:blendShapeTargets").HasAuthoredTargets():
        note(f"{prim.GetPath()} has blend shapes: it is drawn without them")


# -- shapes by formula


def _cube(value: Callable[[str], Any]) -> Polygons:
    import trimesh

    return _of_shape(trimesh.creation.box([float(value("size"))] * 3))


def _sphere(value: Callable[[str], Any]) -> Polygons:
    import trimesh

    return _of_shape(trimesh.creation.icosphere(SUBDIVISIONS, float(value("radius"))))


def _round(name: str) -> Callable[[Callable[[str], Any]], Polygons]:
    """A solid of revolution around the axis that the prim names, its middle in the origin."""

    def made(value: Callable[[str], Any]) -> Polygons:
        import trimesh

        sections = [SECTIONS // 2, SECTIONS] if name == "capsule" else SECTIONS
        keyword = {"count": sections} if name == "capsule" else {"sections": sections}
        shape = getattr(trimesh.creation, name)(radius=float(value("radius")), height=float(value("height")), **keyword)
        shape.apply_translation(-shape.bounds.mean(axis=0))
        return _of_shape(shape, str(value("axis")))

    return made


def _plane(value: Callable[[str], Any]) -> Polygons:
    """Across its axis: width and length along x and y for Z, x and z for Y, z and y for X."""
    import trimesh

    width, length, axis = float(value("width")) / 2, float(value("length")) / 2, str(value("axis"))
    first, second = {"X": (2, 1), "Y": (0, 2), "Z": (0, 1)}[axis]
    points = np.zeros((4, 3))
    points[:, first], points[:, second] = np.array([-1, 1, 1, -1]) * width, np.array([-1, -1, 1, 1]) * length
    faces = np.array([[0, 1, 2], [0, 2, 3]]) if axis == "Z" else np.array([[0, 2, 1], [0, 3, 2]])
    return _of_shape(trimesh.Trimesh(points, faces, process=False))


def _of_shape(shape: Any, axis: str = "Z") -> Polygons:
    import trimesh

    smooth = trimesh.graph.smooth_shade(shape, angle=CREASE_RADIANS)
    turn = TURNS[axis]
    points, normals = (np.asarray(array, np.float64)[:, turn] for array in (smooth.vertices, smooth.vertex_normals))
    index = np.asarray(smooth.faces, np.int64).reshape(-1)
    count = len(index) // 3
    return Polygons(points, np.full(count, 3), index, np.arange(3 * count).reshape(-1, 3), np.arange(count), normals)


SHAPES: dict[str, Callable[[Callable[[str], Any]], Polygons]] = {
    "Cube": _cube, "Sphere": _sphere, "Cylinder": _round("cylinder"), "Cone": _round("cone"), "Capsule": _round("capsule"),
    "Plane": _plane,
}  # fmt: skip
