"""Running parts in local processes that may die: spawned workers, limits per item, one retry alone, then a reject.

An item that brings its worker down (crash, CPU time, wall time or memory over the limit) is tried once more, first in a
fresh process; if that dies too the item is rejected as ``crash``, ``time`` or ``memory``, marked as machine-dependent and with
the limit that it ran into: a run with a higher one tries it again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import psutil
from pebble import ProcessExpired, ProcessPool

from pipeline.errors import MachineError
from pipeline.worker import (
    THREADS_VARIABLE,
    PartResult,
    PartTask,
    close_workers,
    die_with_parent,
    run_part,
    running_file,
    write_log,
)

REASONS = ("crash", "time", "memory")  # of rejects that are the machine's doing
POLL_S = 0.25
MAX_POOLS = 8  # that break as a whole
MAX_OPENINGS = 1  # deaths while a worker opens: one may be bad luck
MAX_UNEXPLAINED = 4  # deaths of a part's worker beyond what its items can explain
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    THREADS_VARIABLE,
)


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    """Environment for workers about to be spawned: native libraries read it when they load."""
    saved = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update({name: str(count) for name in THREAD_VARIABLES})
    try:
        yield
    finally:
        for name, value in saved.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def run_parts(
    tasks: Iterable[PartTask],
    workers: int,
    threads: int,
    on_result: Callable[[PartResult], None],
    log: Callable[[str], None],
) -> None:
    """Make all parts by ``workers`` processes with ``threads`` native threads each; with 0, in this process, unprotected.

    ``on_result`` gets each result as it comes. ``log`` gets lines for people.
    """
    if workers == 0:
        try:
            for task in tasks:
                on_result(run_part(task, log=False))
        finally:
            close_workers()
        return
    waiting = iter(tasks)
    for _ in range(MAX_POOLS):
        try:
            with open_pool(workers, threads) as pool:
                run_on(pool, waiting, workers, on_result, log)
            return
        except PoolBroken as broken:
            log("the worker processes died before they began, or while they were given work: starting new ones")
            waiting = itertools.chain(broken.tasks, waiting)
    raise MachineError("worker processes keep dying as they start: look at the machine's memory; finished parts are kept")


class PoolBroken(Exception):
    """The pool can do no more (a worker was killed at the pool's own business); ``tasks`` are still to be done."""

    def __init__(self, tasks: Iterable[PartTask]):
        super().__init__()
        self.tasks = list(tasks)


@contextlib.contextmanager
def open_pool(workers: int, threads: int) -> Iterator[ProcessPool]:
    """Processes for parts, with ``threads`` native threads each; they end with this process."""
    with _threads(threads):
        pool = ProcessPool(max_workers=workers, initializer=die_with_parent, context=multiprocessing.get_context("spawn"))
        try:
            with _uninterrupted():
                assert pool.active  # starts the processes and the threads that replace them
            yield pool
            pool.close()
        except BaseException:
            pool.stop()
            for process in multiprocessing.active_children():  # parts are safe from kills, and a polite end takes seconds
                process.kill()
            raise
        finally:
            pool.join()


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Threads and processes that begin in here never see Ctrl-C, not even while they import: it is the runner's business."""
    resource_tracker.ensure_running()  # its first start would let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_on(
    pool: ProcessPool,
    waiting: Iterator[PartTask],
    workers: int,
    on_result: Callable[[PartResult], None],
    log: Callable[[str], None],
) -> None:
    """Make all parts by the pool's ``workers``, at most twice as many at a time, and hold each to its task's limits."""
    _PoolRun(pool, on_result, log).run(waiting, 2 * workers)


class _PoolRun:
    """Parts on their way through one pool: those that workers have, and the deaths of workers so far."""

    def __init__(self, pool: ProcessPool, on_result: Callable[[PartResult], None], log: Callable[[str], None]):
        self.pool, self.on_result, self.log = pool, on_result, log
        self.flying: dict[Any, PartTask] = {}  # future -> task
        self.verdicts: dict[str, Mapping[str, Any]] = {}  # part key -> reject, for the kills that we made ourselves
        self.deaths: dict[str, int] = {}  # part key -> workers that died over it
        self.openings = 0  # workers that died while they opened

    def run(self, waiting: Iterator[PartTask], most: int) -> None:
        """Make all parts that wait, ``most`` at a time."""
        while True:
            for task in itertools.islice(waiting, most - len(self.flying)):
                self._submit(task)
            if not self.flying:
                return
            for future in self._finished():
                self._collect(future)
            for task in self.flying.values():
                _hold_to_limits(task, self.verdicts)

    def _submit(self, task: PartTask) -> None:
        try:
            self.flying[self.pool.schedule(run_part, args=[task])] = task
        except RuntimeError:
            raise PoolBroken([task, *self.flying.values()]) from None

    def _finished(self) -> Iterable[Any]:
        """The futures that are done, after a moment's wait if there are none."""
        done, _ = wait(list(self.flying), timeout=POLL_S, return_when=FIRST_COMPLETED)
        if not done and not self.pool.active:  # its threads gave up over a worker killed as it started: nobody will answer
            raise PoolBroken(self.flying.values())
        return done

    def _collect(self, future: Any) -> None:
        """Hand over the part's result, or submit the part again if its worker died."""
        task = self.flying.pop(future)
        try:
            self.on_result(future.result())
        except BrokenProcessPool:
            raise PoolBroken([task, *self.flying.values()]) from None
        except ProcessExpired as death:
            self._count(task, death)
            self._submit(_after_death(task, death, self.verdicts.pop(task.part_key, None), self.log))

    def _count(self, task: PartTask, death: ProcessExpired) -> None:
        """Count a worker's death. MachineError where there are too many to go on."""
        self.deaths[task.part_key] = self.deaths.get(task.part_key, 0) + 1
        state = _read_running(running_file(task.draft, task.part_key))
        if state is not None and state["item"] is None:
            self.openings += 1
            if self.openings > MAX_OPENINGS:
                why = self.verdicts.get(task.part_key, {}).get("detail", f"exit code {death.exitcode}")
                raise MachineError(
                    f"{task.stage}: workers die while they open what its items need ({why}), before any item: look at "
                    "the machine's memory and at the logs; finished parts are kept"
                ) from None
        if self.deaths[task.part_key] > 2 * len(task.items) + MAX_UNEXPLAINED:
            raise MachineError(
                f"{task.stage}: workers keep dying (exit code {death.exitcode}) and no item is to blame: "
                "look at the machine's memory and at the logs; finished parts are kept"
            ) from None


def _after_death(
    task: PartTask, death: ProcessExpired, verdict: Mapping[str, Any] | None, log: Callable[[str], None]
) -> PartTask:
    """The task to submit after its worker died: the suspect first, or rejected when it was the suspect already."""
    path = running_file(task.draft, task.part_key)
    state = _read_running(path)
    path.unlink(missing_ok=True)
    if state is None or state["item"] is None or state["item"] in task.killed:
        # It died before or between items: nothing to blame but the machine. Starts as it was; each death is one line.
        log(f"{task.stage}: a worker died (exit code {death.exitcode}) outside any item; its part starts again")
        return task
    item = state["item"]
    verdict = verdict or {"reason": "crash", "detail": f"worker died with exit code {death.exitcode}"}
    message = f"{item}: {verdict['detail']}; "
    message += f"rejected as {verdict['reason']}" if task.first == item else "trying it once more, alone"
    log(f"{task.stage}: {message}")
    with contextlib.suppress(OSError):
        write_log(task.draft, task.part_key, message)
    if task.first != item:
        return dataclasses.replace(task, first=item)
    killed = {**task.killed, item: {**verdict, "machine": True}}
    return dataclasses.replace(task, first=None, killed=killed)


def _read_running(path: Path) -> dict[str, Any] | None:
    """What a worker says it is at; None where it says nothing."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None


def _hold_to_limits(task: PartTask, verdicts: dict[str, Mapping[str, Any]]) -> None:
    """Kill the part's worker if it is over a limit. ``verdicts`` then has the reject of the item, by the part's key."""
    state = _read_running(running_file(task.draft, task.part_key))
    if state is None:
        return
    try:
        process = psutil.Process(state["pid"])
        if process.ppid() != os.getpid():  # a file that an earlier run or another machine left
            return
        times = process.cpu_times()
        cpu_s = times.user + times.system - state["cpu_s"]
        memory_gb = process.memory_info().rss / 2**30
    except psutil.Error:
        return
    wall_s = time.monotonic() - state["monotonic"]
    limits = task.limits
    if state["item"] is None:  # it opens: no item pays for that, and it has a limit of its own
        limits = limits.model_copy(update={"cpu_s": math.inf, "wall_s": task.open_wall_s})
    if cpu_s > limits.cpu_s:
        reason, limit, detail = "time", "cpu_s", f"over {limits.cpu_s:g} s of CPU time"
    elif wall_s > limits.wall_s:
        reason, limit, detail = "time", "wall_s", f"over {limits.wall_s:g} s on the clock"
    elif memory_gb > limits.memory_gb:
        reason, limit, detail = "memory", "memory_gb", f"over {limits.memory_gb:g} GB of memory"
    else:
        return
    verdicts[task.part_key] = {"reason": reason, "detail": detail, "limit": {limit: getattr(limits, limit)}}
    with contextlib.suppress(ProcessLookupError):
        os.kill(state["pid"], signal.SIGKILL)
