"""A mesh file as checked arrays: everything that a stranger's file can get wrong is settled here, before native code
runs.

Reads one file and, for glTF, the buffers beside it, never anything outside the given root. trimesh parses; what it
would follow or allocate on a file's word alone (materials, images, URIs, stated counts, node graphs) is checked or
removed first. Base colours come along when they are asked for (``stages.graphics.geometry.colours``) and never cost a mesh.
"""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry import colours
from stages.graphics.geometry.measure import normal_vectors
from stages.graphics.geometry.paths import check_path, inside
from stages.graphics.geometry.records import TextureRecord

SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")  # what is looked for in a folder
BUFFER_SUFFIX = ".bin"  # files that a glTF may keep its buffers in
DRACO = "KHR_draco_mesh_compression"
# Extensions that a file may require and that change nothing about where its triangles are, or that the loader decodes.
HARMLESS = {DRACO, "KHR_mesh_quantization"}
HARMLESS_PREFIXES = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_animation_", "KHR_xmp")
EXTENT_RANGE = (1e-12, 1e12)  # longest side of a sane bounding box, in the file's own units


@dataclass
class Loaded:
    """vertices (V, 3) float64 and faces (F, 3) int64 in the file's units and axes; scene graph flattened, parts
    concatenated."""

    vertices: np.ndarray
    faces: np.ndarray
    parts: int = 1
    about: dict[str, str] = field(default_factory=dict)  # origin and licence where the file states them
    texture: TextureRecord | None = None  # base colours, if they were asked for and there are any; without an id
    notes: list[str] = field(default_factory=list)  # what of the colours could not be had, and why


@dataclass
class _Part:
    """A part of a file in its place: points (V, 3), triangles (F, 3), and where they were asked for its base colour
    and corner coordinates (F, 3, 2)."""

    points: np.ndarray
    triangles: np.ndarray
    material: colours.Material | None = None
    uv: np.ndarray | None = None

    def content(self) -> tuple:
        """What parts are put in order by: trimesh makes up names for unnamed nodes, other ones at each call."""
        look = self.material or colours.Material()
        uv = b"" if self.uv is None else self.uv.tobytes()
        return self.points.tobytes(), self.triangles.tobytes(), uv, look.colour, look.picture


def load_mesh(path: Path, root: Path, max_bytes: int, max_faces: int, textures: bool = False) -> Loaded:
    """The checked mesh of a file inside ``root``; raises Reject with a reason of *collect*.

    ``textures``: with its base colours. The mesh is the same with and without.
    """
    path, root = Path(path), Path(root)
    if not inside(path, root):
        raise Reject("unsafe_path", f"{path.name} leads outside the folder")
    if not path.is_file():
        raise Reject("unreadable", f"{path.name} is not a regular file")
    size = path.stat().st_size
    if size > max_bytes:
        raise Reject("too_large", f"{size} bytes, at most {max_bytes} are read")
    data = path.read_bytes()
    kind = path.suffix.lower()
    notes: list[str] = []
    if textures and kind in (".glb", ".gltf", ".obj"):
        try:
            return _load(data, kind, path.parent, root, max_bytes, max_faces, colours.Images())
        except Reject as error:  # a colour or texture coordinate cannot make a mesh fail: once more without
            notes.append(f"{error.reason}: {error.detail}")
    loaded = _load(data, kind, path.parent, root, max_bytes, max_faces, None)
    loaded.notes = notes
    return loaded


def _load(
    data: bytes, kind: str, folder: Path, root: Path, max_bytes: int, max_faces: int, images: colours.Images | None
) -> Loaded:
    """The mesh in the bytes of a file; with base colours where ``images`` collects them."""
    about: dict[str, str] = {}
    materials: Any = None
    try:
        if kind in (".gltf", ".glb"):
            data, about, materials = _prepare_gltf(data, kind, folder, root, max_bytes, max_faces, images)
            kind = ".glb"
        elif kind == ".obj":
            _check_obj(data, folder, root)
            if images is not None:
                materials = colours.obj_materials(data, folder, root, max_bytes, images)
        else:
            _check_counts(data, kind, max_faces)
        parts = _parse(data, kind, materials)
    except Reject:
        raise
    except MemoryError:
        raise
    except Exception as error:  # parsers of strangers' files fail in every way: all of them mean "unreadable"
        raise Reject("unreadable", f"{type(error).__name__}: {str(error)[:200]}") from None
    starts = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    faces = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)])
    vertices, faces, kept = _settled(np.concatenate([part.points for part in parts]), faces, max_faces)
    loaded = Loaded(vertices, faces, len(parts), about)
    if images is not None:
        looks = [(part.material or colours.Material(), part.uv, len(part.triangles)) for part in parts]
        loaded.texture, loaded.notes = colours.texture_record("", looks, kept), images.notes
    return loaded


def checked(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without unused vertices and zero-area triangles, or a Reject: safe for native code afterwards."""
    return _settled(vertices, faces, max_faces)[:2]


def _settled(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``checked``, and the indices of the faces that are left."""
    if len(faces) == 0 or len(vertices) == 0:
        raise Reject("no_faces", f"{len(vertices)} vertices, {len(faces)} faces")
    if len(faces) > max_faces:
        raise Reject("too_large", f"{len(faces)} faces, at most {max_faces} are taken")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise Reject("bad_indices", f"indices {faces.min()}..{faces.max()} for {len(vertices)} vertices")
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise Reject("not_finite", f"{int((~np.isfinite(vertices)).any(axis=1).sum())} vertices")
    if np.abs(vertices).max() > EXTENT_RANGE[1]:
        raise Reject("degenerate", f"coordinates up to {np.abs(vertices).max():.3g}")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent < EXTENT_RANGE[0] or extent < 1e-6 * np.abs(vertices).max():
        raise Reject("degenerate", f"longest side {extent:.3g}")
    corners = (vertices / extent)[faces]
    double_area = np.linalg.norm(normal_vectors(corners), axis=1)
    solid = double_area > 1e-14
    if double_area.sum() < 1e-8:
        raise Reject("degenerate", f"area {double_area.sum() / 2:.3g} of the squared longest side")
    used, faces = np.unique(faces[solid], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3), np.flatnonzero(solid)


def normalise(vertices: np.ndarray) -> np.ndarray:
    """Bounding box centred on the origin, longest side 1; computed in float64, rounded once to float32."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return ((vertices - (low + high) / 2) / (high - low).max()).astype(np.float32)


def buffer_files(path: Path) -> list[str]:
    """URIs of the side files that a ``.gltf`` names, as written; [] where it cannot be read."""
    try:
        tree = json.loads(path.read_bytes())
        return [b["uri"] for b in tree.get("buffers", []) if not b.get("uri", "data:").startswith("data:")]
    except (OSError, ValueError, AttributeError, TypeError):
        return []


def _parse(data: bytes, kind: str, materials: Any = None) -> list[_Part]:
    """The parts by trimesh, from memory: no resolver of files, so nothing else can be opened.

    ``materials``: base colours, by name for OBJ, by number for glTF; None where they were not asked for.
    """
    import trimesh

    options: dict[str, Any] = {"skip_materials": materials is None} if kind == ".obj" else {}
    library = colours.library_without_images(materials) if kind == ".obj" and materials is not None else None
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], process=False, resolver=_Nothing(library), **options)
    parts = []
    for name in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        points, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        if triangles.min() < 0 or triangles.max() >= len(points):  # before parts are joined, where it would hide
            raise Reject("bad_indices", f"indices {triangles.min()}..{triangles.max()} for {len(points)} vertices")
        transform = np.asarray(transform, np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            points = points @ transform[:3, :3].T + transform[:3, 3]
        if np.linalg.det(transform[:3, :3]) < 0:  # a mirrored node turns its faces inside out
            triangles = triangles[:, ::-1]
        part = _Part(points, triangles)
        if materials is not None:
            part.material, uv = _look(mesh, kind, materials)
            part.uv = None if uv is None else uv[triangles]
        parts.append(part)
    if not parts:
        raise Reject("no_faces", "no part of it has a triangle")
    return sorted(parts, key=_Part.content)


def _look(mesh: Any, kind: str, materials: Any) -> tuple[colours.Material | None, np.ndarray | None]:
    """A part's base colour and its (V, 2) texture coordinates, as far as it has them."""
    if kind == ".obj":
        look = materials.get(getattr(getattr(mesh.visual, "material", None), "name", None))
        uv = getattr(mesh.visual, "uv", None)
    else:
        name = next((name for name in mesh.vertex_attributes if UV.match(name)), None)
        if name is None:
            return None, None
        number, full_scale = map(int, UV.match(name).groups())
        look, uv = materials[number], np.asarray(mesh.vertex_attributes[name], np.float64) / full_scale
    usable = uv is not None and np.shape(uv) == (len(mesh.vertices), 2)
    return look, np.asarray(uv, np.float64) if usable else None


class _Nothing:
    """A resolver that has no file but, if any, one material library: what trimesh asks for here is never geometry."""

    def __init__(self, library: bytes | None = None):
        self.library = library

    def get(self, name: str) -> bytes:
        if self.library is not None and name.lower().endswith(colours.LIBRARY_SUFFIX):
            return self.library
        raise FileNotFoundError(name)

    __getitem__ = get

    def keys(self) -> list[str]:
        return []

    def namespaced(self, namespace: str) -> _Nothing:
        return self


def _check_obj(data: bytes, folder: Path, root: Path) -> None:
    """An OBJ's faces need nothing else, but a material library outside its folder is a file not to trust."""
    for name in colours.library_names(data):
        check_path(name, folder, root)
    # trimesh takes an index past the end without a word in some layouts: count for ourselves
    count = len(re.findall(rb"^[ \t]*v[ \t]", data, flags=re.MULTILINE))
    highest = 0
    for line in re.findall(rb"^[ \t]*f[ \t]+(.+)$", data, flags=re.MULTILINE):
        for word in line.split():
            head = word.split(b"/", 1)[0]
            if head.lstrip(b"-").isdigit():
                highest = max(highest, abs(int(head)))
    if highest > count:
        raise Reject("bad_indices", f"a face names vertex {highest} of {count}")


def _check_counts(data: bytes, kind: str, max_faces: int) -> None:
    """Counts that a PLY, OFF or binary STL states must fit its bytes and the limits, before a parser allocates them."""
    stated: list[tuple[str, int, int]] = []  # what, how many, fewest bytes each
    if kind == ".ply":
        header = data[: data.find(b"end_header") + 1] if b"end_header" in data[:65536] else b""
        if not header:
            raise Reject("unreadable", "no PLY header")
        for name, number in re.findall(rb"^element[ \t]+(\w+)[ \t]+(\d+)", header, flags=re.MULTILINE):
            stated.append((name.decode(), int(number), 2))
    elif kind == ".off":
        text = re.sub(rb"#[^\n]*", b"", data[:65536])
        numbers = re.match(rb"\s*(?:[A-Z4n]*OFF\b)?\s*(\d+)\s+(\d+)", text)
        if not numbers:
            raise Reject("unreadable", "no OFF header")
        stated += [("vertex", int(numbers[1]), 6), ("face", int(numbers[2]), 4)]
    elif kind == ".stl" and not data[:512].lstrip().lower().startswith(b"solid") and len(data) >= 84:
        stated.append(("face", struct.unpack_from("<I", data, 80)[0], 50))
    for name, number, least in stated:
        if number * least > len(data):
            raise Reject("unreadable", f"states {number} elements {name!r} in {len(data)} bytes")
        if name == "face" and number > max_faces:
            raise Reject("too_large", f"states {number} faces, at most {max_faces} are taken")


def check_claims(path: Path, max_bytes: int, max_faces: int) -> None:
    """Reject a mesh file, for whoever parses it as it is, whose numbers do not fit its size or the limits."""
    if path.stat().st_size > max_bytes:
        raise Reject("too_large", f"{path.stat().st_size} bytes, at most {max_bytes} are read")
    data, kind = path.read_bytes(), path.suffix.lower()
    if kind in (".gltf", ".glb"):
        tree = split_glb(data)[0] if kind == ".glb" else json.loads(data)
        _check_accessors(tree, max_bytes)
        _check_graph(tree, max_faces)
    else:
        _check_counts(data, kind, max_faces)


def _prepare_gltf(
    data: bytes,
    kind: str,
    folder: Path,
    root: Path,
    max_bytes: int,
    max_faces: int,
    images: colours.Images | None,
) -> tuple[bytes, dict[str, str], list[colours.Material] | None]:
    """A self-contained GLB with the same triangles and nothing else: no materials, images, skins, cameras or outer
    files.

    Where ``images`` collects colours, also the materials; a primitive then carries the texture coordinates of its
    material under a name that says which (``UV``).
    """
    binary = b""
    if kind == ".glb":
        tree, binary = split_glb(data)
    else:
        tree = json.loads(data)
    if not isinstance(tree, dict) or not str(tree.get("asset", {}).get("version", "2")).startswith("2"):
        raise Reject("unsupported", "not glTF 2.x")
    required = set(tree.get("extensionsRequired", []))
    unknown = sorted(e for e in required - HARMLESS if not e.startswith(HARMLESS_PREFIXES))
    if unknown:
        raise Reject("unsupported", f"requires {', '.join(unknown)}")
    _check_accessors(tree, max_bytes)
    _check_graph(tree, max_faces)
    if _uses_draco(tree) and importlib.util.find_spec("DracoPy") is None:
        raise Reject("needs_draco", "requires Draco compression: install the package DracoPy")
    joined, offsets = bytearray(), []
    for index, buffer in enumerate(tree.get("buffers", [])):
        offsets.append(len(joined))
        joined += _buffer(buffer, index, binary, folder, root, max_bytes)
        joined += b"\0" * (-len(joined) % 4)
        if len(joined) > max_bytes:
            raise Reject("too_large", f"buffers of over {max_bytes} bytes")
    for view in tree.get("bufferViews", []):
        start = view.get("byteOffset", 0)
        if min(start, view["byteLength"], view["buffer"]) < 0:
            raise Reject("unreadable", "a buffer view with negative numbers")
        end = offsets[view["buffer"] + 1] if view["buffer"] + 1 < len(offsets) else len(joined)
        view["byteOffset"] = start + offsets[view["buffer"]]
        if view["byteOffset"] + view["byteLength"] > end:
            raise Reject("unreadable", "a buffer view past the end of its buffer")
        view["buffer"] = 0
    _check_draco(tree, joined)
    materials, sets = None, []
    if images is not None:
        materials, sets = colours.gltf_materials(tree, joined, folder, root, max_bytes, images)
    for name in ("materials", "textures", "images", "samplers", "skins", "cameras", "animations", "extensions"):
        tree.pop(name, None)
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            number = primitive.pop("material", None)
            primitive.pop("targets", None)
            stated = primitive["attributes"]
            primitive["attributes"] = {k: v for k, v in stated.items() if k == "POSITION"}
            extensions = primitive.get("extensions", {})
            primitive["extensions"] = {k: v for k, v in extensions.items() if k == DRACO}
            if materials is not None and number is not None:
                _keep_uv(tree, primitive, stated, int(number), sets[int(number)])
    for node in tree.get("nodes", []):
        for name in ("skin", "camera", "extensions"):
            node.pop(name, None)
    tree["buffers"] = [{"byteLength": len(joined)}]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(joined), 0x004E4942) + joined
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks, _gltf_about(tree), materials


UV = re.compile(r"_M(\d+)_(\d+)\Z")  # attribute of a prepared primitive: number of its material, what stands for 1


def _keep_uv(tree: dict[str, Any], primitive: dict[str, Any], stated: dict[str, int], number: int, coordinates: int) -> None:
    """Give the primitive its texture coordinates under a name that tells its material (positions where it has none)."""
    source = f"TEXCOORD_{coordinates}"
    accessor = tree["accessors"][stated[source]] if source in stated else {}
    full_scale = colours.INTEGER_UV.get(accessor.get("componentType"), 1) if accessor.get("normalized") else 1
    primitive["attributes"][f"_M{number}_{full_scale}"] = stated.get(source, stated["POSITION"])
    draco = primitive["extensions"].get(DRACO, {}).get("attributes", {})
    if source in draco:
        draco[f"_M{number}_{full_scale}"] = draco.pop(source)


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """(JSON, binary chunk) of a GLB."""
    magic, version, _ = struct.unpack_from("<III", data)
    if magic != 0x46546C67:
        raise Reject("unreadable", "no GLB header")
    if version != 2:
        raise Reject("unsupported", f"GLB version {version}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > len(data):
            raise Reject("unreadable", "a chunk past the end of the file")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return json.loads(chunks[0x4E4F534A]), chunks.get(0x004E4942, b"")


def _buffer(buffer: dict[str, Any], index: int, binary: bytes, folder: Path, root: Path, max_bytes: int) -> bytes:
    """The bytes of one buffer: the GLB's own, a data URI, or a file inside the root."""
    uri = buffer.get("uri")
    if uri is None:
        if index:
            raise Reject("unreadable", f"buffer {index} has no data")
        data = binary
    elif uri.startswith("data:"):
        data = base64.b64decode(uri.partition(",")[2])
    else:
        target = check_path(uri, folder, root)
        if target.suffix.lower() != BUFFER_SUFFIX:  # only these are part of the source's identity
            raise Reject("unsupported", f"buffer file {uri[:80]!r}: only *{BUFFER_SUFFIX} is read")
        if not target.is_file():
            raise Reject("unreadable", f"buffer file {uri[:80]!r} is missing")
        if target.stat().st_size > max_bytes:
            raise Reject("too_large", f"buffer file {uri[:80]!r} has over {max_bytes} bytes")
        data = target.read_bytes()
    if len(data) < buffer["byteLength"]:
        raise Reject("unreadable", f"buffer {index} states {buffer['byteLength']} bytes and has {len(data)}")
    return data[: buffer["byteLength"]]


def _uses_draco(tree: dict[str, Any]) -> bool:
    """Whether any triangle of the file exists only as Draco data."""
    return DRACO in tree.get("extensionsRequired", []) or any(
        DRACO in primitive.get("extensions", {}) for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]
    )


def _check_draco(tree: dict[str, Any], data: bytes | bytearray) -> None:
    """A few kilobytes of Draco can hold millions of faces: their header may not claim more than the accessors, which
    count against the limit, do."""
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            if DRACO in primitive.get("extensions", {}):
                view = tree["bufferViews"][primitive["extensions"][DRACO]["bufferView"]]
                stated = int(tree["accessors"][primitive["indices"]]["count"]) // 3
                faces = _draco_faces(bytes(data[view["byteOffset"] :][: min(64, view["byteLength"])]))
                if faces > stated:
                    raise Reject("unreadable", f"Draco data of {faces} faces where {stated} are stated")


def _draco_faces(head: bytes) -> int:
    """Faces that a Draco mesh claims to hold, from its first bytes (bitstream 2.2, which glTF prescribes)."""
    if head[:5] != b"DRACO" or tuple(head[5:8]) != (2, 2, 1):
        raise Reject("unsupported", "Draco data that is not a mesh of bitstream 2.2")
    if head[10] & 0x80:  # metadata comes first, of any length: the worker's limits must do
        return 0
    numbers, at = [], 11 + head[8]  # sequential: faces, points; edgebreaker: a byte, points, faces
    for _ in range(2):
        value = shift = 0
        while True:
            byte, at = head[at], at + 1
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                break
        numbers.append(value)
    return numbers[head[8]]


COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def _check_accessors(tree: dict[str, Any], max_bytes: int) -> None:
    """An accessor without a view stands for zeros, as many as it says, and parsers allocate them whether used or not."""
    total = 0
    for accessor in tree.get("accessors", []):
        number = int(accessor["count"])
        if number < 0:
            raise Reject("unreadable", f"an accessor of {number} elements")
        if "bufferView" not in accessor or "sparse" in accessor:
            total += number * COMPONENT_BYTES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
    if total > max_bytes:
        raise Reject("too_large", f"accessors without data of {total} bytes, at most {max_bytes} are taken")


def _check_graph(tree: dict[str, Any], max_faces: int) -> None:
    """Nodes form a forest, as glTF demands (no cycle, no node used twice: nothing multiplies), of a sane number of
    faces."""
    accessors, nodes, faces = tree.get("accessors", []), tree.get("nodes", []), []
    for mesh in tree.get("meshes", []):
        total = 0
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", 4)
            if mode in (4, 5, 6):
                where = primitive["indices"] if "indices" in primitive else primitive["attributes"]["POSITION"]
                number = int(accessors[where]["count"])
                total += number // 3 if mode == 4 else max(number - 2, 0)
        faces.append(total)
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            if child in parent or not 0 <= child < len(nodes):
                raise Reject("unreadable", f"node {child} has two parents or does not exist")
            parent[child] = index
    depth = {index: 0 for index in range(len(nodes)) if index not in parent}
    queue = list(depth)
    for index in queue:  # grows while it is walked: breadth first
        for child in nodes[index].get("children", []):
            depth[child] = depth[index] + 1
            queue.append(child)
    if len(depth) != len(nodes):
        raise Reject("unreadable", "the nodes form a cycle")
    total = sum(faces[node["mesh"]] for node in nodes if "mesh" in node)
    if total > max_faces:
        raise Reject("too_large", f"states {total} faces, at most {max_faces} are taken")


def _gltf_about(tree: dict[str, Any]) -> dict[str, str]:
    """Licence and origin as the common exporters write them: asset.copyright, and asset.extras of Sketchfab."""
    asset = tree.get("asset", {})
    extras = asset.get("extras", {}) if isinstance(asset.get("extras"), dict) else {}
    licence = extras.get("license") or asset.get("copyright") or ""
    origin = extras.get("source") or ""
    return {name: str(value)[:300] for name, value in (("licence", licence), ("origin", origin)) if value}
