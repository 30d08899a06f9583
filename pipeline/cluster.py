"""Running parts on Dask workers: ``executor=dask``, by the address of a scheduler or a job queue that starts the workers.

A part is one Dask task over the shared store: Dask chooses where it runs, starts it again when its worker is lost, and shows
it on its dashboard. On the worker the part is made by a process of its own under the limits per item that hold locally
(``pipeline.executor``): an item that crashes, hangs or eats memory costs that process, never the Dask worker. What travels
over the network is which items to make and whether it worked; records go straight into the store.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import socket
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from functools import cache, cached_property
from typing import Annotated, Any, Literal

from pebble import ProcessExpired
from pydantic import Field, model_validator

from pipeline.code import code_digest
from pipeline.config import Section, StageConfig, nearest
from pipeline.errors import MachineError, UserError
from pipeline.executor import PoolBroken, open_pool, run_on
from pipeline.stage import load_system
from pipeline.store import FINISHED
from pipeline.worker import PartResult, PartTask, running_file

# known names -> (module, class): a config chooses one of these, never an import path
CLUSTERS = {
    "local": ("distributed", "LocalCluster"),
    "slurm": ("dask_jobqueue", "SLURMCluster"),
    "pbs": ("dask_jobqueue", "PBSCluster"),
    "sge": ("dask_jobqueue", "SGECluster"),
    "lsf": ("dask_jobqueue", "LSFCluster"),
    "oar": ("dask_jobqueue", "OARCluster"),
    "moab": ("dask_jobqueue", "MoabCluster"),
    "htcondor": ("dask_jobqueue", "HTCondorCluster"),
    "kubernetes": ("dask_kubernetes.operator", "KubeCluster"),
}
CONNECT = "30s"  # to the scheduler
IN_FLIGHT = 32  # parts that the scheduler holds at least; twice its threads once there are more: it must not hold millions
TELL_EVERY_S = 60.0  # say so while no worker is there
VISIBLE_S = 90.0  # how long a network file system may take to show what another machine wrote
RETRIES = 2  # of a task that raised for a reason outside the items: a file system that was away, a pool that broke
GONE = "the Dask scheduler is gone or was restarted: finished parts are kept, run again"


class LocalExecutor(Section):
    """Worker processes on this machine."""

    name: Literal["local"] = "local"


class DaskExecutor(Section):
    """Workers of a Dask scheduler: a running one, or one that this run starts through a job queue."""

    name: Literal["dask"] = "dask"
    address: str | None = None  # of a running scheduler: tcp://HOST:8786, or tls://HOST:8786
    cluster: str | None = None  # or what starts the workers: one of CLUSTERS
    workers: int = Field(1, ge=1)  # worker processes to ask the cluster for; lost ones are asked for again
    options: dict[str, Any] = {}  # arguments of the cluster's class: queue, cores, memory, walltime ...
    threads: int = Field(1, ge=1)  # native threads of each part

    @model_validator(mode="after")
    def _one_of_two(self) -> DaskExecutor:
        if (self.address is None) == (self.cluster is None):
            raise ValueError("give executor.address=tcp://HOST:8786 or executor.cluster=NAME, one of the two")
        if self.cluster is not None and self.cluster not in CLUSTERS:
            raise ValueError(f"cluster={self.cluster!r} is unknown{nearest(self.cluster, CLUSTERS)}")
        return self


Executor = Annotated[LocalExecutor | DaskExecutor, Field(discriminator="name")]


# -- on the worker


class _Guard:
    """On each Dask worker (its plugin): the processes that make parts, one for each of the worker's threads."""

    def __init__(self, name: str, threads: int):
        self.name, self.threads = name, threads

    def setup(self, worker: Any) -> None:
        # Dask starts its workers as daemons, which multiprocessing forbids children because they would outlive it: ours do not
        # (pipeline.worker.die_with_parent).
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        self.workers = worker.state.nthreads
        self.lock = threading.Lock()
        self.stack = contextlib.ExitStack()
        self.pool: Any = None

    def working_pool(self) -> Any:
        """The pool; a new one where the last can do no more."""
        with self.lock:
            if self.pool is None or not self.pool.active:
                self.stack.close()
                self.pool = self.stack.enter_context(open_pool(self.workers, self.threads))
            return self.pool

    def teardown(self, worker: Any) -> None:
        if self.pool is not None:
            self.pool.stop()  # what is running now belongs to a run that has ended
            self.stack.close()


@cache
def _code(system: str, stage: str) -> str:
    return code_digest(load_system(system), stage)


def _pool(guard: str) -> Any:
    from distributed import get_worker

    return get_worker().plugins[guard].working_pool()


def _make_part(task: PartTask, code: str, guard: str) -> tuple[PartResult | UserError, list[str]]:
    """Make one part; returns its result and lines for people.

    What a person must mend is returned, not raised, because Dask would try again. ``code`` is the digest of the runner's code
    of the stage, ``guard`` the name of the plugin that has the processes.
    """
    host = socket.gethostname()
    if not task.draft.is_dir():
        return UserError(f"{host} sees no {task.draft}: executor=dask needs a store that all machines have under one path"), []
    if _code(task.system, task.stage) != code:
        return UserError(f"{host} has other code of {task.stage}: all machines need the same, then start the workers again"), []
    results: list[PartResult] = []
    lines: list[str] = []
    running_file(task.draft, task.part_key).unlink(missing_ok=True)  # of a lost worker, whose process numbers mean nothing here
    try:
        run_on(_pool(guard), iter([task]), 1, results.append, lines.append)
    except UserError as error:
        return error, lines
    except PoolBroken:  # raised, so that Dask tries again; this one can travel
        raise _dying(host) from None
    return results[0], lines


def _dying(host: str) -> MachineError:
    return MachineError(
        f"{host}: worker processes keep dying as they start: look at the machine's memory and at the Dask worker's log; "
        "finished parts are kept, run again"
    )


def _environment(system: str, stage: str, config: StageConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
    return load_system(system).stage(stage).environment(config, previous)


def _environment_of(guard: str, *arguments: Any) -> dict[str, Any] | UserError:
    try:
        return _pool(guard).schedule(_environment, args=arguments).result()
    except UserError as error:
        return error
    except (BrokenProcessPool, ProcessExpired):
        return _dying(socket.gethostname())


# -- in the runner


@contextlib.contextmanager
def _while_the_scheduler_lives() -> Iterator[None]:
    """Whatever a lost scheduler shows as is said in one way."""
    try:
        yield
    except CancelledError:
        raise MachineError(GONE) from None
    except OSError as error:
        if error.errno is None:  # Dask's own, of a connection; those of files have a number
            raise MachineError(GONE) from error
        raise


class Cluster:
    """A Dask scheduler for one run: connected to, or started, when the first part is to be made."""

    def __init__(self, config: DaskExecutor, out: Callable[[str], None]):
        self._config, self._out = config, out
        self._guard = f"lightmill-{uuid.uuid4().hex[:8]}"
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.close()

    @cached_property
    def _client(self) -> Any:
        config = self._config
        try:
            import distributed
            from distributed.diagnostics.plugin import WorkerPlugin
        except ModuleNotFoundError:
            raise UserError("executor=dask needs Dask: pip install 'lightmill[dask]'") from None
        scheduler: Any = config.address
        if config.cluster is not None:
            scheduler = self._stack.enter_context(self._start(config.cluster))
        try:
            client = self._stack.enter_context(distributed.Client(scheduler, timeout=CONNECT))
        except (OSError, ValueError) as error:
            raise UserError(f"no Dask scheduler answers at executor.address={config.address}: {error}") from None
        guard = type("Guard", (_Guard, WorkerPlugin), {})(self._guard, config.threads)
        client.register_plugin(guard, name=self._guard)

        def leave() -> None:
            if client.status == "running":  # a scheduler that is gone is told nothing, and must not hide why the run ends
                with contextlib.suppress(OSError):
                    client.unregister_worker_plugin(self._guard)

        self._stack.callback(leave)
        self._out(f"dask: scheduler {client.scheduler.address}, dashboard {client.dashboard_link}")
        return client

    def _start(self, name: str) -> Any:
        module, attribute = CLUSTERS[name]
        try:
            kind = getattr(importlib.import_module(module), attribute)
        except ModuleNotFoundError as error:
            raise UserError(f"executor.cluster={name} needs the package {error.name}") from None
        first = {"n_workers": 0} | ({"dashboard_address": ":0"} if name == "local" else {})
        try:
            cluster = kind(**first | self._config.options)
        except (TypeError, ValueError) as error:
            raise UserError(f"executor.options do not suit {attribute}: {error}") from None
        cluster.adapt(minimum=self._config.workers, maximum=self._config.workers)  # scale() would not replace lost ones
        return cluster

    @_while_the_scheduler_lives()
    def environment(self, system: str, stage: str, config: StageConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        """The stage's runtime choices as a worker sees them: the machine that starts a run may have another GPU, or none."""
        future = self._client.submit(_environment_of, self._guard, system, stage, config, previous, pure=False)
        result = self._wait([future], self._out)[0].result()
        if isinstance(result, UserError):
            raise result
        return result

    @_while_the_scheduler_lives()
    def run_parts(
        self,
        tasks: Iterable[PartTask],
        on_result: Callable[[PartResult], None],
        log: Callable[[str], None],
    ) -> None:
        """Make all parts by whatever workers the scheduler has, as they come and go.

        ``on_result`` gets each result as it comes. ``log`` gets lines for people.
        """
        from distributed import KilledWorker

        client, waiting, run = self._client, iter(tasks), uuid.uuid4().hex[:8]
        flying: dict[Any, PartTask] = {}
        try:
            while True:
                while len(flying) < max(IN_FLIGHT, 2 * sum(client.nthreads().values())):
                    task = next(waiting, None)
                    if task is None:
                        break
                    code = _code(task.system, task.stage)
                    key = f"{task.stage}-{run}", task.part_key
                    future = client.submit(_make_part, task, code, self._guard, key=key, pure=False, retries=RETRIES)
                    flying[future] = task
                if not flying:
                    return
                for future in self._wait(list(flying), log):
                    task = flying.pop(future)
                    try:
                        result, lines = future.result()
                    except KilledWorker as error:
                        trace = (
                            f"its part was lost with {error.last_worker.address} and others before: look at the workers' logs"
                        )
                        result, lines = PartResult(task.part_key, failed=tuple((item.id, trace) for item in task.items)), []
                    for line in lines:
                        log(line)
                    if isinstance(result, UserError):
                        raise result
                    if not result.failed:
                        _wait_until_visible(task)
                    on_result(result)
        finally:
            client.cancel(list(flying))

    def _wait(self, futures: list[Any], log: Callable[[str], None]) -> list[Any]:
        """The futures that are done, at least one. From time to time a line says that there is no worker."""
        from distributed import wait

        last_message_time = time.monotonic()
        while True:
            with contextlib.suppress(TimeoutError):
                done = wait(futures, timeout=2.0, return_when="FIRST_COMPLETED").done
                lost = [future for future in done if future.cancelled()]
                if lost:
                    raise MachineError(GONE)
                return list(done)
            if self._client.status not in ("running", "connecting"):
                raise MachineError(GONE)
            if time.monotonic() - last_message_time > TELL_EVERY_S and not self._client.nthreads():
                log(f"dask: waiting, {self._client.scheduler.address} has no worker")
                last_message_time = time.monotonic()


def _wait_until_visible(task: PartTask) -> None:
    """A network file system may hide for a while what another machine has just written."""
    marker = task.draft / FINISHED / f"{task.part_key}.json"
    until = time.monotonic() + VISIBLE_S
    while not marker.exists():
        if time.monotonic() > until:
            raise MachineError(
                f"{marker} was written by a worker and is not to be seen here: is the store on one shared file system? "
                "Finished parts are kept, run again"
            )
        time.sleep(0.5)
