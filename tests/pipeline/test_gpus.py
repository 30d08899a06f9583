"""Which GPUs a process may use: what CUDA_VISIBLE_DEVICES names, else what the driver lists."""

from __future__ import annotations

import os

import pytest

from pipeline.gpus import visible_gpus


@pytest.fixture
def smi(tmp_path, monkeypatch):
    """Puts a script in the place of nvidia-smi, and hides the variable."""

    def install(script: str) -> None:
        path = tmp_path / "nvidia-smi"
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)

    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return install


def test_the_driver_lists_gpus_by_uuid(smi):
    smi('case "$*" in *--query-gpu=uuid*) echo GPU-aa; echo GPU-bb;; *) echo "$*" >&2; exit 2;; esac')
    assert visible_gpus() == ["GPU-aa", "GPU-bb"]


@pytest.mark.parametrize("script", ["echo 'NVIDIA-SMI has failed'; exit 9", "exit 0"])
def test_a_driver_that_fails_has_no_gpus(smi, script):
    smi(script)
    assert visible_gpus() == []


def test_without_a_driver_there_are_no_gpus(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert visible_gpus() == []


@pytest.mark.parametrize(
    ("named", "gpus"),
    [
        ("3,5", ["3", "5"]),
        ("GPU-bb", ["GPU-bb"]),
        (" 0, 1 ", ["0", "1"]),
        ("", []),
        ("-1", []),
        ("2,-1,4", ["2"]),  # as CUDA reads it: nothing counts after the first that is none
    ],
)
def test_the_variable_decides_whatever_the_driver_lists(smi, monkeypatch, named, gpus):
    smi("echo GPU-aa")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
    assert visible_gpus() == gpus
