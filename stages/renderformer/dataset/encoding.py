"""A scene's arrays as the bytes of a shard's ``scene.npz``, and back: compact, and readable with numpy alone.

Reads and writes bytes. One design choice: what a triangle shares is stored once (corners, normals, materials) and indexed,
in the smallest dtype whose error neither model nor pixels can see (docs/dataset.md has the figures); arrays are stored by
columns and deflated, which is where repeated channels vanish. ``READ`` is the whole decoder for people without this code.
"""

from __future__ import annotations

import io
import zipfile

import numpy as np

from pipeline.errors import UserError
from stages.graphics.arrays import unpack_json
from stages.renderformer.records import PATCH_SIDE, TEXTURED_CHANNELS, SceneRecord

MAX_BYTES = 1 << 30  # of a scene's arrays together, unpacked
GRID = 65535  # steps of a quantised coordinate over the scene's bounding box
MAX_ERROR = 1e-4  # scene units; scenes so large that a step would move a corner further keep float32
UNIT = 32767  # of a normal's components
PATCH_SHAPE = (TEXTURED_CHANNELS, PATCH_SIDE, PATCH_SIDE)

READ = """
import io, numpy as np

def read_scene(data: bytes) -> dict:
    a = dict(np.load(io.BytesIO(data)))
    vertices = a["vertices"] * a["scale"] + a["origin"]  # (P, 3) float32
    normals = a["normals"] / np.float32(32767)  # (N, 3)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-12))
    scene = {"triangles": vertices[a["faces"]], "vertex_normals": normals[a["face_normals"]]}
    scene |= {k: a[k].astype(np.float32)[a["material"]] for k in ("diffuse", "specular", "roughness")}
    scene["emission"] = np.concatenate([a["emission"], np.zeros((1, 3), np.float32)])[a["emission_index"]]
    same = ("light_index", "object_index", "camera_to_world", "fov_deg", "patch_index", "patches")
    return scene | {k: a[k] for k in same if k in a}
"""


def _unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows in order of first appearance, and the index (len(rows),) of each row in them. Compared by their bytes."""
    rows = np.ascontiguousarray(rows)
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    return rows[first[order]], place[inverse.reshape(-1)]


def _smallest(index: np.ndarray) -> np.ndarray:
    """Indices, -1 allowed, in the smallest integer dtype that holds them."""
    low, high = int(index.min(initial=0)), int(index.max(initial=0))
    kinds = (np.uint8, np.uint16, np.int32) if low >= 0 else (np.int8, np.int16, np.int32)
    return index.astype(next(kind for kind in kinds if high <= np.iinfo(kind).max))


def encode_scene(scene: SceneRecord) -> bytes:
    """The arrays of ``scene.npz``. The same scene always gives the same bytes (numpy dates zip members 1980)."""
    arrays = scene.arrays()
    corners = arrays["triangles"].reshape(-1, 3)
    low, high = corners.min(axis=0, initial=np.inf), corners.max(axis=0, initial=-np.inf)
    step = float(np.float32(np.max(high - low, initial=0.0) / GRID))
    if 0 < step / 2 <= MAX_ERROR:
        vertices = np.clip(np.round((corners.astype(np.float64) - low) / step), 0, GRID).astype(np.uint16)
        origin, scale = low, step
    else:
        vertices, origin, scale = corners, np.zeros(3), 1.0
    normals = np.round(np.clip(arrays["vertex_normals"].reshape(-1, 3), -1, 1) * UNIT).astype(np.int16)
    vertices, faces = _unique_rows(vertices)
    normals, face_normals = _unique_rows(normals)
    reflectance = np.concatenate([arrays["diffuse"], arrays["specular"], arrays["roughness"][:, None]], axis=1)
    materials, material = _unique_rows(reflectance.astype(np.float16))
    emits = np.nonzero(arrays["emission"].any(axis=1))[0]
    emission, emission_row = _unique_rows(arrays["emission"][emits])
    emission_index = np.full(len(arrays["emission"]), -1)
    emission_index[emits] = emission_row
    out = {
        "vertices": vertices,
        "origin": origin.astype(np.float32),
        "scale": np.float32(scale),
        "faces": _smallest(faces.reshape(-1, 3)),
        "normals": normals,
        "face_normals": _smallest(face_normals.reshape(-1, 3)),
        "diffuse": materials[:, :3],
        "specular": materials[:, 3:6],
        "roughness": materials[:, 6],
        "material": _smallest(material),
        "emission": emission,
        "emission_index": _smallest(emission_index),
        "light_index": _smallest(arrays["light_index"]),
        "object_index": _smallest(arrays["object_index"]),
        "camera_to_world": arrays["camera_to_world"],
        "fov_deg": arrays["fov_deg"],
    }
    if scene.textured:
        out |= {"patch_index": _smallest(arrays["patch_index"]), "patches": arrays["patches"]}
    buffer = io.BytesIO()
    columns = {name: np.asfortranarray(out[name]) if out[name].ndim == 2 else out[name] for name in sorted(out)}
    np.savez_compressed(buffer, allow_pickle=False, **columns)
    return buffer.getvalue()


def decode_scene(id: str, scene: bytes, meta: bytes) -> SceneRecord:
    """A scene from the members ``scene.npz`` and ``meta.json`` of a shard's sample; UserError if they do not fit together."""
    try:
        with np.load(io.BytesIO(scene), allow_pickle=False) as file:
            claimed = sum(entry.file_size for entry in file.zip.infolist())
            if claimed > MAX_BYTES:
                raise UserError(f"scene {id}: its arrays claim {claimed:,} bytes, more than {MAX_BYTES:,}")
            a = {name: file[name] for name in file.files}
        vertices = a["vertices"] * a["scale"] + a["origin"]
        normals = a["normals"] / np.float32(UNIT)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-12))
        material = a["material"]
        arrays = {
            "triangles": vertices[a["faces"]],
            "vertex_normals": normals[a["face_normals"]],
            **{name: a[name].astype(np.float32)[material] for name in ("diffuse", "specular", "roughness")},
            "emission": np.concatenate([a["emission"], np.zeros((1, 3), np.float32)])[a["emission_index"]],
            **{name: a[name] for name in ("light_index", "object_index", "camera_to_world", "fov_deg")},
        }
        if "patches" in a:
            arrays |= {name: a[name] for name in SceneRecord.PATCH_DTYPES}
            index, patches = arrays["patch_index"], arrays["patches"]
            if patches.shape[1:] != PATCH_SHAPE or index.shape != material.shape or index.max(initial=-1) >= len(patches):
                raise ValueError(f"patches {patches.shape} do not fit their index of {index.shape}")
        dtypes = SceneRecord.DTYPES | SceneRecord.PATCH_DTYPES
        arrays = {name: np.ascontiguousarray(values, dtypes[name]) for name, values in arrays.items()}
        return SceneRecord(id, **arrays, meta=unpack_json(meta))
    except UserError:
        raise
    except (
        KeyError, IndexError, ValueError, TypeError, OSError, EOFError, MemoryError, zipfile.BadZipFile, zipfile.zlib.error,
    ) as error:  # fmt: skip
        raise UserError(f"scene {id} cannot be decoded ({type(error).__name__}: {error})") from error
