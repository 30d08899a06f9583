"""A committed artifact, read only, and what reading it has in common with reading a draft."""

from __future__ import annotations

import errno
from collections.abc import Collection, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.errors import Damaged, UserError
from pipeline.keys import LEGACY_SYSTEM, digest_of
from pipeline.store.files import (
    hash_file,
    read_jsonl,
    read_sealed,
)
from pipeline.store.listing import Listing, Row
from pipeline.store.record import Record, record_digest

SCHEMA = 2  # of manifests; from 2 on they are sealed, so that a changed byte shows
DRAFT = "draft.json"  # what is being made; stays with the artifact


def place(preimage: Mapping[str, Any]) -> str:
    """Where artifacts of this preimage lie, relative to the store: ``SYSTEM/STAGE``, of the legacy system ``STAGE``."""
    system, stage = preimage.get("system", LEGACY_SYSTEM), preimage["stage"]
    return stage if system == LEGACY_SYSTEM else f"{system}/{stage}"


def is_sound(path: Path, digest: str) -> bool:
    """Whether the file exists, can be read and has that digest."""
    try:
        return hash_file(path) == digest
    except OSError:
        return False


def unreadable(error: OSError) -> str:
    return f"cannot be read ({error.strerror or error})"


class Records:
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
        """The record of the row. Damaged where its bytes are gone, cut or changed."""
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


class Artifact(Records):
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
    def key(self) -> str:
        return self.manifest["key"]

    @property
    def stage(self) -> str:
        return self.manifest["preimage"]["stage"]

    @property
    def system(self) -> str:
        return self.manifest["preimage"].get("system", LEGACY_SYSTEM)

    @property
    def place(self) -> str:
        """The folder in the store that its manifest implies. Where that is damaged, the folder that it lies in."""
        try:
            origin: Mapping[str, Any] | None = self.manifest
        except Damaged:
            origin = read_draft(self.path)
        return self.path.parent.name if origin is None else place(origin["preimage"])

    @property
    def name(self) -> str:
        """How people name it: ``STAGE/FOLDER``, or ``SYSTEM/STAGE/FOLDER``."""
        return f"{self.place}/{self.path.name}"

    @property
    def codes(self) -> list[str]:
        """Code digests behind this artifact. The first is the run that committed it; the rest made parts that it reused."""
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
        """What is wrong with one file, empty if nothing is. ``size`` and ``digest`` are not compared where they are None."""
        path = self.path / name
        try:
            if not path.is_file():
                return f"{name} is missing" + (f" ({items} items)" if items is not None else "")
            actual_size = path.stat().st_size
            if size is not None and actual_size != size:
                return f"{name} has {actual_size} bytes, not {size}"
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
    """The folder's ``draft.json``: key, preimage, system, config, environment. None if it is missing or damaged."""
    try:
        return read_sealed(folder / DRAFT)
    except (OSError, ValueError):
        return None
