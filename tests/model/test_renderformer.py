"""The network computes what the released one does, and its fast paths what their slow references do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from checks.parity import difference
from model.renderformer import reference
from model.renderformer.config import ModelConfig
from model.renderformer.inputs import Triangles, constant_material, kept_cells, material_patches, textured_patches
from model.renderformer.layers import SelfAttention, Windows
from model.renderformer.network import RenderFormer, from_patches, ray_directions, to_patches
from tests.model.synthetic import batch
from tests.model.test_config import MICRO

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
    data = batch(7, **({"resolution": RESOLUTION} | sizes))
    return model.read(data), torch.from_numpy(data["camera_to_world"]), torch.from_numpy(data["fov_deg"])


def plain(model: RenderFormer, resolution: int = RESOLUTION, textured: bool = False, **sizes) -> torch.Tensor:
    """The slow reference on the batch that ``inputs`` reads."""
    data = {name: torch.from_numpy(x) for name, x in batch(7, resolution=resolution, textured=textured, **sizes).items()
            if isinstance(x, np.ndarray)}  # fmt: skip
    channels, patch = model.config.texture_channels, model.config.texture_encode_patch_size
    material = constant_material(data["diffuse"], data["specular"], data["roughness"], data["emission"], channels)
    patches = material_patches(material, patch)
    if textured and patch > 1:
        rows = data["patch_index"] >= 0
        patches[rows] = textured_patches(data["patches"][data["patch_index"][rows]], material[rows], patch)
    with torch.inference_mode():
        return reference.forward(
            model, data["triangles"], data["vertex_normals"], patches, data["mask"], data["camera_to_world"],
            data["fov_deg"], resolution,
        )  # fmt: skip


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
    "swin": {"view_transformer_use_swin_attn": True},
}


@pytest.mark.parametrize("fields", VARIANTS.values(), ids=VARIANTS)
@pytest.mark.parametrize("textured", [False, True])
def test_fast_paths_equal_the_plain_network(fields, textured):
    """Packed scenes of two sizes, collapsed and full patches, three views from one projection of keys and values."""
    model = build(**fields)
    resolution = 64 if model.config.view_transformer_use_swin_attn else RESOLUTION
    sizes = {"views": 3, "padded": 4, "textured": textured}
    scene, cameras, fov = inputs(model, resolution=resolution, **sizes)
    assert (scene.patches is not None) == (textured and model.config.texture_encode_patch_size > 1)
    expected = plain(model, resolution, **sizes)
    assert expected.std() > 1e-3
    torch.testing.assert_close(run(model, scene, cameras, fov, resolution), expected, atol=2e-5, rtol=1e-5)
    for rays_at_once in (1, 10**9):  # one view at a time, and all together
        images = model.render(scene, cameras, fov, resolution, rays_at_once=rays_at_once)
        torch.testing.assert_close(images, expected, atol=2e-5, rtol=1e-5)


def test_textures_are_read_through_patches_of_the_models_size():
    model = build(texture_encode_patch_size=4)
    scene, _, _ = inputs(model, textured=True)
    assert scene.patches.shape[1:] == (13, 4, 4) and 0 < len(scene.textured) < len(scene.triangles)
    kept = kept_cells(4)
    assert (scene.patches[:, :, ~kept] == 0).all()
    data = batch(7, resolution=RESOLUTION, textured=True)
    texture = data["patches"][data["patch_index"][data["mask"]][scene.textured[0]]].astype(np.float32)
    i = np.arange(32)
    block = (i[:8, None] + i[None, 24:] <= 32) * texture[0, :8, 24:]  # cell (0, 3): what of its 8 x 8 texels is kept
    expected = block.sum() / (i[:8, None] + i[None, 24:] <= 32).sum()
    assert scene.patches[0, 0, 0, 3].item() == pytest.approx(expected, rel=1e-3)
    flat = material_patches(torch.full((1, 7), 0.25), 32)
    const = textured_patches(flat, torch.full((1, 13), 0.25), 4)
    torch.testing.assert_close(const, material_patches(torch.full((1, 13), 0.25), 4))
    with pytest.raises(ValueError, match="texture_encode_patch_size=5"):
        inputs(build(texture_encode_patch_size=5), textured=True)


def test_released_patches_that_repeat_one_value_are_collapsed():
    model = build()
    scene, cameras, fov = inputs(model)
    counts = scene.segments.lengths
    material = scene.material.clone()
    patches = material_patches(material, 2)
    patches[3, 0, 0, 1] += 0.5  # one textured triangle

    def padded(x):
        return torch.stack(x.split(counts))

    packed = Triangles.pack(padded(scene.triangles), padded(scene.vertex_normals), padded(patches))
    assert packed.textured.tolist() == [3] and torch.equal(packed.material[4:], material[4:])
    assert not torch.equal(run(model, packed, cameras, fov), run(model, scene, cameras, fov))


def test_gradients_reach_the_full_patch_weight_alike():
    model = build()
    scene, cameras, fov = inputs(model)
    patches = material_patches(scene.material, model.config.texture_encode_patch_size)
    everything = torch.arange(len(patches))
    full = Triangles(scene.triangles, scene.vertex_normals, scene.material, scene.segments, patches, everything)
    gradients = []
    for scenes in (scene, full):
        model.zero_grad()
        model(scenes, cameras, fov, RESOLUTION).sum().backward()
        gradients.append(model.texture_encoder.weight.grad.clone())
    torch.testing.assert_close(*gradients, atol=1e-3, rtol=1e-4)


def test_activation_checkpointing_changes_neither_value_nor_gradient():
    model = build().train()
    scene, cameras, fov = inputs(model, padded=3)
    results = []
    for on in (False, True):
        model.activation_checkpointing(on)
        model.zero_grad()
        y = model(scene, cameras, fov, RESOLUTION)
        y.square().sum().backward()
        results.append([y.detach(), *(p.grad.clone() for p in model.parameters())])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_compiled_layers_are_compiled_once_for_scenes_of_any_size():
    """Else a run would compile at every step. Traced only: what the backend makes of the graphs is torch's matter."""
    from torch._dynamo.utils import counters

    plain, compiled = build(num_layers=2), build(num_layers=2)
    compiled.compile_layers("eager")
    graphs = []
    for triangles, padded, scenes in ((12, 0, 2), (20, 3, 2), (33, 5, 3), (41, 1, 4), (52, 2, 2)):
        sizes = {"triangles": triangles, "padded": padded, "scenes": scenes}
        scene, cameras, fov = inputs(plain, **sizes)
        y = [model(scene, cameras, fov, RESOLUTION).detach() for model in (plain, compiled)]
        torch.testing.assert_close(*y, atol=1e-6, rtol=1e-5)
        graphs.append(counters["stats"]["unique_graphs"])
    assert graphs[0] > 0 and graphs[2] == graphs[3] == graphs[4]


@pytest.mark.parametrize("precision", ["mixed", "bf16"])
def test_lower_precision_stays_near(precision):
    """bfloat16 has 8 bits: outputs differ by about a hundredth, positions and angles must not."""
    model = build()
    scene, cameras, fov = inputs(model, padded=2)
    exact = run(model, scene, cameras, fov)
    rough = model.render(scene, cameras, fov, RESOLUTION, precision=precision)
    assert rough.dtype == torch.float32
    assert 0 < (rough - exact).abs().max() < 0.05 * exact.abs().max()
    far = torch.eye(4).expand(2, 2, 4, 4).clone()
    far[..., :3, 3] = 1000.125  # in bfloat16 a camera this far off would see everything in one place
    with torch.autocast("cpu", dtype=torch.bfloat16):
        tokens = model.encode(scene)
        points = model.view_transformer.camera_points(tokens, far)
    torch.testing.assert_close(points, (tokens.positions - 1000.125).expand(2, -1, -1), atol=0, rtol=0)


def moved(scene: Triangles, cameras: torch.Tensor, motion: torch.Tensor) -> tuple[Triangles, torch.Tensor]:
    rotation, shift = motion[:3, :3], motion[:3, 3]
    triangles = scene.triangles @ rotation.T + shift
    return Triangles(triangles, scene.vertex_normals @ rotation.T, scene.material, scene.segments), motion @ cameras


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
    moved_by = torch.tensor([0.5, -0.25, 1.0])
    shifted = Triangles(scene.triangles + moved_by, scene.vertex_normals, scene.material, scene.segments)
    with torch.inference_mode():
        torch.testing.assert_close(model.encode(scene).x, model.encode(shifted).x, atol=1e-4, rtol=1e-4)


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
            slow = attention(x, mask=mask)
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
