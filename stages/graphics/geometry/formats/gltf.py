"""glTF 2.0 files: their tree, buffers, accessors and nodes, checked as they are read.

``Gltf`` is the one reader of glTF numbers: byte strides, sparse accessors, normalised integers (KHR_mesh_quantization) and
Draco are settled there. It follows no link outside the root, and nothing is allocated on the file's word alone.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats import draco
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.json_values import data_of, floats, integer, integers, items, parse, table
from stages.graphics.geometry.formats.parts import Source
from stages.graphics.geometry.paths import check_path

BUFFER_SUFFIX = ".bin"  # files that a glTF may keep its buffers in
# Extensions that a file may require and that change nothing about where its triangles are, or that are decoded here.
INSTANCING = "EXT_mesh_gpu_instancing"
HARMLESS = {draco.EXTENSION, "KHR_mesh_quantization", "KHR_node_visibility", INSTANCING}
HARMLESS_PREFIXES = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_animation_", "KHR_xmp")
DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # by componentType
SHAPES = {  # (columns, rows) by type
    "SCALAR": (1, 1), "VEC2": (1, 2), "VEC3": (1, 3), "VEC4": (1, 4), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4),
}  # fmt: skip
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of primitives
TRANSFORMS = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}  # attributes of instances, and their numbers
# Extensions that cannot be done without, and what to do about a file that requires one.
ADVICE = {
    name: f"{name}: write it without that compression, as `gltfpack -i IN.glb -o OUT.glb -noq` does"
    for name in ("EXT_meshopt_compression", "KHR_meshopt_compression")
}
SINGULAR = {"accessors": "accessor", "buffers": "buffer", "bufferViews": "buffer view", "meshes": "mesh", "nodes": "node",
            "scenes": "scene"}  # fmt: skip


class Gltf:
    """An opened glTF file whose nodes form a forest and whose buffers are at hand.

    tree: the JSON. Its lists of ``SINGULAR`` hold tables; deeper values are checked where they are read.
    """

    def __init__(self, data: bytes, source: Source):
        self.source = source
        self.tree, binary = split_glb(data) if source.path.suffix.lower() == ".glb" else (parse(data), b"")
        self._check_version()
        for kind, name in SINGULAR.items():
            entries = self.tree.setdefault(kind, [])
            if not isinstance(entries, list):
                raise Reject("unreadable", f"{kind} is not a list")
            for index, entry in enumerate(entries):
                if not isinstance(entry, dict):
                    raise Reject("unreadable", f"{name} {index}: not a table")
        check_accessors(self.tree, source.max_bytes)
        check_graph(self.tree, source.max_faces)
        self._buffers = self._read_buffers(binary)
        self._decoded: dict[int, tuple[np.ndarray, dict[int, np.ndarray]]] = {}  # Draco data by buffer view

    def _check_version(self) -> None:
        asset = self.tree.get("asset")
        version = str(asset.get("version", "2") if isinstance(asset, dict) else "2")
        if not version.startswith("2"):
            raise Reject("unsupported", f"glTF {version[:20]}, expected 2.x")
        required = self.tree.get("extensionsRequired", [])
        if not isinstance(required, list):
            raise Reject("unreadable", "extensionsRequired is not a list")
        unknown = sorted({str(e)[:60] for e in required if e not in HARMLESS and not str(e).startswith(HARMLESS_PREFIXES)})
        if unknown:
            raise Reject("unsupported", f"requires {', '.join(ADVICE.get(name, name) for name in unknown)}")
        if draco.EXTENSION in required:
            draco.require_decoder()

    # -- bytes

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """The table of that number in a list of the tree, such as ``meshes``."""
        entries = self.tree[kind]
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise Reject("unreadable", f"{SINGULAR[kind]} {str(index)[:40]} does not exist, the file has {len(entries)}")
        return entries[index]

    def _read_buffers(self, binary: bytes) -> list[bytes]:
        buffers, total = [], 0
        for index, entry in enumerate(self.tree["buffers"]):
            with at(f"buffer {index}"):
                stated = integer(entry, "byteLength")
                data = self._buffer(entry, index, binary)
                if len(data) < stated:
                    raise Reject("unreadable", f"it states {stated} bytes and has {len(data)}")
                buffers.append(data[:stated])
                total += stated
                if total > self.source.max_bytes:
                    raise Reject("too_large", f"buffers of over {self.source.max_bytes} bytes")
        return buffers

    def _buffer(self, entry: dict[str, Any], index: int, binary: bytes) -> bytes:
        """The bytes of one buffer: the GLB's own, a data URI, or a file inside the root."""
        uri = entry.get("uri")
        if uri is None:
            for name in ADVICE:
                if name in entry.get("extensions", {}):
                    raise Reject("unsupported", f"it exists only as {ADVICE[name]}")
            if index:
                raise Reject("unreadable", "it has no data")
            return binary
        if not isinstance(uri, str):
            raise Reject("unreadable", "its uri is not text")
        if uri.startswith("data:"):
            return data_of(uri)
        target = check_path(uri, self.source.folder, self.source.root)
        if target.suffix.lower() != BUFFER_SUFFIX:  # only these are part of the source's identity
            raise Reject("unsupported", f"file {uri[:80]!r}: only *{BUFFER_SUFFIX} is read")
        if not target.is_file():
            raise Reject("unreadable", f"file {uri[:80]!r} is missing")
        if target.stat().st_size > self.source.max_bytes:
            raise Reject("too_large", f"file {uri[:80]!r} has over {self.source.max_bytes} bytes")
        return target.read_bytes()

    def view(self, index: Any) -> memoryview:
        """The bytes of a buffer view."""
        entry = self.entry("bufferViews", index)
        with at(f"buffer view {index}"):
            number, start, length = integer(entry, "buffer"), integer(entry, "byteOffset", 0), integer(entry, "byteLength")
            self.entry("buffers", number)
            data = self._buffers[number]
            if start + length > len(data):
                raise Reject("unreadable", f"it ends at byte {start + length} of buffer {number}, which has {len(data)}")
            return memoryview(data)[start : start + length]

    # -- numbers

    def accessor(self, index: Any) -> np.ndarray:
        """(count, n) numbers of an accessor: float64, or int64 where they are integers that are not normalised.

        Matrices come column by column.
        """
        entry = self.entry("accessors", index)
        with at(f"accessor {index}"):
            count, (columns, rows), dtype = layout(entry)
            if "bufferView" in entry:
                values = self._elements(entry, count, (columns, rows), dtype)
            else:
                values = np.zeros((count, columns * rows), dtype)
            if "sparse" in entry:
                values = self._with_changes(values, entry, (columns, rows))
            return numbers(values, entry)

    def _elements(self, entry: dict[str, Any], count: int, shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
        """(count, n) values as stored in the buffer view that a table names, from its ``byteOffset`` on."""
        columns, rows = shape
        column_bytes = rows * dtype.itemsize
        if columns > 1:
            column_bytes += -column_bytes % 4  # columns of matrices start at multiples of four
        size = columns * column_bytes
        number, start = entry["bufferView"], integer(entry, "byteOffset", 0)
        data = self.view(number)
        with at(f"buffer view {number}"):
            stride = integer(self.entry("bufferViews", number), "byteStride", 0) or size
        if stride < size:
            raise Reject("unreadable", f"byteStride {stride} of buffer view {number} for elements of {size} bytes")
        end = start + (count - 1) * stride + size if count else start
        if end > len(data):
            raise Reject("unreadable", f"{count} elements end at byte {end} of buffer view {number}, which has {len(data)}")
        bytes_ = np.frombuffer(data, np.uint8)[start:]
        if not count:
            return np.zeros((count, columns * rows), dtype)
        strides = (stride, column_bytes, 1)
        raw = np.lib.stride_tricks.as_strided(bytes_, (count, columns, rows * dtype.itemsize), strides, writeable=False)
        return np.ascontiguousarray(raw).view(dtype).reshape(count, columns * rows)

    def _with_changes(self, values: np.ndarray, entry: dict[str, Any], shape: tuple[int, int]) -> np.ndarray:
        """The values with those of a sparse accessor's list in their places."""
        with at("sparse"):
            sparse = table(entry, "sparse")
            count, where, what = integer(sparse, "count"), table(sparse, "indices"), table(sparse, "values")
            kind = integer(where, "componentType")
            if kind not in (5121, 5123, 5125):
                raise Reject("unreadable", f"indices of componentType {kind}, expected 5121, 5123 or 5125")
            places = self._elements(where, count, (1, 1), np.dtype(DTYPES[kind]))[:, 0]
            if len(places) and places.max() >= len(values):
                raise Reject("unreadable", f"it changes element {int(places.max())} of {len(values)}")
            changed = values.copy()
            changed[places] = self._elements(what, count, shape, values.dtype)
            return changed

    # -- meshes

    def primitives(self, mesh: Any) -> list[Primitive]:
        """The primitives of a mesh that are made of triangles."""
        entries = primitives_of(self.entry("meshes", mesh))
        return [Primitive(self, mesh, number, entry) for number, entry in enumerate(entries) if _mode(entry) in (4, 5, 6)]

    def draco(self, primitive: dict[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Triangles, and attributes by name as stored, that a primitive keeps compressed; None where it keeps none."""
        extensions = primitive.get("extensions", {})
        if draco.EXTENSION not in extensions:
            return None
        entry = table(extensions, draco.EXTENSION)
        number = integer(entry, "bufferView")
        if number not in self._decoded:
            stated = layout(self.entry("accessors", integer(primitive, "indices")))[0] // 3
            data = bytes(self.view(number))
            with at(f"buffer view {number}"):
                self._decoded[number] = draco.decode(data, stated)
        triangles, values = self._decoded[number]
        names = table(entry, "attributes")
        return triangles, {name: values[id] for name, id in names.items() if isinstance(id, int) and id in values}

    # -- nodes

    def placements(self) -> Iterator[tuple[int, np.ndarray]]:
        """Each node of the scene, parents first, and its (4, 4) matrix to the scene: columns are applied to points.

        The scene is the file's default one, else the first. A file without scenes shows all its nodes.
        """
        if not self.tree["scenes"]:
            return self.walk(self.roots(), self._visible)
        number = integer(self.tree, "scene", 0)
        with at(f"scene {number}"):
            return self.walk(integers(self.entry("scenes", number), "nodes"), self._visible)

    def _visible(self, index: int) -> bool:
        """Whether a node and what is below it are drawn (KHR_node_visibility)."""
        stated = self.entry("nodes", index).get("extensions")
        hidden = stated.get("KHR_node_visibility") if isinstance(stated, dict) else None
        return not isinstance(hidden, dict) or hidden.get("visible") is not False

    def roots(self) -> list[int]:
        """The nodes that are below no other."""
        nodes = self.tree["nodes"]
        below = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in below]

    def walk(self, roots: list[int], drawn: Callable[[int], bool] = lambda index: True) -> Iterator[tuple[int, np.ndarray]]:
        """These nodes and all below them, parents first, each with its (4, 4) matrix to the scene; none below one not drawn."""
        queue = [(root, np.eye(4)) for root in dict.fromkeys(roots)]
        while queue:
            index, above = queue.pop()
            if not drawn(index):
                continue
            node = self.entry("nodes", index)
            with at(f"node {index}"):
                matrix = above @ local_matrix(node)
                yield index, matrix
                queue += [(child, matrix) for child in integers(node, "children")]


class Primitive:
    """Triangles of a mesh with one material.

    points: (V, 3) float64 in the mesh's frame. triangles: (F, 3) int64. material: number of its material, or None.
    """

    def __init__(self, gltf: Gltf, mesh: int, number: int, entry: dict[str, Any]):
        self.gltf, self.entry, self.place = gltf, entry, f"mesh {mesh}: primitive {number}"
        self.mesh = gltf.entry("meshes", mesh)
        with at(self.place):
            self._names = table(entry, "attributes")
            self._compressed = gltf.draco(entry)
            self.material = integer(entry, "material") if "material" in entry else None
            self.points = self.attribute("POSITION", 3)
            self.triangles = self._triangles()

    def attribute(self, name: str, *widths: int) -> np.ndarray:
        """(V, n) numbers of an attribute, n one of the ``widths``; a Reject where it is missing or of another shape."""
        index = integer(self._names, name)
        shape = self._shape(index, name, widths)
        stored = self._compressed[1].get(name) if self._compressed else None
        if stored is None:
            return self.gltf.accessor(index)
        with at(f"accessor {index}"):
            if stored.shape != shape:
                raise Reject("unreadable", f"{name} of {shape[0]} elements, its Draco data has {len(stored)}")
            return numbers(stored, self.gltf.entry("accessors", index))

    def target(self, number: int, name: str) -> np.ndarray:
        """(V, 3) numbers that a morph target adds to an attribute at weight 1."""
        with at(f"target {number}"):
            index = integer(items(self.entry, "targets")[number], name)
            self._shape(index, name, (3,))
            return self.gltf.accessor(index)

    def _shape(self, index: int, name: str, widths: tuple[int, ...]) -> tuple[int, int]:
        """(V, n) that an accessor states, n one of the ``widths`` and V that of the positions; or a Reject."""
        entry = self.gltf.entry("accessors", index)
        with at(f"accessor {index}"):
            count, (columns, rows), _ = layout(entry)
            if columns * rows not in widths:
                raise Reject("unreadable", f"{name} of type {entry['type']}")
            stated = layout(self.gltf.entry("accessors", integer(self._names, "POSITION")))[0]
            if count != stated:
                raise Reject("unreadable", f"{name} of {count} elements beside {stated} positions")
            return count, columns * rows

    def has(self, name: str) -> bool:
        return name in self._names

    def _triangles(self) -> np.ndarray:
        if self._compressed:
            return self._compressed[0]
        mode = _mode(self.entry)
        if "indices" in self.entry:
            number = integer(self.entry, "indices")
            values = self.gltf.accessor(number)
            if values.shape[1] != 1 or values.dtype.kind != "i":
                raise Reject("unreadable", f"accessor {number}: indices that are not single whole numbers")
            flat, place = values[:, 0], f"accessor {number}: {len(values)} indices"
        else:
            flat, place = np.arange(len(self.points)), f"{len(self.points)} vertices"
        if mode == TRIANGLES:
            if len(flat) % 3:
                raise Reject("unreadable", f"{place} are no whole number of triangles")
            return flat.reshape(-1, 3)
        if len(flat) < 3:
            return np.zeros((0, 3), np.int64)
        if mode == FAN:
            return np.stack([np.full(len(flat) - 2, flat[0]), flat[1:-1], flat[2:]], axis=1)
        strip = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
        strip[1::2] = strip[1::2, ::-1]
        return strip

    def vertex_place(self, vertex: int) -> str:
        return f"{self.place}: accessor {self._names['POSITION']}: element {vertex}"

    def triangle_place(self, triangle: int) -> str:
        indices = f"accessor {self.entry['indices']}: " if "indices" in self.entry else ""
        return f"{self.place}: {indices}triangle {triangle}"


# -- values of the tree


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """(JSON, binary chunk) of a GLB."""
    if len(data) < 12 or data[:4] != b"glTF":
        raise Reject("unreadable", "byte 0: no GLB header")
    version = struct.unpack_from("<I", data, 4)[0]
    if version != 2:
        raise Reject("unsupported", f"byte 4: GLB version {version}")
    chunks: dict[int, bytes] = {}
    start = 12
    while start + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, start)
        if start + 8 + length > len(data):
            raise Reject("unreadable", f"byte {start}: a chunk of {length} bytes in a file that ends at byte {len(data)}")
        chunks.setdefault(kind, data[start + 8 : start + 8 + length])
        start += 8 + length
    if 0x4E4F534A not in chunks:
        raise Reject("unreadable", "byte 12: no JSON chunk")
    return parse(chunks[0x4E4F534A]), chunks.get(0x004E4942, b"")


def layout(accessor: dict[str, Any]) -> tuple[int, tuple[int, int], np.dtype]:
    """(elements, (columns, rows), dtype) that an accessor states."""
    component, shape = integer(accessor, "componentType"), accessor.get("type")
    if component not in DTYPES:
        raise Reject("unreadable", f"componentType {component}, expected one of {', '.join(map(str, DTYPES))}")
    if not isinstance(shape, str) or shape not in SHAPES:
        raise Reject("unreadable", f"type {str(shape)[:40]!r}, expected one of {', '.join(SHAPES)}")
    return integer(accessor, "count"), SHAPES[shape], np.dtype(DTYPES[component])


def numbers(values: np.ndarray, accessor: dict[str, Any]) -> np.ndarray:
    """Values as stored in the numbers that they stand for: float64, or int64 for integers that are not normalised."""
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):  # some patterns of bits that are no number
            return values.astype(np.float64)
    if accessor.get("normalized") is not True or accessor["componentType"] == 5125:
        return values.astype(np.int64)
    most = np.iinfo(np.dtype(DTYPES[accessor["componentType"]])).max
    return np.maximum(values.astype(np.float64) / most, -1.0)


def primitives_of(mesh: dict[str, Any]) -> list[dict[str, Any]]:
    """The primitives of a mesh, each a table."""
    entries = mesh.get("primitives")
    if not isinstance(entries, list):
        raise Reject("unreadable", "primitives is not a list")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("extensions", {}), dict):
            raise Reject("unreadable", f"primitive {number}: not a table")
    return entries


def _mode(primitive: dict[str, Any]) -> int:
    return integer(primitive, "mode", TRIANGLES)


def local_matrix(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) matrix of a node to its parent: its matrix, or translation, rotation and scale."""
    matrix = np.eye(4)
    if "matrix" in node:
        matrix = floats(node, "matrix", 16).reshape(4, 4).T
    if "translation" in node:
        move = np.eye(4)
        move[:3, 3] = floats(node, "translation", 3)
        matrix = matrix @ move
    if "rotation" in node:
        matrix = matrix @ rotation(floats(node, "rotation", 4))
    if "scale" in node:
        matrix = matrix @ np.diag([*floats(node, "scale", 3), 1.0])
    return matrix


def instances(gltf: Gltf, node: dict[str, Any]) -> np.ndarray | None:
    """(N, 4, 4) matrices of a node's copies in its own frame (EXT_mesh_gpu_instancing); None where it has none."""
    extensions = table(node, "extensions") if "extensions" in node else {}
    if INSTANCING not in extensions:
        return None
    with at(INSTANCING):
        names = table(table(extensions, INSTANCING), "attributes")
        parts = {name: gltf.accessor(integer(names, name)) for name in TRANSFORMS if name in names}
        for name, values in parts.items():
            if values.shape[1] != TRANSFORMS[name] or len(values) != len(next(iter(parts.values()))):
                raise Reject("unreadable", f"{name} of {len(values)} times {values.shape[1]} numbers")
            if not np.isfinite(values).all():
                raise Reject("not_finite", f"{name} has a number that is not finite")
        matrices = np.tile(np.eye(4), (len(next(iter(parts.values()), [0])), 1, 1))
        for number, matrix in enumerate(matrices):
            if "ROTATION" in parts:
                matrix[:] = rotation(parts["ROTATION"][number].astype(np.float64))
            if "SCALE" in parts:
                matrix[:3, :3] *= parts["SCALE"][number]
            if "TRANSLATION" in parts:
                matrix[:3, 3] = parts["TRANSLATION"][number]
        return matrices


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """(4, 4) matrix of a quaternion (x, y, z, w) of any length; the identity for one of no length."""
    length = quaternion @ quaternion
    matrix = np.eye(4)
    if length < 4 * np.finfo(np.float64).eps:
        return matrix
    scaled = quaternion * np.sqrt(2.0 / length)
    (xx, xy, xz, xw), (_, yy, yz, yw), (_, _, zz, zw), _ = np.outer(scaled, scaled)
    matrix[:3, :3] = [
        [1.0 - yy - zz, xy - zw, xz + yw],
        [xy + zw, 1.0 - xx - zz, yz - xw],
        [xz - yw, yz + xw, 1.0 - xx - yy],
    ]
    return matrix


def check_accessors(tree: dict[str, Any], max_bytes: int) -> None:
    """An accessor without a view stands for zeros, as many as it says: all together may not be over the limit."""
    total = 0
    for index, accessor in enumerate(tree.get("accessors", [])):
        with at(f"accessor {index}"):
            count, (columns, rows), dtype = layout(accessor)
            if "bufferView" not in accessor or "sparse" in accessor:
                total += count * columns * rows * dtype.itemsize
            if total > max_bytes:
                raise Reject("too_large", f"accessors without data of {total} bytes, at most {max_bytes} are taken")


def check_graph(tree: dict[str, Any], max_faces: int) -> None:
    """Nodes form a forest, as glTF demands (no cycle, no node used twice: nothing multiplies), of a sane number of
    faces."""
    nodes = tree.get("nodes", [])
    faces = [_stated_faces(tree, index) for index in range(len(tree.get("meshes", [])))]
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        with at(f"node {index}"):
            for child in integers(node, "children"):
                if child in parent or child >= len(nodes):
                    raise Reject(
                        "unreadable", f"its child {child} " + ("has two parents" if child in parent else "does not exist")
                    )
                parent[child] = index
    depth = {index: 0 for index in range(len(nodes)) if index not in parent}
    queue = list(depth)
    for index in queue:  # grows while it is walked: breadth first
        for child in integers(nodes[index], "children"):
            depth[child] = depth[index] + 1
            queue.append(child)
    if len(depth) != len(nodes):
        lost = next(index for index in range(len(nodes)) if index not in depth)
        raise Reject("unreadable", f"node {lost}: it is below itself, nodes form a cycle")
    total = 0
    for index, node in enumerate(nodes):
        if "mesh" in node:
            with at(f"node {index}"):
                mesh = integer(node, "mesh")
                if mesh >= len(faces):
                    raise Reject("unreadable", f"mesh {mesh} does not exist, the file has {len(faces)}")
                copies = _stated_instances(tree, node)
                total += faces[mesh] * copies
                if copies * _stated_vertices(tree, mesh) > 3 * max_faces and copies > 1:
                    raise Reject("too_large", f"{copies} instances of {_stated_vertices(tree, mesh)} vertices")
    if total > max_faces:
        raise Reject("too_large", f"states {total} faces, at most {max_faces} are taken")


def _stated_instances(tree: dict[str, Any], node: dict[str, Any]) -> int:
    """Copies of a node's mesh that its instances state; 1 without any."""
    extensions = table(node, "extensions") if "extensions" in node else {}
    if INSTANCING not in extensions:
        return 1
    names = table(table(extensions, INSTANCING), "attributes")
    stated = [integer(names, name) for name in TRANSFORMS if name in names]
    return max((_stated_count(tree, index) for index in stated), default=1)


def _stated_vertices(tree: dict[str, Any], mesh: int) -> int:
    """Positions that the accessors of a mesh's largest primitive state."""
    names = [table(primitive, "attributes") for primitive in primitives_of(tree["meshes"][mesh])]
    return max((_stated_count(tree, integer(entry, "POSITION")) for entry in names if "POSITION" in entry), default=0)


def _stated_count(tree: dict[str, Any], accessor: int) -> int:
    accessors = tree.get("accessors", [])
    if accessor >= len(accessors):
        raise Reject("unreadable", f"accessor {accessor} does not exist, the file has {len(accessors)}")
    return layout(accessors[accessor])[0]


def _stated_faces(tree: dict[str, Any], mesh: int) -> int:
    """Triangles that the accessors of a mesh state."""
    total = 0
    with at(f"mesh {mesh}"):
        for number, primitive in enumerate(primitives_of(tree["meshes"][mesh])):
            with at(f"primitive {number}"):
                if (mode := _mode(primitive)) not in (TRIANGLES, STRIP, FAN):
                    continue
                attributes = table(primitive, "attributes")
                indices = integer(primitive, "indices") if "indices" in primitive else integer(attributes, "POSITION")
                count = _stated_count(tree, indices)
                total += count // 3 if mode == TRIANGLES else max(count - 2, 0)
    return total
