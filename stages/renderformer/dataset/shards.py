"""Samples out of shards: where each member lies, seeks to the members that are wanted, and what to do about damage.

Reads ``files/index.jsonl``, ``files/shards.json`` and ``parts/*.tar`` of a *shard* artifact, of a copy of it in another
folder, or of one behind a URL that webdataset can open; writes only a download cache. One design choice: a shard is random
access. The index holds offset, bytes and CRC-32 of every member, so that a view that is not drawn costs nothing; a shard from
afar is fetched whole, once, and then is random access too.

A damaged sample (a member whose CRC does not match or that does not decode) raises ``DamagedSample``, which the batches skip
by name. A damaged shard (missing, cut) is a ``UserError`` unless ``skip_damaged_shards``: then its samples count as damaged.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError
from pipeline.store import RECORD_ID
from stages.graphics.exr import decode_lights
from stages.renderformer.dataset.encoding import decode_scene
from stages.renderformer.guides import SceneGuides, ViewGuides, guide_member
from stages.renderformer.guides.records import SCENE_MEMBER, check_guides, decode_scene_guides, decode_view_guides
from stages.renderformer.records import SceneRecord, ViewRecord
from stages.renderformer.views import LAYERS, decode_layers, view_members

SHARD = re.compile(r"parts/([0-9a-f]{64})\.tar\Z")  # a shard's path; the name is the blake2b-256 of its bytes
REMOTE = re.compile(r"[a-z][a-z0-9+.-]+:")  # pipe:, http:, file: ..
INDEX, SHARDS = "index.jsonl", "shards.json"


class DamagedSample(UserError):
    """One sample cannot be read; the others can."""


class DamagedShard(UserError):
    """A shard is missing, cut or not what it is named after: none of its samples can be trusted."""


@dataclass
class Sample:
    """One scene with the views that were asked for; treat as read only, the cache shares its arrays.

    AOV layers that were not asked for are None, and so are guides.
    """

    scene: SceneRecord
    views: dict[int, ViewRecord]  # camera index -> what it saw
    guides: SceneGuides | None = None
    view_guides: dict[int, ViewGuides] = field(default_factory=dict)  # by camera index


def _view(lights: np.ndarray, meta: dict[str, Any], layers: Mapping[str, np.ndarray]) -> ViewRecord:
    """A view from its decoded members; layers that are not there are None."""
    return ViewRecord(lights, **{name: layers.get(name) for name in LAYERS}, meta=meta)  # type: ignore[arg-type]


def decode_members(id: str, members: Mapping[str, bytes]) -> Sample:
    """A whole sample from its members by name (of a store's record, or of a sample that plain webdataset yields)."""
    scene = decode_scene(id, members["scene.npz"], members["meta.json"])
    views = {}
    for index in scene.meta["views"]:
        image, aov = view_members(index)
        where = f"{image} of {id}"
        views[index] = _view(*decode_lights(members[image], where), decode_layers(members[aov], where))
    return Sample(scene, views)


def decode_sample(record: Any) -> Sample:
    """A shard's record, whole."""
    return decode_members(record.id, record.members)


# --- where the bytes are ----------------------------------------------------------------------------------------------


class Folder:
    """A dataset in a local folder: ``files/`` and ``parts/``."""

    def __init__(self, root: Path):
        self.root = root

    def path(self, name: str) -> Path:
        return self.root / name

    def shard(self, name: str) -> Path:
        return self.root / name


class Remote:
    """A dataset behind a URL that ``webdataset.gopen`` opens; files are fetched whole into ``cache`` and kept there.

    ``root`` may hold ``{}`` for the file's path (``pipe:curl -sf https://host/data/{}``), else the path is appended.
    """

    def __init__(self, root: str, cache: Path, gigabytes: float | None = None):
        self.root, self.limit = root, None if gigabytes is None else gigabytes * 1e9
        self.cache = cache / hashlib.blake2b(root.encode(), digest_size=16).hexdigest()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lock = threading.Lock()

    def url(self, name: str) -> str:
        return self.root.replace("{}", name) if "{}" in self.root else f"{self.root.rstrip('/')}/{name}"

    def path(self, name: str) -> Path:
        target = self.cache / name
        with self._lock:
            if not target.is_file():
                self._fetch(name, target)
        return target

    def shard(self, name: str) -> Path:
        path = self.path(name)
        if self.limit is not None:
            os.utime(path)
            self._make_room(path)
        return path

    def _make_room(self, keep: Path) -> None:
        """Drop the shards that were not used for longest; readers that have one open are not disturbed."""
        with self._lock:
            files = [(path, path.stat()) for path in keep.parent.glob("[!.]*.tar")]
            total = sum(stat.st_size for _, stat in files)
            for path, stat in sorted(files, key=lambda item: item[1].st_mtime_ns):
                if total > self.limit and path != keep:
                    path.unlink(missing_ok=True)
                    total -= stat.st_size

    def _fetch(self, name: str, target: Path) -> None:
        from webdataset.gopen import gopen

        url, digest = self.url(name), hashlib.blake2b(digest_size=32)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with atomic_path(target) as temporary:
                with open(temporary, "wb") as file, gopen(url) as stream:
                    while block := stream.read(1 << 20):
                        digest.update(block)
                        file.write(block)
                match = SHARD.match(name)
                if match and digest.hexdigest() != match[1]:
                    raise DamagedShard(f"{url} does not hash to its name: the shard is damaged or was cut on the way")
        except DamagedShard:
            raise
        except (OSError, ValueError) as error:
            raise UserError(f"{url} cannot be read ({error})") from error


def open_source(source: Any, cache_folder: Path | str | None = None, cache_gb: float | None = None) -> Folder | Remote:
    """``source``: an artifact, a folder, or a URL, whose shards are kept in ``cache_folder``, at most ``cache_gb`` of them."""
    root = getattr(source, "path", source)
    if isinstance(root, str) and REMOTE.match(root):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return Remote(root, Path(cache_folder) if cache_folder else home / "lightmill", cache_gb)
    root = Path(root)
    if not (root / "files" / INDEX).is_file():
        raise UserError(f"{root} is not a dataset: it has no files/{INDEX} (give a shard artifact's folder, or a URL)")
    return Folder(root)


# --- random access ----------------------------------------------------------------------------------------------------


class ShardDataset:
    """Random access to the samples of one split, with a bounded cache of decoded members. Safe to use from threads.

    ``ids`` in the shards' order, ``triangles`` (len,) their counts, ``shard_of`` (len,) the number of each one's shard,
    ``resolution`` in pixels, ``dropped`` the number of scenes over ``max_triangles``: known from the index, without reading a
    sample.
    """

    def __init__(
        self,
        source: Any,
        split: str,
        max_triangles: int | None = None,
        cache_mb: float = 1024.0,
        *,
        cache_folder: Path | str | None = None,
        cache_gb: float | None = None,
        skip_damaged_shards: bool = False,
    ):
        self.split = split
        self.source = open_source(source, cache_folder, cache_gb)
        self._skip = skip_damaged_shards
        self.ids: list[str] = []
        triangles, shard_of, splits, self.dropped, self.resolution = [], [], set(), 0, 0
        shards: dict[str, int] = {}
        lines: list[bytes] = []
        with open(self.source.path(f"files/{INDEX}"), "rb") as file:
            for number, line in enumerate(file, 1):
                try:
                    row = json.loads(line)
                    id, group, count, shard, resolution = (
                        row[name] for name in ("id", "split", "triangles", "shard", "resolution")
                    )
                    if not RECORD_ID.match(id):  # files are named after it
                        raise ValueError(f"{id!r} is no name of a scene")
                except (ValueError, KeyError, TypeError) as error:
                    raise UserError(
                        f"line {number} of {file.name} is no line of an index ({error!r}): fetch it again"
                    ) from error
                splits.add(group)
                if group != split:
                    continue
                if max_triangles is not None and count > max_triangles:
                    self.dropped += 1
                    continue
                lines.append(line)
                self.ids.append(id)
                triangles.append(count)
                shard_of.append(shards.setdefault(shard, len(shards)))
                self.resolution = resolution
        if not self.ids:
            over = f" with at most {max_triangles} triangles" if self.dropped else ""
            raise UserError(f"the dataset has no {split} scenes{over}: its splits are {', '.join(sorted(splits)) or 'empty'}")
        # Lines are parsed again where needed: a tenth of the memory of parsed ones, and one block that processes share
        self._lines, self._starts = b"".join(lines), np.cumsum([0, *map(len, lines)])
        self._parsed: tuple[int, dict[str, Any]] = -1, {}
        self.triangles, self.shard_of = np.array(triangles), np.array(shard_of)
        self._sizes = self._shard_sizes(shards)
        self.cache_bytes = int(cache_mb * 1e6)
        self._cache: OrderedDict[tuple, tuple[Any, int]] = OrderedDict()
        self._used, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return len(self.ids)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_cache": OrderedDict(), "_used": 0, "_lock": None}  # to a worker process: without the cache

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lock = threading.Lock()

    def __getitem__(self, index: int) -> Sample:
        """The sample whole: every view with every layer."""
        return self.read(index, layers=("all",))

    def row(self, index: int) -> dict[str, Any]:
        """A sample's line of the index: its views, shard, members and more; treat as read only."""
        number, row = self._parsed  # who asks for a row reads its sample next, which asks again
        if number != index:
            row = json.loads(self._lines[self._starts[index] : self._starts[index + 1]])
            self._parsed = index, row
        return row

    def read(
        self,
        index: int,
        views: Sequence[int] | None = None,
        layers: Sequence[str] = (),
        dtype: type | None = np.float32,
        guides: bool = False,
    ) -> Sample:
        """The sample with these views (None: all), their lights, their AOVs if any ``layers`` are wanted, and its guides;
        ``dtype`` None: half floats, as stored."""
        row = self.row(index)
        chosen_views = row["views"] if views is None else sorted({int(view) for view in views})
        with Reader(self, row) as reader:
            scene = self._cached((index, "scene"), lambda: decode_scene(row["id"], reader["scene.npz"], reader["meta.json"]))
            out = {}
            for view in chosen_views:
                image, aov = view_members(view)
                where = f"{image} of {row['id']}"
                lights, meta = self._cached((index, image, dtype), lambda n=image, w=where: decode_lights(reader[n], w, dtype))
                layer_images = {}
                if layers:
                    layer_images = self._cached((index, aov, dtype), lambda n=aov, w=where: decode_layers(reader[n], w, dtype))
                out[view] = _view(lights, meta, layer_images)
            sample = Sample(scene, out)
            if guides:
                self._add_guides(sample, index, reader)
        return sample

    def _add_guides(self, sample: Sample, index: int, reader: Reader) -> None:
        def read(name: str, decode: Callable[[bytes, str], Any]) -> Any:
            return self._cached((index, name), lambda: decode(reader[name], f"{name} of {sample.scene.id}"))

        sample.guides = read(SCENE_MEMBER, decode_scene_guides)
        for view in sample.views:
            sample.view_guides[view] = read(guide_member(view), decode_view_guides)
        check_guides(len(sample.scene.triangles), sample.guides, sample.view_guides.values())

    def _cached(self, key: tuple, decode: Any) -> Any:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key][0]
        try:
            value = decode()
        except (DamagedSample, DamagedShard):
            raise
        except UserError as error:
            raise DamagedSample(str(error)) from error
        size = _nbytes(value)
        with self._lock:
            if key not in self._cache and size <= self.cache_bytes:
                self._cache[key] = value, size
                self._used += size
                while self._used > self.cache_bytes:
                    self._used -= self._cache.popitem(last=False)[1][1]
        return value

    @property
    def guided(self) -> bool:
        """Whether the samples hold guides."""
        return SCENE_MEMBER in self.row(0)["members"]

    def _shard_sizes(self, shards: Mapping[str, int]) -> dict[str, int]:
        """Bytes of each shard; those on this disk are compared with what is there."""
        sizes = {}
        for split in json.loads(self.source.path(f"files/{SHARDS}").read_bytes()).values():
            for part in split["parts"]:
                if part["path"] in shards:
                    sizes[part["path"]] = part["bytes"]
        for name in sorted(shards):
            if not SHARD.match(name) or name not in sizes:
                raise UserError(f"the index names a shard {name!r} that {SHARDS} does not hold")
            if isinstance(self.source, Folder) and not self._skip:
                self._check(name, self.source.shard(name), sizes[name])
        return sizes

    def _check(self, name: str, path: Path, size: int) -> None:
        try:
            actual_size = os.stat(path).st_size
        except (FileNotFoundError, NotADirectoryError):
            actual_size = None
        if actual_size != size:
            problem = "is missing" if actual_size is None else f"has {actual_size:,} bytes, not {size:,}"
            raise DamagedShard(
                f"the shard {path} {problem}: fetch it again or make it again (lightmill verify), "
                "or set skip_damaged_shards (train.skip_damaged_shards=true) to go on without its samples"
            )


class Reader:
    """The members of one sample: one open, a seek each, CRC checked."""

    def __init__(self, dataset: ShardDataset, row: dict[str, Any]):
        self._dataset, self._row, self._file = dataset, row, None

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: Any) -> None:
        if self._file is not None:
            self._file.close()

    def __getitem__(self, name: str) -> bytes:
        id = self._row["id"]
        if self._file is None:
            self._file = self._open()
        if name not in self._row["members"]:
            raise DamagedSample(f"{id} has no member {name}")
        offset, size, crc = self._row["members"][name]
        if not 0 <= offset <= offset + size <= self._dataset._sizes[self._row["shard"]]:
            raise DamagedSample(f"{name} of {id} is said to lie outside its shard")
        self._file.seek(offset)
        data = self._file.read(size)
        if len(data) != size:
            self._shard_error(f"the shard {self._row['shard']} ends inside {name} of {id}: it was cut")
        if zlib.crc32(data) != crc:
            raise DamagedSample(f"{name} of {id} has changed: its CRC-32 does not match the index")
        return data

    def _open(self) -> Any:
        name = self._row["shard"]
        try:
            path = self._dataset.source.shard(name)
            self._dataset._check(name, path, self._dataset._sizes[name])
            return open(path, "rb")  # noqa: SIM115 - closed with the reader
        except (UserError, OSError) as error:
            self._shard_error(str(error))

    def _shard_error(self, text: str) -> None:
        raise (DamagedSample if self._dataset._skip else DamagedShard)(text)


def _nbytes(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (SceneRecord, SceneGuides, ViewGuides)):
        value = vars(value)
    parts = value.values() if isinstance(value, dict) else value
    return sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
