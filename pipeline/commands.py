"""The commands for people: ls, status, show, why, verify, repair, gc, pin. Each is a function that a command line mounts."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipeline.errors import Damaged, UserError
from pipeline.hydra_config import compose
from pipeline.plan import plan_run
from pipeline.progress import duration
from pipeline.repair import repair
from pipeline.status import lines, read_states
from pipeline.store import Artifact, Store, iter_inputs
from pipeline.terminal import console, print_table

STATE_STYLES = {"running": "green", "stopped": "yellow", "dead": "red"}


def size(count: float) -> str:
    """1.2 MB, and so on."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _flat(value: Any, path: str = "") -> dict[str, Any]:
    if isinstance(value, Mapping) and value:
        return {
            name: leaf for key, item in value.items() for name, leaf in _flat(item, f"{path}.{key}" if path else key).items()
        }
    return {path: value}


def difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Lines naming what differs between two preimages: ``render.max_spp: 64 -> 256``."""
    before, after = _flat(old), _flat(new)
    lines = []
    for name in sorted(before.keys() | after.keys()):
        if before.get(name, "absent") != after.get(name, "absent"):
            parameter = name.replace("params.", f"{new['stage']}.", 1)
            a, b = (_short(side.get(name, "absent")) for side in (before, after))
            lines.append(f"{parameter}: {a} -> {b}")
    return lines


def _short(value: Any) -> str:
    text = str(value)
    return text[:12] if len(text) == 64 and all(c in "0123456789abcdef" for c in text) else text


def _places(store: Store, reference: str | None) -> list[str | None]:
    """The places that a person names by a stage or a system; [None], all of them, where nothing is named."""
    return [None] if reference is None else [*store.places(reference)] or [reference]


def command_ls(store: Store, arguments: argparse.Namespace) -> int:
    places = _places(store, arguments.stage)
    artifacts = [artifact for place in places for artifact in store.artifacts(place)]
    print_table((_list_row(store, artifact) for artifact in artifacts), right=(1, 2, 3))
    for path in store.drafts():
        place = store.place_of(path)
        if None in places or place in places:
            holder = store.claim(place, path.name.removesuffix(".partial")).holder()
            state = f"in the making by process {holder['pid']} on {holder['host']}" if holder else "unfinished"
            parts = len(list((path / "markers").glob("[!.]*.json")))
            print(f"{place}/{path.name[:12]}.partial  {parts} parts, {state}")
    readable = {artifact.path for artifact in artifacts}
    for path in (path for place in places for path in store.folders(place)):
        if path not in readable:
            name = f"{store.place_of(path)}/{path.name:<30}"
            print(f"{name} damaged: `lightmill verify` says how, `lightmill repair` makes it anew")
    if not artifacts:
        print(f"no artifacts in {store.root}")
    return 0


def _list_row(store: Store, artifact: Artifact) -> tuple[str, ...]:
    outputs = artifact.manifest["outputs"]
    age = duration(time.time() - artifact.manifest["finished"])
    rejects = sum(outputs["rejects"].values())
    pin = "pinned" if store.pinned(artifact.key) else ""
    return artifact.name, f"{outputs['records']} records", f"{rejects} rejected", size(outputs["bytes"]), f"{age} ago", pin


def command_show(store: Store, arguments: argparse.Namespace) -> int:
    artifact = store.resolve(arguments.artifact)
    manifest = artifact.manifest
    outputs = manifest["outputs"]
    print(artifact.name)
    print(f"  path      {artifact.path}")
    print(f"  key       {artifact.key}{'  (pinned)' if store.pinned(artifact.key) else ''}")
    print(f"  digest    {artifact.digest}")
    parts = len(outputs["parts"])
    print(f"  records   {outputs['records']} of {outputs['items']} items in {parts} parts, {size(outputs['bytes'])}")
    for reason, count in sorted(outputs["rejects"].items()):
        print(f"  rejected  {count} {reason}")
    for reject in artifact.rejects()[: arguments.rejects]:
        print(f"            {reject['item']}: {reject['reason']}: {reject['detail']}")
    seconds = manifest.get("seconds", manifest["finished"] - manifest["started"])
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(manifest["finished"]))
    code = manifest["code"]
    print(
        f"  made      {when} in {duration(seconds)} on {manifest['machine']['host']}, {manifest['machine']['gpu'] or 'no GPU'}"
    )
    print(f"  command   {manifest['command']}")
    dirty = " with changes" if code["dirty"] else ""
    print(f"  code      version {manifest['preimage']['version']}, commit {code['commit']}{dirty}")
    if "others" in code:
        print(f"  code      parts of it were made by other code: {', '.join(_short(other) for other in code['others'])}")
    for name, value in sorted(_flat(manifest["environment"]).items()):
        if name:
            print(f"  runtime   {name} = {value}")
    for name, value in sorted(_flat(manifest["preimage"]["params"]).items()):
        if not name.startswith("identity.items"):
            print(f"  config    {artifact.stage}.{name} = {_short(value)}")
    for name, value in manifest["summary"].items():
        _summary(name, value)
    for name, entry in outputs["files"].items():
        print(f"  file      files/{name}  {size(entry['bytes'])}")
    print("  lineage")
    _lineage(store, artifact, "    ", set())
    return 0


def _summary(name: str, value: Any) -> None:
    """A group of plain values, such as a distribution, is one line."""
    label = name.removeprefix("summary.")
    if not isinstance(value, Mapping):
        print(f"  summary   {label} = {value}")
    elif not any(isinstance(item, Mapping) for item in value.values()):
        print(f"  summary   {label}: " + (", ".join(f"{key} {value[key]}" for key in sorted(value, key=_natural)) or "none"))
    else:
        for key in sorted(value, key=_natural):
            _summary(f"{name}.{key}", value[key])


def _natural(name: str) -> list[tuple[bool, int, str]]:
    """Sorts p10 before p100."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"(\d+)", name)]


def _lineage(store: Store, artifact: Artifact, indent: str, printed_keys: set[str]) -> None:
    for name, key, parent in iter_inputs(store, artifact):
        again = " (above)" if key in printed_keys and parent is not None else ""
        line = parent.name if parent is not None else f"{name}/{key[:12]} (gone)"
        print(f"{indent}{line}{again}")
        if parent is not None and not again:
            printed_keys.add(key)
            _lineage(store, parent, indent + "  ", printed_keys)


def command_why(store: Store, arguments: argparse.Namespace) -> int:
    """Two artifacts: what differs. A stage and overrides: why it would be computed, against the nearest artifact.

    The stage is written as for the other commands: ``STAGE``, or ``SYSTEM/STAGE``.
    """
    first, *rest = arguments.words
    if len(rest) == 1 and "=" not in rest[0]:
        old, new = store.resolve(first), store.resolve(rest[0])
        if old.stage != new.stage:
            raise UserError(f"{first} is of stage {old.stage}, {rest[0]} of {new.stage}: only like can be compared")
        _explain(store, old.manifest["preimage"], new.manifest["preimage"], "", lambda key: _preimage(store, key))
        return 0
    plan = plan_run(compose([*_choice_of_stage(store, first), *rest])).stages
    by_key = {planned.key: planned.preimage for planned in plan.values()}
    for name, planned in plan.items():
        artifact = store.find(planned.place, planned.key)
        if artifact is not None:
            print(f"{name}: up to date, {artifact.name}")
            continue
        others = store.artifacts(planned.place)
        if not others:
            print(f"{name}: to make, there is no {name} artifact in {store.root}")
            continue
        # the nearest: fewest differing leaves, the newest among equals
        near = min(reversed(others), key=lambda a: len(difference(a.manifest["preimage"], planned.preimage)))
        print(f"{name}: to make; against {near.name}:")
        _explain(
            store,
            near.manifest["preimage"],
            planned.preimage,
            "  ",
            lambda key: by_key.get(key) or _preimage(store, key),
        )
    return 0


def _choice_of_stage(store: Store, reference: str) -> list[str]:
    """The overrides that choose ``STAGE`` or ``SYSTEM/STAGE``.

    Artifacts of that name know the module of their system, which may have a longer name. Without any, SYSTEM is the module.
    """
    system, _, stage = reference.rpartition("/")
    places = [place for place in store.places(reference) if place.rpartition("/")[2] == stage]
    modules = {artifact.manifest["system"] for place in places for artifact in store.artifacts(place)[-1:]}
    if len(modules) == 1:
        system = modules.pop()
    return [f"stage={stage}", *([f"system={system}"] if system else [])]


def _preimage(store: Store, key: str) -> Mapping[str, Any] | None:
    artifact = store.by_key(key)
    return artifact.manifest["preimage"] if artifact is not None else None


def _explain(
    store: Store,
    old: Mapping[str, Any],
    new: Mapping[str, Any],
    indent: str,
    preimage: Callable[[str], Mapping[str, Any] | None],
) -> None:
    lines = difference(old, new)
    own_lines = [line for line in lines if not line.startswith("inputs.")]
    for line in own_lines:
        print(f"{indent}{line}")
    for name in sorted(old["inputs"].keys() | new["inputs"].keys()):
        a, b = old["inputs"].get(name), new["inputs"].get(name)
        if a != b and a and b:
            before, after = preimage(a), preimage(b)
            print(f"{indent}input {name}: {a[:12]} -> {b[:12]}")
            if before is not None and after is not None:
                _explain(store, before, after, indent + "  ", preimage)
    if not lines:
        print(f"{indent}nothing differs")


def command_status(store: Store, arguments: argparse.Namespace) -> int:
    states = [state for place in _places(store, arguments.stage) for state in read_states(store, place)]
    if arguments.json:
        print(json.dumps(states, indent=1))
        return 0
    out = console()
    for state in states:
        head, *rest = lines(state)
        out.print(head, style=STATE_STYLES[state["state"]])
        out.print("\n".join(rest))
    if not states:
        print(f"nothing is running or unfinished in {store.root}")
    return 0


def command_verify(store: Store, arguments: argparse.Namespace) -> int:
    if arguments.artifacts:
        artifacts = [store.resolve(name) for name in arguments.artifacts]
    else:
        artifacts = [Artifact(path) for path in store.folders()]
    bad = 0
    for artifact in artifacts:
        problems = artifact.verify(deep=arguments.deep)
        bad += bool(problems)
        name = artifact.name
        print(f"{name}: {'sound' if not problems else f'{len(problems)} problem(s); lightmill repair {name} makes it anew'}")
        for problem in problems:
            print(f"  {problem}")
    depth = "every byte read" if arguments.deep else "sizes and listings; --deep reads every byte"
    print(f"{len(artifacts) - bad} of {len(artifacts)} artifacts sound ({depth})")
    return Damaged.status if bad else 0


def command_repair(store: Store, arguments: argparse.Namespace) -> int:
    for reference in arguments.artifacts:
        repair(store, store.resolve(reference), arguments.workers)
    return 0


def command_gc(store: Store, arguments: argparse.Namespace) -> int:
    garbage = store.garbage(arguments.days)
    total = 0
    for path, reason in garbage:
        count = _bytes(path)
        print(f"{'deleting' if arguments.delete else 'would delete'} {path.relative_to(store.root)}  {size(count)}  {reason}")
        if arguments.delete and not store.remove(path, arguments.days):
            print("  kept: somebody works on it or has come to need it since")
            count = 0
        total += count
    verb = "freed" if arguments.delete else "to free; nothing was deleted, add --delete"
    print(f"{len(garbage)} entries, {size(total)} {verb}")
    return 0


def _bytes(folder: Path) -> int:
    """Of all files in it; another gc may be deleting them."""
    total = 0
    for where, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += os.lstat(os.path.join(where, name)).st_size
    return total


def command_pin(store: Store, arguments: argparse.Namespace) -> int:
    artifact = store.resolve(arguments.artifact)
    store.pin(artifact.key, not arguments.remove)
    print(f"{artifact.name} {'no longer pinned' if arguments.remove else 'pinned: gc keeps it'}")
    return 0


def add_commands(parsers: Any, program: str) -> None:
    """Mount the engine's commands on ``parsers`` (argparse's subparsers)."""

    def add(
        name: str, function: Callable[[Store, argparse.Namespace], int], summary: str, example: str
    ) -> argparse.ArgumentParser:
        parser = parsers.add_parser(
            name, help=summary, description=summary, epilog=f"example: {program} {name} {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        parser.add_argument("--store", default="store", help="the store's folder (default: store)")
        parser.set_defaults(function=lambda arguments: function(_existing(arguments.store), arguments))
        return parser

    parser = add("ls", command_ls, "list artifacts and unfinished work", "render")
    parser.add_argument("stage", nargs="?", help="only this stage or system: STAGE, SYSTEM or SYSTEM/STAGE")
    parser = add("status", command_status, "what runs, how far it is, what failed; and what was left unfinished", "")
    parser.add_argument("stage", nargs="?", help="only this stage or system: STAGE, SYSTEM or SYSTEM/STAGE")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser = add("show", command_show, "show one artifact: config, counts, rejects, summary, lineage", "render")
    parser.add_argument("artifact", help="a key or its beginning, stage/folder, or a stage's name for its newest")
    parser.add_argument("--rejects", type=int, default=10, help="how many rejects to list (default: 10)")
    parser = add("why", command_why, "say which parameter makes a stage run again", "render render.max_spp=64")
    parser.add_argument("words", nargs="+", help="STAGE or SYSTEM/STAGE and config overrides, or two artifacts to compare")
    parser = add("verify", command_verify, "check artifacts against their manifests", "--deep")
    parser.add_argument("artifacts", nargs="*", help="which (default: all)")
    parser.add_argument("--deep", action="store_true", help="read and hash every byte")
    parser = add("repair", command_repair, "make the damaged parts of an artifact anew and swap them in", "render")
    parser.add_argument("artifacts", nargs="+", help="as for show")
    parser.add_argument("--workers", type=int, help="worker processes (default: one per core)")
    parser = add("gc", command_gc, "delete what is unpinned, unused and not an input of a kept artifact", "--days 14 --delete")
    parser.add_argument("--days", type=float, default=14.0, help="keep what was used within so many days (default: 14)")
    parser.add_argument("--delete", action="store_true", help="really delete; without it only the list is printed")
    parser = add("pin", command_pin, "keep an artifact from gc", "train/tiny-0123456789ab")
    parser.add_argument("artifact", help="as for show")
    parser.add_argument("--remove", action="store_true", help="take the pin off")


def _existing(path: str) -> Store:
    if not Path(path).is_dir():
        raise UserError(f"there is no store at {path}: give --store DIR, or make one with `make data`")
    return Store(path)
