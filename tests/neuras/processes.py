"""The line as a person runs it: a process of its own, and the artifacts that it leaves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from pipeline.store import Artifact, Store

ROOT = Path(__file__).resolve().parents[2]


def run_pipeline(*words: str, timeout: float = 1200, module: str = "pipeline") -> str:
    """What ``python -m pipeline``, or another module, prints; it must succeed."""
    done = subprocess.run(
        [sys.executable, "-m", module, *words], cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def artifact(store: Path, stage: str) -> Artifact:
    """The only artifact of a stage."""
    (only,) = Store(store).artifacts(f"neuras/{stage}")
    return only
