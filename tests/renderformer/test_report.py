"""lightmill report: runs side by side on the same scenes only, what the page says, and probes."""

from __future__ import annotations

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from model.renderformer.config import ModelConfig
from pipeline.errors import UserError
from pipeline.keys import digest_of
from pipeline.store import Artifact, Store
from stages.renderformer.evaluation.side_by_side import write_report
from stages.renderformer.s05_shard import Shard, ShardConfig
from stages.renderformer.s07_evaluate import Evaluate, EvaluateConfig
from tests.renderformer.fakes import commit_shards, dataset_inputs, sharded


def commit(store: Store, stage: str, fill, params: dict, inputs: dict, version: int = 2) -> Artifact:
    """An artifact whose draft ``fill`` wrote; it returns the artifact's records by group."""
    preimage = {"stage": stage, "version": version, "params": params, "inputs": inputs}
    draft = store.draft(stage, digest_of(preimage), preimage, out=lambda text: None)
    draft.use_parts([])
    part, items = draft.open_part(), []
    for group, record in fill(draft):
        part.add(record, record.id, group, "")
        items.append(record.id)
    draft.use_parts([{"part_key": "0", "group": "", "items": items, "rejects": [], **part.close()}])
    if stage == "evaluate":
        config = EvaluateConfig(timing_scenes=0)
        artifacts = {name: store.find(name, key) for name, key in inputs.items()}
        Evaluate().finish(config, artifacts, draft)
        Evaluate().check(draft)
    manifest = {"key": draft.key, "preimage": preimage, "outputs": draft.outputs(), "summary": {}, "finished": 0.0}
    return store.commit(draft, params.get("name", "x"), manifest)


def trained(store: Store, name: str, shard: Artifact) -> Artifact:
    from safetensors.numpy import save_file

    def fill(draft):
        folder = draft.files / "checkpoint"
        folder.mkdir()
        config = ModelConfig(num_layers=2, view_transformer_n_layers=4)
        (folder / "config.json").write_text(config.dumps())
        save_file({"weight": np.zeros((3, 4), np.float32)}, folder / "model.safetensors")
        (draft.files / "log.jsonl").write_text('{"step": 10, "loss": 0.5}\n{"step": 20, "loss": 0.25}\n')
        return []

    return commit(store, "train", fill, {"name": name, "lr": len(name)}, {"shard": shard.key})


@pytest.fixture
def factor(monkeypatch):
    """Stands in for the network, which renders the true image times a factor."""
    fake = SimpleNamespace(value=1.0, shard=None)

    def predict_scene(model, scene, views, resolution, device):
        from stages.renderformer.dataset import decode_sample

        sample = decode_sample(fake.shard.read(scene.id))
        return np.stack([sample.views[view].image for view in views]) * fake.value

    def load_model(folder):
        return SimpleNamespace(without_learning=lambda: None)

    monkeypatch.setitem(
        sys.modules,
        "stages.renderformer.inference.predict",
        SimpleNamespace(load_model=load_model, predict_scene=predict_scene),
    )
    return fake


def evaluated(store: Store, name: str, shard: Artifact, factor, value: float, version: int = Evaluate.version) -> Artifact:
    stage, config = Evaluate(), EvaluateConfig(timing_scenes=0)
    train = trained(store, name, shard)
    factor.value, factor.shard = value, shard

    def fill(draft):
        inputs = {"shard": shard, "train": train}
        worker = stage.open(config, inputs, {"device": "cpu"})
        return [("test", record) for item in stage.items(config, inputs) for record in stage.process(worker, item)]

    return commit(store, "evaluate", fill, {"split": "test"}, {"shard": shard.key, "train": train.key}, version)


def probe(store: Store) -> Artifact:
    facts = {
        "name": "lights", "title": "Number of lights", "question": "How many lights are too many?", "setting": "lights, 1 to 8",
        "model": {"name": "tiny", "parameters": 12}, "columns": ["lights", "PSNR"], "rows": [[1, "20 <b>"], [8, None]],
        "notes": ["It falls."],
    }  # fmt: skip

    def fill(draft):
        from PIL import Image

        Image.new("RGB", (4, 4)).save(draft.files / "figure.png")
        (draft.files / "probe.json").write_text(json.dumps(facts))
        return []

    return commit(store, "probe", fill, {"name": "lights"}, {})


@pytest.fixture
def store(tmp_path, factor) -> Store:
    _, shard = sharded(tmp_path, train=2, test=3)
    return Store(shard.path.parents[1])


def shard_of(store: Store) -> Artifact:
    return store.artifacts("shard")[0]


def test_runs_and_probes_on_one_page(store, factor, tmp_path):
    near, far = (evaluated(store, name, shard_of(store), factor, value) for name, value in (("near", 0.9), ("far", 0.5)))
    out = tmp_path / "page.html"
    written = write_report([f"close <by>={near.key}", far.key[:12], probe(store).key], store, out, gallery=3)
    assert written == [out, tmp_path / "page.json", tmp_path / "page.md", tmp_path / "page.png"]
    target, ours, theirs = np.split(np.asarray(Image.open(written[3]), float), 3)  # of all nine views in a row
    assert target.shape[1] == 9 * len(target)
    assert 0 < np.abs(ours - target).mean() < np.abs(theirs - target).mean()
    page, numbers, table = out.read_text(), json.loads(written[1].read_text()), written[2].read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # one file, nothing to fetch
    assert "close &lt;by&gt;" in page and "close <by>" not in page and "20 &lt;b&gt;" in page
    assert "figure_1" not in page  # plots bring no ids that another plot brings as well
    # three views: target and direct light once, three pictures of each run, and the probe's figure
    assert page.count("<img") == 3 * (2 + 2 * 3) + 1
    assert "train.lr" in page and "How many lights are too many?" in page and "It falls." in page

    assert [run["name"] for run in numbers["runs"]] == ["close <by>", "far"]
    psnr = [run["methods"]["model"]["psnr"]["mean"] for run in numbers["runs"]]
    against = numbers["differences"]
    assert against["base"] == "close <by>" and (against["runs"]["far"]["scenes"], against["runs"]["far"]["views"]) == (3, 9)
    assert against["runs"]["far"]["gains"]["psnr"]["mean"] == pytest.approx(psnr[1] - psnr[0])
    assert against["runs"]["far"]["gains"]["flip"]["high"] < 0  # worse, although its error is higher
    assert numbers["probes"][0]["rows"] == [[1, "20 <b>"], [8, None]]
    assert "per_scene" not in numbers["runs"][0]

    header = next(line for line in table.splitlines() if line.startswith("| metric"))
    # the baselines of the same scenes stand there once
    assert header.count("|") == 2 + 2 + 4 and r"| close \<by> | far | mean training image |" in header
    assert f"{against['runs']['far']['gains']['psnr']['mean']:+.2f} [" in table and "### Number of lights" in table
    assert "| 8 | – |" in table and r"| 1 | 20 \<b> |" in table  # nothing that Markdown would read as a tag


def test_a_page_may_hold_probes_alone(store, tmp_path):
    write_report([probe(store).key], store, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "How many lights are too many?" in page and "Gallery" not in page and page.count("<img") == 1


def test_runs_on_different_scenes_are_refused_unless_asked(store, factor, tmp_path):
    one = evaluated(store, "one", shard_of(store), factor, 0.9)
    more = dataset_inputs(tmp_path / "more", train=3, test=4)
    other_shard = commit_shards(store.root, more, Shard(), ShardConfig(shard_mb=1), 4)
    other = evaluated(store, "other", other_shard, factor, 0.8)
    with pytest.raises(UserError, match=r"different scenes.*3 test scenes.*4 test scenes.*--different-data"):
        write_report([one.key, other.key], store, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
    write_report([one.key, other.key], store, tmp_path / "page.html", different_data=True)
    page = (tmp_path / "page.html").read_text()
    assert "evaluated on different data" in page and 'class="best"' not in page
    assert "mean training image, one" in page and "mean training image, other" in page


def test_what_cannot_be_shown_is_named(store, factor, tmp_path):
    run, out = evaluated(store, "one", shard_of(store), factor, 0.9), tmp_path / "page.html"
    for words, message in (
        ([shard_of(store).key], "stage shard: a report shows those of evaluate and probe"),
        ([run.key, run.key[:12]], "given 2 times"),
        (["nothing-there"], "lightmill ls"),
    ):
        with pytest.raises(UserError, match=message):
            write_report(words, store, out)
    with pytest.raises(UserError, match="end in .html"):
        write_report([run.key], store, tmp_path / "page.pdf")
    with pytest.raises(UserError, match="not a folder"):
        write_report([run.key], store, tmp_path / "nowhere" / "page.html")
    two = evaluated(store, "two", shard_of(store), factor, 0.9)
    with pytest.raises(UserError, match="2 runs are called 'same'"):
        write_report([f"same={run.key}", f"same={two.key}"], store, out)
    (tmp_path / "README.md").write_text("mine")
    with pytest.raises(UserError, match="README.md would be replaced"):
        write_report([run.key], store, tmp_path / "README.html")
    assert (tmp_path / "README.md").read_text() == "mine"
    old = evaluated(store, "old", shard_of(store), factor, 0.9, version=1)
    with pytest.raises(UserError, match="version 1 of evaluate.*evaluate the model again"):
        write_report([old.key], store, out)
    broken = probe(store)
    broken.file("probe.json").write_text('{"title": "x"}')
    with pytest.raises(UserError, match="has no name, question, setting"):
        write_report([broken.key], store, out)
    assert not out.exists()


def test_without_its_shards_a_run_still_has_numbers(store, factor, tmp_path):
    import shutil

    runs = [evaluated(store, name, shard_of(store), factor, value).key for name, value in (("a", 0.9), ("bb", 0.5))]
    shutil.rmtree(shard_of(store).path)
    with pytest.raises(UserError, match="gone.*--gallery 0"):
        write_report(runs, store, tmp_path / "page.html")
    write_report(runs, store, tmp_path / "page.html", gallery=0)
    assert "No view is shown" in (tmp_path / "page.html").read_text()
    assert json.loads((tmp_path / "page.json").read_text())["differences"]["runs"]["bb"]["scenes"] == 3
