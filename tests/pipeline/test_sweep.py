"""A sweep knows its keys, says what its jobs share, and a job that fails takes no other with it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.hydra_config import compose
from pipeline.store import Store
from pipeline.sweep import (
    JOB_VARIABLE,
    KEYS_VARIABLE,
    check_keys,
    describe,
    expand,
    keys_of,
    label,
    plan_of,
    planned_keys,
    run_side_by_side,
    shared_stages,
    sweep_keys,
)

ROOT = Path(__file__).resolve().parents[2]


def run(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeline", *words, f"store={folder}/store"]
    command += [f"hydra.run.dir={folder}/runs", f"hydra.sweep.dir={folder}/runs"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | variables)


@pytest.fixture
def folders(tmp_path) -> tuple[Path, Path]:
    """One with enough different meshes for three splits, one with a single mesh."""
    good, few = tmp_path / "good", tmp_path / "few"
    good.mkdir()
    few.mkdir()
    for number in range(6):
        corners = [(0, 0, 0), (1 + number, 0, 0), (0, 1, 0), (0, 0, 1 + number**2)]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4"]
        (good / f"{number}.obj").write_text("\n".join(lines) + "\n")
    (few / "0.obj").write_bytes((good / "0.obj").read_bytes())
    return good, few


def test_sweep_keys_are_known_before_it_runs(tmp_path):
    words = ["stage=train", "model=tiny,small", f"store={tmp_path}"]
    keys = sweep_keys(words)
    first, second = keys.values()
    assert list(keys) == [f"stage=train model={name} store={tmp_path}" for name in ("tiny", "small")]
    assert first["train"] != second["train"]
    assert {name: key for name, key in first.items() if name != "train"} == {
        name: key for name, key in second.items() if name != "train"
    }
    assert sweep_keys([*words, f"hydra.sweep.dir={tmp_path}"]) == keys  # Hydra leaves its own settings out of a job's name too


def test_an_override_that_only_the_swept_group_knows(tmp_path):
    (tmp_path / "ids.json").write_text('["0123456789abcdef0123456789abcdef"]')
    sweep = "experiment=table1/full,table1/no_dpt"
    done = run(tmp_path, "-m", sweep, f"collect.ids_file={tmp_path}/ids.json", "stage=collect", "plan=true")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("== ") == 2 and done.stdout.count("00 collect") == 2
    bad = run(tmp_path, "-m", sweep, "collect.ids_fil=x", "stage=collect", "plan=true")
    assert bad.returncode == 2 and bad.stderr.startswith("error: collect.ids_fil is unknown") and "Traceback" not in bad.stderr


def test_what_jobs_share_is_said(tmp_path):
    jobs = expand(["stage=evaluate", "model=tiny,small", f"store={tmp_path}"])
    assert list(shared_stages(jobs)) == ["collect", "remesh", "decimate", "scene", "render", "shard"]
    assert describe(jobs) == (
        f"sweep: 2 jobs share collect, remesh, decimate, scene, render, shard (shard {jobs[0].plan['shard'].key[:12]}); "
        "artifacts of their own: train 2, evaluate 2"
    )
    assert [label(job, jobs) for job in jobs] == ["tiny", "small"]
    apart = expand(["stage=collect", "collect.per_family=1,2", f"store={tmp_path}"])
    assert describe(apart) == "sweep: 2 jobs; artifacts of their own: collect 2"


def test_a_failed_job_leaves_the_others_and_is_taken_up_again(tmp_path, folders):
    good, few = folders
    words = ["stage=collect", "collect=folder", f"collect.path={few},{good}", "jobs=2", "-m"]
    done = run(tmp_path, *words)
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"error: 1 of 2 jobs failed: {few}; the others are done")
    assert f"{good} " in done.stdout and len(Store(tmp_path / "store").artifacts("collect")) == 1
    for path in good.iterdir():
        (few / path.name).write_bytes(path.read_bytes() + b"v 9 9 9\n")  # another source, so another artifact
    again = run(tmp_path, *words)
    assert again.returncode == 0, again.stdout + again.stderr
    assert again.stdout.count("up to date") == 1 and len(Store(tmp_path / "store").artifacts("collect")) == 2


def test_a_job_whose_config_is_not_the_planned_one_stops(tmp_path):
    keys = planned_keys({f"stage=collect collect.per_family=1 store={tmp_path}/store": {"collect": "0" * 64}})
    done = run(tmp_path, "stage=collect", "collect.per_family=1", **{KEYS_VARIABLE: keys, JOB_VARIABLE: "1"})
    assert done.returncode == 2 and "changed after the sweep began" in done.stderr
    assert not Store(tmp_path / "store").artifacts()


def test_a_sweep_of_thousands_of_jobs_starts_processes_and_knows_all_their_keys(tmp_path, monkeypatch):
    """All keys go into one variable of the environment, and Linux refuses those of 128 KiB."""
    jobs = {
        f"stage=collect collect.per_family={number} store={tmp_path}": {"collect": f"{number:064}"} for number in range(8000)
    }
    monkeypatch.setenv(KEYS_VARIABLE, planned_keys(jobs))
    subprocess.run(["true"], check=True)
    root = compose(["stage=collect", "collect.per_family=1", f"store={tmp_path}"])
    for task in list(jobs)[::1000]:
        with pytest.raises(UserError, match="changed after the sweep began"):
            check_keys(task, root)
    check_keys("stage=collect collect.per_family=9000", root)  # no job of the sweep
    task = list(jobs)[1]
    monkeypatch.setenv(KEYS_VARIABLE, planned_keys(jobs | {task: keys_of(plan_of(root))}))
    check_keys(task, root)
    with pytest.raises(UserError, match="8001 jobs: at most 8000"):
        planned_keys(jobs | {"more": {}})


def test_a_job_that_a_signal_killed_has_the_status_that_a_shell_gives_it(tmp_path, monkeypatch):
    killed = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"]
    popen = subprocess.Popen
    monkeypatch.setattr("pipeline.sweep.subprocess.Popen", lambda words, **options: popen(killed, **options))
    jobs = expand(["stage=collect", "collect.per_family=1,2", f"store={tmp_path}"])
    assert run_side_by_side(jobs, 2, [], ["test"], print) == {"1": 137, "2": 137}


@pytest.mark.parametrize("setting", ["force", "retry"])
def test_what_all_jobs_share_is_not_forced_by_each_of_them(tmp_path, setting):
    words = ["stage=remesh", "remesh.resolution=48,49", "collect.per_family=1", f"{setting}=collect", "jobs=2", "-m"]
    done = run(tmp_path, *words)
    assert done.returncode == 2 and f"{setting}=collect: all jobs of the sweep share it" in done.stderr
