"""The train stage: shards in, a released-format checkpoint, a log and a curve out; and what renders with it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from copy import copy

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.renderformer.dataset import decode_sample
from stages.renderformer.inference.output import Output
from stages.renderformer.inference.predict import load_model, predict_scene
from stages.renderformer.inference.renderer import Renderer, predict
from stages.renderformer.inference.settings import PredictSettings
from stages.renderformer.s06_train import ModelSection, Train, TrainConfig
from tests.renderformer.fakes import FakeArtifact, sharded

MODEL = dict(
    name="micro", latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=64, num_register_tokens=2,
    texture_encode_patch_size=1, view_transformer_latent_dim=128, view_transformer_n_layers=4, view_transformer_n_heads=1,
    view_transformer_ffn_hidden_dim=64, dpt_features=8, dpt_out_channels=(8, 8, 8, 8),
)  # fmt: skip


def config(**fields) -> TrainConfig:
    return TrainConfig(**(dict(model=MODEL, steps=4, batch_scenes=2, views_per_scene=2, warmup=1, device="cpu") | fields))


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    """A *shard* artifact of 16 px images."""
    return sharded(tmp_path_factory.mktemp("train"), size=16, validation=2)[1]


@pytest.fixture(scope="module")
def trained(shard, tmp_path_factory):
    draft = FakeArtifact(tmp_path_factory.mktemp("artifact"), [])
    draft.state = draft.path / "state"
    products = Train().run(config(), {"shard": shard}, draft)
    return draft, products


def test_products(trained, shard):
    draft, products = trained
    assert products == ["checkpoint/config.json", "checkpoint/model.safetensors"]
    assert all((draft.files / name).is_file() for name in [*products, "log.jsonl", "curve.png", "best/model.safetensors"])
    assert list((draft.files / "tensorboard").glob("events.*"))
    assert draft.notes["training"]["steps"] == 4
    sample = shard.ids("validation")[0]
    scene = decode_sample(shard.read(sample)).scene
    images = predict_scene(load_model(draft.files / "checkpoint"), scene, [0, 2], 16)
    assert images.shape == (2, 16, 16, 3) and images.dtype == np.float32 and (images >= 0).all()


def test_validation_is_shown_in_pictures(trained, shard):
    """Reference above, prediction below, one column per scene, at the exposure that suits the reference."""
    from PIL import Image

    from stages.graphics.tonemap import exposure_for, to_picture
    from stages.renderformer.dataset import decode_sample

    (path,) = sorted((trained[0].files / "validation").iterdir())
    picture = np.asarray(Image.open(path))
    count = len(shard.ids("validation"))
    assert path.name == "step-0000004.png" and picture.shape == (32, 16 * min(6, count), 3)
    first = decode_sample(shard.read(shard.ids("validation")[0]))
    reference = first.views[min(first.views)].image
    assert np.array_equal(picture[:16, :16], to_picture(reference, exposure_for(reference)))


def test_same_seed_same_bytes(trained, shard, tmp_path):
    draft, products = trained
    other = FakeArtifact(tmp_path, [])
    other.state = tmp_path / "state"
    settings = {"ahead": 1, "log_every": 3, "pictures": 0, "tensorboard": False, "activation_checkpointing": True}
    Train().run(config(**settings), {"shard": shard}, other)
    for name in products:
        assert (other.files / name).read_bytes() == (draft.files / name).read_bytes()


def train_on(shard, path, **fields):
    draft = FakeArtifact(path, [])
    draft.state = path / "state"
    said = []
    draft.log = said.append
    Train().run(config(**fields), {"shard": shard}, draft)
    return draft, said


def test_a_second_run_starts_from_the_first_ones_weights(trained, shard, tmp_path):
    """The curriculum's second stage: equal at a learning rate of nothing; its key follows the weights, not their path."""
    from pipeline.stage import StageConfig
    from pipeline.store.files import hash_file

    first = trained[0].files / "checkpoint"
    draft, said = train_on(shard, tmp_path / "second", init_from=str(first), lr=1e-30, muon_lr=1e-30, weight_decay=0.0)
    assert f"starting from {first}" in said[0]
    a, b = (load_model(folder / "checkpoint").state_dict() for folder in (trained[0].files, draft.files))
    assert all(np.allclose(a[name], b[name], atol=1e-6) for name in a)
    assert issubclass(TrainConfig, StageConfig)
    elsewhere = tmp_path / "artifact" / "files" / "checkpoint"
    shutil.copytree(first, elsewhere)
    stage = Train()
    identities = [stage.identity(config(init_from=str(path)), hash_file) for path in (first, tmp_path / "artifact")]
    assert identities[0] == identities[1] and stage.identity(config(), hash_file) == {}
    (elsewhere / "model.safetensors").write_bytes(b"other")
    assert stage.identity(config(init_from=str(tmp_path / "artifact")), hash_file) != identities[0]
    with pytest.raises(UserError, match="holds no checkpoint"):
        stage.identity(config(init_from=str(tmp_path / "nothing")), hash_file)
    with pytest.raises(UserError, match="dim_feedforward 64 instead of 32"):
        train_on(shard, tmp_path / "third", init_from=str(first), model=MODEL | {"dim_feedforward": 32})


def test_a_model_trained_on_test_objects_is_no_start(trained, shard, tmp_path):
    """Its list of training objects, with those of the models that it started from, lies beside its weights."""
    first = trained[0].files / "checkpoint"
    known = json.loads(shard.file("objects.json").read_text())
    listed = json.loads((first / "objects.json").read_text())
    assert listed == {"objects": {id: o["content_hash"] for id, o in known["train"].items()}, "complete": True}
    assert listed["objects"] and (trained[0].files / "best" / "objects.json").is_file()
    load_model(first)  # the list is none of the format's business

    other = tmp_path / "other"
    shutil.copytree(first, other)

    def start_from(number: int, **listed):
        (other / "objects.json").write_text(json.dumps({"objects": {}, "complete": True} | listed))
        return train_on(shard, tmp_path / str(number), init_from=str(other), steps=1)

    tested, content = next((id, o["content_hash"]) for id, o in known["test"].items())
    with pytest.raises(UserError, match=rf"trained on 1 object\(s\) of the test split \({tested}\)"):
        start_from(0, objects={"another-name": content})
    draft, said = start_from(1, objects={tested: "of another seed", "old": "from before"})
    assert not any("warning" in line for line in said)
    kept = json.loads((draft.files / "checkpoint" / "objects.json").read_text())
    assert kept == {"objects": {**listed["objects"], tested: "of another seed", "old": "from before"}, "complete": True}
    draft, said = start_from(2, complete=False)
    assert any("some may be in the test split" in line for line in said)
    (other / "objects.json").unlink()
    draft, said = train_on(shard, tmp_path / "3", init_from=str(other), steps=1)
    assert any("some may be in the test split" in line for line in said)
    assert not json.loads((draft.files / "checkpoint" / "objects.json").read_text())["complete"]
    (other / "objects.json").write_text("[]")
    with pytest.raises(UserError, match="no list of training objects"):
        train_on(shard, tmp_path / "4", init_from=str(other), steps=1)


def test_killed_at_any_step_and_resumed_is_the_same_run(shard, tmp_path, monkeypatch):
    """Through the real loader; checks/kills.py does it with real kills."""
    import stages.renderformer.dataset

    settings = {"steps": 9, "checkpoint_every": 4, "log_every": 1, "relight": True, "mirror": True, "ema": 0.9}
    whole, _ = train_on(shard, tmp_path / "whole", **settings)
    real, resumed = stages.renderformer.dataset.prefetch, None
    for killed_at in (2, 6, None):

        def prefetch(batches, start, stop, *arguments, killed_at=killed_at):
            for step, batch in enumerate(real(batches, start, stop, *arguments), start=start):
                if step == killed_at:
                    raise KeyboardInterrupt
                yield batch

        monkeypatch.setattr(stages.renderformer.dataset, "prefetch", prefetch)
        if killed_at is None:
            resumed, said = train_on(shard, tmp_path / "killed", **settings)
            assert "going on from step 4 of 9" in said
        else:
            with pytest.raises(KeyboardInterrupt):
                train_on(shard, tmp_path / "killed", **settings)
    measured = {"seconds", "scenes_per_s", "tokens_per_s", "memory_gb", "mfu"}
    logs = [draft.file("log.jsonl").read_text().splitlines() for draft in (whole, resumed)]
    rows = [[{k: v for k, v in json.loads(line).items() if k not in measured} for line in lines] for lines in logs]
    assert rows[0] == rows[1] and len([row for row in rows[0] if "loss" in row]) == 9
    weights = [(draft.files / "checkpoint" / "model.safetensors").read_bytes() for draft in (whole, resumed)]
    assert weights[0] == weights[1]


@pytest.mark.parametrize(("name", "days", "paths"), [("paper_256", 5.2, 2.15e15), ("paper_512", 5.5, 8.59e15)])
def test_the_papers_experiments_say_what_they_cost(name, days, paths, tmp_path):
    """Planned, not run; the authors report 5 and 3 days on eight A100."""
    from pipeline.hydra_config import compose
    from pipeline.run import run_pipeline

    (tmp_path / "ids.txt").write_text("some uids\n")
    words = [
        f"experiment={name}",
        f"collect.ids_file={tmp_path / 'ids.txt'}",
        "stage=train",
        "plan=true",
        f"store={tmp_path}/s",
    ]
    lines = []
    run_pipeline(compose(words), words, lines.append)
    text = "\n".join(lines)
    assert float(re.search(r"([\d.]+) of eight", text)[1]) == pytest.approx(days, abs=0.05)
    assert f"{paths:.2e} camera paths" in text
    assert "2,000,000 training scenes" in text and "steps of 128 scenes x 4 views" in text
    assert not list((tmp_path / "s").glob("*/*"))


def test_a_given_checkpoint_is_planned_without_a_cost(tmp_path):
    from pipeline.hydra_config import compose
    from pipeline.run import run_pipeline

    words = [
        "stage=evaluate",
        "train=given",
        "train.checkpoint=model/pretrained/renderformer",
        "plan=true",
        f"store={tmp_path}/s",
    ]
    lines = []
    run_pipeline(compose(words), words, lines.append)
    text = "\n".join(lines)
    assert re.search(r"06 train +to make", text) and "07 evaluate" in text and "training:" not in text


def test_a_given_model_is_not_tested_on_objects_that_it_was_trained_on(trained, shard, tmp_path):
    from stages.renderformer.s06_given import GivenConfig, TrainOrGiven

    given = tmp_path / "given"
    shutil.copytree(trained[0].files / "checkpoint", given)

    def give(number: int) -> list[str]:
        draft = FakeArtifact(tmp_path / str(number), [])
        lines = []
        draft.log = lines.append
        TrainOrGiven().run(GivenConfig(checkpoint=str(given)), {"shard": shard}, draft)
        return lines

    assert give(0) == []
    tested, content = next(
        (id, o["content_hash"]) for id, o in json.loads(shard.file("objects.json").read_text())["test"].items()
    )
    (given / "objects.json").write_text(json.dumps({"objects": {"another-name": content}, "complete": True}))
    with pytest.raises(UserError, match=rf"train\.checkpoint=.* was trained on 1 object\(s\) of the test split \({tested}\)"):
        give(1)
    (given / "objects.json").unlink()
    assert ["some may be in the test split" in line for line in give(2)] == [True]


@pytest.mark.parametrize("policy", [{}, {"GOMP_SPINCOUNT": "7"}, {"OMP_WAIT_POLICY": "active"}])
def test_threads_wait_briefly_unless_the_user_says_how(policy):
    import os

    code = """if True:
        import os, sys
        from model.training.threads import wait_briefly
        wait_briefly()
        print(os.environ.get("OMP_WAIT_POLICY"), os.environ.get("GOMP_SPINCOUNT"), "torch" in sys.modules)"""
    clean = {
        name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
    }
    output = subprocess.run([sys.executable, "-c", code], env=clean | policy, capture_output=True, text=True, check=True).stdout
    spins = policy.get("GOMP_SPINCOUNT", "None") if policy else "100000"
    assert output.split() == [policy.get("OMP_WAIT_POLICY", "None"), spins, "False"]


def test_resolution_must_suit_the_model(shard, tmp_path):
    draft = FakeArtifact(tmp_path, [])
    draft.state = tmp_path / "state"
    with pytest.raises(UserError, match="multiple of 64"):
        Train().run(config(model=MODEL | {"view_transformer_use_swin_attn": True}), {"shard": shard}, draft)


def test_model_section_mirrors_the_network_config():
    from model.renderformer.config import FIXED, ModelConfig

    own = ModelSection.model_fields.keys() - {"name"}
    assert own == set(ModelConfig.__dataclass_fields__) - set(FIXED)
    assert ModelSection().build() == ModelConfig()


def test_stage_is_cheap_to_import():
    modules = "stages.renderformer.s06_train, stages.renderformer.inference.renderer"
    code = f"import sys, {modules}; sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_predict_writes_images(trained, shared_data, tmp_path, capsys):
    from PIL import Image

    checkpoint = trained[0].files / "checkpoint"
    scene = next(path for path in sorted((shared_data / "scenes").rglob("*.h5")))
    renderer = Renderer(checkpoint)
    (exr,) = predict(renderer, scene, Output(tmp_path / "out.exr"), PredictSettings(resolution=16))
    assert "was trained with at most" in capsys.readouterr().err
    from stages.graphics.exr import read_rgb

    assert read_rgb(exr).shape == (16, 16, 3)
    paths = predict(renderer, scene, Output(tmp_path / "all.png"), PredictSettings("all", resolution=16))
    assert paths[0].name == "all-0.png" and Image.open(paths[0]).size == (16, 16)


def test_without_a_checkpoint_the_shipped_model_is_used(trained, shared_data, tmp_path, monkeypatch, capsys):
    import stages.renderformer.inference.renderer
    from stages.cli import main

    scene = next(path for path in sorted((shared_data / "scenes").rglob("*.h5")))
    words = ["predict", str(scene), "-o", str(tmp_path / "out.png"), "--resolution", "16", "--device", "cpu"]
    monkeypatch.setattr(stages.renderformer.inference.renderer, "PRETRAINED", tmp_path / "none")
    assert main(words) == 2 and "no model ships" in capsys.readouterr().err
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "renderformer").symlink_to(trained[0].files / "checkpoint")
    assert main(words) == 0 and (tmp_path / "out.png").is_file()
    assert main([*words, "--checkpoint", "ships:renderformer"]) == 0
    assert main([*words, "--checkpoint", "ships:guided"]) == 2 and "choose from ships:renderformer" in capsys.readouterr().err


def test_of_two_models_that_ship_the_guided_one_is_used(tmp_path, monkeypatch):
    from stages.renderformer.inference import renderer

    monkeypatch.setattr(renderer, "PRETRAINED", tmp_path)
    for name in ("renderformer", "guided"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text("{}")
    assert renderer.checkpoint_folder(None) == renderer.checkpoint_folder("ships:guided") == tmp_path / "guided"
    assert renderer.checkpoint_folder("ships:renderformer") == tmp_path / "renderformer"
    assert renderer.checkpoint_name(tmp_path / "guided") == "the guided model that ships"
    assert renderer.checkpoint_name(tmp_path) == str(tmp_path)


def test_what_ships_is_small_and_has_its_report():
    from stages.renderformer.inference.renderer import PRETRAINED, shipped_checkpoints

    assert shipped_checkpoints()
    for folder in shipped_checkpoints().values():
        load_model(folder)
        assert "python -m pipeline" in (folder / "report.md").read_text()
    assert sum(path.stat().st_size for path in PRETRAINED.rglob("*") if path.is_file()) <= 10e6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"out": "x.jpg"}, "must end in"),
        ({"resolution": 20}, "multiple of 8"),
        ({"view": 99}, "does not exist"),
        ({"device": "tpu"}, "unknown"),
    ],
)
def test_predict_refuses(trained, shared_data, tmp_path, arguments, message):
    scene = next(path for path in sorted((shared_data / "scenes").rglob("*.h5")))
    arguments = {"out": "x.exr", "resolution": 16, "device": "auto"} | arguments
    with pytest.raises(UserError, match=message):
        output = Output(tmp_path / arguments.pop("out"))
        renderer = Renderer(trained[0].files / "checkpoint", arguments.pop("device"))
        predict(renderer, scene, output, PredictSettings(**arguments))


@pytest.fixture
def damaged(shard, tmp_path):
    """A copy of the shards with one training sample whose scene does not match its checksum, and that sample's row."""
    shutil.copytree(shard.path, tmp_path / "copy")
    rows = map(json.loads, (tmp_path / "copy" / "files" / "index.jsonl").read_text().splitlines())
    row = next(row for row in rows if row["split"] == "train")
    offset, size, _ = row["members"]["scene.npz"]
    with open(tmp_path / "copy" / row["shard"], "r+b") as file:
        file.seek(offset + size // 2)
        byte = file.read(1)[0]
        file.seek(-1, 1)
        file.write(bytes([byte ^ 4]))
    return moved(shard, tmp_path), row


def moved(shard, folder):
    """The artifact as it lies in the folder ``copy``."""
    other = copy(shard)
    other.path = folder / "copy"
    return other


def test_a_damaged_sample_is_said_once_by_name_and_counted(damaged, tmp_path):
    artifact, row = damaged
    draft, said = train_on(artifact, tmp_path / "run", steps=6)
    assert [line.split(":")[0] for line in said if "damaged" in line] == [
        f"sample {row['id']} is damaged, another one takes its place"
    ]
    assert draft.notes["training"]["damaged_samples"] == 1


def test_a_damaged_shard_stops_training_with_a_setting_that_exists(damaged, tmp_path):
    artifact, row = damaged
    path = artifact.path / row["shard"]
    path.write_bytes(path.read_bytes()[:-1024])
    with pytest.raises(UserError, match=r"the shard .* bytes, not .*train\.skip_damaged_shards=true"):
        train_on(artifact, tmp_path / "run", steps=2)
