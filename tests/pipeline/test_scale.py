"""bench/scale.py: what it says that data costs, and how much memory it says that steps take."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench import scale
from pipeline.hydra_config import compose
from pipeline.run import run_pipeline
from pipeline.store import Store


def make(folder: Path, **sections: dict) -> dict:
    root = {"system": "tests.pipeline.toy", "stage": "squares", "store": str(folder), "workers": 0}
    return run_pipeline(root | {"numbers": {}, "squares": {}, "total": {}} | sections, ["test"], lambda text: None)["artifacts"]


def test_logs_give_each_item_s_time_once_whatever_it_is_called(tmp_path):
    lines = [
        "3 items of collect train: process 1 on here",
        "collect opened: 9.000 s, 9.000 s of CPU",
        "a/b c.obj: 2.000 s, 1.000 s of CPU, 2 record(s)",
        "d: 1.000 s, 8.000 s of CPU, 1 record(s)",  # its worker died then
        "d: 1.000 s, 3.000 s of CPU, 1 record(s)",
        "e: 0.100 s, 2.000 s of CPU, rejected, dark: no light, taken over it says",
        "f: 0.100 s, 7.000 s of CPU, FAILED",
        "g: 0.000 s, 0.500 s of CPU, 1 record(s), taken over from v1-0123456789ab",
        "h: 0.000 s, 0.500 s of CPU, rejected, dark: no light, taken over",
        "finished: 3 records, 1 rejects, 10 bytes",
    ]
    (tmp_path / "part.log").write_text("".join(f"2026-01-01 10:00:00 {line}\n" for line in lines))
    assert scale.seconds_per_item(tmp_path) == (2.0, 3)


def test_what_an_item_costs_is_counted_by_those_that_are_kept(tmp_path):
    """13 of 14 numbers and their squares: the rejected one's time is in it, a card that only the artifact has is not."""
    artifacts = make(tmp_path, numbers={"n": 14})
    for name, tried in (("numbers", 14), ("squares", 13)):
        artifact = artifacts[name]
        costs = scale.per_item(artifact)
        mean, timed = scale.seconds_per_item(artifact.path / "logs")
        assert (costs.kept, costs.measured, timed) == (13, tried, tried)
        assert costs.seconds == pytest.approx(mean * tried / 13)
        assert costs.bytes == sum(path.stat().st_size for path in (artifact.path / "parts").iterdir()) / 13
    assert (artifacts["squares"].path / "files" / "card.txt").is_file()


def test_an_artifact_that_tells_no_times_is_named(tmp_path):
    artifact = make(tmp_path)["squares"]
    for path in (artifact.path / "logs").iterdir():
        path.write_text("2026-01-01 10:00:00 n001: 1.0 s, 1 record(s)\n")  # as logs were before they told CPU time
    with pytest.raises(SystemExit, match=f"squares/{artifact.path.name} tells no item's CPU time .* force=squares"):
        scale.per_item(artifact)
    with pytest.raises(SystemExit, match="no artifact of collect"):
        scale.measured(Store(tmp_path))


def test_the_sample_is_rendered_as_the_paper_s_first_phase_is(tmp_path):
    sample = scale.sample_config(tmp_path, scale.parsed([]).sample_scenes)
    paper = compose(["experiment=paper_256", "collect.ids=[a]"])
    for stage in ("remesh", "decimate", "render", "shard"):
        assert sample[stage] == paper[stage]
    assert sample["scene"] | {"count": None} == paper["scene"] | {"count": None}
    assert (sample["collect"]["name"], sample["scene"]["count"]["train"]) == ("procedural", 12)


def test_memory_is_each_process_s_own(tmp_path):
    """A small process with a large child and a large parent."""
    hoard = bytearray(b"x") * (400 << 20)
    child = "import time; hoard = bytearray(b'x') * (150 << 20); time.sleep(1.5)"
    script = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    began = time.monotonic()
    memory = scale.watch_memory(subprocess.Popen([sys.executable, "-c", script]))
    assert time.monotonic() - began > 1.5 and hoard
    assert memory.own < 60
    assert 150 < memory.worker < 230
    assert memory.worker - 20 < memory.all < memory.own + memory.worker


def test_the_store_s_table(tmp_path, capsys):
    scale.bench_store(tmp_path, 3000)
    table = capsys.readouterr().out.splitlines()
    (resume,) = [line.split() for line in table if line.split()[0] == "resume"]
    own, worker, together = map(float, resume[3:])
    assert 20 < worker < 300 and together < own + 2 * worker + 100
    assert not (tmp_path / "million").exists()
