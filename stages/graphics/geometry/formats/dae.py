"""Collada, by the package pycollada, which is optional: triangles and polygons of the scene's nodes. No colours."""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.polygons import points_at, triangulate

TO_Y_UP = {
    "Z_UP": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "X_UP": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}  # as other formats have it
DEEPEST = 200  # nodes within nodes


def read(data: bytes, source: Source) -> list[Part]:
    """The triangles of the file's scene, turned so that y is up."""
    if importlib.util.find_spec("collada") is None:
        raise Reject("needs_package", ".dae files need the package pycollada: pip install pycollada")
    import collada

    passed_over = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    try:
        tree = collada.Collada(io.BytesIO(data), ignore=passed_over)
    except collada.common.DaeError as error:
        raise Reject("unreadable", _words(error)) from None
    if tree.scene is None:
        raise Reject("no_faces", "it has no scene that shows its geometries")
    for error in tree.errors:
        source.note(f"left out: {_words(error)}")
    if tree.materials:
        source.note("colours of Collada files are not read")
    turn = np.eye(4)
    turn[:3, :3] = TO_Y_UP.get(tree.assetInfo.upaxis, np.eye(3))
    return list(_Scene(collada, source, turn).parts(tree.scene.nodes, turn, 0))


def _words(error: Any) -> str:
    """What an error of the package says, without the names that parsers give themselves."""
    text = re.sub(r"\(<string>.*|\b\w*\s*(?:Parsing )?Error:\s*", "", str(error.msg)).strip(" ,")
    return text[:200] or "it is damaged"


class _Scene:
    """Walks the nodes. turn: (4, 4), which makes y point up."""

    def __init__(self, collada: Any, source: Source, turn: np.ndarray):
        self.collada, self.source, self.turn, self.faces = collada, source, turn, 0

    def parts(self, nodes: Any, above: np.ndarray, depth: int) -> Iterator[Part]:
        kinds = self.collada.scene
        if depth > DEEPEST:
            raise Reject("unreadable", f"nodes nest over {DEEPEST} deep")
        for node in nodes:
            if isinstance(node, kinds.GeometryNode):
                yield from self._geometry(node.geometry, above)
            elif isinstance(node, kinds.ControllerNode):
                yield from self._controlled(node.controller)
            elif isinstance(node, kinds.Node | kinds.NodeNode):
                yield from self.parts(node.children, above @ node.matrix, depth + 1)

    def _controlled(self, controller: Any) -> Iterator[Part]:
        """A skin or morph at rest: its geometry by the bind shape, which stands in the scene whatever its node does."""
        self.source.note(f"{str(controller.id)[:60]!r} is moved by a skeleton or shape keys: it is drawn as its points stand")
        geometry = getattr(controller, "geometry", None) or controller.source_geometry
        bind = getattr(controller, "bind_shape_matrix", None)
        yield from self._geometry(geometry, self.turn if bind is None else self.turn @ np.asarray(bind, float).reshape(4, 4))

    def _geometry(self, geometry: Any, matrix: np.ndarray) -> Iterator[Part]:
        for number, primitive in enumerate(geometry.primitives):
            place = f"{str(geometry.id)[:60]}: primitive {number}"
            with at(place):
                part = self._primitive(primitive, matrix, place)
            if part is not None:
                yield part

    def _primitive(self, primitive: Any, matrix: np.ndarray, place: str) -> Part | None:
        if isinstance(primitive, self.collada.lineset.LineSet):
            self.source.note(f"{place}: lines are left out")
            return None
        index = np.asarray(primitive.vertex_index, np.int64).reshape(-1)
        if isinstance(primitive, self.collada.triangleset.TriangleSet):
            sizes = np.full(len(index) // 3, 3)
        else:
            sizes = np.asarray(primitive.polyends, np.int64) - np.asarray(primitive.polystarts, np.int64)
        self.faces += len(sizes)
        if self.faces > self.source.max_faces:
            raise Reject("too_large", f"over {self.source.max_faces} faces")
        points = np.asarray(primitive.vertex, np.float64)
        corners, _ = triangulate(sizes, points_at(points, index))
        vertex, triangle = f"{place}: vertex {{}}".format, f"{place}: triangle {{}}".format
        triangles = checked_part(points, index[corners], vertex, triangle).triangles
        if np.linalg.det(matrix[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        return checked_part(points @ matrix[:3, :3].T + matrix[:3, 3], triangles, vertex, triangle)
