"""What a browser may know of a store: artifacts, records, rejects, lineage and progress, as plain JSON.

Records are read by seek; a record's bytes are never unpacked to a file. One design choice: an artifact is named by its
folder in the store, and a file of it only if the manifest lists it. So no name from a request becomes a path by itself.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import Damaged, UserError
from pipeline.keys import LEGACY_SYSTEM
from pipeline.stage import System
from pipeline.status import read_states
from pipeline.store import Artifact, Store
from stages.graphics.panels import Shown, Views

NAME = re.compile(r"(?:[a-z][a-z0-9_]*/){1,2}[A-Za-z0-9_][A-Za-z0-9._-]*-[0-9a-f]{12}\Z")
KEPT = 16  # artifacts whose listings stay in memory
PAGE_SIZE = 100  # records or rejects of one answer


class Pages:
    """The pages of one store. ``systems``: the project's, in order."""

    def __init__(self, store: Store, systems: Sequence[System]):
        self.store = store
        self.systems = {system.name: system for system in sorted(systems, key=lambda system: system.name != LEGACY_SYSTEM)}
        self._kept: OrderedDict[str, tuple[Any, Artifact]] = OrderedDict()
        self._summaries: dict[str, tuple[Any, dict[str, Any]]] = {}
        self._lock = threading.Lock()

    # -- finding

    def artifact(self, name: str) -> Artifact:
        """The artifact of that name (``stage/folder`` or ``system/stage/folder``), with its listing once it was read."""
        if not NAME.match(name):
            raise UserError(f"{name!r} is not the name of an artifact, such as render/128px-0123456789ab")
        stamp, path = self._stamp(name), self.store.root / name
        with self._lock:
            kept = self._kept.pop(name, None)
            if kept is None or kept[0] != stamp:
                kept = stamp, Artifact(path)
            self._kept[name] = kept
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return kept[1]

    def _stamp(self, name: str) -> tuple[int, int, int]:
        """What changes when the artifact's manifest does."""
        path = self.store.root / name
        try:
            stat = (path / "manifest.json").stat()
        except OSError:
            if path.is_dir():
                raise Damaged(f"{name} has no manifest: `lightmill repair {name}` makes it anew") from None
            raise UserError(f"there is no artifact {name} in {self.store.root}") from None
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    def by_key(self, key: str) -> Artifact | None:
        """The artifact of that key, if it is still in the store and its manifest can be read."""
        for path in self.store.folders():
            if path.name.endswith(f"-{key[:12]}"):
                with contextlib.suppress(Damaged):
                    artifact = self.artifact(path.relative_to(self.store.root).as_posix())
                    if artifact.key == key:
                        return artifact
        return None

    def shown(self, name: str, record_id: str | None = None) -> Shown:
        artifact = self.artifact(name)
        if record_id is not None:
            artifact.row(record_id)  # UserError where there is none
        return Shown(self.store, artifact, record_id)

    def file(self, name: str, file: str) -> Path:
        """A file of the artifact. UserError unless its manifest lists it and it lies in the artifact's folder."""
        artifact = self.artifact(name)
        path = artifact.path / "files" / file
        if file not in artifact.manifest["outputs"]["files"] or not path.is_file():
            raise UserError(f"{name} has no file {file}")
        if not path.resolve().is_relative_to(artifact.path.resolve()):
            raise UserError(f"{file} of {name} is a link that leads out of the artifact")
        return path

    def views(self, artifact: Artifact) -> Callable[[Shown], Any] | None:
        """How the artifact's system shows its stage, if it has a way of its own."""
        system = self.systems.get(artifact.system)
        views = views_of(system) if system is not None else None
        return views.stages.get(artifact.stage) if views is not None else None

    # -- pages

    def overview(self) -> dict[str, Any]:
        """All systems with their stages, all artifacts, what is unfinished, and what is damaged."""
        summaries, damaged = [], []
        for path in self.store.folders():
            name = path.relative_to(self.store.root).as_posix()
            try:
                summaries.append(self._summary(name))
            except Damaged:
                damaged.append(name)
        summaries.sort(key=lambda summary: summary["finished"])
        order = {name: list(system.modules) for name, system in self.systems.items()}
        for summary in summaries:  # a system that is not the project's: stages in the order of their making
            stages = order.setdefault(summary["system"], [])
            if summary["stage"] not in stages:
                stages.append(summary["stage"])
        return {
            "store": str(self.store.root),
            "systems": [{"name": name, "stages": stages} for name, stages in order.items()],
            "artifacts": summaries,
            "states": self.states(),
            "damaged": damaged,
        }

    def _summary(self, name: str) -> dict[str, Any]:
        """What a card tells of an artifact. Kept: the manifest of a large one takes long to read."""
        stamp = self._stamp(name)
        if self._summaries.get(name, (None,))[0] != stamp:
            self._summaries[name] = stamp, self._facts(self.artifact(name))
        facts = self._summaries[name][1]
        return {**facts, "age_s": time.time() - facts["finished"], "pinned": self.store.pinned(facts["key"])}

    @staticmethod
    def _facts(artifact: Artifact) -> dict[str, Any]:
        manifest = artifact.manifest
        outputs = manifest["outputs"]
        return {
            "name": artifact.name,
            "system": artifact.system,
            "stage": artifact.stage,
            "key": artifact.key,
            "digest": artifact.digest,
            "records": outputs["records"],
            "items": outputs["items"],
            "rejects": outputs["rejects"],
            "bytes": outputs["bytes"],
            "finished": manifest["finished"],
            "inputs": manifest["preimage"]["inputs"],
        }

    def states(self) -> list[dict[str, Any]]:
        """Unfinished artifacts, as ``lightmill status --json`` gives them."""
        return read_states(self.store)

    def about(self, name: str) -> dict[str, Any]:
        """One artifact: what ``lightmill show`` prints, and the groups of its records."""
        artifact = self.artifact(name)
        manifest = artifact.manifest
        return {
            **self._summary(name),
            "path": str(artifact.path),
            "reasons": self._reasons(artifact),
            "made": {
                "command": manifest["command"],
                "seconds": manifest.get("seconds", manifest["finished"] - manifest["started"]),
                "host": manifest["machine"]["host"],
                "version": manifest["preimage"]["version"],
                "commit": manifest["code"]["commit"],
            },
            "params": {key: value for key, value in manifest["preimage"]["params"].items() if key != "identity"},
            "summary": manifest["summary"],
            "files": {file: entry["bytes"] for file, entry in manifest["outputs"]["files"].items()},
            "parts": len(manifest["outputs"]["parts"]),
        }

    def _reasons(self, artifact: Artifact) -> Mapping[str, str]:
        """What each reason of a reject means, where the system is at hand."""
        system = self.systems.get(artifact.system)
        known = system is not None and artifact.stage in system.modules
        return dict(system.stage(artifact.stage).reasons) if known else {}

    def records(self, name: str, start: int = 0, find: str = "") -> dict[str, Any]:
        """A page of an artifact's records; those whose id holds ``find``."""
        rows = self.artifact(name).rows()
        if find and rows.holds(find):
            found, total = [rows.find(find)], 1
        elif find:
            matching = [row for row in rows if find in row.id]
            found, total = matching[start : start + PAGE_SIZE], len(matching)
        else:
            found, total = rows[start : start + PAGE_SIZE], len(rows)
        return {
            "total": total,
            "start": start,
            "records": [
                {"id": row.id, "group": row.group, "bytes": sum(size for _, size in row.members.values()),
                 "members": len(row.members)} for row in found
            ],
        }  # fmt: skip

    def beside(self, name: str, record_id: str) -> dict[str, Any]:
        """One record: its members, its neighbours, and records of the same id in other artifacts of the line.

        Damaged where its bytes are not those that were written.
        """
        artifact = self.artifact(name)
        rows = artifact.rows()
        row = artifact.row(record_id)
        artifact.read(record_id)  # as a whole, which compares its digest
        number = rows.number(record_id)
        near = {"previous": number - 1, "next": number + 1}
        return {
            "id": row.id,
            "group": row.group,
            "part": row.part,
            "digest": row.digest,
            "number": number,
            "total": len(rows),
            "members": {member: size for member, (_, size) in row.members.items()},
            **{side: rows[at].id if 0 <= at < len(rows) else None for side, at in near.items()},
            "inputs": self._same(artifact, record_id),
        }

    def _same(self, artifact: Artifact, record_id: str) -> list[dict[str, str]]:
        """Records of that id in the artifacts that this one was made from, the last made first."""
        out, seen, todo = [], set(), list(artifact.manifest["preimage"]["inputs"].items())
        while todo:
            role, key = todo.pop(0)
            parent = self.by_key(key) if key not in seen else None
            seen.add(key)
            if parent is not None:
                if record_id in parent:
                    same = {"artifact": parent.name, "stage": parent.stage, "role": role}
                    out.append((parent.manifest["finished"], same))
                todo += parent.manifest["preimage"]["inputs"].items()
        return [same for _, same in sorted(out, key=lambda entry: -entry[0])]

    def rejects(self, name: str, start: int = 0, reason: str = "") -> dict[str, Any]:
        """A page of an artifact's rejects; those of that reason."""
        artifact = self.artifact(name)
        chosen = [reject for reject in artifact.rejects() if not reason or reject["reason"] == reason]
        return {"total": len(chosen), "start": start, "rejects": [self._reject(r) for r in chosen[start : start + PAGE_SIZE]]}

    def reject(self, name: str, item: str) -> dict[str, Any]:
        """One reject, and the records that it would have been made from."""
        artifact = self.artifact(name)
        for reject in artifact.rejects():
            if reject["item"] == item:
                meaning = self._reasons(artifact).get(reject["reason"], "")
                return {**self._reject(reject), "meaning": meaning, "inputs": self._same(artifact, item)}
        raise UserError(f"{name} has no reject {item!r}")

    @staticmethod
    def _reject(reject: Mapping[str, Any]) -> dict[str, Any]:
        return {field: reject.get(field, "") for field in ("item", "group", "reason", "detail")}

    def logs(self) -> Iterator[tuple[Artifact, str]]:
        """Artifacts that hold the log of a training, and its file's name."""
        for artifact in self.store.artifacts():
            for file in artifact.manifest["outputs"]["files"]:
                if file in ("log.jsonl", "curve.csv"):
                    yield artifact, file


def views_of(system: System) -> Views | None:
    """The views of a system; its module is imported here."""
    return system.load(system.views) if system.views else None
