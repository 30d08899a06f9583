"""Files appear whole or not at all, flushed before they get their names."""

from __future__ import annotations

import os

import pytest

from pipeline.atomic import TEMPORARY, atomic_path, write_atomic
from pipeline.store import Store


def test_a_file_gets_its_name_only_when_it_is_whole_and_flushed(tmp_path, monkeypatch):
    target, flushed = tmp_path / "image.exr", []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (flushed.append((os.fstat(handle).st_ino, target.exists())), fsync(handle)))
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"whole")
        assert temporary.parent == tmp_path and temporary.suffix == ".exr" and not target.exists()
        assert [path.name for path in tmp_path.glob(TEMPORARY)] == [temporary.name]
    assert flushed == [(target.stat().st_ino, False), (tmp_path.stat().st_ino, True)]
    assert target.read_bytes() == b"whole" and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "deep" / "values.json"
    write_atomic(target, [b"ol", b"d"])
    with pytest.raises(error), atomic_path(target) as temporary:
        temporary.write_bytes(b"half")
        raise error
    assert target.read_bytes() == b"old" and list(target.parent.iterdir()) == [target]


def test_what_may_be_lost_is_not_flushed(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", None)
    with atomic_path(tmp_path / "run.json", durable=False) as temporary:
        temporary.write_bytes(b"now")
    assert (tmp_path / "run.json").read_bytes() == b"now"


def test_a_draft_drops_what_a_killed_writer_left(tmp_path):
    draft = Store(tmp_path).draft("train", "0" * 64, {})
    folders = [draft.path, draft.path / "markers", draft.files / "checkpoint", draft.path / "state"]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".model.0123abcd.tmp.safetensors").write_bytes(b"half")
        (folder / "model.safetensors").write_bytes(b"whole")
    draft.sweep()
    for folder in folders:
        assert [path.name for path in folder.iterdir() if path.is_file() and "model" in path.name] == ["model.safetensors"]
