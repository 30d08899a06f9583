"""The last section of docs/concepts.md does what it says: a system outside the project, run, swept, listed and read."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```\w+\n# (file|run): (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def blocks() -> dict[str, str]:
    """Name in a block's first line -> the rest of the block."""
    return {name: text for _, name, text in BLOCK.findall((ROOT / "docs" / "concepts.md").read_text())}


def shell(folder: Path, script: str) -> str:
    """What the commands print, with `python` and `lightmill` of this checkout first on the path."""
    commands = f'set -e\npython() {{ "{sys.executable}" "$@"; }}\nlightmill() {{ "{sys.executable}" -m stages.cli "$@"; }}\n'
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["sh", "-c", commands + script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_walk_through_of_a_third_system_works(blocks, tmp_path):
    system = [name for name in blocks if name.startswith("words/")]
    assert sum(blocks[name].count("\n") for name in system) < 60
    for name in (*system, "read.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(blocks[name])

    first = shell(tmp_path, blocks["first"])
    assert "2 records, 1 rejected" in first
    assert re.search(r"01 count +done +words/count/v1-\w{12}  2 records", first)

    swept = shell(tmp_path, blocks["sweep"])
    assert "sweep: 2 jobs share collect" in swept
    assert swept.count("00 collect    up to date") == 2
    assert swept.count("01 count      up to date") == 1 and swept.count("01 count      done") == 1

    listed = shell(tmp_path, blocks["list"]).splitlines()
    assert [line.partition("/v1-")[0] for line in listed] == ["words/collect", "words/count", "words/count"]
    assert shell(tmp_path, blocks["read"]) == "cat 0\nsea 2\n"

    changed = shell(tmp_path, blocks["change"])
    assert "3 items, 2 of them already there" in changed and "2 items, 1 of them already there" in changed
