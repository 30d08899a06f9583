"""The store: a folder of artifacts, found by key, made from drafts, kept by pins and recent use."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.atomic import sync, write_atomic
from pipeline.errors import Damaged, MachineError, UserError
from pipeline.store.artifact import DRAFT, Artifact, read_draft
from pipeline.store.claim import Claim
from pipeline.store.draft import FINISHED, UNFINISHED, UNKNOWN, WORKING, Attempt, Draft
from pipeline.store.files import (
    write_sealed,
)

PLACES = ("[!.]*", "[!.]*/[!.]*")  # patterns of the folders that hold artifacts: STAGE, SYSTEM/STAGE
TRASH = (".trash/*", "[!.]*/.gone-*", "[!.]*/*/.gone-*")  # the last two: how an earlier gc named what it was deleting


class Store:
    """A folder of artifacts."""

    def __init__(self, root: Path | str):
        self.root = Path(root).absolute()
        self._nodes: dict[Path, tuple[Any, _Node]] = {}  # artifacts as gc saw them last

    # -- finding

    def folder(self, place: str, key: str) -> Path | None:
        """The folder of the committed artifact, sound or damaged. ``place``: see ``pipeline.store.place``."""
        return next(iter((self.root / place).glob(f"[!.]*-{key[:12]}")), None)

    def find(self, place: str, key: str) -> Artifact | None:
        """The committed artifact; an error where its manifest is damaged."""
        path = self.folder(place, key)
        return Artifact(path) if path is not None and Artifact(path).key == key else None

    def by_key(self, key: str) -> Artifact | None:
        """The committed artifact of that key, wherever it lies; an error where its manifest is damaged."""
        for path in self._glob(f"[!.]*-{key[:12]}"):
            if Artifact(path).key == key:
                return Artifact(path)
        return None

    def _glob(self, name: str, place: str | None = None) -> list[Path]:
        """Folders of that name at the place, or at all of them: ``STAGE`` and ``SYSTEM/STAGE``."""
        places = PLACES if place is None else (place,)
        return sorted(path for folder in places for path in self.root.glob(f"{folder}/{name}"))

    def place_of(self, path: Path) -> str:
        """The place of an artifact or draft of this store."""
        return path.parent.relative_to(self.root).as_posix()

    def artifacts(self, place: str | None = None) -> list[Artifact]:
        """All committed artifacts (of that place) whose manifests can be read, oldest first."""
        dated = []
        for path in self.folders(place):
            with contextlib.suppress(Damaged):
                artifact = Artifact(path)
                dated.append((artifact.manifest["finished"], str(path), artifact))
        return [artifact for _, _, artifact in sorted(dated, key=lambda entry: entry[:2])]

    def folders(self, place: str | None = None) -> list[Path]:
        """The folders of all committed artifacts (of that place), sound or damaged."""
        named = self._glob("[!.]*-" + "[0-9a-f]" * 12, place)
        return [path for path in named if (path / "manifest.json").exists() or (path / DRAFT).exists()]

    def drafts(self) -> list[Path]:
        return self._glob("[!.]*.partial")

    def places(self, reference: str | None = None) -> list[str]:
        """The places that hold something. ``reference``: ``STAGE``, ``SYSTEM/STAGE`` or ``SYSTEM``, all of its stages.

        ``STAGE`` alone is the legacy system's, or, where that has none of the name, the only system's that has one.
        """
        places = sorted({self.place_of(path) for path in (*self.folders(), *self.drafts())})
        if reference is None or reference in places:
            return places if reference is None else [reference]
        of_system = [name for name in places if name.startswith(f"{reference}/")]
        return of_system or [name for name in places if name.endswith(f"/{reference}")]

    def resolve(self, reference: str) -> Artifact:
        """The artifact that a person means: a key or its beginning, ``stage/folder``, a folder, or a stage's newest.

        A stage of a system is ``system/stage``; see ``places`` for what ``stage`` alone means.
        """
        path = Path(reference)
        for folder in (path, self.root / reference if ".." not in path.parts else path):
            if (folder / "manifest.json").is_file() or ((folder / DRAFT).is_file() and folder.suffix != ".partial"):
                return Artifact(folder)
        where, _, rest = reference.rpartition("/")
        places = [name for name in self.places(reference) if name.rpartition("/")[2] == rest]
        if len(places) > 1:
            raise UserError(f"{reference!r} is a stage of several systems: say which ({', '.join(places)})")
        if places and (newest := self.artifacts(places[0])):
            return newest[-1]
        token = rest.rpartition("-")[2]
        folders = [path for place in self.places(where) for path in self.folders(place)] if where else self.folders()
        matches = [Artifact(path) for path in folders if len(token) >= 4 and self._is_key(token, path)]
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise UserError(f"{reference!r} is the beginning of {len(matches)} keys: give more letters")
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
        place: str,
        key: str,
        preimage: Mapping[str, Any],
        attempt: Attempt | None = None,
        out: Any = print,
    ) -> Draft:
        """A new draft, or the one that an interrupted run left. A force sets aside what no force has begun."""
        attempt = attempt or Attempt()
        path = self.draft_path(place, key)
        before = read_draft(path)
        begun = any(any((path / folder).glob("[!.]*")) for folder in (FINISHED, UNFINISHED, "state"))
        if begun and attempt.purpose == "force" and (before or {}).get("purpose") != "force":
            aside = self.trash(path)
            out(f"   note: force takes nothing of what an earlier run had finished; that is in {aside} until gc deletes it")
            before, begun = None, False
        draft = Draft(path, place.rpartition("/")[2], key, preimage, out)
        about = {"key": key, "preimage": draft.preimage, "started": time.time(), **attempt.origin} if before is None else before
        others = [other for other in about.get("codes", [UNKNOWN]) if other != attempt.code] if begun else []
        if others and attempt.code != UNKNOWN:
            maker = "code that nobody noted" if others == [UNKNOWN] else "other code of the same version"
            out(f"   note: what is finished of {place} was made by {maker}; it is kept (to begin anew, delete {path})")
        facts = {"purpose": attempt.purpose, "codes": [*others, attempt.code]}
        if before is None or not facts.items() <= before.items():
            write_sealed(path / DRAFT, {**about, **facts})
        return draft

    def draft_path(self, place: str, key: str) -> Path:
        return self.root / place / f"{key}.partial"

    def claim(self, place: str, key: str) -> Claim:
        return Claim(self.root / place / f".{key}.claim")

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
        old = self.folder(self.place_of(draft.path), draft.key)
        if old is not None and not replace and not Artifact(old).verify():
            shutil.rmtree(draft.path)
            target = old
        else:
            target = draft.path.with_name(f"{slug}-{draft.key[:12]}")
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

    def _used(self, node: _Node) -> float:
        """When the artifact was last used, in seconds of the epoch; when it was committed, if nobody noted a use."""
        path = self.root / ".used" / node.key
        return path.stat().st_mtime if path.exists() else node.committed

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
        garbage: list[tuple[Path, str]] = []
        for pattern in TRASH:
            reason = "trash: replaced or set aside, or left by an interrupted gc"
            garbage += [(path, reason) for path in self.root.glob(pattern)]
        nodes = [node for path in self.folders() if (node := self._node(path)) is not None]
        todo = [node.key for node in nodes if node.damaged or self.pinned(node.key) or self._used(node) >= horizon]
        for path in self.drafts():
            key = path.name.removesuffix(".partial")
            claimed_by_another = key != claimed and self.claim(self.place_of(path), key).holder() is not None
            if not claimed_by_another and not _changed_since(path, horizon):
                garbage.append((path, f"unfinished and untouched for {days:g} days"))
            elif (draft := read_draft(path)) is not None:
                todo += draft["preimage"]["inputs"].values()
            else:  # damaged, or not written yet: any artifact may be its input
                todo += [node.key for node in nodes]
        inputs = {node.key: node.inputs for node in nodes}
        needed_keys: set[str] = set()
        while todo:
            if (key := todo.pop()) not in needed_keys:
                needed_keys.add(key)
                todo += inputs.get(key, ())
        for node in sorted(nodes, key=lambda node: node.committed, reverse=True):
            if node.key not in needed_keys:
                garbage.append((node.path, f"not pinned, not used for {days:g} days"))
            else:
                leftovers = [node.path / name for name in WORKING if (node.path / name).exists()]
                garbage += [(path, "left over by a commit that was interrupted") for path in leftovers]
        return garbage

    def remove(self, path: Path, days: float) -> bool:
        """Delete what ``garbage(days)`` listed, unless somebody works on it or has come to need it since; says whether.

        Out of sight first, so that a kill in the middle leaves no half artifact.
        """
        parts = path.relative_to(self.root).parts
        if parts[0] != ".trash" and not path.name.startswith(".gone-"):
            folder = path.parent if path.name in WORKING else path  # of the artifact or draft
            node = None if folder.suffix == ".partial" else self._node(folder)
            key = node.key if node is not None else folder.name.removesuffix(".partial")
            claim = self.claim(self.place_of(folder), key)
            if not claim.take():
                return False
            try:
                if path not in [entry for entry, _ in self.garbage(days, key)]:
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
        cached = self._nodes.get(folder)
        if cached is None or stamp is None or cached[0] != stamp:
            try:
                origin = Artifact(folder).manifest
            except Damaged:
                if not folder.exists():
                    return None
                origin = read_draft(folder) or {"key": folder.name, "preimage": {"inputs": {}}}
            committed, inputs = origin.get("finished"), tuple(origin["preimage"]["inputs"].values())
            cached = stamp, _Node(folder, origin["key"], committed or 0.0, inputs, damaged=committed is None)
            self._nodes[folder] = cached
        return cached[1]


class _Node(NamedTuple):
    """An artifact as gc sees it."""

    path: Path
    key: str
    committed: float  # seconds of the epoch; 0 where its manifest is damaged
    inputs: tuple[str, ...]  # their keys
    damaged: bool  # its manifest is


def _changed_since(draft: Path, moment: float) -> bool:
    """Whether anything was written in the draft since then: a part's marker, a log, a checkpoint, a file, the run's state."""
    for folder in (*WORKING, "logs", "files"):
        for where, _, names in os.walk(draft / folder):
            for name in ("", *names):
                with contextlib.suppress(FileNotFoundError):
                    if os.stat(os.path.join(where, name)).st_mtime >= moment:
                        return True
    return False


def store_of(artifact: Artifact) -> Store:
    """The store that the artifact lies in."""
    return Store(artifact.path.absolute().parents[1])


def iter_inputs(store: Store, artifact: Artifact) -> Iterator[tuple[str, str, Artifact | None]]:
    """(role, key, artifact or None if it is gone) of each input."""
    for role, key in artifact.manifest["preimage"]["inputs"].items():
        yield role, key, store.by_key(key)


def history(inputs: Mapping[str, Artifact]) -> dict[str, dict[str, Any]]:
    """Stage -> preimage of its key, for ``inputs`` and everything upstream of them that is still in the store."""
    preimages: dict[str, dict[str, Any]] = {}
    todo = list(inputs.values())
    while todo:
        artifact = todo.pop()
        if artifact.stage not in preimages:
            preimages[artifact.stage] = artifact.manifest["preimage"]
            todo += [parent for _, _, parent in iter_inputs(store_of(artifact), artifact) if parent is not None]
    return preimages
