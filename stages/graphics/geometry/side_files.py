"""The files beside a mesh file that decide what is made of it: buffers, layers of USD; for colours, libraries and images."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.errors import Reject
from stages.graphics.geometry.colours import IMAGE_FORMATS, side_file
from stages.graphics.geometry.formats import mtl, obj, usd
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.gltf import BUFFER_SUFFIX
from stages.graphics.geometry.formats.json_values import items, parse
from stages.graphics.geometry.formats.parts import Source


def buffers(path: Path, root: Path) -> list[Path]:
    """The files that a glTF keeps its buffers in; what is unsafe or missing is left out, as it is rejected when read."""
    return _known(path, root, ((uri, (BUFFER_SUFFIX,)) for uri in _uris(path, "buffers")))


def layers(path: Path, root: Path) -> list[Path]:
    """The layers that a USD file is composed of; [] where it may not or cannot be read."""
    if path.suffix.lower() not in usd.SUFFIXES:
        return []
    try:
        with at(path.name):
            return usd.layers(path, root)
    except Reject:
        return []


def colours(path: Path, root: Path) -> list[Path]:
    """The material libraries and images that decide a mesh's colours; what is unsafe or missing is left out."""
    if path.suffix.lower() != ".obj":
        return _known(path, root, ((uri, IMAGE_FORMATS) for uri in _uris(path, "images")))
    try:
        with at(path.name):
            names = mtl.library_files(obj.library_names(path.read_bytes()), Source(path, root, 0, 0))
    except Reject:
        return []
    libraries = _known(path, root, ((name, (mtl.SUFFIX,)) for name in names))
    images = []
    for library in libraries:
        try:
            with at(library.name):
                images += [entry.image for entry in mtl.parse(library.read_bytes()).values() if entry.image]
        except Reject:
            continue
    return sorted({*libraries, *_known(path, root, ((image, IMAGE_FORMATS) for image in images))})


def _uris(path: Path, kind: str) -> list[str]:
    """The URIs, but for data, of a list of a glTF; [] where it cannot be read."""
    if path.suffix.lower() not in (".gltf", ".glb"):
        return []
    try:
        with at(path.name):
            with open(path, "rb") as file:  # of a GLB only its first chunk, the JSON
                head = file.read(20) if path.suffix.lower() == ".glb" else b""
                tree = parse(file.read(struct.unpack_from("<I", head, 12)[0] if head else -1))
            uris = [entry.get("uri") for entry in items(tree, kind)]
    except Reject:
        return []
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _known(path: Path, root: Path, references: Iterator[tuple[str, Any]]) -> list[Path]:
    files = set()
    for uri, suffixes in references:
        try:
            with at(path.name):
                files.add(side_file(uri, path.parent, root, suffixes))
        except Reject:
            continue
    return sorted(files)
