"""The network computes what the released one does, and its fast paths what their slow references do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from model.config import ModelConfig
from model.layers import SelfAttention, Windows
from model.renderformer import RenderFormer, Triangles, from_patches, material_patches, ray_directions, to_patches
from model.training import scene_of
from tests.model.synthetic import batch
from tests.model.test_config import MICRO
from tests.parity import difference

RESOLUTION = 16


def build(**fields) -> RenderFormer:
    """A small network with weights large enough that every part shows in the output."""
    torch.manual_seed(0)
    model = RenderFormer(ModelConfig(**(MICRO | fields))).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim >= 2:
                parameter.mul_(2)
    return model


def inputs(model: RenderFormer, **sizes):
    data = batch(7, resolution=RESOLUTION, **sizes)
    return scene_of(data, model, "cpu"), torch.from_numpy(data["camera_to_world"]), torch.from_numpy(data["fov_deg"])


def run(model, scene, cameras, fov, resolution=RESOLUTION) -> torch.Tensor:
    with torch.inference_mode():
        return model(scene, cameras, fov, resolution)


def test_released_outputs_are_reproduced(shared_data):
    folders = sorted(path for path in (shared_data / "parity").iterdir() if path.is_dir())
    assert folders
    for folder in folders:
        assert difference(folder) < 2e-5, folder.name


VARIANTS = {
    "base": {},
    "world": {"turn_to_cam_coord": False},
    "nerf": {"pe_type": "nerf"},
    "nerf world": {"pe_type": "nerf", "turn_to_cam_coord": False},
    "no dpt": {"use_dpt_decoder": False},
    "neither": {"use_dpt_decoder": False, "view_transformer_include_self_attn": False},
    "0 + 4": {"num_layers": 0},
    "vector": {"texture_channels": 10, "texture_encode_patch_size": 1},
    "no registers": {"num_register_tokens": 0},
    "doubled frequency": {"rope_double_max_freq": True},
}


@pytest.mark.parametrize("fields", VARIANTS.values(), ids=VARIANTS)
def test_constant_materials_equal_full_patches(fields):
    model = build(**fields)
    scene, cameras, fov = inputs(model, padded=3)
    patches = material_patches(scene.material, model.config.texture_encode_patch_size)
    full = Triangles(scene.triangles, scene.vertex_normals, patches, scene.mask)
    fast, slow = run(model, scene, cameras, fov), run(model, full, cameras, fov)
    assert fast.std() > 1e-3
    torch.testing.assert_close(fast, slow, atol=2e-5, rtol=1e-5)


def test_gradients_reach_the_full_patch_weight_alike():
    model = build()
    scene, cameras, fov = inputs(model)
    patches = material_patches(scene.material, model.config.texture_encode_patch_size)
    found = []
    for material in (scene.material, patches):
        model.zero_grad()
        model(Triangles(scene.triangles, scene.vertex_normals, material), cameras, fov, RESOLUTION).sum().backward()
        found.append(model.texture_encoder.weight.grad.clone())
    torch.testing.assert_close(*found, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("fields", VARIANTS.values(), ids=VARIANTS)
def test_many_views_equal_one_at_a_time(fields):
    """Keys and values are projected once for all views; alone, each view has its own."""
    model = build(**fields)
    scene, cameras, fov = inputs(model, views=3, padded=2)
    together = run(model, scene, cameras, fov)
    alone = [run(model, scene, cameras[:, i : i + 1], fov[:, i : i + 1]) for i in range(3)]
    torch.testing.assert_close(together, torch.cat(alone, dim=1), atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("fields", VARIANTS.values(), ids=VARIANTS)
def test_padding_changes_nothing(fields):
    model = build(**fields)
    scene, cameras, fov = inputs(model)
    plain = run(model, scene, cameras, fov)

    def pad(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x, torch.full_like(x[:, :5], 0.3)], dim=1)

    mask = torch.ones(pad(scene.triangles).shape[:2], dtype=torch.bool)
    mask[:, -5:] = False
    padded = Triangles(pad(scene.triangles), pad(scene.vertex_normals), pad(scene.material), mask)
    torch.testing.assert_close(run(model, padded, cameras, fov), plain, atol=2e-5, rtol=1e-5)


def moved(scene: Triangles, cameras: torch.Tensor, motion: torch.Tensor) -> tuple[Triangles, torch.Tensor]:
    rotation, shift = motion[:3, :3], motion[:3, 3]
    triangles = scene.triangles @ rotation.T + shift
    return Triangles(triangles, scene.vertex_normals @ rotation.T, scene.material, scene.mask), motion @ cameras


def test_camera_space_view_stage_sees_no_rigid_motion():
    """With normals unturned and no view-independent layers, only the view stage could notice; in world space it does."""
    motion = torch.eye(4)
    motion[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    motion[:3, :3] *= torch.linalg.det(motion[:3, :3])
    motion[:3, 3] = torch.tensor([0.3, -0.2, 0.1])
    for world, same in ((False, True), (True, False)):
        model = build(num_layers=0, turn_to_cam_coord=not world)
        scene, cameras, fov = inputs(model)
        other, turned = moved(scene, cameras, motion)
        other.vertex_normals = scene.vertex_normals
        difference = (run(model, scene, cameras, fov) - run(model, other, turned, fov)).abs().max()
        assert (difference < 1e-4) == same


def test_view_independent_stage_sees_no_translation():
    """Rotary positions are relative: the tokens of a shifted scene are the same, to rounding."""
    model = build()
    scene, _, _ = inputs(model)
    shifted = Triangles(scene.triangles + torch.tensor([0.5, -0.25, 1.0]), scene.vertex_normals, scene.material)
    with torch.inference_mode():
        torch.testing.assert_close(model.encode(scene), model.encode(shifted), atol=1e-4, rtol=1e-4)


def test_swin_windows_equal_masked_attention():
    """The shifted windows of a 16 x 24 token grid against attention over all tokens, masked one pair at a time."""
    torch.manual_seed(0)
    h, w, size, shift = 16, 24, 8, 4
    attention = SelfAttention(32, 2).eval()
    x = torch.randn(2, h * w, 32)
    for shifted in (False, True):
        s = shift if shifted else 0
        row, column = np.divmod(np.arange(h * w), w)
        # Windows start at s, s + 8, ...; the strips before s and after the last full window stand alone.
        place = ((row - s) // size) * 100 + (column - s) // size
        mask = torch.from_numpy(place[:, None] == place[None, :])[None, None]
        with torch.inference_mode():
            slow = attention(x, None, mask)
            fast = Windows(h, w, shifted, x.device).apply(attention, x)
        torch.testing.assert_close(fast, slow, atol=1e-5, rtol=0)


def test_rays_go_through_pixel_centres():
    directions = ray_directions(torch.tensor([90.0]), 4, 4)[0]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(4, 4))
    corner = directions[0, 0] / -directions[0, 0, 2]  # top left: left and up of the axis
    torch.testing.assert_close(corner, torch.tensor([-0.75, 0.75, -1.0]))
    image = torch.arange(2 * 16 * 24 * 3, dtype=torch.float32).view(2, 16, 24, 3)
    torch.testing.assert_close(from_patches(to_patches(image, 8), 2, 3, 8), image.permute(0, 3, 1, 2))


def test_resolution_must_fit():
    model = build()
    scene, cameras, fov = inputs(model)
    with pytest.raises(ValueError, match="multiple of 8"):
        run(model, scene, cameras, fov, 20)
    swin = build(view_transformer_use_swin_attn=True)
    with pytest.raises(ValueError, match="multiple of 64"):
        run(swin, scene, cameras, fov, 32)
