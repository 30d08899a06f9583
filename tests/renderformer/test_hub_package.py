"""The package huggingface_hub itself, without a network: it takes the calls that are made, and its errors are understood."""

from __future__ import annotations

import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from model.renderformer import checkpoint as files
from model.renderformer.config import ModelConfig
from model.renderformer.network import RenderFormer
from stages.renderformer import hub
from tests.conftest import ROOT
from tests.renderformer.test_predict import MICRO

huggingface_hub = pytest.importorskip("huggingface_hub", reason="the optional package huggingface_hub is not installed")


@pytest.mark.parametrize(
    ("call", "arguments", "keywords"),
    [
        ("snapshot_download", ["a/b"], {"revision": None, "allow_patterns": []}),
        ("HfApi.create_repo", [None, "a/b"], {"repo_type": "model", "private": False, "exist_ok": True}),
        ("HfApi.list_repo_files", [None, "a/b"], {"repo_type": "model"}),
        ("HfApi.create_commit", [None, "a/b", []], {"commit_message": "", "repo_type": "model"}),
        ("CommitOperationAdd", ["path", b"bytes"], {}),
    ],
)
def test_the_calls_that_are_made_fit(call, arguments, keywords):
    target = huggingface_hub
    for name in call.split("."):
        target = getattr(target, name)
    inspect.signature(target).bind(*arguments, **keywords)


def test_files_and_bytes_can_be_committed(tmp_path):
    (tmp_path / "a.tar").write_bytes(b"tar")
    for content in (tmp_path / "a.tar", b"card"):
        operation = huggingface_hub.CommitOperationAdd("files/x", hub._given(content))
        assert operation.path_in_repo == "files/x" and operation.upload_info.size in (3, 4)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("GatedRepoError", "is gated"),
        ("RepositoryNotFoundError", "does not exist there"),
        ("RevisionNotFoundError", "no such revision"),
        ("LocalEntryNotFoundError", "not in the cache"),
        ("OfflineModeIsEnabled", "not in the cache"),
    ],
)
def test_its_errors_have_the_names_that_are_looked_for(name, words):
    from huggingface_hub import errors

    kind = getattr(errors, name)
    assert words in hub._reason(kind.__new__(kind), "a/b")


def checkpoint_offline(tmp_path: Path, reference: str, **variables: str) -> str:
    """What `hub.checkpoint` gives or says in a process without a network, whose cache lies in ``tmp_path``."""
    code = (
        "import sys; from stages.renderformer import hub\n"
        "try: print(hub.checkpoint(sys.argv[1]))\nexcept ValueError as error: print(type(error).__name__, error)"
    )
    environment = {**os.environ, "HF_HOME": str(tmp_path), "HF_ENDPOINT": "http://127.0.0.1:9", **variables}
    command = [sys.executable, "-c", code, reference]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("variables", [{"HF_HUB_OFFLINE": "1"}, {}])
def test_a_cached_checkpoint_needs_no_network_and_another_says_so(tmp_path, variables):
    config = ModelConfig(**MICRO)
    files.save(config, RenderFormer(config).state_dict(), tmp_path / "made", {})
    repository = tmp_path / "hub" / "models--someone--kept"
    commit = "0123456789abcdef0123456789abcdef01234567"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(commit)
    shutil.copytree(tmp_path / "made", repository / "snapshots" / commit)
    found = checkpoint_offline(tmp_path, "hub:someone/kept", **variables)
    assert found == str(repository / "snapshots" / commit)
    said = checkpoint_offline(tmp_path, "hub:someone/absent", **variables)
    assert said.startswith("UserError hub:someone/absent is not in the cache, and the hub cannot be reached"), said
