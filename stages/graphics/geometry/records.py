"""Records of meshes: shapes, dtypes, units and frames.

Any right-handed frame; *collect* states what it makes of it. F triangles, V vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.stage import Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays, unpack_json


@dataclass
class MeshRecord:
    """One object as a triangle mesh.

    vertices: (V, 3) float32. After *collect* the bounding box is centred on the origin and its longest side is 1; later
        stages keep that frame.
    faces: (F, 3) int32, counter-clockwise seen from outside.
    meta: JSON. ``object_id``, ``content_hash``, ``source``, ``origin``, ``licence``, ``family`` and the stage's measures.
    """

    id: str
    vertices: np.ndarray
    faces: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)

    def to_record(self) -> Record:
        arrays = {"vertices": self.vertices.astype(np.float32), "faces": self.faces.astype(np.int32)}
        return Record(self.id, {"mesh.npz": pack_arrays(arrays), "meta.json": pack_json(self.meta)})

    @classmethod
    def from_record(cls, record: Record) -> MeshRecord:
        arrays = unpack_arrays(record.members["mesh.npz"])
        return cls(record.id, arrays["vertices"], arrays["faces"], unpack_json(record.members["meta.json"]))


@dataclass
class TextureRecord:
    """What *collect* kept of an object's colours: base-colour images and how they lie on the mesh of the same name.

    A record of its own beside the MeshRecord, so that textures change nothing of the mesh and of what is made from it.

    id: the mesh's, with ``TextureRecord.SUFFIX``. F faces are those of the mesh, in its order; M materials, I images.
    uv: (F, 3, 2) float32 per corner; (0, 0) is the upper left corner of the image, v runs down (glTF's convention).
    material: (F,) int32, a row of the following. colour: (M, 3) float32, linear factor of the image or the colour itself.
    image: (M,) int16 into ``images``, -1 = none. wrap: (M, 2) uint8 along u and v, an index into ``WRAPS``.
    images: (H, W, 3) uint8 each, sRGB, row 0 on top.
    tint: (F, 3, 3) float32 linear colours of the corners, which multiply all that; None where there are none.
    """

    id: str
    uv: np.ndarray
    material: np.ndarray
    colour: np.ndarray
    image: np.ndarray
    wrap: np.ndarray
    images: list[np.ndarray]
    tint: np.ndarray | None = None

    SUFFIX = "-texture"
    WRAPS = ("repeat", "clamp", "mirror")
    DTYPES = {"uv": np.float32, "material": np.int32, "colour": np.float32, "image": np.int16, "wrap": np.uint8}

    def to_record(self) -> Record:
        arrays = {name: np.asarray(getattr(self, name)).astype(dtype) for name, dtype in self.DTYPES.items()}
        arrays |= {f"image{index}": image for index, image in enumerate(self.images)}
        if self.tint is not None:
            arrays["tint"] = self.tint.astype(np.float32)
        return Record(self.id, {"texture.npz": pack_arrays(arrays, compressed=True)})

    @classmethod
    def from_record(cls, record: Record) -> TextureRecord:
        arrays = unpack_arrays(record.members["texture.npz"])
        tint = arrays.pop("tint", None)
        images = [arrays[f"image{index}"] for index in range(len(arrays) - len(cls.DTYPES))]
        return cls(record.id, **{name: arrays[name] for name in cls.DTYPES}, images=images, tint=tint)
