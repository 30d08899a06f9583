"""The hub as users meet it, by a client that keeps repositories in folders: no network."""

from __future__ import annotations

import json
import shutil
import sys
import types
from pathlib import Path

import pytest
import torch
import yaml

from model.renderformer import checkpoint as files
from model.renderformer.config import ModelConfig
from model.renderformer.network import RenderFormer
from pipeline.errors import UserError
from stages.cli import main
from stages.renderformer import hub
from stages.renderformer.dataset import ShardDataset
from stages.renderformer.inference.renderer import Renderer
from tests.renderformer.fakes import sharded
from tests.renderformer.test_predict import MICRO


class RepositoryNotFoundError(OSError):
    pass


class GatedRepoError(RepositoryNotFoundError):
    pass


class RevisionNotFoundError(OSError):
    pass


class LocalEntryNotFoundError(FileNotFoundError):
    pass


class FakeHub(types.ModuleType):
    """huggingface_hub as far as it is used. server: repositories by name, in folders; None: there is no network."""

    def __init__(self, server: Path | None, cache: Path):
        super().__init__("huggingface_hub")
        self.server, self.cache, self.commits = server, cache, []
        self.HfApi = lambda: self

    def snapshot_download(self, name, *, revision=None, allow_patterns=None):
        kept = self.cache / name
        if self.server is None:
            if kept.is_dir():
                return str(kept)
            raise LocalEntryNotFoundError("cannot find an appropriate cached snapshot folder")
        if name.startswith("gated/"):
            raise GatedRepoError("401 Client Error. Request ID: 1")
        if not (self.server / name).is_dir():
            raise RepositoryNotFoundError("401 Client Error. Request ID: 2")
        if revision not in (None, "main"):
            raise RevisionNotFoundError("404 Client Error")
        kept.mkdir(parents=True, exist_ok=True)
        for path in (self.server / name).iterdir():
            if path.name in allow_patterns:
                shutil.copyfile(path, kept / path.name)
        return str(kept)

    def create_repo(self, name, *, repo_type, private, exist_ok):
        assert exist_ok
        (self.server / name).mkdir(parents=True, exist_ok=True)

    def list_repo_files(self, name, *, repo_type):
        return [path.relative_to(self.server / name).as_posix() for path in (self.server / name).rglob("*") if path.is_file()]

    def CommitOperationAdd(self, path, content):  # noqa: N802 (the library's name)
        return path, content

    def create_commit(self, name, operations, *, commit_message, repo_type):
        self.commits.append([path for path, _ in operations])
        for path, content in operations:
            target = self.server / name / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content if isinstance(content, bytes) else Path(content).read_bytes())


@pytest.fixture
def client(tmp_path, monkeypatch) -> FakeHub:
    (tmp_path / "server").mkdir()
    fake = FakeHub(tmp_path / "server", tmp_path / "cache")
    monkeypatch.setitem(sys.modules, "huggingface_hub", fake)
    return fake


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    config = ModelConfig(**MICRO)
    folder = tmp_path_factory.mktemp("hub") / "trained"
    files.save(config, RenderFormer(config).state_dict(), folder, {"triangles": "900", "resolution": "16"})
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return sharded(tmp_path_factory.mktemp("hub") / "data", per_shard=2)[1]


def test_a_checkpoint_is_rendered_by_its_name_and_again_without_a_network(client, trained):
    shutil.copytree(trained, client.server / "someone" / "model-v1")
    renderer = Renderer("hub:someone/model-v1", "cpu")
    assert renderer.triangles == 900
    client.server = None
    assert Renderer("hub:someone/model-v1", "cpu").resolution == 16


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("hub:someone/absent", "does not exist there, or is private"),
        ("hub:gated/model", "is gated: accept its terms at https://huggingface.co/gated/model"),
        ("hub:someone/data@v9", "no such revision"),
        ("hub:someone/data", "is no checkpoint"),
        ("hub:one-word", "is no name on the hub"),
        ("hub:../../etc/passwd", "is no name on the hub"),
    ],
)
def test_what_cannot_be_had_is_said_in_one_line(client, reference, words, tmp_path, capsys):
    (client.server / "someone" / "data").mkdir(parents=True)
    (client.server / "someone" / "data" / "README.md").write_text("data")
    (tmp_path / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    out = str(tmp_path / "x.png")
    assert main(["predict", str(tmp_path / "box.obj"), "--checkpoint", reference, "-o", out, "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert words in error and reference in error and error.count("\n") == 1 and "Request ID" not in error


def test_without_a_network_or_the_package_it_says_what_to_do(client, monkeypatch):
    client.server = None
    with pytest.raises(UserError, match="not in the cache, and the hub cannot be reached.*give their folder"):
        hub.checkpoint("hub:someone/model")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match="pip install huggingface_hub"):
        hub.checkpoint("hub:someone/model")


def test_training_and_evaluation_take_a_name_as_well(client, trained):
    from stages.renderformer.s06_given import GivenConfig, checkpoint_files
    from stages.renderformer.s06_train import initial_folder

    shutil.copytree(trained, client.server / "someone" / "model")
    assert [path.name for path in checkpoint_files(GivenConfig(checkpoint="hub:someone/model"))] == [
        "config.json", "model.safetensors",
    ]  # fmt: skip
    assert (initial_folder("hub:someone/model") / "config.json").is_file()


def header(readme: bytes) -> dict:
    """The YAML in front of a card."""
    _, text, _ = readme.decode().split("---\n", 2)
    return yaml.safe_load(text)


def test_a_dry_run_lists_all_and_uploads_nothing(dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)  # not even the package is needed
    store = dataset.path.parents[1]
    assert main(["publish", "shard", "hub:me/scenes", "--dry-run", "--store", str(store)]) == 0
    out = capsys.readouterr().out
    assert "nothing was uploaded" in out and "README.md" in out and "license: " in out
    parts = sorted(path.relative_to(dataset.path).as_posix() for path in (dataset.path / "parts").iterdir())
    assert all(f"{(dataset.path / part).stat().st_size:,}  {part}" in out for part in parts)


def test_a_published_dataset_is_a_dataset_again(client, dataset, tmp_path):
    """By our loader at its address, by webdataset shard by shard; the card's header names each split's shards."""
    what = hub.publication(str(dataset.path.relative_to(dataset.path.parents[1])), "hub:me/scenes", dataset.path.parents[1])
    assert hub.publish(what) == "https://huggingface.co/datasets/me/scenes"
    there = client.server / "me" / "scenes"
    ours, again = (ShardDataset(str(source), "train") for source in (dataset.path, there))
    assert again.ids == ours.ids and (again.read(0).scene.triangles == ours.read(0).scene.triangles).all()
    assert client.commits[-1][-1] == "README.md"  # last, so that a card stands for a whole dataset
    card = header((there / "README.md").read_bytes())
    splits = {entry["split"]: entry["path"] for entry in card["configs"][0]["data_files"]}
    shards = json.loads((there / "files" / "shards.json").read_bytes())
    assert splits == {split: [part["path"] for part in shards[split]["parts"]] for split in shards}
    import webdataset

    read = [
        sample["__key__"] for path in splits["train"] for sample in webdataset.WebDataset(str(there / path), shardshuffle=False)
    ]
    assert sorted(read) == sorted(ours.ids)
    for picture in ("files/contact.png", "files/distributions.png"):
        assert f"]({picture})" in (there / "README.md").read_text() and (there / picture).is_file()


def test_a_second_upload_leaves_the_parts_that_are_there(client, dataset):
    what = hub.publication("shard", "hub:me/scenes", dataset.path.parents[1])
    hub.publish(what)
    client.commits.clear()
    hub.publish(what)
    assert client.commits and not any(path.startswith("parts/") for commit in client.commits for path in commit)


def test_a_published_checkpoint_renders_by_its_name(client, trained, tmp_path):
    what = hub.publication(str(trained), "hub:me/model", tmp_path, "mit")
    assert hub.publish(what) == "https://huggingface.co/me/model"
    assert Renderer("hub:me/model", "cpu").triangles == 900
    readme = (client.server / "me" / "model" / "README.md").read_bytes()
    assert header(readme)["license"] == "mit" and b"--checkpoint hub:me/model" in readme
    assert client.commits[-1][-1] == "README.md"


def test_only_datasets_and_checkpoints_are_published(dataset, tmp_path, trained):
    with pytest.raises(UserError, match="leave @v2 out"):
        hub.publication(str(trained), "hub:me/model@v2", tmp_path)
    (trained / "model.safetensors").rename(tmp_path / "moved")
    try:
        with pytest.raises(ValueError, match="is missing"):
            hub.publication(str(trained), "hub:me/model", tmp_path)
    finally:
        (tmp_path / "moved").rename(trained / "model.safetensors")
