"""``lightmill status``: what a run does and why it ended, from the store alone; and the log that each part leaves."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from bench.scale import seconds_per_item
from pipeline import commands
from pipeline.errors import ItemsFailed
from pipeline.store import Store
from tests.pipeline.test_faults import at_work, command, finish, start, wait_for


def ask(capsys, store: Path, *words: str) -> str:
    parser = argparse.ArgumentParser()
    commands.add_commands(parser.add_subparsers(), "lightmill")
    arguments = parser.parse_args(["status", *words, "--store", str(store)])
    assert arguments.function(arguments) == 0
    return capsys.readouterr().out


def test_a_run_can_be_watched_and_its_end_be_read(tmp_path, capsys):
    store = tmp_path / "store"
    process = start(command(store, workers=1, numbers={"n": 30, "pause_s": 0.05, "sleep": ["n023"]}))
    wait_for(at_work(store, "n023"), process)
    running = ask(capsys, store)
    assert f"running, process {process.pid} on" in running
    assert "stages    numbers running, squares to come, total to come" in running
    assert "now       n023 for" in running
    (state,) = json.loads(ask(capsys, store, "--json"))
    assert (state["parts"], state["total"]) == (8, 30)
    assert 4 <= state["parts_done"] <= 6 and 0 < state["done"] <= 24
    assert "/s, " in running and "left" in running
    process.kill()
    process.wait()
    dead = ask(capsys, store, "numbers")
    assert "ended without a word" in dead and "go on     " in dead
    assert ask(capsys, store, "squares").startswith("nothing is running or unfinished")
    assert finish(start(command(store, workers=0, numbers={"n": 30})))[0] == 0
    assert "nothing is running or unfinished" in ask(capsys, store)


def test_failures_are_named_with_their_logs_and_rejects_with_their_reasons(tmp_path, capsys):
    status, _ = finish(start(command(tmp_path, workers=2, numbers={"n": 15, "fail": ["n002", "n003"]})))
    assert status == ItemsFailed.status
    output = ask(capsys, tmp_path)
    assert f"stopped with status {ItemsFailed.status}" in output
    assert "rejects   1 unlucky" in output
    for item in ("n002", "n003"):
        (line,) = [line for line in output.splitlines() if line.strip().startswith(f"failed    {item}: RuntimeError: a bug")]
        log = Path(line.rpartition("(")[2].rstrip(")"))
        assert f"{item}: " in log.read_text() and "Traceback" in log.read_text()


def test_every_part_leaves_a_log_outside_the_digest(tmp_path):
    words = command(tmp_path / "a", workers=2, numbers={"n": 15, "crash": ["n005"]})
    assert finish(start(words))[0] == 0
    artifact = Store(tmp_path / "a").resolve("numbers")
    parts = artifact.manifest["outputs"]["parts"]
    assert sorted(path.stem for path in (artifact.path / "logs").iterdir()) == sorted(p["part_key"][:16] for p in parts)
    (crashed,) = [p for p in parts if "n005" in p["items"]]
    log = (artifact.path / "logs" / f"{crashed['part_key'][:16]}.log").read_text()
    assert "trying it once more, alone" in log and "rejected as crash" in log
    assert "n007: " in log and "1 record(s)" in log and "finished: 3 records, 1 rejects" in log
    for path in (artifact.path / "logs").iterdir():
        path.unlink()
    assert artifact.verify(deep=True) == []


def test_logs_tell_the_time_of_items_from_that_of_opening(tmp_path):
    assert finish(start(command(tmp_path, workers=1, numbers={"n": 15, "pause_s": 0.05})))[0] == 0
    logs = Store(tmp_path).resolve("numbers").path / "logs"
    seconds, items = seconds_per_item(logs)
    assert items == 15 and seconds < 0.05  # waiting is no work
    lines = [line for path in logs.iterdir() for line in path.read_text().splitlines()]
    assert len([line for line in lines if "numbers opened: 0." in line]) == 1
    assert all(float(line.split(": ")[1].split()[0]) >= 0.05 for line in lines if line.endswith("1 record(s)"))
