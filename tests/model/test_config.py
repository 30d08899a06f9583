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
    with pytest.raises(ValueError, match="tri_token has shape"):
        checkpoint.load(folder)
    with pytest.raises(ValueError, match="config.json is missing"):
        checkpoint.load(tmp_path / "nowhere")
    folder, _, _ = broken("truncated")
    (folder / "model.safetensors").write_bytes(b"123")
    with pytest.raises(ValueError, match="not a safetensors file"):
        checkpoint.load(folder)
