"""The content-addressed store: committed artifacts, drafts in the making, and what keeps them apart.

::

    store/render/<slug>-<12 hex of the key>/manifest.json items.jsonl rejects.jsonl parts/<digest>.tar files/ logs/
    store/render/<key>.partial/      the same in the making, with markers/ (finished parts) and state/ (run stages)

A committed artifact is never changed in place. Parts are written to a temporary name, flushed and renamed to their digest;
a marker then says that the part is finished. Killing a process anywhere leaves a complete artifact or a draft that the next
run continues.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from pipeline.errors import Damaged, MachineError, UserError
from pipeline.files import (
    TarWriter,
    hash_file,
    json_line,
    read_jsonl,
    read_sealed,
    sync,
    write_atomic,
    write_json,
    write_jsonl,
    write_sealed,
)
from pipeline.keys import digest_of
from pipeline.listing import Listing, Row
from pipeline.stage import Record

SCHEMA = 2  # of manifests; from 2 on they are sealed, so that a changed byte shows
STALE_CLAIM_S = 120.0  # another host's claim without a heartbeat for this long is taken over
DRAFT = "draft.json"  # what is being made; stays with the artifact
TRASH = (".trash/*", "[!.]*/.gone-*", "[!.]*/*/.gone-*")  # the last two: how an earlier gc named what it was deleting
UNKNOWN = "unknown"  # the digest of code that nobody noted
WORKING = ("markers", "running", "state")  # folders of a draft that its artifact does not keep


def record_digest(members: Mapping[str, bytes]) -> str:
    """Hex blake2b-256 over the names and bytes of a record's members."""
    digest = hashlib.blake2b(digest_size=32)
    for name in sorted(members):
        data = members[name]
        digest.update(f"{len(name)}:{name}:{len(data)}:".encode())
        digest.update(data)
    return digest.hexdigest()


def is_sound(path: Path, digest: str) -> bool:
    """Whether the file is there, can be read and has that digest."""
    try:
        return hash_file(path) == digest
    except OSError:
        return False


def unreadable(error: OSError) -> str:
    return f"cannot be read ({error.strerror or error})"


class _Records:
    """Rows and their bytes: what drafts and artifacts have in common."""

    path: Path

    def rows(self) -> Listing:
        """All rows, sorted by (group, item)."""
        raise NotImplementedError

    def __contains__(self, record_id: str) -> bool:
        return self.rows().holds(record_id)

    def row(self, record_id: str) -> Row:
        try:
            return self.rows().find(record_id)
        except KeyError:
            raise UserError(f"there is no record {record_id!r} in {self.path}") from None

    def digest_of(self, record_id: str) -> str:
        """The digest of a record, without parsing its row."""
        try:
            return self.rows().digest(record_id)
        except KeyError:
            raise UserError(f"there is no record {record_id!r} in {self.path}") from None

    def ids(self, group: str | None = None) -> list[str]:
        return [row.id for row in self.rows() if group is None or row.group == group]

    def groups(self) -> list[str]:
        return sorted({row.group for row in self.rows()})

    def part_path(self, digest: str) -> Path:
        return self.path / "parts" / f"{digest}.tar"

    def part_of(self, record_id: str) -> tuple[Path, str]:
        """The tar that holds the record, and its group."""
        row = self.row(record_id)
        return self.part_path(row.part), row.group

    def read(self, record_id: str, only: Collection[str] | None = None) -> Record:
        """One record, or ``only`` these members of it: one open, one seek per member, whatever the part's size.

        A whole record is checked against its digest, so that nothing is made from damaged bytes.
        """
        return self.read_row(self.row(record_id), only)

    def read_row(self, row: Row, only: Collection[str] | None = None) -> Record:
        """The record that the row tells the place of."""
        path = self.part_path(row.part)
        try:
            with open(path, "rb") as file:
                members = {}
                for name, (offset, size) in row.members.items():
                    if only is None or name in only:
                        file.seek(offset)
                        members[name] = file.read(size)
        except FileNotFoundError:
            raise self.damaged(f"parts/{path.name} is missing") from None
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            raise self.damaged(f"parts/{path.name} {unreadable(error)}") from None
        record = Record(row.id, members)
        cut = any(len(data) != row.members[name][1] for name, data in members.items())
        if cut or (only is None and record_digest(members) != row.digest):
            raise self.damaged(f"parts/{path.name} is {'cut off' if cut else 'changed'} at record {row.id}")
        return record

    def damaged(self, what: str) -> Damaged:
        """The error that says what is damaged and what to do."""
        return Damaged(f"{self.path}: {what}; `lightmill repair {self.path.parent.name}/{self.path.name}` makes it anew")


class Artifact(_Records):
    """A committed artifact: read only."""

    def __init__(self, path: Path):
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"Artifact({self.path.parent.name}/{self.path.name})"

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return Artifact, (self.path,)  # workers reopen by path: cheap to send

    @cached_property
    def manifest(self) -> dict[str, Any]:
        try:
            return read_sealed(self.path / "manifest.json", SCHEMA)
        except (OSError, ValueError) as error:
            raise self.damaged(f"manifest.json cannot be used ({error})") from None

    @property
    def store(self) -> Store:
        """The store that it lies in."""
        return Store(self.path.absolute().parents[1])

    @property
    def key(self) -> str:
        return self.manifest["key"]

    @property
    def stage(self) -> str:
        return self.manifest["preimage"]["stage"]

    @property
    def codes(self) -> list[str]:
        """Digests of the code that made it: first that of the run that ended it, then others whose parts that took over."""
        code = self.manifest["code"]
        return [code["digest"], *code.get("others", [])]

    @property
    def digest(self) -> str:
        return self.manifest["outputs"]["digest"]

    def _sound(self, name: str) -> Path:
        if trouble := self._trouble(name, None, self.manifest["outputs"]["listings"][name]):
            raise self.damaged(trouble)
        return self.path / name

    @cached_property
    def _rows(self) -> Listing:
        return Listing(self._sound("items.jsonl"))

    def rows(self) -> Listing:
        return self._rows

    def rejects(self) -> list[dict[str, Any]]:
        return read_jsonl(self._sound("rejects.jsonl"))

    def file(self, name: str) -> Path:
        """Path of ``files/<name>``."""
        path = self.path / "files" / name
        if not path.exists():
            raise UserError(f"{self.path} has no file {name}")
        return path

    def _trouble(self, name: str, size: int | None, digest: str | None, items: int | None = None) -> str:
        """What is wrong with one file, empty if nothing is; None: not looked at."""
        path = self.path / name
        try:
            if not path.is_file():
                return f"{name} is missing" + (f" ({items} items)" if items is not None else "")
            found = path.stat().st_size
            if size is not None and found != size:
                return f"{name} has {found} bytes, not {size}"
            if digest is not None and hash_file(path) != digest:
                return f"{name} does not hash to {'its name' if digest in name else digest[:12]}"
        except OSError as error:
            return f"{name} {unreadable(error)}"
        return ""

    def verify(self, deep: bool = False) -> list[str]:
        """What is wrong with it, as lines; ``deep`` reads every byte. Empty means sound."""
        problems: list[str] = []
        try:
            outputs = self.manifest["outputs"]
        except Damaged as error:
            return [str(error).removeprefix(f"{self.path}: ").partition(";")[0]]
        for part in outputs["parts"]:
            name = f"parts/{part['digest']}.tar"
            problems.append(self._trouble(name, part["bytes"], part["digest"] if deep else None, len(part["items"])))
        for name, entry in outputs["files"].items():
            problems.append(self._trouble(f"files/{name}", entry["bytes"], entry["digest"] if deep else None))
        for name, expected in outputs["listings"].items():
            problems.append(self._trouble(name, None, expected))
        problems = [problem for problem in problems if problem]
        if digest_of(self.manifest["preimage"]) != self.key:
            problems.append("manifest.json: the key is not the hash of its preimage")
        if self.manifest.get("schema", 1) > 1 and read_draft(self.path) is None:
            problems.append(f"{DRAFT}, from which a damaged manifest could be repaired, is missing or changed itself")
        return problems


def read_draft(folder: Path) -> dict[str, Any] | None:
    """What is, or was, being made in the folder: key, preimage, system, config, environment. None if missing or damaged."""
    try:
        return read_sealed(folder / DRAFT)
    except (OSError, ValueError):
        return None


class Claim:
    """Who works on a draft: a file with host and pid, held by a kernel lock that ends with its process, however that ends.

    Where locks do not reach other hosts, a heartbeat (the file's time) stands in for them. Losing a claim wastes work, never
    corrupts: the commit does not rely on it.
    """

    def __init__(self, path: Path):
        self.path = path
        self._handle: int | None = None
        self._stop = threading.Event()

    def holder(self) -> dict[str, Any] | None:
        """Host, pid and start time of who holds it now; None if nobody does."""
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError:
            return None
        try:
            return self._other(handle, fcntl.LOCK_SH)
        finally:
            os.close(handle)

    @staticmethod
    def _other(handle: int, lock: int) -> dict[str, Any] | None:
        """Who else holds the open claim file; where nobody does it is locked now."""
        locked, free = False, True
        try:
            fcntl.flock(handle, lock | fcntl.LOCK_NB)
            locked = True
        except BlockingIOError:
            free = False
        except OSError:  # a file system without locks
            pass
        try:
            other = json.loads(os.pread(handle, 4096, 0))
        except ValueError:
            other = None if free else {"host": "?", "pid": 0}
        if other is None or not free:
            return other
        if other["host"] == socket.gethostname():
            return None if locked or not psutil.pid_exists(other["pid"]) or other["pid"] == os.getpid() else other
        return other if abs(time.time() - os.fstat(handle).st_mtime) < STALE_CLAIM_S else None

    def take(self) -> bool:
        """Take it unless another process holds it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if self._other(handle, fcntl.LOCK_EX) is not None:
                return False
            if not self._is_at_path(handle):  # its last holder has just let go of it, and of its name
                return False
            me = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.time()}
            os.truncate(handle, 0)
            os.pwrite(handle, json.dumps(me).encode(), 0)
            self._handle, handle = handle, -1
        finally:
            if handle >= 0:
                os.close(handle)

        def beat() -> None:
            while not self._stop.wait(STALE_CLAIM_S / 8):
                with contextlib.suppress(OSError):
                    os.utime(self.path)

        threading.Thread(target=beat, daemon=True).start()
        return True

    def _is_at_path(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(handle))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        self._stop.set()
        if self._handle is not None:
            if self._is_at_path(self._handle):
                self.path.unlink(missing_ok=True)
            os.close(self._handle)
            self._handle = None


class Draft(_Records):
    """An artifact in the making. Everything in it survives a kill; the next run continues with what is finished."""

    def __init__(self, path: Path, stage: str, key: str, preimage: Mapping[str, Any], out: Any = print):
        self.path = path
        self.stage = stage
        self.key = key
        self.preimage = dict(preimage)
        self.summary: dict[str, Any] = {}
        self._out = out
        self._whole_rejects: list[dict[str, Any]] = []
        for folder in ("parts", "markers", "files", "state", "logs", "running"):
            (path / folder).mkdir(parents=True, exist_ok=True)

    files = property(lambda self: self.path / "files")
    state = property(lambda self: self.path / "state")
    logs = property(lambda self: self.path / "logs")

    def log(self, text: str) -> None:
        """A line in the run's output."""
        self._out(text)

    def note(self, name: str, value: Any) -> None:
        """A small JSON summary for the manifest, shown by ``lightmill show``."""
        self.summary[name] = value

    def reject(self, item: str, reason: str, detail: str = "") -> None:
        """Reject an item for what only the whole artifact shows (a duplicate, say). Its record stays in the parts."""
        self._whole_rejects.append({"item": item, "group": "", "reason": reason, "detail": detail, "whole": True})

    def sweep(self) -> None:
        """Delete what workers that were killed left half written. Only for who holds the claim."""
        for pattern in ("parts/.*.tmp", "markers/.*.tmp", ".*.tmp", "running/*.json"):
            for path in self.path.glob(pattern):
                path.unlink(missing_ok=True)

    def describe(self, **facts: Any) -> None:
        write_sealed(self.path / DRAFT, {**(read_draft(self.path) or {}), **facts})

    # -- environment: runtime choices that one artifact must not mix

    def environment(self) -> dict[str, Any] | None:
        return (read_draft(self.path) or {}).get("environment")

    def set_environment(self, environment: Mapping[str, Any]) -> None:
        self.describe(environment=environment)

    # -- code: digests of all that made what is in here; one artifact may mix them, and its manifest says so

    def codes(self) -> list[str]:
        return (read_draft(self.path) or {}).get("codes", [UNKNOWN])

    def made_by(self, codes: Iterable[str], what: str) -> None:
        """Remember who made ``what``, which the draft takes over."""
        known = self.codes()
        new = sorted(set(codes) - set(known))
        if new:
            self.describe(codes=known + new)
            whose = "code that nobody noted" if new == [UNKNOWN] else "other code of the same version"
            self.log(f"   note: {what} made by {whose}")

    # -- parts

    def marker(self, part_key: str) -> dict[str, Any] | None:
        """The finished part of that key, or None; a marker whose file is missing or cut does not count."""
        path = self.path / "markers" / f"{part_key}.json"
        try:
            marker = read_sealed(path)
            if marker["digest"] is not None and self.part_path(marker["digest"]).stat().st_size != marker["bytes"]:
                return None
            return marker
        except (OSError, ValueError):
            return None

    def sound_markers(self, parts: Mapping[str, list[str]]) -> tuple[dict[str, dict[str, Any] | None], int]:
        """Of ``parts``, part key -> ids of its items: part key -> marker (less its rows) or None, with every byte read; and how
        many parts turned out damaged. A marker of other items does not count.

        What an interrupted run left may have lain for weeks; hashing runs at the disk's speed, computing again does not.
        """

        def check(part_key: str) -> tuple[dict[str, Any] | None, bool]:
            marker = self.marker(part_key)
            if marker is not None and marker["items"] != parts[part_key]:
                return None, False
            if marker is not None:
                del marker["rows"]  # there may be millions
            if marker is None or marker["digest"] is None or is_sound(self.part_path(marker["digest"]), marker["digest"]):
                return marker, False
            return None, True

        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
            found = dict(zip(parts, threads.map(check, parts), strict=True))
        return {key: marker for key, (marker, _) in found.items()}, sum(damaged for _, damaged in found.values())

    def finish_part(self, part_key: str, marker: Mapping[str, Any]) -> None:
        write_sealed(self.path / "markers" / f"{part_key}.json", marker)

    def open_part(self) -> PartWriter:
        return PartWriter(self)

    def link_part(self, source: Path, part_key: str, marker: Mapping[str, Any]) -> bool:
        """Take over a finished part of an earlier artifact by hard link (a copy where links are not possible).

        Returns False, and takes nothing, where the source is damaged.
        """
        if marker["digest"] is not None:
            target = self.part_path(marker["digest"])
            if not is_sound(source, marker["digest"]):
                return False
            if not target.exists() or not target.samefile(source):  # of what lies there already nobody knows that it is sound
                temporary = target.with_name(f".{uuid.uuid4().hex[:8]}.tmp")
                try:
                    os.link(source, temporary)
                except OSError:
                    shutil.copyfile(source, temporary)
                    sync(temporary)
                os.replace(temporary, target)
        self.finish_part(part_key, marker)
        return True

    def use_parts(self, markers: Iterable[Mapping[str, Any]]) -> None:
        """The markers, in order, that make up the artifact: from here on rows and rejects can be read.

        Rows go to ``items.jsonl`` as the markers come; only what the manifest says of a part is kept in memory.
        """
        self._markers: list[dict[str, Any]] = []
        makers: dict[str, str] = {}

        def lines() -> Iterator[bytes]:
            for marker in markers:
                self._markers.append({name: value for name, value in marker.items() if name != "rows"})
                for row in marker["rows"]:
                    record, item = row["id"], row["item"]
                    if record in makers:
                        raise UserError(f"items {makers[record]!r} and {item!r} both made a record {record!r}")
                    makers[record] = record if record == item else item  # one string of the two
                    yield json_line(row)

        write_atomic(self.path / "items.jsonl", lines())
        self._rows = Listing(self.path / "items.jsonl")
        self._records = len(makers)

    def rows(self) -> Listing:
        return self._rows

    def rejects(self) -> list[dict[str, Any]]:
        return [reject for marker in self._markers for reject in marker["rejects"]] + self._whole_rejects

    # -- commit

    def outputs(self, products: Iterable[str] = ()) -> dict[str, Any]:
        """The manifest's ``outputs``: parts, items, rejects, bytes, and the digest over records and products."""
        rejects = self.rejects()
        write_jsonl(self.path / "rejects.jsonl", rejects)
        parts = [
            {name: marker[name] for name in ("part_key", "digest", "bytes", "group", "items")}
            for marker in self._markers
            if marker["digest"] is not None
        ]
        files = {}
        for path in sorted(self.files.rglob("*")):
            if path.is_file():
                name = path.relative_to(self.files).as_posix()
                files[name] = {"bytes": path.stat().st_size, "digest": hash_file(path)}
            sync(path)  # stages just write: before the manifest vouches for a file, and state/ goes, it must be on the disk
        reasons: dict[str, int] = {}
        for reject in rejects:
            reasons[reject["reason"]] = reasons.get(reject["reason"], 0) + 1
        digest = digest_of(
            {
                "parts": [[part["group"], part["digest"]] for part in parts],
                "rejects": [[r["group"], r["item"], r["reason"]] for r in rejects if not r.get("machine")],
                "products": [[name, files[name]["digest"]] for name in sorted(products)],
            }
        )
        return {
            "digest": digest,
            "records": self._records,
            "items": sum(len(marker["items"]) for marker in self._markers),
            "rejects": reasons,
            "bytes": sum(part["bytes"] for part in parts) + sum(entry["bytes"] for entry in files.values()),
            "parts": parts,
            "empty_parts": [
                {name: marker[name] for name in ("part_key", "group", "items")}
                for marker in self._markers
                if marker["digest"] is None
            ],
            "files": files,
            "listings": {name: hash_file(self.path / name) for name in ("items.jsonl", "rejects.jsonl")},
        }


class PartWriter:
    """Writes one part under a temporary name; ``close`` renames it to its digest."""

    def __init__(self, draft: Draft):
        self._draft = draft
        self._path = draft.path / "parts" / f".{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp"
        self._file = open(self._path, "wb")  # noqa: SIM115 - closed in close or discard
        self._tar = TarWriter(self._file)
        self._rows: list[dict[str, Any]] = []

    def add(self, record: Record, item: str, group: str, item_key: str) -> None:
        members = {name: (self._tar.add(f"{record.id}.{name}", data), len(data)) for name, data in record.members.items()}
        self._rows.append(Row(record.id, item, group, "", record_digest(record.members), item_key, members).to_json())

    def close(self) -> dict[str, Any]:
        """Flush, rename; returns the marker's ``digest``, ``bytes`` and ``rows``. A part without records has no file."""
        digest = self._tar.close()
        if not self._rows:
            self.discard()
            return {"digest": None, "bytes": 0, "rows": []}
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._path, self._draft.part_path(digest))
        sync(self._path.parent)
        for row in self._rows:
            row["part"] = digest
        return {"digest": digest, "bytes": self._tar.size, "rows": self._rows}

    def discard(self) -> None:
        with contextlib.suppress(OSError):  # closing flushes, and the disk may be full
            self._file.close()
        self._path.unlink(missing_ok=True)


class Store:
    """A folder of artifacts."""

    def __init__(self, root: Path | str):
        self.root = Path(root).absolute()
        self._nodes: dict[Path, tuple[Any, _Node]] = {}  # artifacts as gc saw them last

    # -- finding

    def folder(self, stage: str, key: str) -> Path | None:
        """The folder of the committed artifact, sound or damaged."""
        return next(iter((self.root / stage).glob(f"[!.]*-{key[:12]}")), None)

    def find(self, stage: str, key: str) -> Artifact | None:
        """The committed artifact; an error where its manifest is damaged."""
        path = self.folder(stage, key)
        return Artifact(path) if path is not None and Artifact(path).key == key else None

    def artifacts(self, stage: str | None = None) -> list[Artifact]:
        """All committed artifacts whose manifests can be read, oldest first."""
        found = []
        for path in self.folders(stage):
            with contextlib.suppress(Damaged):
                artifact = Artifact(path)
                found.append((artifact.manifest["finished"], str(path), artifact))
        return [artifact for _, _, artifact in sorted(found, key=lambda entry: entry[:2])]

    def folders(self, stage: str | None = None) -> list[Path]:
        """The folders of all committed artifacts, sound or damaged."""
        found = self.root.glob(f"{stage or '[!.]*'}/[!.]*-" + "[0-9a-f]" * 12)
        return sorted(path for path in found if (path / "manifest.json").exists() or (path / DRAFT).exists())

    def drafts(self) -> list[Path]:
        return sorted(self.root.glob("[!.]*/[!.]*.partial"))

    def resolve(self, reference: str) -> Artifact:
        """The artifact that a person means: a key or its beginning, ``stage/folder``, a folder, or a stage's newest."""
        path = Path(reference)
        for folder in (path, self.root / reference if ".." not in path.parts else path):
            if (folder / "manifest.json").is_file() or ((folder / DRAFT).is_file() and folder.suffix != ".partial"):
                return Artifact(folder)
        stage, _, rest = reference.rpartition("/")
        if not stage and (newest := self.artifacts(reference) if reference.isidentifier() else []):
            return newest[-1]
        token = rest.rpartition("-")[2]
        found = [Artifact(path) for path in self.folders(stage or None) if len(token) >= 4 and self._is_key(token, path)]
        if len(found) == 1:
            return found[0]
        if found:
            raise UserError(f"{reference!r} is the beginning of {len(found)} keys: give more letters")
        raise UserError(f"no artifact {reference!r} in {self.root}: `lightmill ls` lists what is there")

    @staticmethod
    def _is_key(token: str, folder: Path) -> bool:
        """Whether the artifact's key begins so. Its folder has twelve letters of it, which is all there is if it is damaged."""
        if not folder.name[-12:].startswith(token[:12]):
            return False
        with contextlib.suppress(Damaged):
            return Artifact(folder).key.startswith(token)
        return True

    # -- making

    def draft(
        self,
        stage: str,
        key: str,
        preimage: Mapping[str, Any],
        out: Any = print,
        origin: Mapping[str, Any] | None = None,
        purpose: str = "make",
        code: str = UNKNOWN,
    ) -> Draft:
        """A new draft, or the one that an interrupted run left.

        ``origin``: what it takes to make it anew (system, config). ``purpose``: make, force or repair; what force did not begin
        itself it sets aside. ``code``: the digest of the code at work.
        """
        path = self.draft_path(stage, key)
        before = read_draft(path)
        begun = any(any((path / folder).glob("[!.]*")) for folder in ("markers", "state"))
        if begun and purpose == "force" and (before or {}).get("purpose") != "force":
            aside = self.trash(path)
            out(f"   note: force takes nothing of what an earlier run had finished; that is in {aside} until gc deletes it")
            before, begun = None, False
        draft = Draft(path, stage, key, preimage, out)
        about = {"key": key, "preimage": draft.preimage, "started": time.time(), **(origin or {})} if before is None else before
        others = [other for other in about.get("codes", [UNKNOWN]) if other != code] if begun else []
        if others and code != UNKNOWN:
            whose = "code that nobody noted" if others == [UNKNOWN] else "other code of the same version"
            out(f"   note: what is finished of {stage} was made by {whose}; it is kept (to begin anew, delete {path})")
        facts = {"purpose": purpose, "codes": [*others, code]}
        if before is None or not facts.items() <= before.items():
            write_sealed(path / DRAFT, {**about, **facts})
        return draft

    def draft_path(self, stage: str, key: str) -> Path:
        return self.root / stage / f"{key}.partial"

    def claim(self, stage: str, key: str) -> Claim:
        return Claim(self.root / stage / f".{key}.claim")

    def commit(self, draft: Draft, slug: str, manifest: Mapping[str, Any], replace: bool = False) -> Artifact:
        """Make the draft an artifact by one rename.

        If the target exists by then, ours is dropped, or swapped in on ``replace``.
        """
        used = {marker["digest"] for marker in draft._markers}
        for path in (draft.path / "parts").iterdir():
            if path.suffix != ".tar" or path.stem not in used:
                path.unlink()  # orphans: temporaries of killed workers, parts of another plan
        write_sealed(draft.path / "manifest.json", manifest)
        for folder in ("parts", "files", "."):
            sync(draft.path / folder)
        problems = Artifact(draft.path).verify()
        if problems:  # somebody else is at work in the same draft after all
            raise MachineError(f"{draft.path} changed while it was being committed ({problems[0]}): run the same command again")
        old = self.folder(draft.stage, draft.key)
        if old is not None and not replace and not Artifact(old).verify():
            shutil.rmtree(draft.path)
            target = old
        else:
            target = self.root / draft.stage / f"{slug}-{draft.key[:12]}"
            if old is not None:
                self.trash(old)
            os.replace(draft.path, target)
            sync(target.parent)
            for folder in WORKING:  # only now: until the rename they are what a resume needs
                shutil.rmtree(target / folder, ignore_errors=True)
        self.touch(draft.key)
        return Artifact(target)

    # -- use, pins, garbage

    def touch(self, key: str) -> None:
        """Remember that the artifact was used just now (outside the artifact, which never changes)."""
        path = self.root / ".used" / key
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        except OSError:
            pass  # a read-only store can still be read

    def last_used(self, artifact: Artifact) -> float:
        return self._used(artifact.key, artifact.manifest["finished"])

    def _used(self, key: str, made: float) -> float:
        path = self.root / ".used" / key
        return path.stat().st_mtime if path.exists() else made

    def pinned(self, key: str) -> bool:
        return (self.root / ".pins" / key).exists()

    def pin(self, key: str, on: bool = True) -> None:
        path = self.root / ".pins" / key
        if on:
            write_atomic(path, b"")
        else:
            path.unlink(missing_ok=True)

    def trash(self, path: Path) -> Path:
        """Take a folder of the store out of sight by one rename; returns where it lies until gc empties the trash."""
        aside = self.root / ".trash" / f"{'-'.join(path.relative_to(self.root).parts)}-{uuid.uuid4().hex[:8]}"
        aside.parent.mkdir(exist_ok=True)
        os.replace(path, aside)
        return aside

    def garbage(self, days: float, claimed: str | None = None) -> list[tuple[Path, str]]:
        """What can go, with the reason: trash, drafts nobody works on, and artifacts nobody needs.

        An artifact is needed while it is pinned, was used within ``days``, or is an input of an artifact that is needed or of
        a draft that is kept. ``claimed``: a key whose claim the caller holds itself.
        """
        horizon = time.time() - days * 86400
        found: list[tuple[Path, str]] = []
        for pattern in TRASH:
            found += [(path, "trash: replaced or set aside, or left by an interrupted gc") for path in self.root.glob(pattern)]
        nodes = [node for path in self.folders() if (node := self._node(path)) is not None]
        todo = [
            node.key for node in nodes if node.damaged or self.pinned(node.key) or self._used(node.key, node.made) >= horizon
        ]
        for path in self.drafts():
            key = path.name.removesuffix(".partial")
            held = key != claimed and self.claim(path.parent.name, key).holder() is not None
            if not held and not _changed_since(path, horizon):
                found.append((path, f"unfinished and untouched for {days:g} days"))
            elif (draft := read_draft(path)) is not None:
                todo += draft["preimage"]["inputs"].values()
            else:  # damaged, or not written yet: any artifact may be its input
                todo += [node.key for node in nodes]
        inputs = {node.key: node.inputs for node in nodes}
        needed: set[str] = set()
        while todo:
            if (key := todo.pop()) not in needed:
                needed.add(key)
                todo += inputs.get(key, ())
        for node in sorted(nodes, key=lambda node: node.made, reverse=True):
            if node.key not in needed:
                found.append((node.path, f"not pinned, not used for {days:g} days"))
            else:
                left = [node.path / name for name in WORKING if (node.path / name).exists()]
                found += [(path, "left over by a commit that was interrupted") for path in left]
        return found

    def remove(self, path: Path, days: float) -> bool:
        """Delete what ``garbage(days)`` listed, unless somebody works on it or has come to need it since; says whether.

        Out of sight first, so that a kill in the middle leaves no half artifact.
        """
        stage, name = path.relative_to(self.root).parts[:2]
        if stage != ".trash" and not path.name.startswith(".gone-"):
            node = None if name.endswith(".partial") else self._node(self.root / stage / name)
            key = node.key if node is not None else name.removesuffix(".partial")
            claim = self.claim(stage, key)
            if not claim.take():
                return False
            try:
                if path not in [found for found, _ in self.garbage(days, key)]:
                    return False
                path = self.trash(path)
            finally:
                claim.release()

        def failed(function: Any, name: str, error: Any) -> None:
            if not issubclass(error[0], FileNotFoundError):  # another gc is faster
                raise error[1]

        shutil.rmtree(path, onerror=failed)
        return True

    def _node(self, folder: Path) -> _Node | None:
        """What gc must know of an artifact; None where it is gone. Read once: gc looks again before each removal.

        One with a damaged manifest counts as in use: while its inputs are there, it can be repaired.
        """
        try:
            stat = (folder / "manifest.json").stat()
            stamp = stat.st_ino, stat.st_mtime_ns, stat.st_size
        except OSError:
            stamp = None
        known = self._nodes.get(folder)
        if known is None or stamp is None or known[0] != stamp:
            try:
                about = Artifact(folder).manifest
            except Damaged:
                if not folder.exists():
                    return None
                about = read_draft(folder) or {"key": folder.name, "preimage": {"inputs": {}}}
            made, inputs = about.get("finished"), tuple(about["preimage"]["inputs"].values())
            known = stamp, _Node(folder, about["key"], made or 0.0, inputs, damaged=made is None)
            self._nodes[folder] = known
        return known[1]


class _Node(NamedTuple):
    """An artifact as gc sees it."""

    path: Path
    key: str
    made: float
    inputs: tuple[str, ...]  # their keys
    damaged: bool  # its manifest is


def _changed_since(draft: Path, moment: float) -> bool:
    """Whether anything was written in the draft since then: a part's marker, a log, a checkpoint, a file, the run's state."""
    for folder in ("running", "state", "markers", "logs", "files"):
        for where, _, names in os.walk(draft / folder):
            for name in ("", *names):
                with contextlib.suppress(FileNotFoundError):
                    if os.stat(os.path.join(where, name)).st_mtime >= moment:
                        return True
    return False


class HashCache:
    """Content hashes of local files, remembered by path, size, mtime and inode; the cache itself is no part of any key."""

    def __init__(self, path: Path):
        self._path = path
        try:
            self._known: dict[str, list[Any]] = json.loads(path.read_bytes())
        except (OSError, ValueError):
            self._known = {}
        self._changed = False

    def __call__(self, path: Path | str) -> str:
        path = Path(path).absolute()
        stat = path.stat()
        stamp = [stat.st_size, stat.st_mtime_ns, stat.st_ino]
        entry = self._known.get(str(path))
        if entry is None or entry[:3] != stamp:
            entry = [*stamp, hash_file(path)]
            self._known[str(path)] = entry
            self._changed = True
        return entry[3]

    def save(self) -> None:
        if self._changed:
            with contextlib.suppress(OSError):  # only a cache
                write_json(self._path, self._known)


def iter_inputs(store: Store, artifact: Artifact) -> Iterator[tuple[str, str, Artifact | None]]:
    """(input name, key, artifact or None if it is gone) of each input."""
    for name, key in artifact.manifest["preimage"]["inputs"].items():
        yield name, key, store.find(name, key)


def history(inputs: Mapping[str, Artifact]) -> dict[str, dict[str, Any]]:
    """Stage -> preimage of its key, for ``inputs`` and everything upstream of them that is still in the store."""
    found: dict[str, dict[str, Any]] = {}
    todo = list(inputs.values())
    while todo:
        artifact = todo.pop()
        if artifact.stage not in found:
            found[artifact.stage] = artifact.manifest["preimage"]
            todo += [parent for _, _, parent in iter_inputs(artifact.store, artifact) if parent is not None]
    return found
