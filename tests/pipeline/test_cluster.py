"""What would break for a user of Dask: other bytes than locally, a lost worker that costs more than its part, no limits."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from pipeline import cluster
from pipeline.cluster import CLUSTERS
from pipeline.errors import MachineError, UserError
from pipeline.executor import PoolBroken
from pipeline.run import run_pipeline
from pipeline.store.files import read_sealed
from pipeline.worker import PartTask

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'lightmill[dask]'")
ROOT = Path(__file__).resolve().parents[2]


def run(store: Path, executor: dict | None = None, **sections):
    """(digests by stage, artifacts, lines) of the toy system's three stages."""
    lines: list[str] = []
    root = {"system": "tests.pipeline.toy", "stage": "total", "store": str(store), "workers": 0}
    root |= {"numbers": {}, "squares": {}, "total": {}} | sections | ({"executor": executor} if executor else {})
    artifacts = run_pipeline(root, ["test"], lines.append)["artifacts"]
    return {name: artifact.digest for name, artifact in artifacts.items()}, artifacts, lines


@pytest.fixture
def scheduler(tmp_path):
    """A real scheduler and start(count, *options) -> that many real worker processes, as ``dask worker`` starts them."""
    file = tmp_path / "scheduler.json"
    started: list[subprocess.Popen] = []

    def dask(*words: str) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(ROOT), "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1"}
        command = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(file), "--host", "127.0.0.1"]
        log = open(tmp_path / f"dask-{len(started)}.log", "wb")  # noqa: SIM115
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log, stderr=log)
        started.append(process)
        return process

    def start(count: int, *options: str) -> list[subprocess.Popen]:
        return [dask("worker", "--nthreads", "1", "--no-dashboard", *options) for _ in range(count)]

    dask("scheduler", "--port", "0", "--no-dashboard")
    until = time.monotonic() + 60
    while not file.is_file() or not file.read_bytes():
        assert time.monotonic() < until, "the scheduler did not start"
        time.sleep(0.1)
    yield json.loads(file.read_bytes())["address"], start
    for process in started:
        process.terminate()
    for process in started:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10)
        process.kill()


def test_a_killed_worker_costs_its_parts_alone_and_the_bytes_are_those_of_a_local_run(scheduler, tmp_path):
    address, start = scheduler
    workers = start(3, "--no-nanny")
    store = tmp_path / "store"
    log = tmp_path / "computed"
    victim: list[int] = []

    def kill_one_at_work() -> None:
        until = time.monotonic() + 60
        while not victim and time.monotonic() < until:
            for path in store.glob("toy/numbers/*.partial/running/*.json"):
                with contextlib.suppress(OSError, ValueError, StopIteration):
                    parents = {parent.pid for parent in psutil.Process(json.loads(path.read_bytes())["pid"]).parents()}
                    process = next(worker for worker in workers if worker.pid in parents)
                    os.kill(process.pid, signal.SIGKILL)
                    victim.append(process.pid)
                    return
            time.sleep(0.02)

    killer = threading.Thread(target=kill_one_at_work)
    killer.start()
    try:
        numbers = {"n": 24, "pause_s": 0.1, "log_to": str(log)}
        digests, artifacts, lines = run(store, {"name": "dask", "address": address}, numbers=numbers)
    finally:
        killer.join()
    assert victim, lines
    local, _, _ = run(tmp_path / "local", numbers={"n": 24})
    assert digests == local
    assert not [problem for artifact in artifacts.values() for problem in artifact.verify(deep=True)]
    computed = Counter(log.read_text().split())
    twice = [item for item, count in computed.items() if count > 1]
    assert len(computed) == 24 and max(computed.values()) <= 2
    assert 1 <= len(twice) <= 4, twice  # items of the one part that it was at


def test_limits_and_crashes_cost_an_item_not_a_dask_worker(scheduler, tmp_path, capsys):
    address, start = scheduler
    start(1)  # with Dask's nanny, as `dask worker` starts it
    numbers = {"n": 9, "crash": ["n003"], "hang": ["n004"], "limits": {"cpu_s": 0.5}}
    _, artifacts, _ = run(tmp_path / "store", {"name": "dask", "address": address}, numbers=numbers)
    assert sorted((r["item"], r["reason"]) for r in artifacts["numbers"].rejects()) == [("n003", "crash"), ("n004", "time")]
    assert len(artifacts["numbers"].rows()) == 7
    assert "n003: worker died with exit code -11; rejected as crash" in capsys.readouterr().out


def test_a_scheduler_that_dies_is_the_machine_s_fault_and_costs_no_finished_part(scheduler, tmp_path):
    address, start = scheduler
    start(1)
    log = tmp_path / "computed"

    def kill() -> None:
        until = time.monotonic() + 60
        while not list((tmp_path / "store").glob("toy/numbers/*.partial/markers/*.json")) and time.monotonic() < until:
            time.sleep(0.02)
        for process in psutil.Process().children():
            if "scheduler" in process.cmdline():
                process.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        with pytest.raises(MachineError, match="scheduler is gone .* run again"):
            run(tmp_path / "store", {"name": "dask", "address": address}, numbers={"n": 24, "pause_s": 0.3})
    finally:
        killer.join()
    done = {item for path in tmp_path.glob("store/toy/numbers/*.partial/markers/*.json") for item in read_sealed(path)["items"]}
    assert 0 < len(done) < 24
    assert run(tmp_path / "store", numbers={"n": 24, "log_to": str(log)})[0] == run(tmp_path / "local", numbers={"n": 24})[0]
    assert not done & set(log.read_text().split())


def test_a_worker_whose_processes_keep_dying_is_the_machine_s_fault(tmp_path, monkeypatch):
    """On the worker: what it raises must travel, or the run would see Dask's complaint about that instead."""

    def broken(*arguments) -> None:
        raise PoolBroken([])

    monkeypatch.setattr("pipeline.cluster._code", lambda system, stage: "code")
    monkeypatch.setattr("pipeline.cluster._pool", lambda guard: None)
    monkeypatch.setattr("pipeline.cluster.run_on", broken)
    task = PartTask("tests.pipeline.toy", "numbers", "key", None, {}, {}, tmp_path, "part", "", (), ())
    with pytest.raises(MachineError, match="worker processes keep dying") as caught:
        cluster._make_part(task, "code", "guard")
    again = pickle.loads(pickle.dumps(caught.value))
    assert (type(again), str(again)) == (MachineError, str(caught.value))


def test_a_part_that_stays_invisible_is_the_machine_s_fault(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.cluster.VISIBLE_S", 0.1)
    task = PartTask("tests.pipeline.toy", "numbers", "key", None, {}, {}, tmp_path, "part", "", (), ())
    with pytest.raises(MachineError, match="one shared file system"):
        cluster._wait_until_visible(task)


def test_own_cluster(tmp_path):
    """``executor.cluster=local``: workers are started for the run and end with it."""
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    executor = {"name": "dask", "cluster": "local", "workers": 2, "options": {"threads_per_worker": 1}}
    digests, _, lines = run(tmp_path / "store", executor)
    assert digests == run(tmp_path / "local")[0]
    assert any(line.startswith("dask: scheduler tcp://127.0.0.1") for line in lines)
    after = {process.pid for process in psutil.Process().children(recursive=True)}
    assert not [pid for pid in after - before if "multiprocessing.spawn" in " ".join(psutil.Process(pid).cmdline())]


def test_a_job_queue_starts_the_workers_and_ends_them(tmp_path, monkeypatch):
    """dask_jobqueue's own class, with an ``sbatch`` that runs the job script here at once."""
    for name, script in (
        # a queue keeps a copy of the script, which may be gone when the job starts
        (
            "sbatch",
            f'cp "$1" {tmp_path}/job.sh; setsid bash {tmp_path}/job.sh > {tmp_path}/job.log 2>&1 & '
            f'echo $! > {tmp_path}/job; echo "Submitted batch job $!"',
        ),
        ("scancel", f'echo "$1" > {tmp_path}/cancelled; kill -- "-$1"'),
    ):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/bash\n{script}\n")
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    options = {"cores": 1, "memory": "2GB", "walltime": "00:10:00", "interface": "lo", "log_directory": str(tmp_path)}
    digests, _, _ = run(tmp_path / "store", {"name": "dask", "cluster": "slurm", "options": options})
    assert digests == run(tmp_path / "local")[0]
    assert (tmp_path / "cancelled").read_text() == (tmp_path / "job").read_text()


@pytest.mark.parametrize(
    ("executor", "message"),
    [
        ({"name": "dask"}, "give executor.address"),
        ({"name": "dask", "cluster": "slurrm"}, "did you mean 'slurm'"),
        ({"name": "dask", "adress": "tcp://x"}, "did you mean 'address'"),
        ({"name": "dask", "address": "127.0.0.1:1"}, "no Dask scheduler answers at executor.address=127.0.0.1:1"),
        ({"name": "dask", "cluster": "slurm", "options": {"cores": 1}}, "executor.options do not suit SLURMCluster.* memory"),
    ],
)
def test_bad_settings_are_named(tmp_path, monkeypatch, executor, message):
    monkeypatch.setattr("pipeline.cluster.CONNECT", "1s")
    with pytest.raises(UserError, match=message):
        run(tmp_path / "store", executor)


def test_every_job_queue_of_the_list_is_one(tmp_path):
    import dask_jobqueue
    import distributed

    modules = {"distributed": distributed, "dask_jobqueue": dask_jobqueue}
    for name, (module, kind) in CLUSTERS.items():
        assert module not in modules or hasattr(modules[module], kind), name
    assert set(CLUSTERS) - {name for name, (module, _) in CLUSTERS.items() if module in modules} == {"kubernetes"}
