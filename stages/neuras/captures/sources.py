"""What a source of a capture is, and the source that all sets on disk share.

A reader (``nerfstudio``, ``colmap``, ``pandaset``) turns a folder's files into an ``Inventory``: facts, no pixels. A
``FolderSource`` makes records of it. What is wrong with one frame is that frame's fault, told when the frame is asked for;
what is wrong with the whole set is a UserError at once.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added, count, existing_folder, report, runtime
from pipeline.errors import Reject, UserError
from pipeline.keys import digest_of
from stages.graphics.geometry.load import SUFFIXES, load_mesh
from stages.graphics.geometry.paths import check_path, inside
from stages.neuras.captures import pictures, poses, splits
from stages.neuras.captures.lenses import Lens
from stages.neuras.records import FRAME, POINTS, CaptureInfo, FrameRecord, Mesh, PointsRecord, Split

FEWEST = 3  # usable frames
MASKS = "masks"  # beside the images of sets that name no masks
FAR_AWAY = 10_000.0  # world units from the origin, beyond which a small place is moved to it
SEEN = 50_000  # points that decide the capture's ball
AXES = {sign + name: tuple((-1.0 if sign else 1.0) * (name == axis) for axis in "xyz") for name in "xyz" for sign in ("", "-")}


class Source(Protocol):
    """A capture: its items, and what each becomes. An item's id is its record's id, ``frame-..`` or ``points-..``.

    ``items``, ``mesh`` and ``info`` are asked for outside the workers too: they may need nothing that is prepared.
    """

    def items(self) -> list[tuple[str, str]]:
        """(id, group) of all items; the group is the frame's split, or "points"."""

    def frame(self, id: str) -> FrameRecord:
        """The frame; raises Reject."""

    def points(self, id: str) -> PointsRecord:
        """The points; raises Reject."""

    def mesh(self) -> Mesh | None:
        """The given mesh, if there is one."""

    def info(self) -> CaptureInfo:
        """What holds for the whole capture."""


class FolderConfig(StageConfig):
    """What the captures in folders have in common."""

    path: str | None = runtime(None)  # capture.path=DIR; the content of its files is what counts
    mesh: str | None = runtime(
        None
    )  # a mesh to learn on, or a folder of its tiles; null: mesh.ply, mesh.glb or mesh.obj in the folder, if there is one
    every: int = count(1, ge=1)  # keep every so-many-th frame, of each split by itself where the set names them
    split: splits.RuleName = "auto"  # auto: the names that the set gives, else every_other
    seed: int = 0  # of random_half
    nth: int = added(8, legacy=8, ge=3)  # of every_nth: one frame in so many is for training
    max_side: int | None = Field(None, ge=16)  # longest side of a picture in pixels, larger ones are made smaller
    units: Literal["auto", "metre", "arbitrary"] = report("auto")  # auto: what the set says, else arbitrary
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = report("auto")  # auto: what the set says, else from the cameras
    max_pixels: int = Field(100_000_000, ge=1)  # of a picture
    max_bytes: int = Field(4 << 30, ge=1)  # of the mesh or a file of points
    max_faces: int = Field(20_000_000, ge=1)  # of the mesh


@dataclass
class Shot:
    """A posed image as a set on disk states it. moment: what frames taken at one time share. split: as the set names it.

    mask, outlines, backdrop: see ``pictures.Original``.
    """

    name: str  # of the image, relative to the capture's folder, for people
    moment: Hashable = None
    image: Path | None = None
    mask: Path | None = None
    outlines: list[list[list[float]]] = field(default_factory=list)
    backdrop: tuple[int, int, int] | None = None
    lens: Lens | None = None
    camera_to_world: np.ndarray | None = None
    split: Split | None = None
    time: float | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    fault: Reject | None = None  # why it cannot be used


@dataclass
class PointSet:
    """Points, read when they are asked for. read: (P, 3) and the sensor's position (3,) or None, as the set has them. file: if
    it is one's.

    moment: of the frames that were taken with it; None for what belongs to no one time. facts: what decides the points
    besides the file.
    """

    name: str
    file: Path | None
    read: Callable[[], tuple[np.ndarray, np.ndarray | None]]
    moment: Hashable = None
    facts: Any = None


@dataclass
class Inventory:
    """What a reader finds. units and up: None where the set does not say. units_from: where it says so, in words. mesh: the
    files of the set's own mesh. decided_by, facts: files and what else decides every frame and all points. notes: sentences for
    the user.
    """

    shots: list[Shot]
    sets: list[PointSet] = field(default_factory=list)
    points: Literal["lidar", "sfm", "none"] = "none"
    units: Literal["metre", "arbitrary"] | None = None
    units_from: str = "nothing in the set says it"
    up: tuple[float, float, float] | None = None
    mesh: list[Path] = field(default_factory=list)
    decided_by: list[Path] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def shot_of(name: str, fill: Callable[[Shot], None]) -> Shot:
    """A shot that ``fill`` completes; a Reject that it raises becomes the shot's fault."""
    shot = Shot(name)
    try:
        fill(shot)
    except Reject as error:
        shot.fault = error
    return shot


def file_in(root: Path, name: Any, what: str) -> Path:
    """The file inside ``root`` that a set names, or a Reject."""
    if not isinstance(name, str) or not name:
        raise Reject(f"no_{what}", f"no {what} is named")
    path = check_path(name, root, root)
    if not path.is_file():
        raise Reject(f"no_{what}", f"there is no file {name!r}")
    return path


def mask_of(root: Path, name: str) -> Path | None:
    """The mask of an image of a set that names none: ``masks/NAME.png``, as COLMAP has it, or with the image's suffix replaced.

    None where there is no such file; a Reject where it leads out of ``root``.
    """
    for named in (f"{MASKS}/{name}.png", f"{MASKS}/{PurePosixPath(name).with_suffix('.png')}"):
        if (root / named).is_file():
            return file_in(root, named, "mask")
    return None


def notes_on_masks(root: Path, shots: Iterable[Shot]) -> list[str]:
    """A sentence about files in ``masks/`` that belong to no image, if there are any."""
    taken = {shot.mask for shot in shots}
    folder = root / MASKS
    strays = sorted(path for path in folder.rglob("*") if path.is_file() and path not in taken and path.name[0] != ".")
    if not strays:
        return []
    return [
        f"{len(strays)} of the files in {MASKS}/ belong to no image, such as {strays[0].relative_to(folder).as_posix()}: "
        "the mask of IMG_1.jpg is IMG_1.jpg.png or IMG_1.png"
    ]


def json_in(root: Path, path: Path, kind: type) -> Any:
    """The content of a JSON file that a set must have; raises UserError."""
    if not inside(path, root):
        raise UserError(f"{str(path)!r} leads out of {str(root)!r}")
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"there is no {str(path)!r}: the set must lie in its own layout (docs/neuras/captures.md)") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{str(path)!r} is not JSON: {error}") from None
    if not isinstance(value, kind):
        raise UserError(f"{str(path)!r} does not hold a {kind.__name__}")
    return value


class FolderSource:
    """The capture in a folder, by a reader of its kind."""

    def __init__(self, config: FolderConfig, read: Callable[[FolderConfig, Path], Inventory], root: Path | None = None):
        self.config = config
        self.root = root or existing_folder("capture.path", config.path, f"capture={config.name} needs a folder")
        self.inventory = read(config, self.root)
        shots = self.inventory.shots
        kept = splits.kept([shot.split for shot in shots], config.every)
        self.shots = dict(zip(_ids([shots[index].name for index in kept]), (shots[index] for index in kept), strict=True))
        chosen = list(self.shots.values())
        assigned, self.split_rule = splits.assigned(
            [shot.moment for shot in chosen],
            [shot.split for shot in chosen],
            splits.Rule(config.split, config.seed, config.nth),
        )
        self.splits = dict(zip(self.shots, assigned, strict=True))
        if config.every > 1:
            self.split_rule += f"; of the set's frames one in {config.every} is taken"
        held = {shot.moment for shot, split in zip(chosen, assigned, strict=True) if split == "test"}
        self.sets = {f"{POINTS}{it.name}": it for it in self.inventory.sets if it.moment is None or it.moment not in held}
        self.mesh_files = _mesh_files(config, self.root) or self.inventory.mesh
        self._check()
        self.origin = _origin([shot.camera_to_world for shot in chosen if shot.fault is None])
        if self.origin.any():
            for shot in chosen:
                if shot.fault is None:
                    shot.camera_to_world = shot.camera_to_world.copy()
                    shot.camera_to_world[:3, 3] -= self.origin

    def items(self) -> list[tuple[str, str]]:
        return [*self.splits.items(), *((id, "points") for id in self.sets)]

    def frame(self, id: str) -> FrameRecord:
        shot = self.shots[id]
        if shot.fault is not None:
            raise shot.fault
        original = pictures.Original(shot.image, shot.lens, shot.mask, shot.outlines, shot.backdrop)
        picture = pictures.made(original, self.config.max_side, self.config.max_pixels)
        camera = shot.lens.camera(shot.camera_to_world).resized(*picture.size)
        return FrameRecord(
            id, camera, picture.image, self.splits[id], time=shot.time, mask=picture.mask, meta={"file": shot.name, **shot.meta}
        )

    def points(self, id: str) -> PointsRecord:
        points, sensor = self.sets[id].read()
        with np.errstate(over="ignore"):
            here = (points - self.origin).astype(np.float32)
        here = here[np.isfinite(here).all(axis=1)]
        if not len(here):
            raise Reject("no_points", f"{id} holds no point")
        return PointsRecord(id, here, None if sensor is None else (sensor - self.origin).astype(np.float32))

    def mesh(self) -> Mesh | None:
        """The given mesh; UserError where it is none."""
        vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
        for path in self.mesh_files:
            try:
                loaded = load_mesh(path, path.parent, self.config.max_bytes, self.config.max_faces)
            except Reject as error:
                raise UserError(f"the mesh {str(path)!r} cannot be used: {error.detail}") from None
            faces.append(loaded.faces + sum(map(len, vertices)))
            vertices.append(loaded.vertices)
        if not self.mesh_files:
            return None
        if (number := sum(map(len, faces))) > self.config.max_faces:
            raise UserError(f"the mesh has {number:,} faces, over capture.max_faces={self.config.max_faces:,}")
        return Mesh((np.concatenate(vertices) - self.origin).astype(np.float32), np.concatenate(faces).astype(np.int32))

    def info(self) -> CaptureInfo:
        config, inventory = self.config, self.inventory
        usable = [(self.splits[id], shot) for id, shot in self.shots.items() if shot.fault is None]
        cameras = [shot.lens.camera(shot.camera_to_world) for split, shot in usable if split == "train"]
        up = AXES[config.up] if config.up != "auto" else inventory.up
        up_from = "capture.up" if config.up != "auto" else "the set" if up is not None else "the cameras, held without roll"
        centre, radius = poses.ball(cameras, self._surface())
        units = config.units if config.units != "auto" else inventory.units or "arbitrary"
        return CaptureInfo(
            units=units,
            metre=1.0 if units == "metre" else radius / 100,
            up=tuple(float(x) for x in (up if up is not None else poses.upward(cameras))),
            centre=tuple(float(x) for x in centre),
            radius=radius,
            points=inventory.points if self.sets else "none",
            split_rule=self.split_rule,
            source={
                "kind": config.name,
                "units_from": "capture.units" if config.units != "auto" else inventory.units_from,
                "up_from": up_from,
            }
            | ({"origin": self.origin.tolist()} if self.origin.any() else {}),
        )

    def hashes(self, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        """What decides the output: per item its files' content and its facts; the mesh's content for the whole."""
        items: dict[str, Any] = {}
        files, facts = [hash_file(path) for path in self.inventory.decided_by], self.inventory.facts
        together = digest_of([*files, facts] if facts else files) if files else None
        for id, shot in self.shots.items():
            facts = {
                "files": [hash_file(path) for path in (shot.image, shot.mask) if path is not None],
                "lens": shot.lens and {name: _plain(value) for name, value in vars(shot.lens).items()},
                "pose": None if shot.camera_to_world is None else shot.camera_to_world.tolist(),
                "said": [self.splits[id], shot.time, shot.name, shot.meta],
                "fault": shot.fault and [shot.fault.reason, shot.fault.detail],
            }
            rarer = {
                "outlines": shot.outlines,
                "backdrop": _plain(shot.backdrop),
                "all": together,
            }  # left out where there are none
            items[id] = digest_of(facts | {name: value for name, value in rarer.items() if value})
        for id, it in self.sets.items():
            content = together if it.file is None else hash_file(it.file)
            items[id] = content if it.facts is None else digest_of([content, it.facts])
        tiles = [hash_file(path) for path in self.mesh_files]
        mesh = tiles if len(tiles) > 1 else tiles[0] if tiles else None
        told = {"units": self.inventory.units, "up": _plain(self.inventory.up), "points": self.inventory.points}
        told |= {"origin": self.origin.tolist()} if self.origin.any() else {}
        return {"items": items, "mesh": mesh, "told": told}

    def _surface(self) -> np.ndarray:
        """(P, 3): points of the set, else of its mesh; some of them where there are many. Without either (0, 3)."""
        found = []
        for it in self.sets.values():
            try:
                found.append(self.points(f"{POINTS}{it.name}").points)
            except Reject:
                continue
        mesh = None if found else self.mesh()
        points = np.concatenate(found) if found else np.zeros((0, 3)) if mesh is None else mesh.vertices
        return points[:: max(len(points) // SEEN, 1)].astype(np.float64)

    def _check(self) -> None:
        if not self.shots:
            raise UserError(f"capture.path={str(self.root)!r} holds no frame")
        usable = [self.splits[id] for id, shot in self.shots.items() if shot.fault is None]
        if "train" in usable and len(usable) >= FEWEST:
            return
        faults = Counter(shot.fault.reason for shot in self.shots.values() if shot.fault is not None)
        told = ", ".join(f"{number} {reason}" for reason, number in sorted(faults.items())) or "none is at fault"
        first = next((f"; {shot.name}: {shot.fault.detail}" for shot in self.shots.values() if shot.fault is not None), "")
        if "train" not in usable:
            raise UserError(f"no training frame is usable ({len(self.shots)} frames: {told}{first})")
        raise UserError(
            f"{len(usable)} usable frames are too few, at least {FEWEST} are needed to learn from some and to test on others: "
            f"take more images, or keep more of them (capture.every={self.config.every}; {told}{first})"
        )


def _origin(poses: Sequence[np.ndarray | None]) -> np.ndarray:
    """(3,) float64: what is taken from all coordinates. 0 but for places on a map of the earth, millions of metres from its
    origin: meshes and points are float32, which would round them to decimetres. A few wild cameras decide nothing.
    """
    positions = np.array([pose[:3, 3] for pose in poses if pose is not None]).reshape(-1, 3)
    if not len(positions):  # of photos that were not placed yet
        return np.zeros(3)
    low, middle, high = np.quantile(positions, (0.1, 0.5, 0.9), axis=0)
    return middle.round() if np.abs(middle).max() > max(FAR_AWAY, 10 * (high - low).max()) else np.zeros(3)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _ids(names: Iterable[str]) -> list[str]:
    """Record ids of the images' names: without what all paths begin with and without suffixes, in the same order."""
    names = list(names)
    twice = [name for name, number in Counter(names).items() if number > 1]
    if twice:
        raise UserError(f"the capture names {twice[0]!r} twice: a frame's image may appear once")
    paths = [PurePosixPath(name.replace("\\", "/")) for name in names]
    while paths and all(len(path.parts) > 1 for path in paths) and len({path.parts[0] for path in paths}) == 1:
        paths = [PurePosixPath(*path.parts[1:]) for path in paths]
    ids: dict[str, str] = {}
    for name, path in zip(names, paths, strict=True):
        slug = re.sub(r"[^A-Za-z0-9_]+", "-", str(path.with_suffix(""))).strip("-")[-100:] or "image"
        if slug in ids:
            raise UserError(f"the images {ids[slug]!r} and {name!r} differ in little more than signs: rename one of them")
        ids[slug] = name
    return [FRAME + slug for slug in ids]


def _mesh_files(config: FolderConfig, root: Path) -> list[Path]:
    """The mesh that the settings name, or that lies in the folder; a folder of tiles is one mesh."""
    if config.mesh is not None:
        path = Path(config.mesh).expanduser()
        tiles = sorted(tile for tile in path.rglob("*") if tile.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
        if not tiles or not all(tile.is_file() for tile in tiles):
            raise UserError(f"capture.mesh={config.mesh!r} is neither a mesh nor a folder of meshes ({', '.join(SUFFIXES)})")
        return tiles
    beside = (root / f"mesh.{suffix}" for suffix in ("ply", "glb", "obj"))
    return next(([path] for path in beside if path.is_file()), [])
