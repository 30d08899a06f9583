"""Mending a damaged artifact: ``lightmill repair``.

A draft of the same key takes over every part that is sound. The others are computed, as in any interrupted run. Then the result
is swapped in, and the damaged artifact goes to the trash.

A row counts only if its part's bytes match it. So any file of the artifact may be the damaged one. What it takes to compute is
in the manifest and again in ``draft.json``. One of the two must be sound.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import tarfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.config import parse
from pipeline.errors import Damaged, UserError
from pipeline.keys import digest_of
from pipeline.make import make_artifact
from pipeline.making import Run
from pipeline.plan import Planned, RunConfig, hashes_of, plan_stage
from pipeline.stage import MapStage, load_system
from pipeline.store import UNKNOWN, Artifact, Draft, Row, Store, is_sound, read_draft, record_digest
from pipeline.worker import log_file


def repair(store: Store, artifact: Artifact, workers: int | None = None, out: Callable[[str], None] = print) -> Artifact:
    """Compute the damaged parts of the artifact anew, swap the mended artifact in, and return it.

    UserError where an input is gone or the key would be another; Damaged where nothing says soundly how it was made.
    """
    name = artifact.name
    problems = artifact.verify(deep=True)
    if not problems:
        out(f"{name}: sound, nothing to repair")
        return artifact
    for problem in problems:
        out(f"{name}: {problem}")
    origin = _origin(artifact)
    settings = RunConfig(
        system=origin["system"],
        stage=(origin["preimage"]["stage"],),
        force=(origin["preimage"]["stage"],),
        store=str(store.root),
        workers="auto" if workers is None else workers,
    )
    planned = _planned(store, name, origin)
    inputs = {}
    for parent, key in origin["preimage"]["inputs"].items():
        inputs[parent] = store.by_key(key)
        if inputs[parent] is None:
            raise UserError(
                f"{name} was made from {parent} {key[:12]}, which is gone: make that first, or compute {_again(origin)}"
            )

    def adopt(draft: Draft) -> None:
        if origin.get("environment") is not None:
            draft.set_environment(origin["environment"])
        linked_parts = 0
        if isinstance(planned.stage, MapStage):
            draft.made_by(_codes(artifact), "what is sound was")
            for marker in sound_parts(artifact):
                source = artifact.part_path(marker["digest"]) if marker["digest"] else artifact.path
                linked_parts += draft.link_part(source, marker["part_key"], marker)
                with contextlib.suppress(OSError):
                    shutil.copyfile(log_file(artifact.path, marker["part_key"]), log_file(draft.path, marker["part_key"]))
            out(f"{name}: {linked_parts} part(s) are sound and kept")
        else:
            out(f"{name}: {planned.name} is one computation and has no parts: all of it is computed again")

    old_digest = _manifest(artifact).get("outputs", {}).get("digest")
    run = Run(settings, load_system(settings.system), store, ["lightmill", "repair", name], out)
    mended = make_artifact(run, planned, inputs, adopt)
    if old_digest is None:
        out(f"{name}: the old digest is lost with the manifest, the new one is {mended.digest[:12]}")
    return mended


def _manifest(artifact: Artifact) -> dict[str, Any]:
    try:
        return artifact.manifest
    except Damaged:
        return {}


def _codes(artifact: Artifact) -> list[str]:
    """Code digests behind the artifact, from whichever copy is sound."""
    return artifact.codes if _manifest(artifact) else (read_draft(artifact.path) or {}).get("codes", [UNKNOWN])


def _origin(artifact: Artifact) -> dict[str, Any]:
    """Key, preimage, system, config and environment, from whichever copy is sound."""
    for copy in (_manifest(artifact), read_draft(artifact.path) or {}):
        if "config" in copy and digest_of(copy["preimage"]) == copy["key"]:
            return copy
    raise Damaged(
        f"{artifact.path}: neither manifest.json nor draft.json says soundly how it was made: delete the folder and run the "
        "command that made it again"
    )


def _again(origin: Mapping[str, Any]) -> str:
    command = origin.get("command")
    return f"all of it again with `{command} force={origin['preimage']['stage']}`" if command else "all of it again"


def _planned(store: Store, name: str, origin: Mapping[str, Any]) -> Planned:
    """The stage as it was planned; its key must come out as it was."""
    preimage = origin["preimage"]
    system = load_system(origin["system"])
    stage = system.stage(preimage["stage"])
    config = parse(stage.Config, origin["config"], stage.name)
    with hashes_of(store) as hashes:
        planned = plan_stage(system.name, stage, config, preimage["inputs"], hashes)
    if planned.key != origin["key"]:
        raise UserError(
            f"{name} cannot be repaired part by part: the version of {stage.name} or the source files that it read have "
            f"changed since; compute {_again(origin)}"
        )
    return planned


def sound_parts(artifact: Artifact) -> Iterator[dict[str, Any]]:
    """Markers of the sound parts: their tar, rows and rejects are as they were written, whatever else is damaged."""
    outputs = _manifest(artifact).get("outputs")
    manifest_parts = {part["digest"]: part for part in outputs["parts"]} if outputs else {}
    rejects: dict[str, dict[str, Any]] = {}
    if outputs:  # without, rejects cannot be checked, and parts that had any are computed again
        with contextlib.suppress(Damaged):
            rejects = {reject["item"]: reject for reject in artifact.rejects() if not reject.get("whole")}

    def checked(part: Mapping[str, Any], rows: list[Row]) -> Iterator[dict[str, Any]]:
        keys = {row.item: row.item_key for row in rows}
        keys |= {item: rejects[item]["item_key"] for item in part["items"] if item in rejects}
        if set(keys) == set(part["items"]):
            items = [(item, keys[item]) for item in part["items"]]
            yield from _part(artifact, part, items, rows, [rejects[item] for item in part["items"] if item in rejects])

    # a part's rows are neighbours, and no more of them are in memory: there may be millions
    for digest, group in itertools.groupby(_rows(artifact.path / "items.jsonl"), key=lambda row: row.part):
        rows = list(group)
        if outputs is None:
            items = sorted({row.item for row in rows})
            yield from checked({"digest": digest, "group": rows[0].group, "items": items}, rows)
        elif digest in manifest_parts:
            yield from checked(manifest_parts[digest], rows)
    for part in outputs["empty_parts"] if outputs else ():
        yield from checked({**part, "digest": None, "bytes": 0}, [])


def _part(
    artifact: Artifact, part: Mapping[str, Any], items: list[tuple[str, str]], rows: list[Row], rejects: list[dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """The part's marker, if the part is sound: its key is the hash of its items' keys, and its rows say what its tar holds."""
    part_key = digest_of({"group": part["group"], "items": [key for _, key in items]})
    if part.get("part_key", part_key) != part_key or any(row.group != part["group"] for row in rows):
        return
    size = 0
    if part["digest"] is not None:
        path = artifact.part_path(part["digest"])
        rows = sorted(rows, key=lambda row: min((offset for offset, _ in row.members.values()), default=0))
        try:
            if not is_sound(path, part["digest"]) or not _rows_match(path, rows):
                return
            size = path.stat().st_size
        except OSError:  # a disk that reads it once and not again
            return
    yield {
        "digest": part["digest"],
        "bytes": size,
        "rows": [row.to_json() for row in rows],
        "part_key": part_key,
        "group": part["group"],
        "items": [item for item, _ in items],
        "rejects": rejects,
    }


def _rows_match(path: Path, rows: list[Row]) -> bool:
    """Whether the rows name all members of the tar, and no other, and the digests of its records."""
    with tarfile.open(path) as tar:
        tar_members = {member.name: (member.offset_data, member.size) for member in tar.getmembers()}
    listed_members = {f"{row.id}.{name}": place for row in rows for name, place in row.members.items()}
    if tar_members != listed_members or sum(len(row.members) for row in rows) != len(tar_members):
        return False
    with open(path, "rb") as file:
        for row in rows:
            members = {}
            for name, (offset, size) in row.members.items():
                file.seek(offset)
                members[name] = file.read(size)
            if record_digest(members) != row.digest:
                return False
    return True


def _rows(path: Path) -> Iterator[Row]:
    """The rows of a listing as far as it can be read. Lines that are none any more are left out."""
    with contextlib.suppress(OSError), open(path, "rb") as file:
        for line in file:
            try:
                row = Row.from_json(json.loads(line))
            except (KeyError, TypeError, ValueError, AttributeError):
                continue
            yield row
