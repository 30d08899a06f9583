"""OBJ: lines of vertices and of faces with any number of corners, one part for each material."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import Look, Material, srgb_colours
from stages.graphics.geometry.formats import mtl
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.polygons import triangulate
from stages.graphics.geometry.formats.text import floats, integers, plain_text, shown

NUMBERS = (b"v", b"vt", b"vn")
LEFT_OUT = {b"surf": "free-form surfaces", b"call": "other files that it calls"}


@dataclass
class _Lines:
    """What follows the key of each line of one kind, and the numbers of the lines."""

    values: list[bytes] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)

    def add(self, value: bytes, number: int) -> None:
        self.values.append(value)
        self.numbers.append(number)


@dataclass
class _Faces:
    """corners: (N, 3) indices of vertex, texture coordinate and normal, -1 where there is none; end to end.

    sizes: (F,) corners of each face. lines: (F,) where it stands.
    """

    corners: np.ndarray
    sizes: np.ndarray
    lines: np.ndarray


def read(data: bytes, source: Source) -> list[Part]:
    """One part for each material, the last to be used first."""
    lines, faces, libraries, left_out = _lines(data)
    source.references += libraries
    for number, what in left_out:
        source.note(f"line {number}: {what} are left out")
    total = sum(len(group.values) for group in faces.values())
    if total > source.max_faces:
        raise Reject("too_large", f"{total} faces, at most {source.max_faces} are taken")
    if not total:
        raise Reject("no_faces", f"{len(lines[b'v'].values)} vertices, no faces")
    points, colours = _vertices(lines[b"v"], source)
    texture = _rows(lines[b"vt"], 1)
    materials = mtl.read(libraries, source) if source.images is not None else {}
    parts = []
    for name, group in reversed(faces.items()):
        indices = _indices(group, {key: np.array(lines[key].numbers) for key in NUMBERS})
        part, corner_rows = _part(points, indices, lines)
        if part is not None:
            if source.images is not None:
                part.look = _look(name, corner_rows, texture, colours, materials, source)
            parts.append(part)
    return parts


def library_names(data: bytes) -> list[str]:
    """What the ``mtllib`` lines of an OBJ name."""
    return _lines(data)[2]


def _lines(data: bytes) -> tuple[dict[bytes, _Lines], dict[str | None, _Lines], list[str], list[tuple[int, str]]]:
    """Lines of numbers by key, of faces by material, the names of material libraries, and (line, what) is not read."""
    numbers = {key: _Lines() for key in NUMBERS}
    faces: dict[str | None, _Lines] = {}
    libraries: list[str] = []
    left_out: dict[bytes, tuple[int, str]] = {}
    material = None
    for number, line in _joined(plain_text(data)):
        words = line.split(None, 1)
        if not words:
            continue
        key, value = words[0], words[1] if len(words) == 2 else b""
        if key in numbers:
            numbers[key].add(value, number)
        elif key in (b"f", b"fo"):
            faces.setdefault(material, _Lines()).add(value, number)
        elif key == b"usemtl":
            material = mtl.material_name(value)
        elif key == b"mtllib" and value:
            libraries.append(value.decode("utf-8", "replace").strip())
        elif key in LEFT_OUT:
            left_out.setdefault(key, (number, LEFT_OUT[key]))
    return numbers, faces, libraries, list(left_out.values())


def _joined(text: bytes):
    """(number, line) of a text; a line that ends with a backslash goes on in the next one, unless it is a comment."""
    lines = enumerate(text.split(b"\n"), 1)
    if b"\\" not in text:
        yield from lines
        return
    for number, line in lines:
        while line.rstrip().endswith(b"\\") and not line.lstrip().startswith(b"#"):
            line = line.rstrip()[:-1] + b" " + next(lines, (0, b""))[1]
        yield number, line


def _rows(lines: _Lines, least: int) -> list[list[bytes]]:
    """The words of each line, without comments; at least so many."""
    rows = [value.split(b"#", 1)[0].split() if b"#" in value else value.split() for value in lines.values]
    for row, number in zip(rows, lines.numbers, strict=True):
        if len(row) < least:
            raise Reject("unreadable", f"line {number}: {len(row)} numbers, expected {least}")
    return rows


def _numbers(rows: list[list[bytes]], lines: _Lines, first: int, last: int) -> np.ndarray:
    """(n, last - first) float64 of columns of the rows."""
    words = [word for row in rows for word in row[first:last]]
    fault, values = floats(words)
    if fault is not None:
        number = lines.numbers[fault // (last - first)]
        raise Reject("unreadable", f"line {number}: {shown(words[fault])} is not a number")
    return values.reshape(len(rows), last - first)


def _vertices(lines: _Lines, source: Source) -> tuple[np.ndarray, np.ndarray | None]:
    """(V, 3) points, and (V, 3) linear colours where all vertices have them. A fourth number, the weight of a rational
    curve, means nothing for polygons."""
    rows = _rows(lines, 3)
    points = _numbers(rows, lines, 0, 3)
    lengths = {len(row) for row in rows}
    if source.images is None or max(lengths, default=3) < 6:
        return points, None
    if min(lengths) < 6:
        source.note("colours of vertices: only some vertices have one, none are read")
        return points, None
    try:
        return points, srgb_colours(_numbers(rows, lines, 3, 6), "colours of vertices", source.note)
    except Reject as reject:
        source.note(f"colours of vertices: {reject.detail}")
        return points, None


def _indices(group: _Lines, line_numbers: dict[bytes, np.ndarray]) -> _Faces:
    """The faces of a group, their indices counted from 0 and over the whole file."""
    rows = _rows(group, 1)
    sizes = np.array([len(row) for row in rows], np.int64)
    words = [word for row in rows for word in row]
    lines = np.array(group.numbers)
    line_of_corner = np.repeat(lines, sizes)
    stated = _stated(words, line_of_corner)
    corners = np.full((len(words), 3), -1, np.int64)
    for column, key in enumerate(NUMBERS):
        values, count = stated[:, column], len(line_numbers[key])
        before = np.searchsorted(line_numbers[key], line_of_corner)  # a negative index counts back from where it stands
        corners[:, column] = np.where(values > 0, values - 1, np.where(values < 0, before + values, -1))
        if key == b"v":
            bad = np.flatnonzero((corners[:, 0] < 0) | (corners[:, 0] >= count))
            if len(bad):
                raise Reject(
                    "bad_indices", f"line {line_of_corner[bad[0]]}: vertex {values[bad[0]]} of {count} (counted from 1)"
                )
    return _Faces(corners, sizes, lines)


def _stated(words: list[bytes], lines: np.ndarray) -> np.ndarray:
    """(N, 3) indices of corners as written, ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``; 0 where there is none."""
    slashes = {word.count(b"/") for word in words}
    parts = max(slashes) + 1
    if len(slashes) == 1 and parts <= 3:
        text = b" ".join(words)
        flat = text.replace(b"//", b"/0/").replace(b"/", b" ").split() if parts > 1 else words
        if len(flat) == parts * len(words):
            fault, values = integers(flat)
            if fault is None:
                return np.pad(values.reshape(-1, parts), ((0, 0), (0, 3 - parts)))
    stated = np.zeros((len(words), 3), np.int64)
    for index, word in enumerate(words):
        fields = word.split(b"/")
        fault, values = integers([field or b"0" for field in fields])
        if fault is not None or len(fields) > 3 or not fields[0]:
            raise Reject("unreadable", f"line {lines[index]}: {shown(word)} is not a corner of a face")
        stated[index, : len(values)] = values
    return stated


def _part(points: np.ndarray, faces: _Faces, lines: dict[bytes, _Lines]) -> tuple[Part | None, np.ndarray]:
    """The triangles of the faces, and for each corner (F, 3) the row (vertex, texture coordinate) that it has.

    A vertex with several texture coordinates or normals becomes several, as in an array for drawing.
    """
    used = np.repeat(faces.sizes > 2, faces.sizes)
    if not used.any():
        return None, np.zeros((0, 3, 2), np.int64)
    corners = np.where(used, faces.corners[:, 0], 0)
    has_uv, has_normal = (bool((faces.corners[used, column] >= 0).all()) for column in (1, 2))
    has_normal = has_normal and (has_uv or bool(lines[b"vn"].values))
    if has_uv or has_normal:
        from trimesh.visual.texture import unmerge_faces

        parted = [faces.corners[used, column : column + 1] for column, has in ((1, has_uv), (2, has_normal)) if has]
        rows, vertex, *_ = unmerge_faces(faces.corners[used, :1], *parted)
        corners[used] = rows[:, 0]
        points = points[vertex]
    regular = len({*faces.sizes.tolist()}) == 1 and len(np.unique((faces.corners >= 0).sum(axis=1))) == 1
    places, owner = triangulate(faces.sizes, points[corners], in_order=not regular)
    triangles = corners[places]
    kept, triangles = np.unique(triangles, return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    place = _Places(faces, places, owner, triangles, lines[b"v"].numbers)
    part = checked_part(points[kept], triangles, place.vertex, place.triangle)
    return part, faces.corners[places][..., :2]


@dataclass
class _Places:
    """Says in which line a triangle or a vertex of a part stands."""

    faces: _Faces
    places: np.ndarray
    owner: np.ndarray
    triangles: np.ndarray
    vertex_lines: list[int]

    def triangle(self, index: int) -> str:
        return f"line {self.faces.lines[self.owner[index]]}"

    def vertex(self, index: int) -> str:
        row, column = np.argwhere(self.triangles == index)[0]
        return f"line {self.vertex_lines[self.faces.corners[self.places[row, column], 0]]}"


def _look(name, corner_rows: np.ndarray, texture: list[list[bytes]], colours, materials: dict[str, Material], source) -> Look:
    """The colours of a part: of its material, else of its vertices."""
    look = Look()
    if name in materials:
        look.material = materials[name]
    elif name:
        source.note(f"material {name[:80]!r} is in no library that was read")
    if look.material.image is not None:
        look.uv = _coordinates(corner_rows[..., 1], texture, source)
    if colours is not None and not look.textured:
        look.tint = colours[corner_rows[..., 0]]
        look.material = Material()
    return look


def _coordinates(indices: np.ndarray, rows: list[list[bytes]], source: Source) -> np.ndarray | None:
    """(F, 3, 2) texture coordinates of corners; None and a note where one is missing."""
    if indices.size and indices.min() >= 0 and indices.max() < len(rows):
        fault, values = floats([word for row in rows for word in (*row, b"0")[:2]])
        if fault is None:
            return values.reshape(-1, 2)[indices]
        source.note(f"texture coordinate {fault // 2 + 1} (vt) is not two numbers")
        return None
    source.note("faces without texture coordinates, or with some that do not exist, have no image")
    return None
