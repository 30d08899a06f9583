"""Making one part, in whatever process the executor chose.

Before each item the worker announces it in ``running/<part>.json``, so that the runner can hold the item to its limits and
knows which one was at work when a process died.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import Reject, UserError
from pipeline.stage import Item, MapStage, Record, load_system
from pipeline.store import Artifact, Draft, Row

THREADS_VARIABLE = "LIGHTMILL_THREADS"  # what a stage may use in a worker; also set as OMP_NUM_THREADS and its like
_opened: dict[tuple[str, str], tuple[MapStage, Any]] = {}  # (stage, key) -> the stage and its worker, once per process


@dataclass(frozen=True)
class Reuse:
    """An item taken over from an earlier artifact: its records' rows there, or its reject."""

    artifact: Path | None = None
    rows: tuple[Row, ...] = ()
    reject: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class PartTask:
    """Everything that a worker needs to make one part."""

    system: str
    stage: str
    key: str
    config: Any
    inputs: Mapping[str, Artifact]
    environment: Mapping[str, Any]
    draft: Path
    part_key: str
    group: str
    items: tuple[Item, ...]
    item_keys: tuple[str, ...]
    reuse: Mapping[str, Reuse] = field(default_factory=dict)
    first: str | None = None  # the item to try first, alone in a fresh process: it was at work when the last one died
    killed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # items that died twice: their rejects


@dataclass(frozen=True)
class PartResult:
    """What the runner hears of a part; ``failed`` holds (item id, traceback) of ordinary exceptions."""

    part_key: str
    done: int
    rejects: int
    failed: tuple[tuple[str, str], ...] = ()


def die_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies, so that a killed run leaves nobody working."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the runner's business


def running_file(draft: Path, part_key: str) -> Path:
    return draft / "running" / f"{part_key}.json"


@contextlib.contextmanager
def _output_to(path: Path) -> Iterator[None]:
    """Send what this process and its native libraries print into the part's log file."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    target = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.dup2(target, 1)
        os.dup2(target, 2)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(target)
        if path.stat().st_size == 0:
            path.unlink()


def _announce(task: PartTask, item: str) -> None:
    times = os.times()
    path = running_file(task.draft, task.part_key)
    temporary = path.with_suffix(f".{os.getpid()}")
    state = {"pid": os.getpid(), "item": item, "cpu_s": times.user + times.system, "time": time.time()}
    temporary.write_text(json.dumps(state))
    os.replace(temporary, path)


def run_part(task: PartTask, log: bool = True) -> PartResult:
    """Make the part: write its tar and its marker into the draft. An exception in an item fails the part."""
    with _output_to(task.draft / "logs" / f"{task.part_key[:16]}.log") if log else contextlib.nullcontext():
        try:
            return _run_part(task)
        finally:
            running_file(task.draft, task.part_key).unlink(missing_ok=True)


def _run_part(task: PartTask) -> PartResult:
    draft = Draft(task.draft, task.stage, task.key, {})
    writer = draft.open_part()
    rejects: list[dict[str, Any]] = []
    failed: list[tuple[str, str]] = []
    early: dict[str, list[Record] | Reject] = {}

    def compute(item: Item) -> list[Record] | Reject:
        _announce(task, item.id)
        stage, worker = _open(task)
        try:
            records = list(stage.process(worker, item))
        except Reject as reject:
            if reject.reason not in stage.reasons:
                raise AssertionError(f"{task.stage} rejects with {reject.reason!r}, not in its list of reasons") from None
            return reject
        if not records:
            raise AssertionError(f"{task.stage} made no record of item {item.id!r} and did not reject it")
        return records

    try:
        for item in task.items:
            if item.id == task.first:
                early[item.id] = compute(item)
        for item, item_key in zip(task.items, task.item_keys, strict=True):
            row = {"item": item.id, "group": item.group, "item_key": item_key}
            if item.id in task.killed:
                rejects.append({**row, **task.killed[item.id]})
                continue
            reuse = task.reuse.get(item.id)
            if reuse is not None and reuse.reject is not None:
                rejects.append({**row, "reason": reuse.reject["reason"], "detail": reuse.reject["detail"]})
                continue
            try:
                if reuse is not None:
                    artifact = Artifact(reuse.artifact)
                    result: list[Record] | Reject = [artifact.read(source.id) for source in reuse.rows]
                else:
                    result = early.pop(item.id) if item.id in early else compute(item)
            except UserError:
                raise
            except Exception:
                failed.append((item.id, traceback.format_exc()))
                continue
            if isinstance(result, Reject):
                rejects.append({**row, "reason": result.reason, "detail": result.detail})
                continue
            for record in result:
                writer.add(record, item.id, item.group, item_key)
        if failed:
            writer.discard()
            return PartResult(task.part_key, 0, 0, tuple(failed))
        marker = {
            **writer.close(),
            "part_key": task.part_key,
            "group": task.group,
            "items": [item.id for item in task.items],
            "rejects": rejects,
        }
        draft.finish_part(task.part_key, marker)
        return PartResult(task.part_key, len(task.items), len(rejects))
    except BaseException:
        writer.discard()
        raise


def _open(task: PartTask) -> tuple[MapStage, Any]:
    """The stage and its worker, built once per process."""
    if (task.stage, task.key) not in _opened:
        stage = load_system(task.system).stage(task.stage)
        assert isinstance(stage, MapStage)
        _opened[task.stage, task.key] = stage, stage.open(task.config, task.inputs, dict(task.environment))
    return _opened[task.stage, task.key]


def close_workers() -> None:
    """Drop what this process opened: a run in the caller's own process leaves nothing behind."""
    _opened.clear()
