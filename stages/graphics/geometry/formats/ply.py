"""PLY, text and binary: elements of named properties, of which those of vertices, faces and triangle strips are read."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import Look, srgb_colours
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.polygons import points_at, triangulate
from stages.graphics.geometry.formats.text import BYTE_ORDER_MARKS, Words, plain_text, shown

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")
TEXTURE_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
MAX_HEADER = 1 << 16  # bytes


@dataclass
class Property:
    """A number, or a list of them where ``length_type`` is given."""

    name: str
    dtype: np.dtype
    length_type: np.dtype | None = None


@dataclass
class Element:
    """``count`` rows; after reading, a column of numbers for each property, or the lists end to end.

    sizes: (count,) of each list property. columns: by property, (count,) or the values of all lists. places: where its rows
    begin, words of a text or bytes.
    """

    name: str
    count: int
    line: int
    properties: list[Property] = field(default_factory=list)
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    sizes: dict[str, np.ndarray] = field(default_factory=dict)
    places: np.ndarray | None = None


@dataclass
class Header:
    byte_order: str  # "" for text
    elements: list[Element]
    texture: str
    size: int  # bytes
    lines: int


def read(data: bytes, source: Source) -> list[Part]:
    """One part; none where the file has no faces."""
    header, elements, place = read_elements(data, source)
    vertex = elements.get("vertex")
    if vertex is None or not vertex.count:
        return []
    points = points_of(vertex)
    corners, sizes, owner_element = _corners(elements)
    if not len(sizes):
        raise Reject("no_faces", f"{vertex.count} vertices, no faces: a cloud of points")
    if header.texture:
        source.note(f"image {header.texture[:80]}: images of PLY files are not read")
    triangles, owner = triangulate(sizes, points_at(points, corners))
    of_face = owner_element.name == "face"
    points, split = _split(points, corners, owner_element) if of_face and len(np.unique(sizes)) == 1 else (points, corners)
    part = checked_part(
        points, split[triangles],
        lambda index: place(vertex, index),
        lambda triangle: place(owner_element, int(owner[triangle]) if of_face else 0),
    )  # fmt: skip
    if source.images is not None:
        part.look = _look(vertex, owner_element, corners[triangles], owner, source)
    return [part]


def read_points(data: bytes, source: Source) -> np.ndarray:
    """(V, 3) float64: the vertices, whether there are faces or not."""
    vertex = read_elements(data, source)[1].get("vertex")
    return np.zeros((0, 3)) if vertex is None else points_of(vertex)


def read_elements(data: bytes, source: Source):
    """(header, elements by name, a function that says where a row of an element stands)."""
    if next((True for mark, _ in BYTE_ORDER_MARKS if data.startswith(mark)), False):
        data = plain_text(data)
    header = _header(data)
    for element in header.elements:
        least = max(1, len(element.properties)) if element.name != "face" else 2
        if element.count * least > len(data):
            stated = f"states {element.count} {element.name} elements"
            raise Reject("unreadable", f"line {element.line}: {stated} in {len(data)} bytes")
        if element.name == "face" and element.count > source.max_faces:
            stated = f"states {element.count} faces"
            raise Reject("too_large", f"line {element.line}: {stated}, at most {source.max_faces} are taken")
    if not header.byte_order:
        words = Words(data[header.size :].replace(b"\r\n", b"\n").replace(b"\r", b"\n"), header.lines + 1)
        _read_text(header.elements, words)

        def place(element: Element, row: int) -> str:
            return words.place(int(element.places[row]))

    else:
        _read_binary(header.elements, data, header.size)

        def place(element: Element, row: int) -> str:
            return f"byte {int(element.places[row])}: {element.name} {row}"

    return header, {element.name: element for element in header.elements}, place


def points_of(vertex: Element) -> np.ndarray:
    """(V, 3) float64."""
    missing = [axis for axis in "xyz" if axis not in vertex.columns or axis in vertex.sizes]
    if missing:
        raise Reject("unreadable", f"line {vertex.line}: vertices without {', '.join(missing)}")
    return np.stack([vertex.columns[axis] for axis in "xyz"], axis=1).astype(np.float64)


# -- header


def _header(data: bytes) -> Header:
    if not data.strip():
        raise Reject("no_faces", "an empty file")
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data, re.IGNORECASE)
    if not first:
        raise Reject("unreadable", "line 1: no PLY header")
    last = re.search(rb"(?:\r|\n)end_header[ \t]*", data[:MAX_HEADER])
    if not last:
        raise Reject("unreadable", f"line {len(data[:MAX_HEADER].splitlines())}: the header has no end_header")
    size = last.end()
    for end in (b"\r\n",) if first[1] != b"\r" else ():  # after a CR alone a byte 10 is data
        if data[size:].startswith(end):
            size += len(end)
            break
    else:
        size += data[size : size + 1] in (b"\r", b"\n")
    lines = re.split(rb"\r\n|\n|\r", data[: last.end()])
    byte_order, elements, texture = None, [], ""
    for number, line in enumerate(lines[1:], 2):
        words = line.decode("utf-8", "replace").split()
        with at(f"line {number}"):
            if not words or words[0] in ("comment", "obj_info", "end_header"):
                found = re.match(r"comment\s+TextureFile\s+(.+)", " ".join(words), re.IGNORECASE)
                texture = found[1] if found else texture
            elif words[0] == "format":
                if len(words) < 2 or words[1] not in FORMATS:
                    raise Reject("unreadable", f"format {shown(line)}, expected one of {', '.join(FORMATS)}")
                byte_order = FORMATS[words[1]]
            elif words[0] == "element":
                if len(words) != 3 or not words[2].isdecimal():
                    raise Reject("unreadable", f"{shown(line)}, expected: element NAME COUNT")
                elements.append(Element(words[1], int(words[2]), number))
            elif words[0] == "property":
                _add_property(words, elements, byte_order or "")
            else:
                raise Reject("unreadable", f"{shown(line)} is no line of a header")
    if byte_order is None:
        raise Reject("unreadable", "line 2: no format")
    return Header(byte_order, elements, texture, size, len(lines))


def _add_property(words: list[str], elements: list[Element], byte_order: str) -> None:
    listed = len(words) == 5 and words[1] == "list"
    types = words[2:4] if listed else words[1:2]
    if not elements or not (listed or len(words) == 3) or any(name not in TYPES for name in types):
        raise Reject("unreadable", f"{' '.join(words)[:60]!r}, expected: property TYPE NAME, or property list TYPE TYPE NAME")
    dtypes = [np.dtype(byte_order + TYPES[name]) for name in types]
    if listed and dtypes[0].kind == "f":
        raise Reject("unreadable", f"{' '.join(words)[:60]!r}: lists of fractional length")
    elements[-1].properties.append(Property(words[-1], dtypes[-1], dtypes[0] if listed else None))


# -- rows


def _read_text(elements: list[Element], words: Words) -> None:
    start = 0
    for element in elements:
        lists = [property for property in element.properties if property.length_type is not None]
        width = len(element.properties)
        if not lists:
            end = start + element.count * width
            element.places = np.arange(start, end, width) if width else np.zeros(element.count, int)
            if end > len(words):
                raise Reject("unreadable", f"{words.place(len(words))}: the file ends in {element.name} "
                             f"{(len(words) - start) // width} of {element.count}")  # fmt: skip
            rows = words.floats(slice(start, end)).reshape(element.count, width)
            with np.errstate(over="ignore"):
                element.columns = {
                    property.name: rows[:, index].astype(property.dtype) if property.dtype.kind == "f" else rows[:, index]
                    for index, property in enumerate(element.properties)
                }
            start = end
        else:
            start = _read_text_lists(element, words, start)
    if start < len(words):
        raise Reject("unreadable", f"{words.place(start)}: {len(words) - start} words after the last element")


def _read_text_lists(element: Element, words: Words, start: int) -> int:
    """Fill an element whose rows hold lists; returns the word after it."""
    element.places = np.zeros(element.count, np.int64)
    begins = {property.name: np.zeros(element.count, np.int64) for property in element.properties}
    sizes = {p.name: np.zeros(element.count, np.int64) for p in element.properties if p.length_type is not None}
    if len(element.properties) == 1 and element.count and words.words[start : start + 1] == [b"3"]:  # the usual, at once
        end = start + 4 * element.count
        if end <= len(words) and set(words.words[start:end:4]) == {b"3"}:
            (property,) = element.properties
            element.places = np.arange(start, end, 4)
            element.sizes[property.name] = np.full(element.count, 3)
            places = np.add.outer(element.places, [1, 2, 3]).ravel()
            element.columns[property.name] = words.integers(places) if property.dtype.kind in "iu" else words.floats(places)
            return end
    for row in range(element.count):
        element.places[row] = start
        for property in element.properties:
            if start >= len(words):
                raise _ends(words.place(len(words)), element, row)
            begins[property.name][row] = start
            if property.name in sizes:
                if not words.words[start].isdigit():
                    raise Reject("unreadable", f"{words.place(start)}: {shown(words.words[start])} where the length of "
                                 f"{property.name} should stand")  # fmt: skip
                sizes[property.name][row] = size = int(words.words[start])
                start += size
            start += 1
        if start > len(words):
            raise _ends(words.place(len(words)), element, row)
    for property in element.properties:
        name, read_values = property.name, words.integers if property.dtype.kind in "iu" else words.floats
        if name in sizes:
            element.sizes[name] = sizes[name]
            element.columns[name] = read_values(_places(begins[name] + 1, sizes[name]))
        else:
            element.columns[name] = read_values(begins[name])
    return start


def _places(starts: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The numbers from each start on, as many as its size, end to end."""
    before = np.cumsum(sizes) - sizes
    return np.repeat(starts - before, sizes) + np.arange(sizes.sum())


def _ends(place: str, element: Element, row: int) -> Reject:
    return Reject("unreadable", f"{place}: the file ends in {element.name} {row} of {element.count}")


def _read_binary(elements: list[Element], data: bytes, start: int) -> None:
    for element in elements:
        if any(property.length_type is not None for property in element.properties):
            start = _read_binary_lists(element, data, start)
            continue
        dtype = np.dtype([(f"f{index}", property.dtype) for index, property in enumerate(element.properties)])
        element.places = start + dtype.itemsize * np.arange(element.count)
        if start + dtype.itemsize * element.count > len(data):
            raise _ends(f"byte {len(data)}", element, (len(data) - start) // max(dtype.itemsize, 1))
        rows = np.frombuffer(data, dtype, element.count, start) if dtype.itemsize else None
        element.columns = {property.name: rows[f"f{index}"] for index, property in enumerate(element.properties)}
        start += dtype.itemsize * element.count
    if data[start:].strip():
        raise Reject("unreadable", f"byte {start}: {len(data) - start} bytes after the last element")


def _read_binary_lists(element: Element, data: bytes, start: int) -> int:
    """Fill an element whose rows hold lists; returns the byte after it."""
    end = _read_equal_rows(element, data, start)
    if end is not None:
        return end
    element.places = np.zeros(element.count, np.int64)
    begins = {property.name: np.zeros(element.count, np.int64) for property in element.properties}
    sizes = {p.name: np.zeros(element.count, np.int64) for p in element.properties if p.length_type is not None}
    signed = {p.name: p.length_type.kind == "i" for p in element.properties if p.length_type is not None}
    dtypes = [dtype for p in element.properties for dtype in (p.dtype, p.length_type) if dtype is not None]
    order = "big" if any(dtype.str[0] == ">" for dtype in dtypes) else "little"
    layout = [(p.name, p.length_type.itemsize if p.name in sizes else 0, p.dtype.itemsize) for p in element.properties]
    for row in range(element.count):
        element.places[row] = start
        for name, length_bytes, item_bytes in layout:
            if length_bytes:
                if start + length_bytes > len(data):
                    raise _ends(f"byte {len(data)}", element, row)
                size = int.from_bytes(data[start : start + length_bytes], order, signed=signed[name])
                if size < 0:
                    raise Reject("unreadable", f"byte {start}: {element.name} {row} has a list of length {size}")
                start += length_bytes
                sizes[name][row] = size
            begins[name][row] = start
            start += item_bytes * (sizes[name][row] if length_bytes else 1)
        if start > len(data):
            raise _ends(f"byte {len(data)}", element, row)
        start = int(start)
    raw = np.frombuffer(data, np.uint8)
    for property in element.properties:
        name, item = property.name, property.dtype.itemsize
        first = begins[name]
        if name in sizes:
            element.sizes[name] = sizes[name]
            first = np.repeat(begins[name] - item * (np.cumsum(sizes[name]) - sizes[name]), sizes[name])
            first = first + item * np.arange(len(first))
        element.columns[name] = raw[first[:, None] + np.arange(item)].copy().view(property.dtype).reshape(-1)
    return start


def _read_equal_rows(element: Element, data: bytes, start: int) -> int | None:
    """``_read_binary_lists`` at once, where all lists are as long as those of the first row; else None."""
    fields, at_byte = [], start
    for index, property in enumerate(element.properties):
        if property.length_type is None:
            fields.append((f"f{index}", property.dtype))
            at_byte += property.dtype.itemsize
            continue
        if not element.count or at_byte + property.length_type.itemsize > len(data):
            return None
        size = int(np.frombuffer(data, property.length_type, 1, at_byte)[0])
        at_byte += property.length_type.itemsize + size * property.dtype.itemsize
        if not 0 <= size <= 1 << 16:
            return None
        fields += [(f"n{index}", property.length_type), (f"f{index}", property.dtype, (size,))]
    dtype = np.dtype(fields)
    if start + dtype.itemsize * element.count > len(data):
        return None
    rows = np.frombuffer(data, dtype, element.count, start)
    for index, property in enumerate(element.properties):
        if property.length_type is not None:
            if (rows[f"n{index}"] != rows[f"n{index}"][0]).any():
                return None
            element.sizes[property.name] = rows[f"n{index}"].astype(np.int64)
        element.columns[property.name] = rows[f"f{index}"].reshape(-1)
    element.places = start + dtype.itemsize * np.arange(element.count)
    return start + dtype.itemsize * element.count


# -- the mesh


def _corners(elements: dict[str, Element]) -> tuple[np.ndarray, np.ndarray, Element | None]:
    """(corners of all polygons, sizes (F,), the element that they are of): faces, else triangle strips."""
    face = elements.get("face")
    if face is not None and face.count:
        names = [name for name in (*CORNERS, *face.sizes) if name in face.sizes]
        if not names:
            raise Reject("unreadable", f"line {face.line}: faces without {' or '.join(CORNERS)}")
        values = face.columns[names[0]]
        if values.dtype.kind == "f":
            raise Reject("unreadable", f"line {face.line}: faces whose {names[0]} are fractions")
        return values.astype(np.int64), face.sizes[names[0]], face
    strips = elements.get("tristrips")
    if strips is None or not strips.count or not set(CORNERS) & set(strips.sizes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), None
    name = next(name for name in CORNERS if name in strips.sizes)
    values, ends = strips.columns[name].astype(np.int64), np.cumsum(strips.sizes[name])
    values = np.insert(values, ends, -1)  # which ends a strip
    triangles = np.stack([values[:-2], values[1:-1], values[2:]], axis=1)
    begin = np.maximum.accumulate(np.where(values[:-2] < 0, np.arange(len(values) - 2) + 1, 0))
    odd = (np.arange(len(triangles)) - begin) % 2 == 1
    triangles[odd] = triangles[odd, ::-1]
    triangles = triangles[(triangles >= 0).all(axis=1)]
    return triangles.reshape(-1), np.full(len(triangles), 3), strips


def _split(points: np.ndarray, corners: np.ndarray, face: Element) -> tuple[np.ndarray, np.ndarray]:
    """Points and corners with vertices parted where the faces give them several texture coordinates."""
    if "texcoord" not in face.sizes or (face.sizes["texcoord"] != 2 * len(corners) // face.count).any():
        return points, corners
    from trimesh.grouping import unique_rows
    from trimesh.visual.texture import unmerge_faces

    if corners.min() < 0 or corners.max() >= len(points):
        return points, corners  # said where the part is checked
    shape = (face.count, -1)
    _, inverse = unique_rows(face.columns["texcoord"].reshape(-1, 2))
    parted, vertex, _ = unmerge_faces(corners.reshape(shape), inverse.reshape(shape))
    return points[vertex], parted.reshape(-1)


def _look(vertex: Element, face: Element, corners: np.ndarray, owner: np.ndarray, source: Source) -> Look:
    """Colours of faces where they have some, else those of vertices."""
    of_faces = _colours(face, source) if face.name == "face" else None
    if of_faces is not None:
        return Look(tint=np.repeat(of_faces[owner][:, None], 3, axis=1))
    of_vertices = _colours(vertex, source)
    return Look(tint=None if of_vertices is None else of_vertices[corners])


def _colours(element: Element, source: Source) -> np.ndarray | None:
    """(count, 3) linear colours of an element's rows, or None."""
    for names in COLOURS:
        if all(name in element.columns and name not in element.sizes for name in names):
            kinds = {property.name: property.dtype for property in element.properties}
            columns = [_unit(element.columns[name], kinds[name]) for name in names]
            values = np.stack(columns, axis=1)
            return srgb_colours(values, f"{element.name} colours", source.note)
    return None


def _unit(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Colour values of one channel as float64: whole numbers by the largest of their type, those of four bytes by 255."""
    values = values.astype(np.float64)
    if dtype.kind == "f":
        return values
    if dtype.itemsize > 2:  # nobody has so many steps
        return values / (255 if values.max(initial=0) < 256 else 65535)
    return np.where(values < 0, values + 256**dtype.itemsize, values) / (256**dtype.itemsize - 1)  # signed ones are not meant
