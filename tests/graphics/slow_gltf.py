"""A second reader of glTF accessors, slow and plain: one number at a time, by the words of the specification."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

FORMATS = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
LARGEST = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COLUMNS = {"MAT2": 2, "MAT3": 3, "MAT4": 4}


def opened(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """(tree, buffers) of a .glb, or of a .gltf whose buffers lie in data URIs or beside it."""
    data, binary = path.read_bytes(), b""
    if data[:4] == b"glTF":
        length = struct.unpack("<I", data[12:16])[0]
        data, binary = data[20 : 20 + length], data[28 + length :]
    tree = json.loads(data)
    buffers = []
    for buffer in tree.get("buffers", []):
        uri = buffer.get("uri")
        if uri is None:
            buffers.append(binary)
        elif uri.startswith("data:"):
            buffers.append(base64.b64decode(uri.split(",", 1)[1]))
        else:
            buffers.append((path.parent / uri).read_bytes())
    return tree, buffers


def elements(tree: dict, buffers: list[bytes], view: int, offset: int, count: int, component: int, kind: str) -> list[tuple]:
    entry = tree["bufferViews"][view]
    size = struct.calcsize(FORMATS[component])
    columns = COLUMNS.get(kind, 1)
    rows = COMPONENTS[kind] // columns
    column_size = rows * size
    while columns > 1 and column_size % 4:
        column_size += 1
    stride = entry.get("byteStride", columns * column_size)
    start = entry.get("byteOffset", 0) + offset
    values = []
    for index in range(count):
        value = ()
        for column in range(columns):
            position = start + index * stride + column * column_size
            value += struct.unpack_from(f"<{rows}{FORMATS[component]}", buffers[entry["buffer"]], position)
        values.append(value)
    return values


def accessor(tree: dict, buffers: list[bytes], index: int) -> list[tuple]:
    entry = tree["accessors"][index]
    component, kind = entry["componentType"], entry["type"]
    if "bufferView" in entry:
        values = elements(tree, buffers, entry["bufferView"], entry.get("byteOffset", 0), entry["count"], component, kind)
    else:
        values = [(0,) * COMPONENTS[kind]] * entry["count"]
    if "sparse" in entry:
        sparse, changed = entry["sparse"], {}
        where, what = sparse["indices"], sparse["values"]
        places = elements(
            tree, buffers, where["bufferView"], where.get("byteOffset", 0), sparse["count"], where["componentType"], "SCALAR"
        )
        news = elements(tree, buffers, what["bufferView"], what.get("byteOffset", 0), sparse["count"], component, kind)
        for (place,), new in zip(places, news, strict=True):
            changed[place] = new
        values = [changed.get(place, value) for place, value in enumerate(values)]
    if entry.get("normalized") and component in LARGEST:
        values = [tuple(max(number / LARGEST[component], -1.0) for number in value) for value in values]
    return values
