"""Which Mitsuba variant renders: trials, choices, and a GPU for each worker."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from pipeline.errors import UserError
from stages.graphics.mitsuba import backend as backends

SCALAR = {"backend": "scalar"}


def test_the_trial_renders_with_a_backend_that_works_and_fails_with_one_that_is_not_here():
    def trial(backend):
        command = [sys.executable, "-m", "stages.graphics.mitsuba.trial", json.dumps(backend)]
        return subprocess.run(command, capture_output=True, text=True)

    good = trial(SCALAR)
    assert good.returncode == 0, good.stderr
    bad = trial({"backend": "llvm", "llvm": 1})
    assert bad.returncode not in (0, backends.OUR_FAULT) and "LLVM 1 is not on this machine" in bad.stderr


def test_without_a_jit_backend_the_scalar_one_is_taken_with_a_word(monkeypatch, caplog):
    monkeypatch.setattr(backends, "works", lambda candidate: candidate["backend"] == "scalar")
    assert backends.choose("auto") == SCALAR
    assert "libllvm19" in caplog.text
    with pytest.raises(UserError, match="backend=llvm does not work here"):
        backends.choose("llvm")
    with pytest.raises(UserError, match="unknown"):
        backends.choose("metal")


def test_workers_spread_over_the_gpus(tmp_path, monkeypatch):
    smi = tmp_path / "nvidia-smi"
    smi.write_text("#!/bin/sh\necho GPU-aa\necho GPU-bb\n")
    smi.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(backends.tempfile, "gettempdir", lambda: str(tmp_path))
    taken, kept = [], []  # a lock lasts as long as its file is open: one set of claims stands for each process
    for _ in range(5):
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        monkeypatch.setattr(backends, "_claims", [])
        backends.claim_gpu()
        taken.append(os.environ["CUDA_VISIBLE_DEVICES"])
        kept.append(backends._claims)
    assert taken == ["GPU-aa", "GPU-bb", "GPU-aa", "GPU-bb", "GPU-aa"]
    kept[1][0].close()  # that process died: its place is free
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(backends, "_claims", [])
    backends.claim_gpu()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "GPU-bb"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-bb")
    assert {"backend": "cuda"} in backends.candidates("auto")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert {"backend": "cuda"} not in backends.candidates("auto")
