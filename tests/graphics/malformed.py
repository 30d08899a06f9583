"""Malformed mesh files, made here: what is wrong with each, and the place where a person finds it."""

from __future__ import annotations

import base64
import copy
import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

POINTS = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0.5]], "<f4")
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], "<u2")
BINARY = POINTS.tobytes() + FACES.tobytes()
TREE: dict[str, Any] = {
    "asset": {"version": "2.0"},
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
    ],
    "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
    "buffers": [{"byteLength": 72}],
}


def glb(tree: dict[str, Any] | bytes, binary: bytes = BINARY) -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def changed(*keys: Any, to: Any, binary: bytes = BINARY) -> bytes:
    """The GLB with one value of its tree replaced."""
    tree = copy.deepcopy(TREE)
    inner = tree
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = to
    return glb(tree, binary)


def without(*keys: Any) -> bytes:
    tree = copy.deepcopy(TREE)
    inner: Any = tree
    for key in keys[:-1]:
        inner = inner[key]
    del inner[keys[-1]]
    return glb(tree)


def with_bytes(position: int, data: bytes) -> bytes:
    return glb(TREE, BINARY[:position] + data + BINARY[position + len(data) :])


def obj(change: Callable[[list[str]], None] = lambda lines: None) -> bytes:
    lines = [*(f"v {x} {y} {z}" for x, y, z in POINTS.tolist()), *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES.tolist())]
    change(lines)
    return "\n".join(lines).encode() + b"\n"


def off(*lines: str) -> bytes:
    return "\n".join(["OFF", "4 4 6", *lines]).encode() + b"\n"


def ply(body: bytes = b"", head: str = "ascii 1.0", vertices: int | str = 4, faces: int | str = 4) -> bytes:
    return (
        f"ply\nformat {head}\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode() + body


def stl(count: int = 4, cut: int | None = None) -> bytes:
    triangles = b"".join(bytes(12) + POINTS[face].tobytes() + bytes(2) for face in FACES)
    return (bytes(80) + struct.pack("<I", count) + triangles)[:cut]


def text_stl(change: Callable[[list[str]], None] = lambda lines: None) -> bytes:
    lines = ["solid a"]
    for face in FACES:
        lines += ["facet normal 0 0 1", "outer loop", *("vertex {} {} {}".format(*POINTS[i].tolist()) for i in face)]
        lines += ["endloop", "endfacet"]
    lines.append("endsolid a")
    change(lines)
    return "\n".join(lines).encode() + b"\n"


def line(number: int, text: str | None) -> Callable[[list[str]], None]:
    """Replace a line, counted from 1, or leave it out."""

    def change(lines: list[str]) -> None:
        lines[number - 1 : number] = [] if text is None else [text]

    return change


VERTEX_LINES = [" ".join(map(str, point)) for point in POINTS.tolist()]
FACE_LINES = [f"3 {a} {b} {c}" for a, b, c in FACES.tolist()]
BINARY_PLY = ply(
    POINTS.tobytes() + b"".join(b"\3" + face.astype("<i4").tobytes() for face in FACES), "binary_little_endian 1.0"
)
ROWS = [*VERTEX_LINES, *FACE_LINES]
HEAD = 9  # lines of the header of a PLY


def rows(number: int, text: str | None, newline: str = "\n") -> bytes:
    """A text PLY with one of its rows replaced; their lines follow those of the header."""
    lines = list(ROWS)
    line(number, text)(lines)
    return ply((newline.join(lines) + newline).encode())


NEST = b'{"asset":' + b"[" * 100_000
DATA = "data:;base64," + base64.b64encode(BINARY).decode()

# name: (bytes, reason, place, words)
MALFORMED: dict[str, tuple[bytes, str, str, str]] = {
    # glTF: the container
    "empty.glb": (b"", "unreadable", "byte 0", "no GLB header"),
    "cut-header.glb": (glb(TREE)[:10], "unreadable", "byte 0", "no GLB header"),
    "version.glb": (glb(TREE)[:4] + b"\1\0\0\0" + glb(TREE)[8:], "unsupported", "byte 4", "GLB version 1"),
    "cut-json.glb": (glb(TREE)[:200], "unreadable", "byte 12", "ends at byte 200"),
    "cut-binary.glb": (glb(TREE)[:-30], "unreadable", f"byte {len(glb(TREE)) - 80}", "a chunk of 72 bytes"),
    "no-json.glb": (glb(TREE)[:12], "unreadable", "byte 12", "no JSON chunk"),
    "comma.glb": (glb(b'{"asset": {"version": "2.0"},}'), "unreadable", "line 1, column 30", "not JSON"),
    "nested.glb": (glb(NEST), "unreadable", "JSON", "nested too deeply"),
    "latin.gltf": (b'{"asset": {"generator": "caf\xe9"}}', "unreadable", "byte 28", "not text in utf-8"),
    "list.glb": (glb(b"[1, 2]"), "unsupported", "JSON", "not a table"),
    "old.glb": (changed("asset", "version", to="1.0"), "unsupported", "glTF 1.0", "expected 2.x"),
    "needs.glb": (changed("extensionsRequired", to=["EXT_meshopt_compression"]), "unsupported", "requires", "EXT_meshopt"),
    # glTF: buffers and views
    "short-buffer.glb": (changed("buffers", 0, "byteLength", to=99), "unreadable", "buffer 0", "states 99 bytes and has 72"),
    "word-buffer.glb": (changed("buffers", 0, "byteLength", to="many"), "unreadable", "buffer 0", "byteLength is 'many'"),
    "list-buffer.glb": (changed("buffers", to={}), "unreadable", "buffers", "not a list"),
    "null-buffer.glb": (changed("buffers", 0, to=None), "unreadable", "buffer 0", "not a table"),
    "two-buffers.glb": (changed("buffers", to=[{"byteLength": 72}] * 2), "unreadable", "buffer 1", "no data"),
    "base64.gltf": (
        json.dumps({**TREE, "buffers": [{"byteLength": 72, "uri": "data:;base64,AAA"}]}).encode(),
        "unreadable", "buffer 0", "not base64",
    ),
    "number-uri.glb": (changed("buffers", 0, "uri", to=7), "unreadable", "buffer 0", "uri is not text"),
    "no-file.glb": (changed("buffers", 0, "uri", to="x.bin"), "unreadable", "buffer 0", "'x.bin' is missing"),
    "view-end.glb": (changed("bufferViews", 1, "byteLength", to=99), "unreadable", "buffer view 1", "ends at byte 147"),
    "view-buffer.glb": (changed("bufferViews", 0, "buffer", to=4), "unreadable", "buffer view 0", "buffer 4 does not exist"),
    "view-negative.glb": (changed("bufferViews", 0, "byteOffset", to=-4), "unreadable", "buffer view 0", "byteOffset is '-4'"),
    "view-stride.glb": (changed("bufferViews", 0, "byteStride", to=8), "unreadable", "accessor 0", "byteStride 8"),
    # glTF: accessors
    "no-view.glb": (changed("accessors", 0, "bufferView", to=9), "unreadable", "accessor 0", "buffer view 9 does not exist"),
    "too-many.glb": (changed("accessors", 0, "count", to=5), "unreadable", "accessor 0", "end at byte 60"),
    "word-count.glb": (changed("accessors", 1, "count", to="twelve"), "unreadable", "accessor 1", "count is 'twelve'"),
    "half-count.glb": (changed("accessors", 1, "count", to=1.5), "unreadable", "accessor 1", "count is '1.5'"),
    "no-count.glb": (without("accessors", 1, "count"), "unreadable", "accessor 1", "count is missing"),
    "component.glb": (changed("accessors", 0, "componentType", to=5124), "unreadable", "accessor 0", "componentType 5124"),
    "type.glb": (changed("accessors", 0, "type", to="VEC9"), "unreadable", "accessor 0", "type 'VEC9'"),
    "vec2.glb": (changed("accessors", 0, "type", to="VEC2"), "unreadable", "accessor 0", "POSITION of type VEC2"),
    "sparse.glb": (
        changed("accessors", 0, "sparse", to={
            "count": 1, "indices": {"bufferView": 1, "byteOffset": 4, "componentType": 5121}, "values": {"bufferView": 0}
        }, binary=BINARY[:52] + b"\x09" + BINARY[53:]),
        "unreadable", "accessor 0: sparse", "changes element 9 of 4",
    ),
    "sparse-list.glb": (changed("accessors", 0, "sparse", to=[]), "unreadable", "accessor 0: sparse", "not a table"),
    "zeros.glb": (
        changed("accessors", 0, to={"componentType": 5126, "count": 10**12, "type": "VEC3"}),
        "too_large", "accessor 0", "without data",
    ),
    # glTF: meshes and nodes
    "index.glb": (with_bytes(48 + 6, b"\x09\0"), "bad_indices", "accessor 1: triangle 1", "vertex 9 of 4"),
    "nan.glb": (with_bytes(12, struct.pack("<f", np.nan)), "not_finite", "accessor 0: element 1", "not a number"),
    "eleven.glb": (changed("accessors", 1, "count", to=11), "unreadable", "accessor 1", "no whole number of triangles"),
    "float-index.glb": (
        changed("meshes", 0, "primitives", 0, "indices", to=0), "unreadable", "primitive 0: accessor 0", "whole numbers"
    ),
    "no-accessor.glb": (
        changed("meshes", 0, "primitives", 0, "indices", to=5), "unreadable", "mesh 0: primitive 0", "accessor 5 does not exist"
    ),
    "no-position.glb": (
        changed("meshes", 0, "primitives", 0, "attributes", to={}), "unreadable", "mesh 0: primitive 0", "POSITION is missing"
    ),
    "primitives.glb": (changed("meshes", 0, "primitives", to=3), "unreadable", "mesh 0", "primitives is not a list"),
    "no-mesh.glb": (changed("nodes", 0, "mesh", to=2), "unreadable", "node 0", "mesh 2 does not exist"),
    "no-scene.glb": (changed("scene", to=3), "unreadable", "scene 3", "does not exist"),
    "cycle.glb": (changed("nodes", to=[{"mesh": 0}, {"children": [2]}, {"children": [1]}]), "unreadable", "node 1", "cycle"),
    "scale.glb": (changed("nodes", 0, "scale", to=[1, 1]), "unreadable", "node 0", "scale is '[1, 1]', expected 3 numbers"),
    "word-scale.glb": (changed("nodes", 0, "scale", to=[1, "x", 1]), "unreadable", "node 0", "expected 3 numbers"),
    "nan-scale.glb": (changed("nodes", 0, "scale", to=[1, np.nan, 1]), "not_finite", "node 0", "not finite"),
    # OBJ
    "word.obj": (obj(line(3, "v 0 one 0")), "unreadable", "line 3", "'one' is not a number"),
    "short.obj": (obj(line(2, "v 1 2")), "unreadable", "line 2", "2 numbers, expected 3"),
    "beyond.obj": (obj(line(6, "f 1 2 9")), "bad_indices", "line 6", "vertex 9 of 4"),
    "zero.obj": (obj(line(7, "f 0 1 2")), "bad_indices", "line 7", "vertex 0 of 4 (counted from 1)"),
    "before.obj": (obj(line(5, "f -5 -4 -3")), "bad_indices", "line 5", "vertex -5 of 4"),
    "corner.obj": (obj(line(8, "f 1/x 2 3")), "unreadable", "line 8", "'1/x' is not a corner"),
    "inf.obj": (obj(line(4, "v 1e999 0 1")), "not_finite", "line 4", "infinite"),
    "separator.obj": (obj(line(4, "v 1_0 0 1")), "unreadable", "line 4", "'1_0' is not a number"),
    "no-face.obj": (obj(lambda lines: lines.__delitem__(slice(4, 8))), "no_faces", "4 vertices", "no faces"),
    # OFF
    "header.off": (b"HELLO\n1 2 3\n", "unreadable", "line 1", "no OFF header"),
    "claims.off": (b"OFF\n1 900000 0\n0 0 0\n", "unreadable", "line 2", "900000 faces"),
    "word.off": (off(*VERTEX_LINES[:3], "0 0 x", *FACE_LINES), "unreadable", "line 6", "'x' is not a number"),
    "short-face.off": (off(*VERTEX_LINES, "3 0 1", *FACE_LINES[1:]), "unreadable", "line 7", "corners in a line of 3 words"),
    "beyond.off": (off(*VERTEX_LINES, *FACE_LINES[:2], "3 0 1 7", FACE_LINES[3]), "bad_indices", "line 9", "vertex 7 of 4"),
    "cut.off": (off(*VERTEX_LINES, *FACE_LINES[:2]), "unreadable", "line 8", "the file ends before face 2 of 4"),
    "binary.off": (b"OFF BINARY\n" + bytes(40), "unsupported", "line 1", "BINARY"),
    # PLY
    "header.ply": (b"plx\n", "unreadable", "line 1", "no PLY header"),
    "endless.ply": (ply()[:-12], "unreadable", "line 8", "no end_header"),
    "format.ply": (ply(head="morse 1.0"), "unreadable", "line 2", "expected one of ascii"),
    "count.ply": (ply(vertices="four"), "unreadable", "line 3", "expected: element NAME COUNT"),
    "claims.ply": (ply(faces=10**6), "unreadable", "line 7", "states 1000000 face"),
    "type.ply": (ply().replace(b"float y", b"real y"), "unreadable", "line 5", "expected: property TYPE NAME"),
    "no-z.ply": (rows(1, VERTEX_LINES[0]).replace(b"float z", b"float w"), "unreadable", "line 3", "vertices without z"),
    "word.ply": (rows(2, "1 two 3"), "unreadable", f"line {HEAD + 2}", "'two' is not a number"),
    "beyond.ply": (rows(6, "3 0 1 4"), "bad_indices", f"line {HEAD + 6}", "vertex 4 of 4"),
    "cut-text.ply": (rows(8, None), "unreadable", f"line {HEAD + 7}", "the file ends in face 3 of 4"),
    "nan.ply": (rows(3, "nan 0 0"), "not_finite", f"line {HEAD + 3}", "not a number"),
    "cut.ply": (BINARY_PLY[:-5], "unreadable", f"byte {len(BINARY_PLY) - 5}", "the file ends in face 3 of 4"),
    "more.ply": (BINARY_PLY + b"xyz", "unreadable", f"byte {len(BINARY_PLY)}", "3 bytes after the last element"),
    "negative.ply": (
        BINARY_PLY.replace(b"list uchar", b"list char").replace(b"\3\0\0\0\0\3\0\0\0\2", b"\xff\0\0\0\0\3\0\0\0\2"),
        "unreadable", f"byte {len(BINARY_PLY) - 14}", "a list of length -1",
    ),
    # STL
    "header.stl": (bytes(50), "unreadable", "byte 50", "ends in the header"),
    "claims.stl": (stl(count=9), "unreadable", "byte 80", "states 9 faces"),
    "cut.stl": (stl(cut=-60), "unreadable", "byte 80", "end at byte 284 of 224"),
    "word.stl": (text_stl(line(5, "vertex 0 one 0")), "unreadable", "line 5", "'one' is not a number"),
    "endless.stl": (text_stl(line(30, None)), "unreadable", "line 29", "no endsolid for the solid of line 1"),
    "loop.stl": (text_stl(line(4, None)), "unreadable", "line 6", "a loop of 2 vertices"),
    "inf.stl": (text_stl(line(6, "vertex 0 inf 0")), "not_finite", "line 6", "infinite"),
}  # fmt: skip
