"""Out of our dataset and into the released formats: scenes as HDF5 that others' loaders and trainers read.

Reads samples of shards; writes ``OUT/<split>/<id>.h5`` per scene, and on request an EXR per view beside it. One design
choice: what is written is exactly the format (``triangles``, ``vn``, ``texture``, ``c2w``, ``fov``), nothing more; what our
arrays hold beyond it (which light a triangle belongs to, names, licences) stays behind. The way back is ``scene=imported``
(``stages.renderformer.s03_import``), which reads the same folders.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError
from pipeline.store import RECORD_ID
from stages.renderformer.records import PATCH_CHANNELS, PATCH_KEPT, PATCH_NORMAL, TEXTURED_CHANNELS, SceneRecord


def released_arrays(scene: SceneRecord) -> dict[str, np.ndarray]:
    """The datasets of a released HDF5 scene: triangles, vn (N, 3, 3), texture (N, 13, 32, 32) fp16, c2w, fov (degrees)."""
    values = np.zeros((len(scene.triangles), 13), np.float32)
    for name, part in PATCH_CHANNELS.items():
        values[:, part] = PATCH_NORMAL if name == "normal" else np.reshape(getattr(scene, name), (len(values), -1))
    if values.max(initial=0) > np.finfo(np.float16).max:
        raise UserError(f"scene {scene.id}: radiance {values.max():g} is more than the format's half floats hold (65504)")
    texture = values.astype(np.float16)[:, :, None, None] * PATCH_KEPT.astype(np.float16)
    if scene.textured:
        rows = np.flatnonzero(scene.patch_index >= 0)
        texture[rows, :TEXTURED_CHANNELS] = scene.patches[scene.patch_index[rows]]
    arrays = {"triangles": scene.triangles, "vn": scene.vertex_normals, "c2w": scene.camera_to_world, "fov": scene.fov_deg}
    return {name: array.astype(np.float32) for name, array in arrays.items()} | {"texture": texture}


def write_hdf5(path: Path, scene: SceneRecord) -> None:
    """The scene as a released HDF5 file, deflated as the released ones are; the file appears whole or not at all."""
    import h5py

    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for name, array in released_arrays(scene).items():
            file.create_dataset(name, data=array, compression="gzip", compression_opts=9)
        if "aspect" in scene.meta:  # of pictures that are not square; other readers pass over it
            file["fov"].attrs["aspect"] = scene.meta["aspect"]


def export(source: Any, out: Path, splits: list[str] | None = None, images: bool = False) -> Iterator[Path]:
    """Write the scenes of some splits (None: all) of a dataset (artifact, folder or URL); yields each HDF5 file's path.

    ``images``: also ``<id>-view<i>.exr``, half-float linear RGB with all lights on, i being the camera's index.
    """
    import json

    from stages.graphics.exr import encode_rgb
    from stages.renderformer.dataset import ShardDataset
    from stages.renderformer.dataset.shards import SHARDS, open_source

    present = sorted(json.loads(open_source(source).path(f"files/{SHARDS}").read_bytes()))
    for split in splits or present:
        if not RECORD_ID.match(split):  # a folder is named after it
            raise UserError(f"{split!r} is no name of a split")
        dataset = ShardDataset(source, split, cache_mb=0)
        (out / split).mkdir(parents=True, exist_ok=True)
        for index, id in enumerate(dataset.ids):
            sample = dataset.read(index, None if images else [])
            path = out / split / f"{id}.h5"
            write_hdf5(path, sample.scene)
            for camera, view in sample.views.items():
                (out / split / f"{id}-view{int(camera)}.exr").write_bytes(encode_rgb(view.image))
            yield path
