"""The network's config: released folders in and out, and refusals by name."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from model.renderformer import checkpoint
from model.renderformer.config import ModelConfig
from model.renderformer.network import RenderFormer

MICRO = dict(
    latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=64, num_register_tokens=2, texture_encode_patch_size=2,
    view_transformer_latent_dim=128, view_transformer_n_layers=4, view_transformer_n_heads=1,
    view_transformer_ffn_hidden_dim=64, dpt_features=8, dpt_out_channels=(8, 8, 8, 8),
)  # fmt: skip


def size(width: int, encoder: int, decoder: int, **fields) -> dict:
    heads, hidden = width // 128, 4 * width
    return dict(
        latent_dim=width, num_heads=heads, dim_feedforward=hidden, num_layers=encoder, view_transformer_latent_dim=width,
        view_transformer_n_heads=heads, view_transformer_ffn_hidden_dim=hidden, view_transformer_n_layers=decoder, **fields,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("fields", "stored"),
    [
        ({}, 205_173_391),
        (size(768, 8, 4), 143_807_119),  # table 1 says 143M, 71M, 45M
        (size(512, 8, 4), 71_771_535),
        (size(384, 8, 4), 45_977_359),
        (
            size(1024, 12, 12, num_register_tokens=32, texture_encode_patch_size=1, rope_double_max_freq=True,
                 view_transformer_use_swin_attn=True, dpt_features=256, dpt_out_channels=(256, 512, 1024, 1024),
                 dpt_out_layers=(2, 5, 8, 11)),
            483_269_903,
        ),
    ],
)  # fmt: skip
def test_sizes_are_the_published_ones(fields, stored):
    with torch.device("meta"):
        model = RenderFormer(ModelConfig(**fields))
    assert sum(tensor.numel() for tensor in model.state_dict().values()) == stored


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"norm_type": "layer_norm"}, "norm_type"),
        ({"include_alpha": True}, "include_alpha"),
        ({"vdir_num_freqs": 4}, "vdir_num_freqs"),
        ({"use_vn_encoder": False}, "use_vn_encoder"),
        ({"pe_type": "learned"}, "pe_type"),
        ({"texture_channels": 12}, "texture_channels"),
        ({"view_transformer_latent_dim": 512}, "view_transformer_latent_dim"),
        ({"num_heads": 5}, "num_heads"),
        ({"view_transformer_n_layers": 3}, "dpt_out_layers"),
        ({"dpt_out_layers": (0, 1, 2, 9)}, "dpt_out_layers"),
        ({"num_heads": 12}, "vertex_pe_num_freqs"),
    ],
)
def test_unsupported_values_are_refused_by_name(fields, named):
    with pytest.raises(ValueError, match=named):
        ModelConfig(**fields)


def test_checkpoint_round_trip_is_exact(tmp_path):
    model = RenderFormer(ModelConfig(**MICRO))
    checkpoint.save(model.config, model.state_dict(), tmp_path, {"triangles": "700"})
    loaded, trained_with = checkpoint.load(tmp_path)
    assert trained_with == {"triangles": "700"} and loaded.config == model.config
    own, other = model.state_dict(), loaded.state_dict()
    assert list(own) == list(other) and all(torch.equal(own[name], other[name]) for name in own)


def test_released_folder_is_written_back_as_it_was(shared_data, tmp_path):
    for folder in sorted((shared_data / "parity").iterdir()):
        model, _ = checkpoint.load(folder)
        checkpoint.save(model.config, model.state_dict(), tmp_path / folder.name)
        assert json.loads((tmp_path / folder.name / "config.json").read_text()) == json.loads(
            (folder / "config.json").read_text()
        )
        from safetensors.torch import load_file

        before, after = (load_file(path / "model.safetensors") for path in (folder, tmp_path / folder.name))
        assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)


def test_strict_loading_names_what_is_wrong(tmp_path):
    from safetensors.torch import load_file, save_file

    model = RenderFormer(ModelConfig(**MICRO))
    checkpoint.save(model.config, model.state_dict(), tmp_path / "a")

    def broken(name: str) -> tuple:
        folder = tmp_path / name
        shutil.copytree(tmp_path / "a", folder)
        return folder, json.loads((folder / "config.json").read_text()), load_file(folder / "model.safetensors")

    folder, config, _ = broken("unknown field")
    (folder / "config.json").write_text(json.dumps(config | {"mixture": 8}))
    with pytest.raises(ValueError, match="unknown field mixture"):
        checkpoint.load(folder)
    folder, config, _ = broken("missing field")
    del config["pe_type"]
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="pe_type is missing"):
        checkpoint.load(folder)
    folder, _, state = broken("missing parameter")
    del state["tri_token"]
    save_file(state, folder / "model.safetensors")
    with pytest.raises(ValueError, match="missing parameter tri_token"):
        checkpoint.load(folder)
    folder, _, state = broken("unknown parameter")
    save_file(state | {"extra": torch.zeros(1)}, folder / "model.safetensors")
    with pytest.raises(ValueError, match="unknown parameter extra"):
        checkpoint.load(folder)
    folder, _, state = broken("wrong shape")
    save_file(state | {"tri_token": torch.zeros(1, 1, 64)}, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"tri_token has shape \(1, 1, 64\), not \(1, 1, 128\)"):
        checkpoint.load(folder)
    folder, _, state = broken("whole numbers")
    save_file({name: tensor.int() for name, tensor in state.items()}, folder / "model.safetensors")
    with pytest.raises(ValueError, match="holds other numbers than weights are: .* of int32.*and .* more; convert"):
        checkpoint.load(folder)
    for value, words in (("128", "'128'"), (128.0, "'128.0'"), (True, "'True'"), (None, "'None'")):
        folder, config, _ = broken(f"type {words}")
        (folder / "config.json").write_text(json.dumps(config | {"latent_dim": value}))
        with pytest.raises(ValueError, match=f"latent_dim is {words}, expected a whole number"):
            checkpoint.load(folder)
    with pytest.raises(ValueError, match="config.json is missing"):
        checkpoint.load(tmp_path / "nowhere")
    folder, _, _ = broken("truncated")
    whole = (folder / "model.safetensors").read_bytes()
    for data, words in ((b"123", "or a damaged one"), (whole[:-40], "cut off or has bytes too many"), (whole[:99], "damaged")):
        (folder / "model.safetensors").write_bytes(data)
        with pytest.raises(ValueError, match=f"is not a safetensors file.*{words}.*fetch it again"):
            checkpoint.load(folder)


@pytest.fixture
def folder(tmp_path):
    """A good checkpoint."""
    model = RenderFormer(ModelConfig(**MICRO))
    checkpoint.save(model.config, model.state_dict(), tmp_path / "good", {"triangles": "9"})
    return tmp_path / "good"


@pytest.mark.parametrize("prefix", ["module.", "_orig_mod.", "_orig_mod.module.", "model."])
def test_a_wrappers_prefix_is_taken_off_and_said(folder, prefix):
    from safetensors.torch import load_file, save_file

    state, said = load_file(folder / "model.safetensors"), []
    save_file({prefix + name: value for name, value in state.items()}, folder / "model.safetensors")
    model, _ = checkpoint.load(folder, said.append)
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())
    assert len(said) == 1 and repr(prefix) in said[0]


def test_a_good_checkpoint_says_nothing(folder, capsys):
    checkpoint.load(folder)
    assert capsys.readouterr() == ("", "")


def test_other_names_are_counted_not_listed(folder):
    from safetensors.torch import save_file

    save_file({f"{'ab'[i % 2]}.layer{i}": torch.zeros(1) for i in range(90)}, folder / "model.safetensors")
    with pytest.raises(ValueError, match=r"unknown parameter a.layer0, a.layer10, a.layer12 and 87 more") as error:
        checkpoint.load(folder)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 820000000\n", "Git LFS pointer.*git lfs pull"),
        (b"\n<!DOCTYPE html>\n<html><head><title>Sign in</title>", "HTML page.*download the file"),
        (b"", "is empty.*fetch it again"),
    ],
)
@pytest.mark.parametrize("name", ["model.safetensors", "config.json"])
def test_what_a_failed_download_left_is_named(folder, name, content, words):
    (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name} is .*{words}".replace("is .*is", "is")):
        checkpoint.load(folder)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_renamed_pickle_is_named_and_not_read(folder, zipped):
    torch.save({"tri_token": torch.zeros(3)}, folder / "model.safetensors", _use_new_zipfile_serialization=zipped)
    with pytest.raises(ValueError, match=r"is a pickle that was renamed.*save_file"):
        checkpoint.load(folder)


def test_a_config_may_begin_with_a_byte_order_mark(folder):
    (folder / "config.json").write_bytes(b"\xef\xbb\xbf" + (folder / "config.json").read_bytes())
    assert checkpoint.load(folder)[1] == {"triangles": "9"}
