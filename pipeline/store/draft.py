"""An artifact in the making. Everything in it survives a kill.

Parts are written to a temporary name, flushed and renamed to their digest; a marker then says that the part is finished.
A part of which an item failed holds its other items, in a tar of the same kind. Its marker lies in a folder of its own,
so that nobody takes the part for a finished one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.atomic import TEMPORARY, publish, sync, write_atomic
from pipeline.errors import UserError
from pipeline.keys import digest_of
from pipeline.store.artifact import DRAFT, Records, is_sound, read_draft
from pipeline.store.files import (
    TarWriter,
    hash_file,
    json_line,
    read_sealed,
    write_jsonl,
    write_sealed,
)
from pipeline.store.listing import Listing, Row
from pipeline.store.record import Record, record_digest

UNKNOWN = "unknown"  # the digest of code that nobody noted
FINISHED, UNFINISHED = "markers", "unfinished"  # folders of parts' markers
WORKING = (FINISHED, UNFINISHED, "running", "state")  # folders of a draft that its artifact does not keep


@dataclass(frozen=True)
class Attempt:
    """What a run notes of itself when it begins a draft or goes on with one.

    origin: what it takes, beside the preimage, to make the artifact anew (system, config).
    purpose: ``make``, ``force`` or ``repair``. A force takes nothing of what another purpose has finished.
    code: digest of the code at work.
    """

    origin: Mapping[str, Any] = field(default_factory=dict)
    purpose: str = "make"
    code: str = UNKNOWN


class Draft(Records):
    """An artifact in the making. Everything in it survives a kill; the next run continues with what is finished."""

    def __init__(self, path: Path, stage: str, key: str, preimage: Mapping[str, Any], out: Any = print):
        self.path = path
        self.stage = stage
        self.key = key
        self.preimage = dict(preimage)
        self.summary: dict[str, Any] = {}
        self._out = out
        self._whole_rejects: list[dict[str, Any]] = []
        for folder in ("parts", "files", "logs", *WORKING):
            (path / folder).mkdir(parents=True, exist_ok=True)

    files = property(lambda self: self.path / "files")
    state = property(lambda self: self.path / "state")
    logs = property(lambda self: self.path / "logs")
    prepared = property(lambda self: self.state / ".prepared")  # for workers; a hidden name: nothing of the work is finished

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
        folders = ("", "parts/", f"{FINISHED}/", f"{UNFINISHED}/", "files/**/", "state/**/")
        for pattern in ("running/*.json", *(folder + TEMPORARY for folder in folders)):
            for path in self.path.glob(pattern):
                path.unlink(missing_ok=True)

    def describe(self, **facts: Any) -> None:
        """Set entries of ``draft.json``."""
        write_sealed(self.path / DRAFT, {**(read_draft(self.path) or {}), **facts})

    # -- environment: runtime choices that one artifact must not mix

    def environment(self) -> dict[str, Any] | None:
        """The runtime choices that it was begun with; None before there are any."""
        return (read_draft(self.path) or {}).get("environment")

    def set_environment(self, environment: Mapping[str, Any]) -> None:
        self.describe(environment=environment)

    # -- code: digests of all that made what is in here; one artifact may mix them, and its manifest says so

    def codes(self) -> list[str]:
        """Code digests behind what is finished, the code at work among them."""
        return (read_draft(self.path) or {}).get("codes", [UNKNOWN])

    def made_by(self, codes: Iterable[str], what: str) -> None:
        """Add digests of code whose parts the draft takes over. ``what`` begins the note to a person: "what is sound was"."""
        noted_codes = self.codes()
        new = sorted(set(codes) - set(noted_codes))
        if new:
            self.describe(codes=noted_codes + new)
            maker = "code that nobody noted" if new == [UNKNOWN] else "other code of the same version"
            self.log(f"   note: {what} made by {maker}")

    # -- parts

    def marker_path(self, part_key: str, folder: str = FINISHED) -> Path:
        return self.path / folder / f"{part_key}.json"

    def marker(self, part_key: str, folder: str = FINISHED) -> dict[str, Any] | None:
        """The part of that key, finished or ``UNFINISHED``, or None. A marker whose file is missing or cut does not count."""
        path = self.marker_path(part_key, folder)
        try:
            marker = read_sealed(path)
            if marker["digest"] is not None and self.part_path(marker["digest"]).stat().st_size != marker["bytes"]:
                return None
            return marker
        except (OSError, ValueError):
            return None

    def sound_markers(self, parts: Mapping[str, list[str]]) -> tuple[dict[str, dict[str, Any] | None], int]:
        """The markers of finished parts, without their rows, and the number of damaged parts.

        ``parts``: part key -> ids of its items. The result maps each part key to its marker, or to None. A marker of other
        items does not count. Every byte is read, because an interrupted run may have lain for weeks, and hashing runs at the
        disk's speed.
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
            checks = dict(zip(parts, threads.map(check, parts), strict=True))
        return {key: marker for key, (marker, _) in checks.items()}, sum(damaged for _, damaged in checks.values())

    def unfinished_parts(self) -> dict[str, dict[str, Any]]:
        """Part key -> marker (less its rows) of each part of which an item failed; ``items`` are those that are done.

        Every byte is read, as by ``sound_markers``. A damaged part is left out.
        """
        markers = {path.stem: self.marker(path.stem, UNFINISHED) for path in (self.path / UNFINISHED).glob("[!.]*.json")}
        return {
            part_key: {name: value for name, value in marker.items() if name != "rows"}
            for part_key, marker in markers.items()
            if marker is not None and (marker["digest"] is None or is_sound(self.part_path(marker["digest"]), marker["digest"]))
        }

    def finish_part(self, part_key: str, marker: Mapping[str, Any]) -> None:
        """Say that the part is finished. What was kept of it while it was not goes."""
        unfinished_marker = self.marker(part_key, UNFINISHED)
        write_sealed(self.marker_path(part_key), marker)
        self.marker_path(part_key, UNFINISHED).unlink(missing_ok=True)
        self._drop_tar(unfinished_marker, marker)

    def keep_unfinished(self, part_key: str, marker: Mapping[str, Any]) -> None:
        """Keep the items that are done of a part of which an item failed, instead of what was kept before."""
        unfinished_marker = self.marker(part_key, UNFINISHED)
        write_sealed(self.marker_path(part_key, UNFINISHED), marker)
        self._drop_tar(unfinished_marker, marker)

    def _drop_tar(self, old: Mapping[str, Any] | None, new: Mapping[str, Any]) -> None:
        """Delete the tar of a marker that is replaced. If the new marker names the same one, it stays."""
        if old is not None and old["digest"] not in (None, new["digest"]):
            self.part_path(old["digest"]).unlink(missing_ok=True)

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
            if not target.exists() or not target.samefile(source):  # a file of that name may be damaged
                temporary = target.with_name(f".{uuid.uuid4().hex[:8]}.tmp")
                try:
                    os.link(source, temporary)
                except OSError:
                    shutil.copyfile(source, temporary)
                publish(temporary, target)
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
        self._file.close()
        publish(self._path, self._draft.part_path(digest))
        for row in self._rows:
            row["part"] = digest
        return {"digest": digest, "bytes": self._tar.size, "rows": self._rows}

    def discard(self) -> None:
        with contextlib.suppress(OSError):  # closing flushes, and the disk may be full
            self._file.close()
        self._path.unlink(missing_ok=True)
