"""What a run meets on a bad day, in real processes: kills, full and read-only disks, a jumping clock, a second runner, Ctrl-C.

After each: what is committed is right, what was finished is not made again, the next run completes, and the message says what
happened. checks/kills.py does the same hundreds of times.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest

from checks import kills
from pipeline.errors import INTERRUPTED, ItemsFailed, MachineError, TooManyRejects
from pipeline.store import Store

ROOT = Path(__file__).resolve().parents[2]


def command(store: Path, stage: str = "total", workers: int = 2, **sections: dict) -> list[str]:
    root = {"system": "tests.pipeline.toy", "stage": stage, "store": str(store), "workers": workers}
    return [
        sys.executable,
        "-m",
        "tests.pipeline.toy_main",
        json.dumps(root | {"numbers": {}, "squares": {}, "total": {}} | sections),
    ]


def start(words: list[str], **environment: str) -> subprocess.Popen:
    """A process in a group of its own, as a terminal makes it."""
    return subprocess.Popen(
        words, cwd=ROOT, env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip


def finish(process: subprocess.Popen) -> tuple[int, str]:
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def wait_for(ready, process: subprocess.Popen) -> None:
    while not ready():
        assert process.poll() is None, f"it ended too early: {process.communicate()[0]}"
        time.sleep(0.01)


def at_work(store: Path, item: str):
    """Whether a worker has announced the item."""

    def seen() -> bool:
        for path in store.glob("toy/*/*.partial/running/*.json"):
            with contextlib.suppress(FileNotFoundError):  # the part was finished meanwhile
                if f'"{item}"' in path.read_text():
                    return True
        return False

    return seen


def digests(store: Path) -> dict[str, str]:
    """Of artifacts that verify to the last byte."""
    artifacts = Store(store).artifacts()
    assert not [problem for artifact in artifacts for problem in artifact.verify(deep=True)]
    assert not Store(store).drafts()
    return {artifact.stage: artifact.digest for artifact in artifacts}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """undisturbed(n) -> digests of a run that nothing happened to."""
    folder = tmp_path_factory.mktemp("undisturbed")

    def run_digests(n: int) -> dict[str, str]:
        if not (folder / str(n)).exists():
            assert finish(start(command(folder / str(n), workers=0, numbers={"n": n})))[0] == 0
        return digests(folder / str(n))

    return run_digests


@pytest.mark.slow
def test_a_short_campaign_of_kills_ends_with_the_digests_of_an_undisturbed_run(capsys):
    assert kills.main(["--what", "synthetic", "--kills", "6", "--seed", "3"]) == 0
    assert "0 finished parts made again" in capsys.readouterr().out


def test_a_campaign_sees_what_differs(tmp_path):
    for name, n in (("calm", 6), ("other", 8)):
        assert finish(start(command(tmp_path / name, workers=0, numbers={"n": n})))[0] == 0
    stages = ("toy/numbers", "toy/squares", "toy/total")
    assert kills.differences(tmp_path / "calm", tmp_path / "calm", stages) == []
    differences = kills.differences(tmp_path / "calm", tmp_path / "other", stages)
    assert [line.partition(" ")[0] for line in differences] == ["toy/numbers:", "toy/squares:", "toy/total:"]
    path = next((tmp_path / "calm").glob("toy/squares/*/parts/*.tar"))
    path.write_bytes(path.read_bytes()[:-1])
    assert "bytes, not" in kills.differences(tmp_path / "calm", tmp_path / "calm", stages)[0]


def test_workers_killed_while_they_start_are_replaced(tmp_path, undisturbed):
    process = start(command(tmp_path, workers=1, numbers={"n": 12}))
    killed: set[int] = set()
    while len(killed) < 3 and process.poll() is None:
        for child in psutil.Process(process.pid).children():
            if child.pid not in killed and len(killed) < 3 and "spawn_main" in " ".join(child.cmdline()):
                child.kill()
                killed.add(child.pid)
        time.sleep(0.01)
    status, output = finish(process)
    assert status == 0, output
    assert "starting new ones" in output and len(killed) == 3
    assert digests(tmp_path) == undisturbed(12)


def test_an_item_that_sleeps_for_ever_is_rejected_alone(tmp_path):
    words = command(tmp_path, "numbers", numbers={"n": 6, "sleep": ["n003"], "limits": {"wall_s": 0.5}})
    status, output = finish(start(words))
    assert status == 0
    assert output.count("n003: over 0.5 s on the clock") == 2
    (reject,) = Store(tmp_path).resolve("numbers").rejects()
    assert (reject["item"], reject["reason"], reject["machine"], reject["limit"]) == ("n003", "time", True, {"wall_s": 0.5})


def test_a_raised_limit_tries_again_what_the_lower_one_rejected_and_nothing_else(tmp_path):
    """In an unfinished artifact. The crash beside it stays: no limit was in its way."""
    log = tmp_path / "computed"

    def run(**numbers) -> tuple[int, str, list[str]]:
        log.write_text("")
        status, output = finish(start(command(tmp_path, "numbers", numbers={"n": 6, "log_to": str(log), **numbers})))
        return status, output, sorted(log.read_text().split())

    status, output, _ = run(sleep=["n003"], crash=["n005"], limits={"wall_s": 0.5}, max_reject_share=0)
    assert status == TooManyRejects.status and "1 crash, 1 time" in output
    for limits in ({"wall_s": 0.5}, {"wall_s": 0.4, "cpu_s": 9999, "memory_gb": 99}):  # as before; none that it ran into
        assert run(limits=limits, max_reject_share=0)[::2] == (TooManyRejects.status, [])
    status, output, computed = run(limits={"wall_s": 100}, sleep=["n001"])  # n001 lies in the same part and is kept
    assert (status, computed) == (0, ["n003"]), output
    assert "1 item(s) that lower limits rejected before are tried again" in output and "5 of them already there" in output
    artifact = Store(tmp_path).resolve("numbers")
    assert artifact.ids() == ["n000", "n002", "n004", "n001", "n003"] and artifact.verify(deep=True) == []
    assert [(reject["item"], reject["reason"]) for reject in artifact.rejects()] == [("n005", "crash")]


def test_what_the_machine_rejected_is_told_and_can_be_tried_again(tmp_path, undisturbed):
    """In a committed artifact: the rest of it is taken over, whole parts by hard link."""
    log = tmp_path / "computed"

    def run(*retry: str, **numbers) -> tuple[int, str, list[str]]:
        log.write_text("")
        words = command(tmp_path, "numbers", retry=retry, numbers={"n": 12, "log_to": str(log), **numbers})
        status, output = finish(start(words))
        return status, output, sorted(log.read_text().split())

    assert run(crash=["n002"], sleep=["n003"], limits={"wall_s": 0.5})[0] == 0
    inodes = {path.stat().st_ino for path in tmp_path.glob("toy/numbers/*/parts/*.tar")}
    status, output, computed = run()
    assert (status, computed) == (0, [])
    assert "up to date" in output and "note: the machine rejected 2 of its items (1 crash, 1 time)" in output
    assert " retry=numbers, numbers.limits.wall_s=N allows more than 0.5" in output
    status, output, computed = run("numbers", sleep=["n003"], limits={"wall_s": 0.5})  # n002 goes well now
    assert (status, set(computed)) == (0, {"n002", "n003"}) and "DIFFERENT from before" in output
    assert len(inodes & {path.stat().st_ino for path in tmp_path.glob("toy/numbers/v1-*/parts/*.tar")}) == 2  # of four
    status, output, computed = run("numbers")
    assert (status, computed) == (0, ["n003"])
    assert digests(tmp_path)["numbers"] == undisturbed(12)["numbers"]
    status, output, computed = run("numbers")
    assert (status, computed) == (0, []) and "up to date" in output and "note" not in output


def test_a_kill_between_the_tries_under_two_limits_costs_nothing_that_was_finished(tmp_path, undisturbed):
    log = tmp_path / "computed"
    numbers = {"n": 6, "log_to": str(log), "max_reject_share": 0}
    words = command(tmp_path, "numbers", workers=1, numbers=numbers | {"sleep": ["n003"], "limits": {"wall_s": 0.5}})
    assert finish(start(words))[0] == TooManyRejects.status
    process = start(command(tmp_path, "numbers", workers=1, numbers=numbers | {"sleep": ["n003"]}))
    wait_for(at_work(tmp_path, "n003"), process)
    process.kill()
    process.wait()
    log.write_text("")
    assert finish(start(command(tmp_path, numbers=numbers)))[0] == 0
    assert log.read_text().split() == ["n003"]
    assert digests(tmp_path) == undisturbed(6)


@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_leaves_nobody_working_and_loses_nothing(tmp_path, undisturbed, times):
    process = start(command(tmp_path, numbers={"n": 12, "stubborn": ["n006"]}))
    wait_for(at_work(tmp_path, "n006"), process)
    family = psutil.Process(process.pid).children(recursive=True)
    for _ in range(times):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(0.2)
    status, output = finish(process)
    assert status == INTERRUPTED
    assert "Traceback" not in output and "interrupted: stopping (Ctrl-C again: at once)" in output
    if times == 1:
        assert "the same command continues" in output
    assert not psutil.wait_procs(family, timeout=30)[1]
    assert finish(start(command(tmp_path, numbers={"n": 12})))[0] == 0
    assert digests(tmp_path) == undisturbed(12)


JUMPING = """
import time
true, began = time.time, time.monotonic()
time.time = lambda: true() + [0, 7200, -86400, 10**7][int((time.monotonic() - began) / 0.4) % 4]
"""


def test_a_clock_that_jumps_changes_nothing(tmp_path, undisturbed):
    """Every process sees its clock jump by hours and back, at moments of its own."""
    (tmp_path / "clock").mkdir()
    (tmp_path / "clock" / "sitecustomize.py").write_text(JUMPING)
    path = os.pathsep.join([str(tmp_path / "clock"), str(ROOT)])
    store = tmp_path / "store"
    words = command(store, numbers={"n": 12, "pause_s": 0.3}, squares={"log_to": str(tmp_path / "computed")})
    processes = [start(words, PYTHONPATH=path) for _ in range(2)]
    for process in processes:
        status, output = finish(process)
        assert status == 0, output
        assert "trying it once more" not in output
    assert digests(store) == undisturbed(12)
    assert len((tmp_path / "computed").read_text().split()) == 12


def test_two_runners_make_it_once(tmp_path, undisturbed):
    store = tmp_path / "store"
    words = command(store, numbers={"n": 12, "pause_s": 0.1}, squares={"log_to": str(tmp_path / "computed")})
    outputs = []
    for process in [start(words) for _ in range(3)]:
        status, output = finish(process)
        assert status == 0, output
        outputs.append(output)
    assert "waiting: process" in "".join(outputs)
    assert len((tmp_path / "computed").read_text().split()) == 12
    assert digests(store) == undisturbed(12)


def test_two_runners_that_both_believe_to_hold_the_claim_corrupt_nothing(tmp_path, undisturbed):
    """As on a file system without locks, or after a pause of minutes: the second is at work in the first one's draft."""
    words = command(tmp_path, numbers={"n": 12, "pause_s": 0.15}, squares={"finish_s": 0.3})
    first = start(words)
    wait_for(at_work(tmp_path, "n002"), first)
    for claim in tmp_path.glob("toy/numbers/.*.claim"):
        claim.unlink()
    second = start(words)
    for process in (first, second):
        status, output = finish(process)
        assert status in (0, MachineError.status), output
        assert "Traceback" not in output
    assert finish(start(words))[0] == 0
    assert digests(tmp_path) == undisturbed(12)


def test_a_runner_that_died_holds_nothing_up(tmp_path):
    process = start(command(tmp_path, numbers={"n": 12, "sleep": ["n006"]}))
    wait_for(at_work(tmp_path, "n006"), process)
    process.kill()
    process.wait()
    assert list(tmp_path.glob("toy/numbers/.*.claim"))
    status, output = finish(start(command(tmp_path, numbers={"n": 12})))
    assert status == 0 and "waiting" not in output


# -- disks


def on_a_small_disk(folder: Path, script: str) -> dict:
    """Run ``script`` with ``disk`` (a tmpfs of 4 MB), ``run`` and ``sh`` defined; returns the ``found`` that it fills.

    The mount lives in a namespace of its own, so this needs no rights where Linux allows user namespaces.
    """
    (folder / "disk").mkdir()
    preamble = f"""
    import json, os, subprocess, sys
    from pathlib import Path
    sys.path.insert(0, {str(ROOT)!r})
    from tests.pipeline.test_faults import command, digests, finish, start
    from pipeline.store import Store
    disk, found = Path({str(folder / "disk")!r}), {{}}
    def sh(*words):
        done = subprocess.run(words, capture_output=True, text=True, cwd={str(ROOT)!r})
        return done.returncode, done.stdout + done.stderr
    def run(**sections):
        return finish(start(command(disk / "store", **sections)))
    """
    ending = "print(json.dumps(found))"
    (folder / "script.py").write_text("\n".join(textwrap.dedent(part) for part in (preamble, script, ending)))
    mount = f"mount -t tmpfs -o size=4m tmpfs {folder / 'disk'}"
    inside = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    try:
        tried = subprocess.run([*inside, mount], capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("no unshare here: a small disk cannot be made")
    if tried.returncode:
        pytest.skip(f"this machine lets nobody mount a small disk: {tried.stderr.strip()}")
    done = subprocess.run([*inside, f"{mount} && exec {sys.executable} {folder / 'script.py'}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_full_disk_stops_the_run_and_the_next_one_goes_on(tmp_path):
    """60 items of 32 kB do not fit beside the ballast, and do once it is gone."""
    outcome = on_a_small_disk(
        tmp_path,
        """
        (disk / "ballast").write_bytes(bytes(3 << 20))
        numbers = {"n": 60, "payload_kb": 32, "pause_s": 0.01}
        found["full"] = run(numbers=numbers)
        parts = {path.name: path.stat().st_ino for path in disk.glob("store/toy/numbers/*.partial/parts/*.tar")}
        found["parts"] = len(parts)
        found["marked"] = len(list(disk.glob("store/toy/numbers/*.partial/markers/[!.]*.json")))
        found["left over"] = [path.name for path in disk.glob("store/**/.*.tmp*")]  # they would take room
        found["again"] = run(numbers=numbers)
        (disk / "ballast").unlink()
        found["room"] = run(numbers=numbers)
        now = {path.name: path.stat().st_ino for path in disk.glob("store/toy/numbers/v1-*/parts/*.tar")}
        found["kept"] = sum(now.get(name) == inode for name, inode in parts.items())
        digests(disk / "store")
        """,
    )
    for attempt in ("full", "again"):
        status, output = outcome[attempt]
        assert status == MachineError.status, output
        assert "No space left on device" in output and "make room" in output and "Traceback" not in output
    assert outcome["marked"] > 0 and outcome["left over"] == []
    assert outcome["room"][0] == 0
    assert outcome["kept"] >= outcome["marked"]


def test_a_read_only_store_can_be_read_and_says_why_it_cannot_be_written(tmp_path):
    outcome = on_a_small_disk(
        tmp_path,
        """
        run(stage="squares")
        sh("mount", "-o", "remount,ro", str(disk))
        found["made"] = run(stage="squares")
        found["to make"] = run()
        lightmill = [sys.executable, "-m", "stages.cli"]
        for word in ("status", "ls", "verify"):
            found[word] = sh(*lightmill, word, "--store", str(disk / "store"))
        sh("mount", "-o", "remount,rw", str(disk))
        found["writable"] = run()
        """,
    )
    assert outcome["made"][0] == 0 and outcome["made"][1].count("up to date") == 2
    status, output = outcome["to make"]
    assert status == MachineError.status
    assert "Read-only file system" in output and "Traceback" not in output
    assert [outcome[word][0] for word in ("status", "ls", "verify")] == [0, 0, 0], outcome
    assert outcome["writable"][0] == 0


# -- exit codes and logs


def test_each_kind_of_trouble_has_its_exit_status(tmp_path):
    def status(**sections: dict) -> tuple[int, str]:
        return finish(start(command(tmp_path, workers=0, **sections)))

    assert status(numbers={"nn": 3})[0] == 2
    code, output = status(numbers={"n": 15, "max_reject_share": 0.01})
    assert code == TooManyRejects.status and "1 unlucky" in output
    code, output = status(numbers={"n": 7, "fail": ["n003"]})
    assert code == ItemsFailed.status and "RuntimeError: a bug" in output
    log = Path(output.partition("Its traceback: ")[2].partition(" (")[0])
    assert "n003: " in log.read_text() and "RuntimeError: a bug" in log.read_text()
    code, output = status(numbers={"n": 7}, squares={"bug": "value"})  # a ValueError is no user's fault by itself
    assert code == 1 and "Traceback" in output and "in stage squares" in output
    code, output = status(numbers={"n": 7}, squares={"bug": "file"})
    assert code == MachineError.status and "Traceback" not in output
    assert "cannot be read or written: No such file or directory" in output and "nowhere" in output
    assert status(numbers={"n": 7})[0] == 0
