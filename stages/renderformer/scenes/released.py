"""Scenes in the two released RenderFormer formats (JSON with mesh files, HDF5 with arrays) as SceneRecords.

JSON: transforms are taken as written (rotate about x, then y, then z, scale, translate; ``normalize`` first
subtracts the vertex mean and scales to radius 0.5). Meshes are read from the scene file's folder only. Smooth
shading splits creases at 30 degrees. Random diffuse colours come from numpy's generator: their distribution is the
format's, the colours are not its converter's.
HDF5: 13-channel patches; its colours are quantised to 8 bits by the released converter, and it does not name lights,
so each connected group of emitting triangles is one light. Diffuse, specular and roughness may change within a
triangle, normal and emission may not. All released files are constant, so how texels lie on a textured triangle is our
reading: the last two axes are row and column as ``SceneRecord.patches`` says.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from model.file_kinds import failed_download
from pipeline.errors import Reject, UserError
from stages.graphics.geometry.load import LARGEST
from stages.graphics.geometry.measure import face_normals, have_area
from stages.renderformer.records import PATCH_CHANNELS, PATCH_KEPT, PATCH_SIDE, TEXTURED_CHANNELS, SceneRecord, patch_means
from stages.renderformer.scenes.assemble import rotation_matrix

CREASE_DEG = 30.0
MIN_ROUGHNESS = 0.01
FORMATS = ".json, .h5 or .hdf5"
MAX_JSON_BYTES = 2**26
MAX_MESH_BYTES, MAX_MESH_FACES = 2**28, 4_000_000  # of one mesh file that a JSON scene names
MAX_DATASET_BYTES = 2**31  # of one dataset of an HDF5 file, uncompressed


def load_scene(path: Path | str) -> SceneRecord:
    """The scene file as a SceneRecord; a UserError says what is wrong with it."""
    path = Path(path)
    loaders = {".json": load_json, ".h5": load_hdf5, ".hdf5": load_hdf5}
    if path.suffix.lower() not in loaders:
        raise UserError(f"{path} is not a scene file: expected {FORMATS}")
    if not path.is_file():
        raise UserError(f"{path} does not exist: give a scene file ({FORMATS})")
    scene = loaders[path.suffix.lower()](path)
    for name, values in scene.arrays().items():
        if not np.isfinite(values).all():
            raise UserError(f"{path}: {name} holds {np.size(values) - np.isfinite(values).sum()} values that are not finite")
    farthest = max(float(np.abs(values).max(initial=0)) for values in (scene.triangles, scene.camera_to_world))
    if farthest > LARGEST:
        raise UserError(f"{path} reaches {farthest:.3g} scene units, at most {LARGEST:.0e} are taken: scale it down")
    return scene


def _download(path: Path) -> str | None:
    """What the file is where a download went wrong."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return failed_download(file.read(512))


# --- JSON -------------------------------------------------------------------------------------------------------------


def load_json(path: Path) -> SceneRecord:
    """A scene in the released JSON format."""
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise UserError(f"{path} has {path.stat().st_size:,} bytes: scenes of at most {MAX_JSON_BYTES:,} are read")
        data = json.loads(path.read_bytes())  # in UTF-8 or 16, with or without a byte order mark
    except UserError:
        raise
    except (ValueError, OSError, RecursionError) as error:
        raise UserError(f"{path} {_download(path) or f'is not JSON: {error}'}") from error
    if not isinstance(data, dict) or not isinstance(data.get("objects"), dict) or not data["objects"]:
        raise UserError(f"{path} has no objects: expected objects {{name: {{mesh_path, material, transform}}}} and cameras")
    cameras = data.get("cameras")
    if not isinstance(cameras, list) or not cameras:
        raise UserError(f"{path} has no camera: add cameras [{{position, look_at, up, fov}}]")

    columns: dict[str, list[np.ndarray]] = {
        name: []
        for name in (
            "triangles",
            "vertex_normals",
            "diffuse",
            "specular",
            "roughness",
            "emission",
            "light_index",
            "object_index",
        )
    }
    objects, notes, lights = [], [], 0
    for index, (name, entry) in enumerate(data["objects"].items()):
        where = f"{path}: object {name!r}"
        if not isinstance(entry, dict):
            raise UserError(f"{where} is not a table of mesh_path, material and transform")
        if entry.get("remesh"):
            raise UserError(f"{where} asks for remeshing: store the remeshed mesh, and set remesh to false")
        material = entry.get("material") or {}
        triangles, normals, groups = _mesh(path.parent, entry, bool(material.get("smooth_shading", False)), where)
        count = len(triangles)
        emission = _numbers(material, "emissive", (0, 0, 0), where, low=0)
        emits = bool(emission.max() > 0)
        if emits and not have_area(triangles.astype(np.float32)).any():
            notes.append(f"{name}: a light without area adds nothing")
            emission, emits = np.zeros(3), False
        values = {
            "triangles": triangles,
            "vertex_normals": normals,
            "diffuse": _diffuse(material, groups, where),
            "specular": np.tile(_numbers(material, "specular", (0, 0, 0), where, low=0), (count, 1)),
            "roughness": np.full(count, max(_numbers(material, "roughness", 1.0, where, low=0), MIN_ROUGHNESS)),
            "emission": np.tile(emission, (count, 1)),
            "light_index": np.full(count, lights if emits else -1),
            "object_index": np.full(count, index),
        }
        for column, value in values.items():
            columns[column].append(value)
        lights += emits
        objects.append({"name": str(name), "kind": "light" if emits else "object", "faces": count})
    poses, fovs = zip(*[_camera(camera, f"{path}: camera {index}") for index, camera in enumerate(cameras)], strict=True)
    aspects = [_aspect(camera, f"{path}: camera {index}") for index, camera in enumerate(cameras)]
    arrays = {name: np.concatenate(parts).astype(SceneRecord.DTYPES[name]) for name, parts in columns.items()}
    meta = {
        "template": "released",
        "law": "released",
        "scene_name": str(data.get("scene_name", path.stem)),
        "objects": objects,
        **({"notes": notes} if notes else {}),
        **({} if aspects == [1.0] * len(aspects) else {"aspect": aspects}),
    }
    return SceneRecord(
        path.stem, **arrays, camera_to_world=np.stack(poses).astype(np.float32), fov_deg=np.float32(fovs), meta=meta
    )


def _numbers(table: dict[str, Any], key: str, default: Any, where: str, low: float = -np.inf) -> Any:
    """A finite number, or as many of them as ``default`` has."""
    value = table.get(key, default)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != np.shape(default) or not np.isfinite(array).all() or (array < low).any():
        count = np.size(default)
        kind = "a number" if count == 1 else f"{count} numbers"
        bound = f" of at least {low:g}" if np.isfinite(low) else ""
        raise UserError(f"{where}: {key} is {value!r}, expected {kind}{bound}")
    return array if array.ndim else float(array)


def _mesh(folder: Path, entry: dict[str, Any], smooth: bool, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transformed triangles (F, 3, 3), unit corner normals (F, 3, 3), and the shading group (F,) of each triangle."""
    import trimesh

    name = entry.get("mesh_path")
    if not isinstance(name, str) or not name:
        raise UserError(f"{where} has no mesh_path")
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise UserError(f"{where}: mesh_path {name!r} leads out of the scene's folder; put the mesh beside the scene file")
    vertices, faces = _arrays(path, where)

    transform = entry.get("transform") or {}
    if transform.get("normalize"):
        vertices = vertices - vertices.mean(axis=0)
        vertices *= 0.5 / max(np.linalg.norm(vertices, axis=1).max(), 1e-12)
    rotation = rotation_matrix(_numbers(transform, "rotation", (0, 0, 0), where))
    scale = _scale(transform, where)
    vertices = vertices @ rotation.T * scale + _numbers(transform, "translation", (0, 0, 0), where)

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    groups = np.arange(len(faces))
    if smooth:
        # Groups are what remains connected when edges sharper than the crease angle are cut.
        mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(CREASE_DEG), facet_minarea=10.0)
        groups = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
        normals = np.array(mesh.vertex_normals[mesh.faces])
    triangles = mesh.vertices[mesh.faces]
    flat = np.repeat(face_normals(triangles)[:, None], 3, axis=1)
    if not smooth:
        return triangles, flat, groups
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return triangles, np.where(length > 0.5, normals / np.maximum(length, 1e-12), flat), groups


def _arrays(path: Path, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 vertices and (F, 3) faces of a mesh file, as they are."""
    from stages.graphics.geometry.formats.parts import Source
    from stages.graphics.geometry.load import PLAIN, read_parts

    if not path.is_file():
        raise UserError(f"{where}: mesh file {path} does not exist")
    if path.suffix.lower() not in PLAIN:
        raise UserError(f"{where}: mesh file {path} is of no kind that is read: expected {', '.join(PLAIN)}")
    try:
        parts = read_parts(Source(path, path.parent, MAX_MESH_BYTES, MAX_MESH_FACES))
    except Reject as reject:
        raise UserError(f"{where}: {path} cannot be read as a mesh ({reject})") from None
    if not parts:
        raise UserError(f"{where}: {path} has no faces")
    starts = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    faces = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)])
    return np.concatenate([part.points for part in parts]), faces


def files_beside(mesh: Path) -> list[Path]:
    """The files that are opened besides a mesh file: the buffers of a glTF. Materials are the scene's, not the mesh's."""
    from stages.graphics.geometry.side_files import buffers

    return buffers(mesh, mesh.parent)


def _scale(transform: dict[str, Any], where: str) -> np.ndarray:
    """(3,) scale; one number stands for all axes."""
    value = transform.get("scale", 1.0)
    default = 1.0 if np.ndim(value) == 0 else (1.0, 1.0, 1.0)
    return np.broadcast_to(_numbers(transform, "scale", default, where), 3)


def _diffuse(material: dict[str, Any], groups: np.ndarray, where: str) -> np.ndarray:
    """(F, 3) diffuse reflectance: one colour, or a random one per triangle or per shading group."""
    seed = material.get("rand_tri_diffuse_seed")
    if seed is None:
        return np.tile(_numbers(material, "diffuse", (0, 0, 0), where, low=0), (len(groups), 1))
    if not isinstance(seed, int) or seed < 0:
        raise UserError(f"{where}: rand_tri_diffuse_seed is {seed!r}, expected null or a number of at least 0")
    kind = material.get("random_diffuse_type", "per-triangle")
    if kind not in ("per-triangle", "per-shading-group"):
        raise UserError(f"{where}: random_diffuse_type is {kind!r}, expected 'per-triangle' or 'per-shading-group'")
    index = np.arange(len(groups)) if kind == "per-triangle" else np.unique(groups, return_inverse=True)[1]
    largest = _numbers(material, "random_diffuse_max", 1.0, where, low=0)
    return np.random.default_rng(seed).uniform(0, largest, (int(index.max()) + 1, 3))[index]


def _camera(camera: Any, where: str) -> tuple[np.ndarray, float]:
    """Camera-to-world matrix (looks along -z, +y up) and field of view in degrees."""
    if not isinstance(camera, dict):
        raise UserError(f"{where} is not a table of position, look_at, up and fov")
    for key in ("position", "look_at", "up"):
        if key not in camera:
            raise UserError(f"{where} has no {key}")
    position, target, up = (_numbers(camera, key, (0, 0, 0), where) for key in ("position", "look_at", "up"))
    fov = _numbers(camera, "fov", 45.0, where)
    if not 0 < fov < 180:
        raise UserError(f"{where}: fov is {fov}, expected degrees between 0 and 180")
    back = position - target
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-9:
        raise UserError(f"{where}: position, look_at and up do not span a plane")
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose, fov


def _aspect(camera: dict[str, Any], where: str) -> float:
    """Width over height of the picture: an entry of ours, which other readers pass over."""
    aspect = _numbers(camera, "aspect", 1.0, where)
    if not 0.01 <= aspect <= 100:
        raise UserError(f"{where}: aspect is {aspect}, expected width over height")
    return aspect


# --- HDF5 -------------------------------------------------------------------------------------------------------------


def load_hdf5(path: Path) -> SceneRecord:
    """A scene in the released HDF5 format."""
    import h5py

    shapes = {"triangles": (3, 3), "vn": (3, 3), "texture": (13,), "c2w": (4, 4), "fov": ()}
    try:
        with h5py.File(path) as file:
            missing = [name for name in shapes if name not in file]
            if missing:
                raise UserError(f"{path} has no dataset {', '.join(missing)}: expected {', '.join(shapes)}")
            arrays = {name: _dataset(file, name, path).astype(np.float32) for name in shapes if name != "texture"}
            texture = _dataset(file, "texture", path)
            aspects = np.atleast_1d(np.asarray(file["fov"].attrs.get("aspect", []), np.float64))
    except (OSError, RuntimeError, KeyError) as error:
        raise UserError(f"{path} {_download(path) or f'is not an HDF5 file that can be read ({error})'}") from error
    patch_index, patches = None, None
    if texture.ndim == 4:
        texture, patch_index, patches = _patches(texture, path)
    arrays["texture"] = texture.astype(np.float32)
    for name, tail in shapes.items():
        if arrays[name].shape[1:] != tail or len(arrays[name]) == 0:
            raise UserError(
                f"{path}: {name} has shape {arrays[name].shape}, expected (at least 1, {', '.join(map(str, tail))})"
            )
    counts = {name: len(arrays[name]) for name in ("triangles", "vn", "texture")}
    if len(set(counts.values())) > 1 or len(arrays["c2w"]) != len(arrays["fov"]):
        raise UserError(f"{path}: lengths differ: {counts}, c2w {len(arrays['c2w'])}, fov {len(arrays['fov'])}")

    channel = {name: arrays["texture"][:, part] for name, part in PATCH_CHANNELS.items()}
    triangles = arrays["triangles"]
    light_index = _light_groups(triangles, channel["emission"].max(axis=1) > 0)
    notes, emission = [], channel["emission"]
    wide = np.bincount(light_index[light_index >= 0], have_area(triangles)[light_index >= 0]) > 0  # lights with an area
    if not wide.all():
        notes = [f"{int((~wide).sum())} of {len(wide)} lights: a light without area adds nothing"]
        lit = (light_index >= 0) & wide[light_index] if wide.any() else np.zeros(len(triangles), bool)
        emission = np.where(lit[:, None], emission, 0)
        light_index = _light_groups(triangles, lit)
    lights = int(light_index.max(initial=-1)) + 1
    objects = [{"name": "surface", "kind": "object", "faces": int((light_index < 0).sum())}]
    objects += [
        {"name": f"light{index}", "kind": "light", "faces": int((light_index == index).sum())} for index in range(lights)
    ]
    return SceneRecord(
        path.stem,
        triangles,
        arrays["vn"],
        channel["diffuse"],
        channel["specular"],
        np.maximum(channel["roughness"][:, 0], MIN_ROUGHNESS),
        emission,
        light_index,
        (light_index + 1).astype(np.int16),
        arrays["c2w"],
        arrays["fov"],
        {
            "template": "released",
            "law": "released",
            "scene_name": path.stem,
            "objects": objects,
            **({"notes": notes} if notes else {}),
            **({"aspect": aspects.tolist()} if len(aspects) == len(arrays["fov"]) and (aspects > 0.01).all() else {}),
        },
        patch_index,
        patches,
    )


def _dataset(file: Any, name: str, path: Path) -> np.ndarray:
    """A dataset whose bytes lie in the file itself: HDF5 can also take them from wherever else it likes."""
    import h5py

    dataset = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual or dataset.dtype.kind not in "fiu":
        raise UserError(f"{path}: {name} is not a dataset of numbers in the file itself (links and virtual ones are not read)")
    if dataset.nbytes > MAX_DATASET_BYTES:
        raise UserError(f"{path}: {name} claims {dataset.nbytes:,} bytes, more than {MAX_DATASET_BYTES:,}")
    return dataset[...]


def _patches(texture: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """(N, 13) values of (N, 13, P, P) patches, whose cells with x + y > P count as zero; for textured triangles the means.

    And ``patch_index`` and ``patches`` of a SceneRecord, None where every triangle is constant.
    """
    side = texture.shape[-1]
    if texture.shape[1:] != (13, side, side):
        raise UserError(f"{path}: texture has shape {texture.shape}, expected (N, 13, {PATCH_SIDE}, {PATCH_SIDE})")
    kept = np.add.outer(np.arange(side), np.arange(side)) <= side
    values = texture[:, :, 0, 0].astype(np.float32)
    varies = (texture[:, :, kept] != texture[:, :, :1, 0]).any(axis=2)  # (N, 13)
    for name in ("normal", "emission"):
        triangles = np.flatnonzero(varies[:, PATCH_CHANNELS[name]].any(axis=1))
        if len(triangles):
            raise UserError(
                f"{path}: {name} changes within triangle {triangles[0]} (and {len(triangles) - 1} more): only diffuse, "
                "specular and roughness may; make it constant or split the triangle"
            )
    rows = np.flatnonzero(varies.any(axis=1))
    if len(rows) == 0:
        return values, None, None
    if side != PATCH_SIDE:
        raise UserError(f"{path} has textured triangles of {side} x {side} texels: only {PATCH_SIDE} x {PATCH_SIDE} are read")
    patches = np.where(PATCH_KEPT, texture[rows, :TEXTURED_CHANNELS], 0).astype(np.float32)
    rough = PATCH_CHANNELS["roughness"]
    patches[:, rough] = np.where(PATCH_KEPT, np.maximum(patches[:, rough], MIN_ROUGHNESS), 0)
    patches = patches.astype(np.float16)
    means = patch_means(patches)
    values[rows, :TEXTURED_CHANNELS] = np.hstack([means["diffuse"], means["specular"], means["roughness"][:, None]])
    index = np.full(len(texture), -1, np.int32)
    index[rows] = np.arange(len(rows))
    return values, index, patches


def _light_groups(triangles: np.ndarray, emits: np.ndarray) -> np.ndarray:
    """(F,) int16 light of each triangle: emitting triangles that share a vertex are one light, in their order."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    groups = np.full(len(triangles), -1, np.int16)
    faces = np.nonzero(emits)[0]
    if len(faces):
        corner = np.unique(triangles[faces].reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1)
        rows = np.repeat(np.arange(len(faces)), 3)
        links = coo_matrix((np.ones(len(rows)), (rows, corner + len(faces))), shape=(len(faces) + corner.max() + 1,) * 2)
        labels = connected_components(links, directed=False)[1][: len(faces)]
        order = {label: index for index, label in enumerate(dict.fromkeys(labels.tolist()))}
        groups[faces] = [order[label] for label in labels.tolist()]
    return groups
