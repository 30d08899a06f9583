"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # a core for each process of tests; before anything imports torch or numpy
    os.environ.setdefault("OMP_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real meshes, scenes and references, beside the checkout or named by LIGHTMILL_SHARED_DATA."""
    path = Path(os.environ.get("LIGHTMILL_SHARED_DATA", ROOT.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no sample data at {path}: set LIGHTMILL_SHARED_DATA to a folder with meshes/, scenes/, cycles/, parity/")
    return path
