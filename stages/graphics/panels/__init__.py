"""What a viewer can show of an artifact or a record: panels, as plain data.

A system names its views (``System.views``): a `Views` that maps each of its stages to a function from a `Shown` to panels.
The viewer draws panels and knows no stage. One design choice: a panel may hold a `Lazy`, whose value is made only when the
page asks for it. So a capture of a thousand frames opens as fast as one of ten.

Arrays travel as they are stored (half floats stay half floats), in one binary answer: ``pack`` writes it, ``page/data.js``
reads it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.store import Artifact, Record, Store, iter_inputs
from stages.graphics.cameras import Camera

ALIGNMENT = 8  # bytes, of each array in an answer
DTYPES = ("uint8", "uint16", "uint32", "int16", "int32", "float16", "float32")  # that a page reads


@dataclass(frozen=True)
class Shown:
    """What a view is asked to show: an artifact, or one of its records."""

    store: Store
    artifact: Artifact
    record_id: str | None = None

    def record(self, only: Sequence[str] | None = None) -> Record:
        """The record, or these members of it."""
        return self.artifact.read(self._id(), only)

    def members(self) -> Mapping[str, tuple[int, int]]:
        """Names of the record's members, with offset and size; nothing of them is read."""
        return self.artifact.row(self._id()).members

    def _id(self) -> str:
        if self.record_id is None:
            raise UserError(f"{self.artifact.name} is shown as a whole: name one of its records")
        return self.record_id

    def input(self, role: str) -> Artifact | None:
        """The artifact that plays the role, if it is still in the store."""
        return next((artifact for name, _, artifact in iter_inputs(self.store, self.artifact) if name == role), None)

    def files(self) -> list[str]:
        """Names of the artifact's files, sorted."""
        return sorted(self.artifact.manifest["outputs"]["files"])


class Lazy:
    """A value that is made when it is asked for."""

    def __init__(self, make: Callable[[], Any]):
        self.make = make


# --- panels -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Facts:
    """Names and values, as nested JSON."""

    title: str
    values: Any


@dataclass(frozen=True)
class Words:
    """Text, as it is."""

    title: str
    text: str


@dataclass(frozen=True)
class Pictures:
    """PNG or JPEG pictures, by caption. sources: members of the record, or, where it is an artifact, names of its files.

    slider: one at a time, with a slider over them (training steps).
    """

    title: str
    sources: Mapping[str, str]
    slider: bool = False


@dataclass(frozen=True)
class Page:
    """An HTML file of the artifact, in a frame."""

    title: str
    file: str


@dataclass(frozen=True)
class Video:
    """An MP4 file of the artifact."""

    title: str
    file: str


@dataclass(frozen=True)
class Curves:
    """Series over steps: name -> [[step, value], ..]. Names with a common unit are drawn together."""

    title: str
    series: Mapping[str, Sequence[tuple[float, float]]]


@dataclass(frozen=True, eq=False)
class Image:
    """A linear HDR image, light by light.

    lights: (L, H, W, 3) float16 or float32 radiance; the image is their sum, each times a gain that the page chooses.
    layers: name -> (H, W) or (H, W, 3): other outputs of the renderer. exposure: to begin with.
    facts: JSON, shown below.
    """

    title: str
    lights: np.ndarray
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)
    exposure: float = 1.0
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Images:
    """HDR images of one view side by side, under one exposure and tone mapper. images: Lazy each, that give an `Image`."""

    title: str
    images: Mapping[str, Lazy]


@dataclass(frozen=True)
class Photo:
    """An 8-bit picture. record: of the same artifact, or of the one named ``artifact``; its member."""

    artifact: str
    record: str
    member: str


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh. V vertices, F faces.

    vertices: (V, 3) float32. faces: (F, 3) int32. normals: (F, 3, 3) float32 per corner; None: flat.
    colours: name -> (F, 3) in [0, 1], linear. values: name -> (F,) numbers, shown on a colour scale; they may be Lazy.
    labels: name -> (F,) int, shown in colours that only tell them apart.
    A scene's preview reads the colours ``diffuse`` and ``emission`` (radiance), and the labels ``object`` and ``light``.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colours: Mapping[str, np.ndarray] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of_corners(cls, name: str, corners: np.ndarray, **more: Any) -> Surface:
        """From (F, 3, 3) corners."""
        return cls(name, corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners)).reshape(-1, 3), **more)


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera in space, and what it saw: a Lazy that gives an `Image` or a `Photo`."""

    name: str
    camera: Camera
    image: Lazy | None = None


@dataclass(frozen=True, eq=False)
class Pane:
    """Things in one space. Of several surfaces one is shown at a time, with a slider over them.

    surfaces: Surface, or Lazy that gives one. points: (P, 3) float32, or a Lazy.
    """

    name: str
    surfaces: Sequence[Any]
    eyes: Sequence[Eye] = ()
    points: Any = None


@dataclass(frozen=True, eq=False)
class Space:
    """Panes side by side that share one camera.

    up: the world's axis that is drawn upwards. eye: number of the camera to begin in; None: outside.
    flat: seen from above without perspective (texture charts).
    objects: [{name, kind}] that the surface's label ``object`` counts. scene: what actions on the scene are asked with
    (``Views.actions``), None where there are none.
    """

    title: str
    panes: Sequence[Pane]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    eye: int | None = None
    flat: bool = False
    note: str = ""
    objects: Sequence[Mapping[str, Any]] = ()
    scene: Mapping[str, Any] | None = None


Show = Callable[[Shown], Iterable[Any]]


@dataclass(frozen=True)
class Views:
    """What a system adds to the viewer.

    stages: stage -> function that gives the panels of an artifact or of a record of it.
        Of a stage that is not there, the viewer shows what the names of members and files tell it.
    actions: name -> function(context, arguments) of the page's requests: a prediction, say. ``context`` is a `Context`.
    suffixes: endings of files outside a store that ``file`` shows; ``file(context)`` gives their panels.
    """

    stages: Mapping[str, Show] = field(default_factory=dict)
    actions: Mapping[str, Callable[[Context, Mapping[str, Any]], Any]] = field(default_factory=dict)
    suffixes: Sequence[str] = ()
    file: Callable[[Context], Iterable[Any]] | None = None


@dataclass
class Context:
    """What actions know beside their arguments, the same during a run of the viewer.

    path: the file that the viewer was started with. checkpoint: what was given with it. kept: an action's own memory.
    """

    store: Store | None = None
    path: Path | None = None
    checkpoint: str | None = None
    device: str = "auto"
    kept: dict[str, Any] = field(default_factory=dict)


# --- as bytes ---------------------------------------------------------------------------------------------------------


def pack(value: Any) -> bytes:
    """Panels, or any plain value with arrays, as one answer: length of the JSON (4 bytes, little endian), JSON, arrays.

    In the JSON an array is ``{"$": [offset, dtype, shape]}``, offsets counting from the first array; a Lazy is
    ``{"lazy": "path"}``, a dataclass an object with its class's name as ``kind``.
    """
    blobs: list[bytes] = []
    at = 0

    def plain(value: Any, path: str) -> Any:
        nonlocal at
        if isinstance(value, np.ndarray):
            kind = value.dtype.name
            kind = {"float64": "float32", "int64": "int32", "bool": "uint8"}.get(kind, kind)
            if kind not in DTYPES:
                raise TypeError(f"{path}: an array of {value.dtype} is not for pages")
            data = np.ascontiguousarray(value, kind).tobytes()
            described = {"$": [at, kind, list(value.shape)]}
            blobs.append(data + bytes(-len(data) % ALIGNMENT))
            at += len(blobs[-1])
            return described
        if isinstance(value, Lazy):
            return {"lazy": path}
        if isinstance(value, Camera):
            return value.to_json()
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            return {"kind": type(value).__name__.lower()} | {name: plain(v, f"{path}/{name}") for name, v in fields.items()}
        if isinstance(value, Mapping):
            return {str(name): plain(v, f"{path}/{name}") for name, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v, f"{path}/{i}") for i, v in enumerate(value)]
        if isinstance(value, (float, np.floating)):
            return float(value) if math.isfinite(value) else None
        if isinstance(value, np.integer):
            return int(value)
        return value

    text = json.dumps(plain(value, ""), allow_nan=False, ensure_ascii=False).encode()
    text += b" " * (-(len(text) + 4) % ALIGNMENT)
    return b"".join([len(text).to_bytes(4, "little"), text, *blobs])


def unpack(data: bytes) -> Any:
    """What ``pack`` wrote, arrays as numpy arrays: for tests and scripts that ask a viewer."""
    length = int.from_bytes(data[:4], "little")
    start = 4 + length

    def rich(value: Any) -> Any:
        if isinstance(value, dict):
            if "$" in value:
                at, kind, shape = value["$"]
                return np.frombuffer(data, kind, math.prod(shape), start + at).reshape(shape)
            return {name: rich(v) for name, v in value.items()}
        return [rich(v) for v in value] if isinstance(value, list) else value

    return rich(json.loads(data[4:start]))


def resolve(value: Any, path: str) -> Any:
    """The value of the Lazy at that path of panels (as ``pack`` named it). UserError where there is none."""
    for name in path.strip("/").split("/"):
        if isinstance(value, Mapping) and name in value:
            value = value[name]
        elif isinstance(value, (list, tuple)) and name.isdecimal() and int(name) < len(value):
            value = value[int(name)]
        elif dataclasses.is_dataclass(value) and name in {f.name for f in dataclasses.fields(value)}:
            value = getattr(value, name)
        else:
            raise UserError(f"there is nothing at {path!r}")
    if not isinstance(value, Lazy):
        raise UserError(f"there is nothing to load at {path!r}")
    return value.make()
