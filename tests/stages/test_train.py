"""The train stage: shards in, a released-format checkpoint, a log and a curve out; and what renders with it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from fakes import FakeArtifact, sharded

from pipeline.errors import UserError
from stages.dataset import decode_sample
from stages.predict import load_model, predict, predict_scene
from stages.s06_train import ModelSection, Train, TrainConfig

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
    assert all((draft.files / name).is_file() for name in [*products, "log.jsonl", "curve.png"])
    assert draft.notes["training"]["steps"] == 4
    sample = shard.ids("validation")[0]
    scene = decode_sample(shard.read(sample)).scene
    images = predict_scene(load_model(draft.files / "checkpoint"), scene, [0, 2], 16)
    assert images.shape == (2, 16, 16, 3) and images.dtype == np.float32 and (images >= 0).all()


def test_same_seed_same_bytes(trained, shard, tmp_path):
    draft, products = trained
    other = FakeArtifact(tmp_path, [])
    other.state = tmp_path / "state"
    Train().run(config(ahead=1, log_every=3), {"shard": shard}, other)
    for name in products:
        assert (other.files / name).read_bytes() == (draft.files / name).read_bytes()


def test_resolution_must_suit_the_model(shard, tmp_path):
    draft = FakeArtifact(tmp_path, [])
    draft.state = tmp_path / "state"
    with pytest.raises(UserError, match="multiple of 64"):
        Train().run(config(model=MODEL | {"view_transformer_use_swin_attn": True}), {"shard": shard}, draft)


def test_model_section_mirrors_the_network_config():
    from model.config import FIXED, ModelConfig

    own = ModelSection.model_fields.keys() - {"name"}
    assert own == set(ModelConfig.__dataclass_fields__) - set(FIXED)
    assert ModelSection().build() == ModelConfig()


def test_stage_is_cheap_to_import():
    code = "import sys, stages.s06_train, stages.predict; sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_predict_writes_images(trained, shared_data, tmp_path, capsys):
    from PIL import Image

    checkpoint = trained[0].files / "checkpoint"
    scene = next(path for path in sorted((shared_data / "scenes").rglob("*.h5")))
    (exr,) = predict(scene, checkpoint, tmp_path / "out.exr", resolution=16)
    assert "was trained with at most" in capsys.readouterr().err
    from stages.exr import read_rgb

    assert read_rgb(exr).shape == (16, 16, 3)
    paths = predict(scene, checkpoint, tmp_path / "all.png", resolution=16, view="all")
    assert paths[0].name == "all-0.png" and Image.open(paths[0]).size == (16, 16)


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
    arguments = {"out": "x.exr", "resolution": 16} | arguments
    with pytest.raises(UserError, match=message):
        predict(scene, trained[0].files / "checkpoint", tmp_path / arguments.pop("out"), **arguments)
