"""Many processes follow the run of one, and can take it over from one another."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from model.renderformer import checkpoint
from model.renderformer.training import BEST, LAST
from model.training.logs import LOG
from tests.model.ranks import STEPS

RANKS = Path(__file__).with_name("ranks.py")
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
RESTARTING = [*TORCHRUN, "--max-restarts=1"]  # as docs/training.md advises: torch's own threads aborted a process once in CI


def run(*words: object, start: list[str]) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"}
    return subprocess.run([*start, str(RANKS), *map(str, words)], capture_output=True, text=True, env=environment)


def told(process: subprocess.CompletedProcess) -> str:
    """What the processes of a run said themselves: torchrun's own table would fill the end of a report."""
    return process.stderr.split("ChildFailedError")[0][-4000:]


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> tuple[Path, Path]:
    """Trainings alone; and half by two DDP processes with half the batch each, killed, and the rest by two FSDP processes."""
    folder = tmp_path_factory.mktemp("runs")
    alone, shared = folder / "alone", folder / "shared"
    assert run(alone, "ddp", start=[sys.executable]).returncode == 0
    assert run(shared, "ddp", "die", start=TORCHRUN).returncode != 0
    assert [rows(shared / network)[-1]["step"] for network in STEPS] == [dies_at for dies_at, _ in STEPS.values()]
    resumed = run(shared, "fsdp", start=RESTARTING)
    assert resumed.returncode == 0, told(resumed)
    if "exitcode" in resumed.stderr:
        warnings.warn(f"a process died and the run was restarted:\n{told(resumed)}", stacklevel=1)
    return alone, shared


@pytest.mark.parametrize("network", STEPS)
def test_two_processes_follow_one_and_share_its_checkpoints(network, runs):
    alone, shared = (folder / network for folder in runs)
    one, two = rows(alone), rows(shared)
    assert [row["step"] for row in one] == [row["step"] for row in two]
    for a, b in zip(one, two, strict=True):
        for name in ("loss", "validation_log_error"):
            assert b.get(name) == pytest.approx(a.get(name), abs=1e-4) if name in a else name not in b
    for name in (LAST, BEST):
        a, b = (checkpoint.load(folder / name)[0].state_dict() for folder in (alone, shared))
        assert all((a[key] - b[key]).abs().max() < 1e-3 for key in a)
    assert torch.load(shared / "training.pt", weights_only=True)["plain"]["step"] == STEPS[network][1]
