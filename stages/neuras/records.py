"""What NeuRas' stages exchange: the records of a capture, and the files of a scaffold and of an atlas.

Frames: the world is the capture's, right-handed, in its own unit (``CaptureInfo.metre``). Cameras are
``stages.graphics.cameras.Camera``. Images are 8-bit sRGB, row 0 on top. Texture coordinates have (0, 0) at the upper left
corner, v runs down: texel [row, column] has its centre at ((column + 0.5) / W, (row + 0.5) / H).

A capture's artifact holds *frame* records ("frame-..") and *points* records ("points-.."), and the files ``capture.json``
(``CaptureInfo``) and, where a mesh is given, ``mesh.npz`` (``save_mesh``).
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from pipeline.stage import Record
from pipeline.store import Artifact
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays, unpack_json
from stages.graphics.cameras import Camera

FRAME, POINTS = "frame-", "points-"  # how the ids of a capture's records begin
POSES = "poses.json"  # camera-to-world (4, 4) of moved cameras by their frames' ids
Poses = Mapping[str, np.ndarray]
Split = Literal["train", "validation", "test", "shift"]  # shift: beside the driven path, only where truth exists


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """A posed image.

    picture: the bytes of a PNG or JPEG, of the camera's size. mask: the bytes of a PNG with one channel, 0 where a pixel is to
    be ignored; None where all count. trajectory: its path, such as "drive" or "shift_2m_right"; ``shift``: metres to the right
    of the drive. time: seconds, None where unknown. depth: (H, W) float32 true distance along the ray in world units, 0
    for nothing, only where truth is known.
    """

    id: str
    camera: Camera
    picture: bytes
    split: Split
    trajectory: str = "drive"
    shift: float = 0.0
    time: float | None = None
    mask: bytes | None = None
    depth: np.ndarray | None = None
    meta: dict[str, Any] = field(default_factory=dict)

    def image(self) -> np.ndarray:
        """(H, W, 3) uint8, sRGB."""
        return np.array(Image.open(io.BytesIO(self.picture)).convert("RGB"))

    def counts(self) -> np.ndarray:
        """(H, W) bool: pixels that the mask lets count."""
        if self.mask is None:
            return np.ones((self.camera.height, self.camera.width), bool)
        return np.array(Image.open(io.BytesIO(self.mask)).convert("L")) > 0

    def to_record(self) -> Record:
        suffix = "png" if self.picture.startswith(b"\x89PNG") else "jpg"
        names = ("split", "trajectory", "shift", "time", "meta")
        members = {
            f"image.{suffix}": self.picture,
            "frame.json": pack_json({"camera": self.camera.to_json(), **{name: getattr(self, name) for name in names}}),
        }
        if self.mask is not None:
            members["mask.png"] = self.mask
        if self.depth is not None:
            members["depth.npz"] = pack_arrays({"depth": self.depth.astype(np.float16)}, compressed=True)
        return Record(self.id, members)

    @classmethod
    def from_record(cls, record: Record) -> FrameRecord:
        values = unpack_json(record.members["frame.json"])
        picture = record.members.get("image.png") or record.members["image.jpg"]
        depth = record.members.get("depth.npz")
        values["camera"] = Camera.from_json(values["camera"])
        return cls(
            record.id,
            picture=picture,
            mask=record.members.get("mask.png"),
            depth=None if depth is None else unpack_arrays(depth)["depth"].astype(np.float32),
            **values,
        )


@dataclass(frozen=True, eq=False)
class PointsRecord:
    """Points on surfaces: a LiDAR sweep, or those of a structure-from-motion model.

    points: (P, 3) float32, world. sensor: (3,) float32, where the sweep's beams came from; None where nothing measured them.
    """

    id: str
    points: np.ndarray
    sensor: np.ndarray | None = None

    def to_record(self) -> Record:
        arrays = {"points": self.points.astype(np.float32)}
        if self.sensor is not None:
            arrays["sensor"] = self.sensor.astype(np.float32)
        return Record(self.id, {"points.npz": pack_arrays(arrays)})

    @classmethod
    def from_record(cls, record: Record) -> PointsRecord:
        return cls(record.id, **unpack_arrays(record.members["points.npz"]))


@dataclass(frozen=True)
class CaptureInfo:
    """What ``capture.json`` says of the whole capture.

    metre: world units per metre, 1 where the capture is in metres; where its unit is unknown, a hundredth of ``radius``, and
    ``units`` says "arbitrary". up: unit vector, world. centre: (3,) and radius: of a ball around the training cameras and
    what they see, world units. points: "lidar", "sfm" or "none". sources: for people, where it came from and its licence.
    """

    units: Literal["metre", "arbitrary"]
    metre: float
    up: tuple[float, float, float]
    centre: tuple[float, float, float]
    radius: float
    points: Literal["lidar", "sfm", "none"]
    split_rule: str
    source: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of(cls, capture: Artifact) -> CaptureInfo:
        return cls(**unpack_json(capture.file("capture.json").read_bytes()))


def natural(name: str) -> list[tuple[int, str, str]]:
    """A key by which names sort as people count: 2.png before 10.png."""
    parts = re.split(r"([0-9]+)", name)  # text and digits by turns
    digits = [part.lstrip("0") if number % 2 else "" for number, part in enumerate(parts)]
    return [(len(value), value, part) for value, part in zip(digits, parts, strict=True)]


def frames(capture: Artifact, *splits: Split) -> Iterator[FrameRecord]:
    """The frames of these splits (all, if none is named), in order of their ids."""
    for row in sorted(capture.rows(), key=lambda row: row.id):  # a store has them by group
        if row.id.startswith(FRAME):
            frame = FrameRecord.from_record(capture.read(row.id))
            if not splits or frame.split in splits:
                yield frame


def posed(frames: Iterable[FrameRecord], poses: Poses) -> Iterator[FrameRecord]:
    """The frames, with these cameras' poses where there are some."""
    for frame in frames:
        pose = poses.get(frame.id, frame.camera.camera_to_world)
        yield replace(frame, camera=replace(frame.camera, camera_to_world=pose))


def refined_poses(scaffold: Artifact) -> Poses:
    """Of the cameras that *refine* moved."""
    return _poses(scaffold.read("mesh").members.get(POSES))


def fitted_poses(fit: Artifact) -> Poses:
    """Of the cameras that a *fit* does not take as the capture has them."""
    path = fit.path / "files" / POSES
    return _poses(path.read_bytes() if path.exists() else None)


def save_poses(folder: Path, poses: Poses) -> None:
    (folder / POSES).write_bytes(pack_json({id: np.asarray(pose).tolist() for id, pose in poses.items()}))


def _poses(data: bytes | None) -> Poses:
    return {} if data is None else {id: np.array(pose, float) for id, pose in unpack_json(data).items()}


def point_sets(capture: Artifact) -> Iterator[PointsRecord]:
    """All points records, in order of their ids."""
    for row in capture.rows():
        if row.id.startswith(POINTS):
            yield PointsRecord.from_record(capture.read(row.id))


@dataclass(frozen=True, eq=False)
class Mesh:
    """vertices: (V, 3) float32, world. faces: (F, 3) int32."""

    vertices: np.ndarray
    faces: np.ndarray

    @classmethod
    def compact(cls, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
        """Of any number types, without the vertices that no face uses."""
        from stages.graphics.geometry import measure

        vertices, faces = measure.compact(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
        return cls(vertices.astype(np.float32), faces.astype(np.int32))

    @classmethod
    def joined(cls, first: Mesh, second: Mesh) -> Mesh:
        """Both, the first one's faces before the second one's."""
        vertices = np.concatenate([first.vertices, second.vertices])
        return cls(vertices, np.concatenate([first.faces, second.faces + len(first.vertices)]).astype(np.int32))


@dataclass(frozen=True, eq=False)
class AtlasMesh:
    """A mesh unfolded into a texture of ``width`` x ``height`` texels.

    vertices: (N, 3) float32, world; a vertex on a seam stands here once per chart. uvs: (N, 2) float32 in [0, 1], v down.
    faces: (F, 3) int32. charts: (F,) int32, the chart that a face belongs to.
    """

    vertices: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    charts: np.ndarray
    width: int
    height: int

    def vertex_charts(self) -> np.ndarray:
        """(N,) float32: the chart that each vertex belongs to."""
        charts = np.zeros(len(self.vertices), np.float32)
        charts[self.faces] = self.charts[:, None]
        return charts


def save(path: Path, value: Mesh | AtlasMesh) -> None:
    """Write ``mesh.npz`` or ``atlas.npz``, the same bytes every time."""
    path.write_bytes(pack_arrays({name: np.asarray(array) for name, array in vars(value).items()}))


def given_mesh(capture: Artifact) -> Mesh | None:
    """The mesh that came with a capture, if one did."""
    path = capture.path / "files" / "mesh.npz"
    return Mesh(**unpack_arrays(path.read_bytes())) if path.exists() else None


def scaffold_mesh(scaffold: Artifact) -> Mesh:
    """The mesh of a *scaffold* or *refine* artifact."""
    return Mesh(**unpack_arrays(scaffold.read("mesh").members["mesh.npz"]))


def surfel_faces(scaffold: Artifact) -> int:
    """How many of its mesh's faces, the last ones, are of surfels."""
    return unpack_json(scaffold.read("mesh").members["mesh.json"])["faces"].get("surfels", 0)


def load_atlas(path: Path) -> AtlasMesh:
    arrays = unpack_arrays(path.read_bytes())
    return AtlasMesh(**{**arrays, "width": arrays["width"].item(), "height": arrays["height"].item()})
