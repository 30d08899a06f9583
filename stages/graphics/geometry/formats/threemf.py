"""3MF: a ZIP archive of XML models. Objects as the build places them, components, parts in other models of the archive; colours
of base materials and colour groups.
"""

from __future__ import annotations

import io
import posixpath
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.etree import ElementTree

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import Look, srgb_colours
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.parts import Part, Source, checked_part

ROOT = "3D/3dmodel.model"  # where it is the rule, if no relationship says otherwise
KIND = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"  # of the relationship that names the root model
NOT_DRAWN = ("other",)  # types of objects that a build does not make
# In the names of extensions that may be required: none of them changes where the triangles are.
KNOWN = ("/production/", "/material/", "/slice/", "/securecontent/")
PREFIX = re.compile(rb"xmlns:(\w+)\s*=\s*[\"']([^\"']*)[\"']")
MAX_UNPACKED = 100  # bytes of an archive's content for each of its own
DEEPEST = 32  # components within components
WHITE = (1.0, 1.0, 1.0)


@dataclass
class _Object:
    """points (V, 3), triangles (F, 3) and colours (F, 3, 3) sRGB or None, or components: (model, id, matrix)."""

    points: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray | None
    components: list[tuple[str, str, np.ndarray]]
    kind: str


@dataclass
class _Model:
    """A model file of the archive: its objects, its colours by property group, and (model, object, matrix) of its build."""

    objects: dict[str, _Object] = field(default_factory=dict)
    colours: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    build: list[tuple[str, str, np.ndarray]] = field(default_factory=list)


def read(data: bytes, source: Source) -> list[Part]:
    """One part for each placed object that has triangles."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except zipfile.BadZipFile:
        raise Reject("unreadable", "it is no ZIP archive, which a 3MF file is") from None
    with archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_UNPACKED * len(data) + source.max_bytes // 16:
            raise Reject("too_large", f"an archive of {len(data):,} bytes that states {unpacked:,}")
        return list(_Archive(archive, source).parts())


class _Archive:
    def __init__(self, archive: zipfile.ZipFile, source: Source):
        self.archive, self.source = archive, source
        self.names = {name.lower(): name for name in archive.namelist()}
        self.models: dict[str, _Model] = {}
        self.faces = 0

    def parts(self) -> Iterator[Part]:
        root = self._root()
        build = self.model(root).build
        if not build:
            raise Reject("no_faces", f"{root}: its build has no item")
        for model, id, matrix in build:
            yield from self._placed(model, id, matrix, 0)

    def _root(self) -> str:
        """The archive's name of the root model."""
        if "_rels/.rels" in self.names:
            with at("_rels/.rels"):
                for entry in ElementTree.fromstring(self.archive.read(self.names["_rels/.rels"])):
                    if entry.get("Type") == KIND:
                        return entry.get("Target", ROOT).lstrip("/")
        return ROOT

    def model(self, name: str) -> _Model:
        if name not in self.models:
            if name.lower() not in self.names:
                raise Reject("unreadable", f"the archive has no model {name[:80]!r}")
            with at(name[:80]):
                data = self.archive.read(self.names[name.lower()])
                try:
                    tree = ElementTree.fromstring(data)
                except ElementTree.ParseError as error:
                    line, column = error.position
                    raise Reject("unreadable", f"line {line}, column {column + 1}: this is not XML") from None
                _check_required(tree.get("requiredextensions", "").split(), dict(PREFIX.findall(data[:8192])))
                self.models[name] = self._parsed(tree, name)
        return self.models[name]

    def _parsed(self, tree: ElementTree.Element, name: str) -> _Model:
        model = _Model()
        for entry in _below(tree, "resources"):
            with at(f"{_tag(entry)} {entry.get('id', '')[:20]}"):
                if _tag(entry) in ("basematerials", "colorgroup"):
                    model.colours[entry.get("id", "")] = [
                        _colour(child.get("displaycolor") or child.get("color") or "") for child in entry
                    ]
                elif _tag(entry) in ("texture2dgroup", "compositematerials", "multiproperties"):
                    self.source.note(f"{_tag(entry)} {entry.get('id', '')}: colours of this kind are not read")
                elif _tag(entry) == "object":
                    model.objects[entry.attrib["id"]] = self._object(entry, model, name)
        for number, entry in enumerate(_below(tree, "build")):
            with at(f"build item {number}"):
                model.build.append(_reference(entry, name))
        return model

    def _object(self, entry: ElementTree.Element, model: _Model, name: str) -> _Object:
        points, triangles, colours = np.zeros((0, 3)), np.zeros((0, 3), np.int64), None
        components = [_reference(child, name) for child in _below(entry, "components")]
        for mesh in (child for child in entry if _tag(child) == "mesh"):
            vertices, faces = list(_below(mesh, "vertices")), list(_below(mesh, "triangles"))
            if len(faces) > self.source.max_faces:
                raise Reject("too_large", f"{len(faces)} faces, at most {self.source.max_faces} are taken")
            points = _numbers(vertices, "xyz", "vertex", float).astype(np.float64)
            triangles = _numbers(faces, ("v1", "v2", "v3"), "triangle", int).astype(np.int64)
            colours = _colours(entry, faces, model.colours) if self.source.images is not None else None
            for left_out in (child for child in mesh if _tag(child) not in ("vertices", "triangles", "metadatagroup")):
                self.source.note(f"object {entry.attrib['id']}: its {_tag(left_out)} is left out")
        return _Object(points, triangles, colours, components, entry.get("type", "model"))

    def _placed(self, name: str, id: str, matrix: np.ndarray, depth: int) -> Iterator[Part]:
        model = self.model(name)
        if id not in model.objects:
            raise Reject("unreadable", f"{name}: object {id[:20]!r} does not exist")
        made, place = model.objects[id], f"{name}: object {id}"
        if depth > DEEPEST:
            raise Reject("unreadable", f"{place}: components nest over {DEEPEST} deep")
        if made.kind in NOT_DRAWN:
            self.source.note(f"{place}: of type {made.kind}, which is not made")
            return
        if len(made.triangles):
            self.faces += len(made.triangles)
            if self.faces > self.source.max_faces:
                raise Reject("too_large", f"{place}: over {self.source.max_faces} faces")
            yield self._part(made, matrix, place)
        for other, component, move in made.components:
            self.faces += 1  # however many components hold nothing
            yield from self._placed(other, component, matrix @ move, depth + 1)

    def _part(self, made: _Object, matrix: np.ndarray, place: str) -> Part:
        vertex, triangle = f"{place}: vertex {{}}".format, f"{place}: triangle {{}}".format
        checked = checked_part(made.points, made.triangles, vertex, triangle)
        mirrored = np.linalg.det(matrix[:3, :3]) < 0
        turn = slice(None, None, -1) if mirrored else slice(None)
        part = checked_part(checked.points @ matrix[:3, :3].T + matrix[:3, 3], made.triangles[:, turn], vertex, triangle)
        if made.colours is not None:
            part.look = Look(tint=srgb_colours(made.colours[:, turn], "colours", self.source.note))
        return part


# -- XML


def _check_required(prefixes: list[str], names: dict[bytes, bytes]) -> None:
    """A Reject where an extension that is required may change the shape."""
    required = [names.get(prefix.encode(), prefix.encode()).decode("utf-8", "replace") for prefix in prefixes]
    unknown = [name for name in required if not any(known in name for known in KNOWN)]
    if unknown:
        raise Reject("unsupported", f"requires the extension {', '.join(unknown)[:160]}")


def _tag(entry: ElementTree.Element) -> str:
    return entry.tag.rpartition("}")[2]


def _below(entry: ElementTree.Element, name: str) -> Iterator[ElementTree.Element]:
    """What is in the children of that name."""
    return (below for child in entry if _tag(child) == name for below in child)


def _reference(entry: ElementTree.Element, model: str) -> tuple[str, str, np.ndarray]:
    """(model, id, matrix) of a build item or a component; its ``path`` is of the production extension."""
    path = next((value for key, value in entry.attrib.items() if key.rpartition("}")[2] == "path"), None)
    if path is not None:
        path = posixpath.normpath(posixpath.join("/", posixpath.dirname(model), path)).lstrip("/")
    matrix = np.eye(4)
    if stated := entry.get("transform"):
        words = stated.split()
        if len(words) != 12:
            raise Reject("unreadable", f"transform of {len(words)} numbers, expected 12")
        matrix[:3] = np.array([_number(word, float) for word in words]).reshape(4, 3).T
    return path or model, entry.attrib["objectid"], matrix


def _number(word: str, kind: type) -> float:
    try:
        return kind(word)
    except ValueError:
        raise Reject("unreadable", f"{word[:40]!r} is not a {'whole ' if kind is int else ''}number") from None


def _numbers(entries: list[ElementTree.Element], names: tuple[str, ...] | str, what: str, kind: type) -> np.ndarray:
    """(N, len(names)) of attributes."""
    try:
        return np.array([[kind(entry.attrib[name]) for name in names] for entry in entries]).reshape(-1, len(names))
    except (KeyError, ValueError):
        for index, entry in enumerate(entries):
            with at(f"{what} {index}"):
                for name in names:
                    _number(entry.attrib[name], kind)
        raise


# -- colours


def _colour(text: str) -> tuple[float, ...]:
    """sRGB in 0 .. 1 of ``#RRGGBB`` or ``#RRGGBBAA``."""
    try:
        return tuple(int(text[start : start + 2], 16) / 255 for start in (1, 3, 5))
    except ValueError:
        raise Reject("unreadable", f"{text[:20]!r} is no colour") from None


def _colours(entry: ElementTree.Element, faces: list[ElementTree.Element], groups: dict[str, list]) -> np.ndarray | None:
    """(F, 3, 3) sRGB at the corners; None where no triangle has a colour. Triangles without one are white."""
    colours, stated = np.ones((len(faces), 3, 3)), False
    for row, face in enumerate(faces):
        group = groups.get(face.get("pid", entry.get("pid", "")))
        if group is None:
            continue
        first = face.get("p1", entry.get("pindex", "0"))
        indices = [int(first), *(int(face.get(name, first)) for name in ("p2", "p3"))]
        if all(0 <= index < len(group) for index in indices):
            colours[row], stated = [group[index] for index in indices], True
    return colours if stated else None
