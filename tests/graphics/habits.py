"""One box of 2 x 1 x 0.5, written with the habits of many exporters."""

from __future__ import annotations

import re

import numpy as np

BOX = np.array([[x, y, z] for x in (0, 2) for y in (0, 1) for z in (0, 0.5)], float)  # 2 x 1 x 0.5
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
V = "".join(f"v {x} {y} {z}\n" for x, y, z in BOX)
F = "".join("f " + " ".join(str(i + 1) for i in quad) + "\n" for quad in QUADS)
MESSY = "".join(f"v {x:+e} {y}. {z}d0\n".replace("1.0.", "1.").replace("0.0.", "0.") for x, y, z in BOX)
INTERLEAVED = "".join("".join("v {} {} {}\n".format(*BOX[i]) for i in quad) + "f -4 -3 -2 -1\n" for quad in QUADS)

HABITS: dict[str, bytes] = {
    "plain.obj": (V + F).encode(),
    "numbers.obj": (V.replace("2 ", "2.e0 ").replace("1 ", "1.e+0 ") + F).encode(),
    "sign-before-e.obj": (V.replace("0.5", "5.0-e1").replace("v 2.0", "v 0.2+e1") + F).encode(),
    "fortran.obj": MESSY.encode() + F.encode(),
    "continued.obj": (V.replace(" 0.5", " \\\n0.5") + F.replace("f ", "f \\\n  ").replace("5 7", "5 \\\r\n 7")).encode(),
    "comment-ends-in-backslash.obj": (b"# C:\\models\\\n" + V.encode() + F.encode()),
    "relative.obj": INTERLEAVED.encode(),
    "relative-at-end.obj": (V + "".join("f " + " ".join(str(i - 8) for i in quad) + "\n" for quad in QUADS)).encode(),
    "with-w.obj": (V.replace("\n", " 1.0\n") + F).encode(),
    "with-colours.obj": (V.replace("\n", " 1 0.5 0\n") + F).encode(),
    "some-colours.obj": (V.replace("\n", " 1 0.5 0\n", 3) + F).encode(),
    "comments-behind.obj": (V + F).replace("\n", " # so 1 2 3\n").encode(),
    "tabs-and-blanks.obj": (V + F).replace("v ", " v\t").replace("f ", "\tf  ").replace("\n", "  \r\n\r\n").encode(),
    "cr.obj": (V + F).replace("\n", "\r").encode(),
    "bom.obj": b"\xef\xbb\xbf" + (V + F).encode(),
    "utf16.obj": (V + F).encode("utf-16"),
    "utf16-without-mark.obj": ("# a comment\n" + V + F).encode("utf-16-le"),
    "latin1.obj": b"o caf\xe9\n" + (V + F).encode(),
    "names-with-spaces.obj": f"mtllib my colours.mtl\no a box f 1\ng An f Three Other Thing\n{V}usemtl my red\n{F}".encode(),
    "normals-and-uv.obj": (V + "vt 0 0\nvn 0 0 1\n" + re.sub(r" (\d)", r" \1/1/1", F)).encode(),
    "two-corners.obj": (V + "v 9 9 9\n" * 9 + "vt 0 0\n" + re.sub(r" (\d)", r" \1/1", F) + "f 16/1 17/1\n").encode(),
    "normals.obj": (V + "vn 0 0 1\n" + re.sub(r" (\d)", r" \1//1", F)).encode(),
    "mixed-corners.obj": (V + "vt 0 0\nvn 0 0 1\n" + F.replace("f 1 2", "f 1/1/1 2//1").replace("f 5 7", "f 5/1 7/")).encode(),
    "points-and-lines.obj": (V + "p 1 2\nl 1 2 3\n" + F + "f 1 2\n").encode(),
}  # fmt: skip


def off_of(head: str, vertex_tail: str = "", face_tail: str = "", newline: str = "\n") -> bytes:
    lines = [head, *(" ".join(map(str, p)) + vertex_tail for p in BOX.tolist())]
    lines += [" ".join(map(str, [4, *quad])) + face_tail for quad in QUADS]
    return newline.join(lines).encode() + b"\n"


HABITS |= {
    "plain.off": off_of("OFF\n8 6 12"),
    "no-edges.off": off_of("OFF\n8 6"),
    "no-word.off": off_of("8 6 12"),
    "glued.off": off_of("OFF8 6 12"),
    "behind.off": off_of("OFF 8 6 12"),
    "stream.off": off_of("OFF\n8 6 12").replace(b" ", b"\n"),
    "one-line.off": off_of("OFF\n8 6 12").replace(b"\n", b" "),
    "cr.off": off_of("OFF\n8 6 12").replace(b"\n", b"\r"),
    "blank.off": off_of(" \n\n# a comment\n  OFF # one more\n\n# and\n8 6 12\n# here").replace(b"\n4", b"\n\n  # face\n\t4"),
    "coff.off": off_of("COFF\n8 6 12", " 255 128 0 255"),
    "coff3.off": off_of("COFF\n8 6 12", " 1.0 0.5 0"),
    "cnoff.off": off_of("CNOFF\n8 6 12", " 0 0 1 255 128 0 255"),
    "noff.off": off_of("NOFF\n8 6 12", " 0 0 1"),
    "stoff.off": off_of("STOFF\n8 6 12", " 0.25 0.5"),
    "face-colours.off": off_of("OFF\n8 6 12", "", " 255 128 0"),
    "face-alpha.off": off_of("OFF\n8 6 12", "", " 1.0 0.5 0.0 1.0"),
    "face-index.off": off_of("OFF\n8 6 12", "", " 7"),
    "unsaid.off": off_of("OFF\n8 6 12", " 9 9 9"),
    "bom.off": b"\xef\xbb\xbf" + off_of("OFF\n8 6 12"),
    "utf16.off": off_of("OFF\n8 6 12").decode().encode("utf-16"),
}


def ply_of(
    kind: str, newline: str = "\n", scalar: str = "float", index: str = "int", length: str = "uchar",
    name: str = "vertex_indices", more: str = "",
) -> bytes:  # fmt: skip
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    colours = more == "colours"
    head = ["ply", f"format {kind} 1.0", "comment made here", "obj_info nothing", "element vertex 8"]
    head += [f"property {scalar} {axis}" for axis in "xyz"]
    head += [f"property uchar {channel}" for channel in ("red", "green", "blue")] if colours else []
    head += ["element face 6", *(["property uchar flags"] if more == "flags" else []), f"property list {length} {index} {name}"]
    head += ["element edge 1", "property int vertex1", "property int vertex2", "end_header"]
    types = {"float": "f4", "double": "f8", "int": "i4", "uint": "u4", "uchar": "u1", "short": "i2"}
    data = (newline.join(head) + newline).encode()
    rows = [([*point], scalar, (255, 128, 0) if colours else ()) for point in BOX.tolist()]
    if not order:
        lines = [" ".join(map(str, [*point, *tail])) for point, _, tail in rows]
        lines += [" ".join(map(str, [*([3] if more == "flags" else []), 4, *quad])) for quad in QUADS]
        return data + (newline.join([*lines, "0 1"]) + newline).encode()
    for point, _, tail in rows:
        data += np.array(point, order + types[scalar]).tobytes() + bytes(tail)
    for quad in QUADS:
        data += b"\3" if more == "flags" else b""
        data += np.array([4], order + types[length]).tobytes() + np.array(quad, order + types[index]).tobytes()
    return data + np.array([0, 1], order + "i4").tobytes()


HABITS |= {
    f"{kind}-{number}.ply": ply_of(kind, **options)
    for kind in ("ascii", "binary_little_endian", "binary_big_endian")
    for number, options in enumerate([
        {}, {"newline": "\r\n"}, {"newline": "\r"}, {"scalar": "double", "index": "uint", "length": "int"},
        {"index": "short", "name": "vertex_index"}, {"more": "flags", "index": "uchar"}, {"more": "colours", "newline": "\r"},
    ])
}  # fmt: skip
TRIANGLES = np.array([[q[0], q[1], q[2]] for q in QUADS] + [[q[2], q[3], q[0]] for q in QUADS])
FACETS = [
    "facet normal 0 0 0\nouter loop\n" + "".join("vertex {} {} {}\n".format(*p) for p in BOX[t]) + "endloop\nendfacet\n"
    for t in TRIANGLES
]
TEXT = "".join(FACETS)
BINARY_STL = b"".join(bytes(12) + BOX[t].astype("<f4").tobytes() + bytes(2) for t in TRIANGLES)
HABITS |= {
    "text.stl": f"solid\n{TEXT}endsolid\n".encode(),
    "upper.stl": f"solid A BOX\n{TEXT}endsolid A BOX\n".upper().encode(),
    "vertex-in-name.stl": f"solid vertex 1 2 3\n{TEXT}endsolid vertex 1 2 3\n".encode(),
    "one-line.stl": f"solid a\n{' '.join(TEXT.split())}\nendsolid a".encode(),
    "cr.stl": f"solid a\r{TEXT}endsolid a\r".replace("\n", "\r").encode(),
    "two-solids.stl": "".join(f"solid {n}\n{''.join(FACETS[n::2])}endsolid {n}\n" for n in (0, 1)).encode(),
    "binary.stl": bytes(80) + b"\x0c\0\0\0" + BINARY_STL,
    "binary-solid.stl": b"solid made by CAD".ljust(80) + b"\x0c\0\0\0" + BINARY_STL,
    "padded.stl": bytes(80) + b"\x0c\0\0\0" + BINARY_STL + b"\n",
}  # fmt: skip
