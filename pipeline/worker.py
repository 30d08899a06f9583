"""Making one part, in whatever process the executor chose.

The worker says in ``running/<part>.json`` what it is at: before it opens what its items need, and before each item. So the
runner can hold it to limits, and knows what was at work when a process died. ``logs/<part>.log`` says what became of each item,
how long it took and what libraries printed; it stays with the artifact, outside its digest.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import multiprocessing
import os
import signal
import socket
import sys
import time
import traceback
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.atomic import atomic_path
from pipeline.config import Limits
from pipeline.errors import STORAGE_ERRORS, Damaged, Reject, UserError
from pipeline.stage import Item, MapStage, Record, load_system
from pipeline.store import FINISHED, UNFINISHED, Artifact, Draft, Row

THREADS_VARIABLE = "LIGHTMILL_THREADS"  # what a stage may use in a worker; also set as OMP_NUM_THREADS and its like
_opened: dict[tuple[str, str], tuple[MapStage, Any]] = {}  # (stage, key) -> the stage and its worker, once per process


@dataclass(frozen=True, slots=True)
class Reuse:
    """An item taken over from an earlier artifact: the ids of its records there, or its reject."""

    artifact: Path | None = None
    records: tuple[str, ...] = ()
    reject: Mapping[str, Any] | None = None


@lru_cache(maxsize=4)
def _artifact(path: Path) -> Artifact:
    """Opened once per process: its listing may be long."""
    return Artifact(path)


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
    open_wall_s: float = 1800.0  # seconds on the clock that opening a worker may take
    limits: Limits = Limits()  # of an item: the executor holds the worker to them


@dataclass(frozen=True)
class PartResult:
    """What the runner hears of a part: numbers of rejects by reason, and (item id, traceback) of each item that raised."""

    part_key: str
    rejects: Mapping[str, int] = field(default_factory=dict)
    failed: tuple[tuple[str, str], ...] = ()


def die_with_parent() -> None:
    """Ask Linux to kill this process when its parent dies, so that a killed run leaves nobody working.

    And before its parent when memory runs out: a worker costs an item's second try, the runner the run.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # it died before the line above
        os._exit(1)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the runner's business


def running_file(draft: Path, part_key: str) -> Path:
    """Where the part's worker says what it is at."""
    return draft / "running" / f"{part_key}.json"


def log_file(draft: Path, part_key: str) -> Path:
    """The part's log, in a draft or an artifact."""
    return draft / "logs" / f"{part_key[:16]}.log"


def write_log(draft: Path, part_key: str, text: str) -> None:
    """A line in the part's log, with the time of day."""
    handle = os.open(log_file(draft, part_key), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(handle, f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n".encode())
    finally:
        os.close(handle)


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
        with contextlib.suppress(OSError):  # a full disk loses what was printed, no more
            sys.stdout.flush()
            sys.stderr.flush()
        for number, copy in zip((1, 2), saved, strict=True):
            os.dup2(copy, number)
            os.close(copy)
        os.close(target)


def _announce(task: PartTask, item: str | None) -> None:
    """Say what this process is at: an item, or None while it opens what its items need."""
    times = os.times()
    # ``time`` is for people; limits go by ``monotonic``, which no change of the clock moves
    state = {"pid": os.getpid(), "item": item, "cpu_s": times.user + times.system}
    with atomic_path(running_file(task.draft, task.part_key), durable=False) as temporary:
        temporary.write_text(json.dumps({**state, "time": time.time(), "monotonic": time.monotonic()}))


def run_part(task: PartTask, log: bool = True) -> PartResult:
    """Make the part: write its tar and its marker into the draft.

    An exception in an item leaves the part unfinished. The draft keeps its other items for the next run.

    ``log``: what this process prints meanwhile goes to the part's log.
    """
    draft = Draft(task.draft, task.stage, task.key, {})
    with _output_to(log_file(task.draft, task.part_key)) if log else contextlib.nullcontext():
        try:
            return _run_part(task, draft)
        finally:
            running_file(task.draft, task.part_key).unlink(missing_ok=True)


@dataclass(frozen=True)
class _Failure:
    """An item that raised."""

    trace: str

    def __str__(self) -> str:
        return f"FAILED\n{self.trace.rstrip()}"


Outcome = list[Record] | Reject | _Failure


class _Stopwatch:
    """Seconds since the last start, on the clock and of this process' CPU time; starts when made."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self._clock, self._cpu = time.monotonic(), time.process_time()

    def __str__(self) -> str:
        return f"{time.monotonic() - self._clock:.3f} s, {time.process_time() - self._cpu:.3f} s of CPU"


def _run_part(task: PartTask, draft: Draft) -> PartResult:
    """Make the part, but for what an earlier try at it has left in the draft."""
    maker = _PartMaker(task, draft)
    group, host = task.group or "-", socket.gethostname()
    maker.say(f"{len(task.items)} items of {task.stage} {group}: process {os.getpid()} on {host}")
    finished = draft.sound_markers({task.part_key: [item.id for item in task.items]})[0][task.part_key]
    if finished is not None and not any(task.limits.exceed(reject) for reject in finished["rejects"]):
        maker.say("finished already, by a worker that died before it could say so")
        return PartResult(task.part_key, Counter(reject["reason"] for reject in finished["rejects"]))
    # a part finished under lower limits, or one of which an item failed: what they lack is computed, the rest stays as it is
    marker = draft.marker(task.part_key, UNFINISHED if finished is None else FINISHED)
    if marker is not None:
        maker.keep(marker)
    return maker.make()


class _PartMaker:
    """Makes one part: each item's records are computed or taken over, then tar and marker written."""

    def __init__(self, task: PartTask, draft: Draft):
        self._task, self._draft = task, draft
        self._watch = _Stopwatch()
        self._kept: dict[str, list[Row]] = {}  # item id -> its rows from an earlier try at this part
        self._rejected = dict(task.killed)  # item id -> its reject, which stands

    def say(self, text: str) -> None:
        """Write a line to the part's log."""
        write_log(self._task.draft, self._task.part_key, text)

    def keep(self, marker: Mapping[str, Any]) -> None:
        """Keep what the marker of an earlier try holds, but for rejects that the limits of this one may spare."""
        for row in map(Row.from_json, marker["rows"]):
            self._kept.setdefault(row.item, []).append(row)
        standing = {reject["item"]: reject for reject in marker["rejects"] if not self._task.limits.exceed(reject)}
        self._rejected = standing | self._rejected

    def make(self) -> PartResult:
        """Make all items, and write the part's tar and its marker."""
        task = self._task
        writer = self._draft.open_part()
        rejects: list[dict[str, Any]] = []
        failed: dict[str, str] = {}  # item id -> traceback
        try:
            early = {item.id: self._attempt(item) for item in task.items if item.id == task.first}
            for item, item_key in zip(task.items, task.item_keys, strict=True):
                row = {"item": item.id, "group": item.group, "item_key": item_key}
                if item.id in self._rejected:
                    rejects.append({**row, **self._rejected[item.id]})
                    continue
                outcome = early.pop(item.id) if item.id in early else self._attempt(item)
                if isinstance(outcome, _Failure):
                    failed[item.id] = outcome.trace
                elif isinstance(outcome, Reject):
                    rejects.append({**row, "reason": outcome.reason, "detail": outcome.detail})
                else:
                    for record in outcome:
                        writer.add(record, item.id, item.group, item_key)
            self._mark(writer.close(), rejects, failed)
        except BaseException:
            writer.discard()
            raise
        return PartResult(task.part_key, Counter(reject["reason"] for reject in rejects), tuple(failed.items()))

    def _mark(self, tar: Mapping[str, Any], rejects: list[dict[str, Any]], failed: Collection[str]) -> None:
        """Write the part's marker: finished, or unfinished without the items in ``failed``. ``tar``: digest, bytes and rows."""
        task = self._task
        items = [item.id for item in task.items if item.id not in failed]
        marker = {**tar, "part_key": task.part_key, "group": task.group, "items": items, "rejects": rejects}
        if not failed:
            self._draft.finish_part(task.part_key, marker)
        elif items:
            self._draft.keep_unfinished(task.part_key, marker)
        state = f"unfinished, {len(failed)} failed" if failed else "finished"
        self.say(f"{state}: {len(tar['rows'])} records, {len(rejects)} rejects, {tar['bytes']} bytes")

    def _attempt(self, item: Item) -> Outcome:
        """The item's records, its reject or its failure, with a line in the log.

        What a person must mend is raised, and what a disk did, because no item is to blame.
        """
        self._watch.start()
        outcome: Outcome
        try:
            taken_over = self._take_over(item)
            outcome, source = taken_over if taken_over is not None else (self._compute(item), "")
        except UserError:
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno in STORAGE_ERRORS:
                raise
            outcome, source = _Failure(traceback.format_exc()), ""
        text = f"{len(outcome)} record(s)" if isinstance(outcome, list) else str(outcome)
        text = f"rejected, {text}" if isinstance(outcome, Reject) else text
        self.say(f"{item.id}: {self._watch}, {text}{source}")
        return outcome

    def _take_over(self, item: Item) -> tuple[Outcome, str] | None:
        """What an earlier try or artifact holds of the item, and the words for the log that say which.

        None where there is nothing, or where it is damaged: then the item is computed.
        """
        rows, reuse = self._kept.get(item.id), self._task.reuse.get(item.id)
        try:
            if rows is not None:
                return [self._draft.read_row(row) for row in rows], ", taken over from before"
            if reuse is None:
                return None
            if reuse.reject is not None:
                return Reject(reuse.reject["reason"], reuse.reject["detail"]), ", taken over"
            assert reuse.artifact is not None
            artifact = _artifact(reuse.artifact)
            return [artifact.read(record) for record in reuse.records], f", taken over from {reuse.artifact.name}"
        except Damaged as error:  # of an artifact that this one does not depend on, or of an unfinished part
            self.say(f"{item.id}: not taken over: {error}")
            return None

    def _compute(self, item: Item) -> list[Record] | Reject:
        """What the stage makes of the item."""
        task = self._task
        if (task.stage, task.key) not in _opened:  # paid once per process, by no item: imports, what the stage loads
            _announce(task, None)
            _open(task)
            self.say(f"{task.stage} opened: {self._watch}")
            self._watch.start()
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


def _open(task: PartTask) -> tuple[MapStage, Any]:
    """The stage and its worker, built once per process."""
    if (task.stage, task.key) not in _opened:
        stage = load_system(task.system).stage(task.stage)
        assert isinstance(stage, MapStage)
        prepared = Draft(task.draft, task.stage, task.key, {}).prepared
        worker = stage.open_prepared(task.config, task.inputs, dict(task.environment), prepared)
        _opened[task.stage, task.key] = stage, worker
    return _opened[task.stage, task.key]


def close_workers() -> None:
    """Drop what this process opened: a run in the caller's own process leaves nothing behind."""
    _opened.clear()
    _artifact.cache_clear()
