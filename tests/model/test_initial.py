"""An informed start: rays begin with the triangles in their direction, and nothing but initial values changes."""

from __future__ import annotations

import pytest
import torch

from model.renderformer.config import ModelConfig
from model.renderformer.initial import start_informed
from model.renderformer.inputs import Triangles
from model.renderformer.network import RenderFormer

TINY = {
    "latent_dim": 128, "num_heads": 1, "dim_feedforward": 256, "num_layers": 1, "num_register_tokens": 2,
    "view_transformer_latent_dim": 128, "view_transformer_n_heads": 1, "view_transformer_ffn_hidden_dim": 256,
    "view_transformer_n_layers": 1, "texture_encode_patch_size": 1, "use_dpt_decoder": False,
}  # fmt: skip


def seen_from_the_right(model: RenderFormer, bright: int) -> torch.Tensor:
    """Sensitivity of each of the 8 x 8 ray bundles to the material of triangle ``bright`` (0 left, 1 right), (8, 8)."""
    corner = torch.tensor([[0.0, 0, 0], [0.15, 0, 0], [0, 0.15, 0]]) - 0.05
    triangles = torch.stack([corner + torch.tensor([x, 0.0, 0.0]) for x in (-0.45, 0.45)])[None]
    normals = torch.tensor([0.0, 0, 1]).expand(1, 2, 3, 3)
    material = torch.full((1, 2, 13), 0.4)
    material[..., 10:] = 0
    material.requires_grad_()
    camera = torch.eye(4)
    camera[2, 3] = 1.75  # looks along -z at the origin
    image = model(Triangles.pack(triangles, normals, material), camera[None, None], torch.tensor([[45.0]]), (64, 64))[0, 0]
    bundles = image.mean(-1).unflatten(0, (8, 8)).unflatten(2, (8, 8)).mean(dim=(1, 3))
    return torch.stack(
        [torch.autograd.grad(b, material, retain_graph=True)[0][0, bright].abs().sum() for b in bundles.flatten()]
    ).view(8, 8)


def test_rays_begin_with_the_triangles_in_their_direction():
    torch.manual_seed(0)
    model = RenderFormer(ModelConfig(**TINY))
    model.eval()
    start_informed(model)
    left, right = seen_from_the_right(model, 0), seen_from_the_right(model, 1)
    share = right / (left + right)
    assert share[:, 6:].mean() > 0.8 and share[:, :2].mean() < 0.2


def test_a_model_without_the_camera_frame_is_refused_by_the_setting_that_helps():
    with pytest.raises(ValueError, match="informed_start=false"):
        start_informed(RenderFormer(ModelConfig(**TINY, turn_to_cam_coord=False)))
