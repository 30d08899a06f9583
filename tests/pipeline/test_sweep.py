"""A sweep knows its keys, says what its jobs share, and a job that fails takes no other with it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.store import Store
from pipeline.sweep import deal, describe, expand, label, plan_again, run_side_by_side, shared_stages

ROOT = Path(__file__).resolve().parents[2]


def run(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeline", *words, f"store={folder}/store"]
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


def keys(words: list[str]) -> dict[str, dict[str, str]]:
    return {job.name: job.keys for job in expand(words)}


def test_sweep_keys_are_known_before_it_runs(tmp_path):
    words = ["stage=train", "model=tiny,small", f"store={tmp_path}"]
    first, second = keys(words).values()
    assert list(keys(words)) == [f"stage=train model={name} store={tmp_path}" for name in ("tiny", "small")]
    assert first["train"] != second["train"]
    assert {name: key for name, key in first.items() if name != "train"} == {
        name: key for name, key in second.items() if name != "train"
    }
    assert keys([*words, f"hydra.sweep.dir={tmp_path}"]) == keys(words)  # Hydra's own settings belong to no job


SCENE = ["plan=true", "stage=scene"]
CASES = [  # from users' reports of Hydra: words, number of jobs
    (["scene.lights.count=[1,4],[1,8]"], 2),
    (["scene.lights.count=[1, 4], [1, 8]"], 2),
    (["scene.lights.count=choice([1,4],[1,8])"], 2),
    (["seed=range(0,3)"], 3),
    (["seed=0,1,0"], 2),  # the same job twice is one
    (["scene.weights={floor_single:1,floor_multi:0}"], 1),
    (["scene.weights.floor_single=1,2", "scene.weights.floor_multi=0,5"], 4),
    (["scene=released,paper", "scene.max_triangles=512"], 2),
    (["scene=released,paper", "scene.max_triangles=512,640", "seed=1,2"], 8),
    (["seed=1,2", "hydra.verbose=true"], 2),
    (["seed=1,2", "scene.max_triangles=512", "seed=3"], 1),  # of a key that comes twice the last one counts
]


@pytest.mark.parametrize(("words", "count"), CASES, ids=lambda value: " ".join(value) if isinstance(value, list) else "")
def test_commas_brackets_and_quotes_make_the_jobs_that_a_person_means(tmp_path, words, count):
    jobs = expand([*SCENE, f"store={tmp_path}", *words])
    assert len(jobs) == len({job.name for job in jobs}) == count


WRONG = [  # words, what the one line names
    (["seed=1,"], "'seed=1,' .*comma"),
    (["scene.lights.count=[1,8"], r"'scene.lights.count=\[1,8' .*do not pair"),
    (["seed="], "seed"),
    (["+note='a,b"], "note"),
    (["scene.cameras.views=4,x"], "scene.cameras.views='x'"),
    (["model=tiny,nosuch", "stage=train"], "model=nosuch is unknown"),
    (["experiment=overfit,paper_256"], "collect.ids"),
    (['+note="a,b"'], "note is unknown"),
]


@pytest.mark.parametrize(("words", "message"), WRONG, ids=lambda value: " ".join(value) if isinstance(value, list) else "")
def test_a_wrong_word_is_named_before_the_first_job(tmp_path, words, message):
    with pytest.raises(UserError, match=message) as error:
        expand([*SCENE, f"store={tmp_path}", *words])
    assert "\n" not in str(error.value)


def test_a_wrong_word_is_one_line_and_status_2(tmp_path):
    for word in ("seed=1,", "scene.lights.count=[1,8"):
        for flags in ([], ["-m"]):
            done = run(tmp_path, *SCENE, word, *flags)
            assert done.returncode == 2 and done.stderr.splitlines() == [done.stderr.strip()]
            assert done.stderr.startswith(f"error: {word!r} is not an override: ")


def test_the_same_job_twice_side_by_side(tmp_path):
    done = run(tmp_path, "-m", "system=tests.pipeline.toy", "total.steps=1,1", "jobs=2")
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(Store(tmp_path / "store").artifacts("toy/total")) == 1


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


@pytest.mark.parametrize("jobs", [[], ["jobs=2"]])
def test_a_job_whose_source_changed_after_the_sweep_began_stops(tmp_path, folders, monkeypatch, capsys, jobs):
    """The first job changes what the second one reads; side by side, what is sent to the process is another key."""
    from pipeline.__main__ import main

    good, _ = folders
    words = ["stage=collect", "collect=folder", f"collect.path={good}", "collect.licence=a,b", f"store={tmp_path}/store"]
    monkeypatch.setattr("pipeline.sweep.shared_stages", lambda jobs: {})

    def change(*arguments) -> bool:
        (good / "0.obj").write_bytes((good / "0.obj").read_bytes() + b"# changed\n")
        return False

    monkeypatch.setattr("pipeline.sweep._complete", change)  # side by side: asked once the keys are known
    if not jobs:
        monkeypatch.setattr("pipeline.sweep.run_plan", change)
    assert main([*words, *jobs, "-m"]) == 2
    streams = capsys.readouterr()
    assert "changed after the sweep began" in streams.out + streams.err


def test_a_job_that_begins_is_planned_anew_and_refused_under_other_keys(tmp_path):
    (job,) = expand(["stage=collect", "collect.per_family=1", f"store={tmp_path}"])
    assert plan_again(job.name, job.root, job.keys).keys == job.keys
    with pytest.raises(UserError, match="changed after the sweep began"):
        plan_again(job.name, job.root, {"collect": "0" * 64})


def test_gpus_are_dealt_to_the_jobs_that_run_at_a_time():
    assert deal([], 2) == [None, None]
    assert deal(["0", "1", "2", "3"], 2) == [["0", "2"], ["1", "3"]]
    assert deal(["0", "1"], 2) == [["0"], ["1"]]
    assert deal(["4", "6"], 3) == [["4"], ["6"], ["4"]]


def test_each_job_sees_its_own_gpus(tmp_path, monkeypatch):
    """Two jobs at a time on two GPUs: their processes get one each."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    show = [sys.executable, "-c", "import os, sys; sys.stdin.read(); print('sees', os.environ['CUDA_VISIBLE_DEVICES'])"]
    popen = subprocess.Popen
    monkeypatch.setattr("pipeline.sweep.subprocess.Popen", lambda words, **options: popen(show, **options))
    jobs = expand(["stage=collect", "collect.per_family=1,2", f"store={tmp_path}"])
    lines: list[str] = []
    assert run_side_by_side(jobs, 2, ["test"], lines.append) == {"1": 0, "2": 0}
    assert sorted(line.rpartition(" ")[2] for line in lines if "sees" in line) == ["3", "5"]


def test_a_launcher_of_hydra_starts_the_jobs(tmp_path):
    """Hydra's own basic one, in this process; of Slurm's nothing but its composition differs."""
    words = ["-m", "hydra/launcher=basic", "system=tests.pipeline.toy", "total.steps=1,2", f"hydra.sweep.dir={tmp_path}/runs"]
    done = run(tmp_path, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "launcher: 2 jobs by basic" in done.stdout
    assert len(Store(tmp_path / "store").artifacts("toy/total")) == 2
    failed = run(tmp_path, *words, "numbers.n=14", "+numbers.fail=[n001]", "numbers.scale=3")
    assert failed.returncode != 0 and "2 of 2 jobs failed" in failed.stderr


def test_a_job_that_a_signal_killed_has_the_status_that_a_shell_gives_it(tmp_path, monkeypatch):
    killed = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"]
    popen = subprocess.Popen
    monkeypatch.setattr("pipeline.sweep.subprocess.Popen", lambda words, **options: popen(killed, **options))
    jobs = expand(["stage=collect", "collect.per_family=1,2", f"store={tmp_path}"])
    assert run_side_by_side(jobs, 2, ["test"], print) == {"1": 137, "2": 137}


@pytest.mark.parametrize("setting", ["force", "retry"])
def test_what_all_jobs_share_is_not_forced_by_each_of_them(tmp_path, setting):
    words = ["stage=remesh", "remesh.resolution=48,49", "collect.per_family=1", f"{setting}=collect", "jobs=2", "-m"]
    done = run(tmp_path, *words)
    assert done.returncode == 2 and f"{setting}=collect: all jobs of the sweep share it" in done.stderr
