"""The guided network: closed forms against sums over the light, and what must hold whatever the weights are."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from model.errors import InputError
from model.renderformer import checkpoint
from model.renderformer.architectures import build, load_config
from model.renderformer.guided.config import GuideConfig, GuidedConfig
from model.renderformer.guided.flops import forward_flops
from model.renderformer.guided.inputs import Scenes
from model.renderformer.guided.light import diffuse_light, joint_masking, masking, specular_light, vector_form_factor
from model.renderformer.guided.network import GuidedNetwork
from model.renderformer.guided.pixels import (
    SHARED,
    Lobes,
    Observer,
    from_bundles,
    share_lobes,
    share_lobes_across,
    to_bundles,
    without_dots,
)
from model.renderformer.guided.triangles import bounce
from model.renderformer.network import to_radiance
from model.renderformer.recipe import FitConfig
from model.renderformer.training import fit
from model.training.parallel import Group
from stages.renderformer.dataset.augment import scene_arrays
from stages.renderformer.guides import GuideCaster
from stages.renderformer.inference.predict import batched, padded_arrays
from tests.model.synthetic import batch, flat_scene

SIDE, VIEWS = 16, 2
SMALL = {"token_dim": 24, "token_layers": 1, "token_heads": 1, "head_dim": 16, "head_layers": 1}
LIGHT = torch.tensor([[0.5, -0.4, 1.0], [0.9, 0.5, 1.3], [-0.4, 0.4, 1.1]], dtype=torch.float64)


def samples(corners: torch.Tensor, n: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    """Points spread evenly over a triangle, (n^2, 3), and the area of each."""
    u, v = (x.flatten() for x in torch.meshgrid(*[(torch.arange(n, dtype=torch.float64) + 0.5) / n] * 2, indexing="ij"))
    root = u.sqrt()
    weights = torch.stack([1 - root, root * (1 - v), root * v], dim=1)
    area = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0]).norm() / 2
    return weights @ corners, area / n**2


def solid_angles(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions from the origin to a triangle's points, and the solid angle of each."""
    points, area = samples(corners)
    distance = points.norm(dim=1, keepdim=True)
    normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    ways = points / distance
    return ways, area * (ways @ (normal / normal.norm())).abs() / distance[:, 0] ** 2


# --- closed forms -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-0.3, 0.5, 0.81)])
def test_diffuse_light_is_the_integral_over_the_light(normal):
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    factor = vector_form_factor(torch.zeros(3, dtype=torch.float64), LIGHT)
    ways, angles = solid_angles(LIGHT)
    expected = ((ways @ n).clamp(min=0) * angles).sum() / math.pi
    torch.testing.assert_close(diffuse_light(factor, n), expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(
        diffuse_light(vector_form_factor(torch.zeros(3).double(), LIGHT.flip(0)), n), expected, rtol=1e-4, atol=0
    )  # fmt: skip  - both sides emit


def test_a_corner_of_a_square_overhead_has_the_textbooks_form_factor():
    """A square of side a at height c above the point, one corner on the normal: twice a/r atan(a/r) over 2 pi."""
    a, c = 1.5, 2.0
    square = torch.tensor([[0, 0, c], [a, 0, c], [a, a, c], [0, a, c]], dtype=torch.float64)
    up = torch.tensor([0, 0, 1], dtype=torch.float64)
    total = sum(diffuse_light(vector_form_factor(torch.zeros(3).double(), square[list(i)]), up) for i in ((0, 1, 2), (0, 2, 3)))
    r = math.hypot(a, c)
    assert total.item() == pytest.approx(2 * a / r * math.atan(a / r) / (2 * math.pi), rel=1e-9)


def test_single_precision_is_enough_for_lights_as_small_as_the_datas():
    far = (LIGHT * 0.05 + torch.tensor([0, 0, 2.4])).double()
    exact = vector_form_factor(torch.zeros(3).double(), far)
    torch.testing.assert_close(vector_form_factor(torch.zeros(3), far.float()).double(), exact, rtol=2e-4, atol=1e-8)


def brdf(normal: torch.Tensor, eye: torch.Tensor, ways: torch.Tensor, alpha: float) -> torch.Tensor:
    """White GGX times the cosine of directions."""
    half = torch.nn.functional.normalize(ways + eye, dim=-1)
    facet, light = half @ normal, ways @ normal
    spread = alpha**2 / (math.pi * (facet**2 * (alpha**2 - 1) + 1) ** 2)
    width = torch.tensor(alpha, dtype=torch.float64)
    return spread * joint_masking(width, normal @ eye, light) / (4 * (normal @ eye))


@pytest.mark.parametrize("alpha", [0.15, 0.3, 0.8])
def test_specular_light_is_the_lobes_integral_over_a_small_light(alpha):
    normal = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    small = LIGHT * 0.1 + torch.tensor([0.6, 0.1, 1.5], dtype=torch.float64)
    ways, angles = solid_angles(small)
    factor = vector_form_factor(torch.zeros(3).double(), small)
    for eye in ((-0.35, -0.05, 0.93), (-0.6, 0.3, 0.74), (0.5, 0.5, 0.7)):
        v = torch.nn.functional.normalize(torch.tensor(eye, dtype=torch.float64), dim=0)
        expected = (brdf(normal, v, ways, alpha) * angles).sum()
        got = specular_light(factor, normal, v, torch.tensor(alpha, dtype=torch.float64))
        assert got.item() == pytest.approx(expected.item(), rel=0.06), eye


def test_a_mirror_shows_the_lights_own_radiance_and_no_surface_more():
    centre = torch.nn.functional.normalize(vector_form_factor(torch.zeros(3).double(), LIGHT), dim=0)
    normal = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    eye = centre * torch.tensor([-1, -1, 1.0])
    factor = vector_form_factor(torch.zeros(3).double(), LIGHT)
    values = [specular_light(factor, normal, eye, torch.tensor(a, dtype=torch.float64)).item() for a in (1e-4, 0.05, 0.2, 1.0)]
    assert values[0] == pytest.approx(1, abs=1e-3) and values == sorted(values, reverse=True)
    below = specular_light(vector_form_factor(torch.zeros(3).double(), -LIGHT), normal, eye, torch.tensor(0.3).double())
    assert below == 0


def test_masking_is_one_from_above_and_falls_to_grazing():
    alpha, cosine = torch.tensor(0.5), torch.linspace(0.01, 1, 50)
    assert masking(alpha, cosine)[-1] == 1 and (masking(alpha, cosine).diff() > 0).all()
    assert (joint_masking(alpha, cosine, cosine) >= masking(alpha, cosine) ** 2 - 1e-6).all()


# --- the network ------------------------------------------------------------------------------------------------------------


def guided_batch(step: int = 0, lights: int = 2, scenes: int = 2, views: int = VIEWS, triangles: int = 12) -> dict[str, Any]:
    """Random scenes with random guides: rays that land anywhere, which no formula here minds."""
    data = batch(step, scenes, triangles, views, SIDE)
    rng = np.random.default_rng(step + 100)
    data["emission"][:, :lights] = rng.uniform(500, 2000, (scenes, lights, 3))
    data["roughness"] = rng.uniform(0.1, 1, (scenes, triangles)).astype(np.float32)
    pixels = (scenes, views, SIDE, SIDE)

    def weights(*shape: int) -> np.ndarray:
        return rng.dirichlet([1, 1, 1], shape)[..., 1:].astype(np.float32)

    guides = {
        "light_triangles": np.tile(np.arange(lights, dtype=np.int32), (scenes, 1)),
        "triangle_seen": rng.random((scenes, triangles, 4, lights)) < 0.6,
        "hit": rng.integers(lights - 1, triangles, (*pixels, 4)).astype(np.int32),
        "hit_weights": weights(*pixels, 4),
        "mirror": rng.integers(-1, triangles, pixels).astype(np.int32),
        "mirror_weights": weights(*pixels),
        "lobe": rng.integers(-1, triangles, (*pixels, 4)).astype(np.int32),
        "lobe_weights": weights(*pixels, 4),
        "light_seen": rng.random((*pixels, 4, lights)) < 0.6,
        "bounces": rng.integers(-1, triangles, (scenes, triangles, 2, 16)).astype(np.int32),
        "bounces_weights": weights(scenes, triangles, 2, 16),
        "vertex": rng.integers(0, 3 * triangles, (scenes, triangles, 3)).astype(np.int32),
    }
    guides["hit"][guides["hit"] < lights] = -1
    guides["main"] = np.where((guides["hit"] >= 0).any(-1), (guides["hit"] >= 0).argmax(-1), -1).astype(np.int32)
    return data | {f"guide_{name}": values for name, values in guides.items()}


def network(seed: int = 0, trained: bool = True, **config: Any) -> GuidedNetwork:
    """With random weights everywhere, so that nothing is zero that training would change."""
    torch.manual_seed(seed)
    model = GuidedNetwork(GuidedConfig(**{**SMALL, **config}))
    if trained:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(torch.randn_like(parameter) * 0.1)
    return model.eval()


def image(model: GuidedNetwork, data: dict[str, Any]) -> torch.Tensor:
    """Radiance."""
    with torch.inference_mode():
        return to_radiance(model(*model.arguments(data, "cpu")))


RUNGS = {
    "hits alone": GuideConfig(False, False, False, False, False, False),
    "light": GuideConfig(True, False, False, False, False, False),
    "mirror": GuideConfig(True, True, False, False, False, False),
    "visibility": GuideConfig(True, True, False, True, False, False),
    "shadow rays": GuideConfig(True, True, False, True, True, False),
    "lobe": GuideConfig(bounces=False),
    "all": GuideConfig(),
}


@pytest.mark.parametrize("rung", RUNGS)
def test_before_training_the_image_is_the_closed_form(rung):
    """The sum over lights and rays, written out; and a trained network without what it learned is that again."""
    data, guide = guided_batch(), RUNGS[rung]
    model = network(trained=False, guide=guide)
    scenes, pixels, _ = model.arguments(data, "cpu")
    with torch.inference_mode():
        encoded = model.encode(scenes)
        known = Observer(scenes, encoded.lit, model.config.guide).know(pixels)
    rays, expected = known.rays, torch.zeros_like(known.rays.position)
    if guide.light:
        for light in range(2):
            radiance = scenes.radiance[:, None, light] * known.direct.seen[..., light, None]
            expected += rays.diffuse * known.direct.diffuse[..., light, None] * radiance
            expected += rays.specular * known.direct.specular[..., light, None] * radiance
    if guide.bounces:
        expected += rays.diffuse * known.bounced
    if guide.mirror or guide.lobe:
        expected += rays.specular * known.reflected.repeat_interleave(4, dim=1)
    expected = (expected * rays.there).unflatten(1, (-1, 4)).mean(dim=2) * scenes.scale[:, None, None]
    size = (2, VIEWS, 2, 2, 8, 8, 3)  # bundles of 8 x 8 pixels
    expected = expected.view(size).transpose(3, 4).reshape(2, VIEWS, SIDE, SIDE, 3)
    torch.testing.assert_close(image(model, data), expected, rtol=1e-5, atol=1e-6 * float(expected.max()))
    assert (expected.max() > 0) == (rung != "hits alone")
    trained = network(guide=guide)
    assert not torch.allclose(image(trained, data), expected, rtol=0.01)
    start = trained.without_learning()
    assert (start is None) == (rung == "hits alone")
    if start is not None:
        torch.testing.assert_close(image(start, data), image(model, data))


def test_the_closed_form_is_linear_in_light():
    """Relighting by any colours is a sum of what each light sheds alone."""
    data, model = guided_batch(), network(trained=False)
    factors = np.array([[0.3, 1.7, 0.0], [2.0, 0.1, 0.5]], np.float32)
    parts = []
    for light, factor in enumerate(factors):
        alone = data["emission"].copy()
        alone[:, 1 - light] = 0
        parts.append(image(model, {**data, "emission": alone}) * torch.from_numpy(factor))
    relit = data["emission"].copy()
    relit[:, :2] *= factors
    torch.testing.assert_close(sum(parts), image(model, {**data, "emission": relit}), rtol=2e-5, atol=1e-5)


def test_lobes_are_shared_by_neighbours_that_see_the_same():
    """Four pixels in a row of a bundle: two near one another, one around a corner, one that hits nothing."""
    radiance = torch.tensor([[1.0, 3.0, 10.0, 7.0]])[..., None].expand(1, 4, 3)
    position = torch.tensor([[[0, 0, 0], [0.001, 0, 0], [0.002, 0, 0], [0.003, 0, 0]]])
    normal = torch.tensor([[[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [0, 0, 1]]])
    there = torch.tensor([[1.0, 1, 1, 0]])[..., None]

    def shared(roughness: float) -> torch.Tensor:
        alpha = torch.full((1, 4, 1), roughness**2)
        return share_lobes(Lobes(radiance, position, normal, alpha, there, SHARED * alpha * 0.5), 4)[0, :, 0]

    torch.testing.assert_close(shared(0.6), torch.tensor([2.0, 2.0, 10.0, 7.0]), atol=0.01, rtol=0)
    torch.testing.assert_close(shared(0.01), radiance[0, :, 0])  # a mirror shares nothing
    assert shared(0.6).sum() == pytest.approx(21, abs=0.05)  # no light is made


def test_in_whole_views_lobes_are_shared_across_the_edges_of_bundles():
    """Noise on a rough wall: what is left changes no more across an edge than within a bundle. A mirror shares nothing."""
    grid, side = (2, 3), 8
    height, width = 2 * side, 3 * side
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    place = torch.stack([rows, columns, 0 * rows], dim=-1)[None, None] * 1e-4
    noise = torch.rand(1, 1, height, width, 3, generator=torch.Generator().manual_seed(0))

    def shared(alpha: float, share) -> torch.Tensor:
        def pixels(values: torch.Tensor) -> torch.Tensor:
            return to_bundles(values, side).flatten(1, 3)

        ones = torch.ones(1, 1, height, width, 1)
        up = torch.tensor([0.0, 0, 1]).expand_as(place)
        lobes = Lobes(*map(pixels, (noise, place, up, alpha * ones, ones, SHARED * alpha * ones)))
        return from_bundles(share(lobes).unflatten(1, (1, 6, side**2)), height, width, side)[0, 0, ..., 0]

    def steps(image: torch.Tensor) -> tuple[float, float]:
        """Mean change from column to column: across the edges of bundles, and elsewhere."""
        change = image.diff(dim=1).abs().mean(dim=0)
        edge = torch.arange(1, width) % side == 0
        return float(change[edge].mean()), float(change[~edge].mean())

    across, within = steps(shared(0.3, lambda lobes: share_lobes_across(lobes, side**2, grid)))
    assert across < 2 * within
    across, within = steps(shared(0.3, lambda lobes: share_lobes(lobes, side**2)))
    assert across > 10 * within
    mirror = shared(1e-5, lambda lobes: share_lobes_across(lobes, side**2, grid))
    torch.testing.assert_close(mirror, without_dots(noise[0], torch.ones(1, height, width, 1))[0, ..., 0])


def test_dots_are_what_one_pixel_alone_shows():
    image, there = torch.ones(1, 7, 9, 3), torch.ones(1, 7, 9, 1)
    image[0, 2, 2] = 50  # alone
    image[0, 0, 8] = 50  # alone, in a corner
    image[0, 4, 4:7] = torch.tensor([20.0, 30, 40])[:, None]  # a line keeps its middle
    image[0, 6, 1] = 0.1
    expected = image.clone()
    expected[0, 2, 2] = expected[0, 0, 8] = 1
    expected[0, 4, 4:7] = torch.tensor([1.0, 20, 1])[:, None]
    torch.testing.assert_close(without_dots(image, there), expected)
    image[0, 3:, :] = 9
    there[0, 3:] = 0  # what hits nothing limits nobody
    thin = torch.zeros_like(there)
    thin[0, 2, 2:4] = 1
    assert without_dots(image, there)[0, 2, 2, 0] == 1
    assert without_dots(image, thin)[0, 2, 2, 0] == 50  # a pixel that has but one neighbour stays


@pytest.mark.parametrize("tokens", ["none", "lookup", "encoder"])
def test_doubled_light_doubles_the_image(tokens):
    """Before the image is written as a logarithm, which rounds by its own steps."""
    model, data = network(tokens=tokens), guided_batch()

    def radiance(factor: int) -> torch.Tensor:
        scenes, pixels, _ = model.arguments({**data, "emission": factor * data["emission"]}, "cpu")
        with torch.inference_mode():
            return model.decode(model.encode(scenes), pixels)

    once, twice = radiance(1), radiance(2)
    assert once.max() > 0
    torch.testing.assert_close(twice, 2 * once, rtol=1e-6, atol=1e-6 * float(once.max()))


def test_padding_changes_nothing():
    """Triangles and lights of a larger scene in the same batch."""
    model, data = network(), guided_batch(scenes=1)
    padded = dict(data)
    for name in ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission", "mask", "guide_triangle_seen"):
        value = np.concatenate([data[name], np.zeros_like(data[name][:, :3])], axis=1)
        padded[name] = value
    for name, nothing in (("bounces", -1), ("bounces_weights", 0), ("vertex", 0)):
        more = np.full_like(data[f"guide_{name}"][:, :3], nothing)
        padded[f"guide_{name}"] = np.concatenate([data[f"guide_{name}"], more], axis=1)
    padded["guide_light_triangles"] = np.pad(data["guide_light_triangles"], ((0, 0), (0, 2)), constant_values=-1)
    for name in ("guide_triangle_seen", "guide_light_seen"):
        padded[name] = np.concatenate([padded[name], np.zeros_like(padded[name])], axis=-1)
    torch.testing.assert_close(image(model, padded), image(model, data), rtol=1e-4, atol=1e-5)


def test_no_light_is_black():
    data = guided_batch()
    assert image(network(), {**data, "emission": 0 * data["emission"]}).abs().max() == 0


@pytest.mark.parametrize("tokens", ["none", "lookup", "encoder"])
def test_some_bundles_are_the_same_pixels_as_in_the_whole_view(tokens):
    from stages.renderformer.dataset.augment import PIXEL_GUIDES, take_bundles

    model, data = network(tokens=tokens), guided_batch(scenes=1)
    chosen = np.array([[3, 1], [0, 2]])
    view = {name: values[0] for name, values in data.items() if name in PIXEL_GUIDES or name == "image"}
    taken = {name: values[None] for name, values in take_bundles(view, chosen, 8).items()}
    few, whole = image(model, {**data, **taken}), image(model, data)
    assert few.shape == (1, 2, 2, 64, 3)
    for v in range(2):
        for place, bundle in enumerate(chosen[v]):
            row, column = 8 * (bundle // 2), 8 * (bundle % 2)
            expected = whole[0, v, row : row + 8, column : column + 8].reshape(64, 3)
            torch.testing.assert_close(few[0, v, place], expected, rtol=1e-4, atol=1e-5)


def test_frames_are_the_views_of_a_batch_in_portions(monkeypatch):
    from model.renderformer.guided import network as module

    """Lobes apart, which frames share across bundles: in portions as at once."""
    model, data = network(), guided_batch(scenes=1)
    without_lobes = network(guide=GuideConfig(lobe=False))
    views = [
        {
            name: values[:, [v]]
            for name, values in data.items()
            if name.startswith("guide_") and values.shape[1:3] == (VIEWS, SIDE)
        }
        | {name: data[name][:, [v]] for name in ("camera_to_world", "fov_deg")}
        for v in range(VIEWS)
    ]

    def frames(network: GuidedNetwork) -> torch.Tensor:
        return torch.stack([to_radiance(y) for y in network.frames(data, iter(views), (SIDE, SIDE), "cpu")])

    whole = frames(model)
    monkeypatch.setattr(module, "AT_ONCE", 600)  # a bundle at a time
    torch.testing.assert_close(frames(model), whole, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(frames(without_lobes), image(without_lobes, data)[0], rtol=1e-4, atol=1e-5)


def test_textured_hits_take_their_texel():
    data = guided_batch(scenes=1)
    index = np.full(data["mask"].shape, -1, np.int32)
    index[0, 5:] = 0
    half = np.zeros((1, 7, 32, 32), np.float16)
    half[:, :, :, 16:] = 1  # bright where corner 1 has more than half of the weight
    model = network(trained=False)
    scenes, pixels, _ = model.arguments({**data, "patch_index": index, "patches": half}, "cpu")
    with torch.inference_mode():
        encoded = model.encode(scenes)
        known = Observer(scenes, encoded.lit, model.config.guide).know(pixels)
    textured = (pixels.hit.triangle >= 5) & (pixels.hit.there[..., 0] > 0)
    bright = pixels.hit.weights[..., 1] > 0.5
    assert torch.equal(known.rays.diffuse[textured][:, 0], bright[textured].float())
    assert torch.equal(known.rays.roughness[textured][:, 0], bright[textured].float())


@pytest.mark.parametrize("rung", RUNGS)
@pytest.mark.parametrize("tokens", ["none", "encoder"])
def test_every_weight_learns(rung, tokens):
    model = network(guide=RUNGS[rung], tokens=tokens).train()
    model(*model.arguments(guided_batch(), "cpu")).square().mean().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_data_without_guides_is_refused():
    with pytest.raises(InputError, match=r"reads guides, and the data has none: .* shard.guides=true"):
        network().arguments(batch(0), "cpu")
    older = {name: values for name, values in guided_batch().items() if name not in ("guide_bounces", "guide_vertex")}
    with pytest.raises(InputError, match=r"reads bounces, and the data has none: .* shard.bounces=true"):
        network().arguments(older, "cpu")
    assert image(network(guide=GuideConfig(bounces=False)), older).max() > 0


# --- radiosity --------------------------------------------------------------------------------------------------------------


def cast(triangles: np.ndarray, albedo: float) -> Scenes:
    """Diffuse triangles (N, 3, 3) with the rays that leave them; flat, lit by nothing."""
    scene = flat_scene(triangles, albedo)
    guides = GuideCaster(scene).scene_guides()
    return Scenes.read(padded_arrays(scene) | batched(scene_arrays(guides)), "cpu")


def grid(corner: tuple, along: tuple, across: tuple, cells: int = 8) -> np.ndarray:
    """(2 cells^2, 3, 3) triangles of a parallelogram, their front where along x across points."""
    corner, along, across = (np.array(vector, float) for vector in (corner, along, across))

    def at(i: int, j: int) -> np.ndarray:
        return corner + along * i / cells + across * j / cells

    return np.array(
        [
            [at(i, j), at(i + a, j + b), at(i + c, j + d)]
            for i in range(cells)
            for j in range(cells)
            for a, b, c, d in ((1, 0, 1, 1), (1, 1, 0, 1))
        ]
    )


def test_in_a_closed_room_of_even_light_bounces_add_up_to_a_geometric_series():
    faces = [
        grid((0, 0, 0), (1, 0, 0), (0, 1, 0), 2), grid((0, 0, 1), (0, 1, 0), (1, 0, 0), 2),
        grid((0, 0, 0), (0, 1, 0), (0, 0, 1), 2), grid((1, 0, 0), (0, 0, 1), (0, 1, 0), 2),
        grid((0, 0, 0), (0, 0, 1), (1, 0, 0), 2), grid((0, 1, 0), (1, 0, 0), (0, 0, 1), 2),
    ]  # fmt: skip
    scenes = cast(np.concatenate(faces), 0.4)
    light = torch.zeros(len(scenes.corners), 2, 4, 3)
    light[:, 0] = torch.tensor([1.0, 2.0, 0.0])  # on fronts, which look inside
    bounced = bounce(scenes, light)
    expected = 0.4 / 0.6 * torch.tensor([1.0, 2.0, 0.0])  # 0.4 + 0.16 + .., of all that is left out 0.4^12
    torch.testing.assert_close(bounced[:, 0], expected.expand(len(light), 3, 3), rtol=1e-4, atol=0)
    assert bounced[:, 1].abs().max() == 0  # backs see the outside


def test_one_square_lights_another_by_their_form_factor():
    """Two unit squares face to face, one apart: 0.1998 (Howell's catalogue, C-11)."""
    floor, roof = grid((0, 0, 0), (1, 0, 0), (0, 1, 0)), grid((0, 0, 1), (0, 1, 0), (1, 0, 0))
    scenes = cast(np.concatenate([floor, roof]), 0.5)
    light = torch.zeros(256, 2, 4, 3)
    light[:128, 0] = 1
    bounced = bounce(scenes, light)
    assert bounced[128:, 0].mean().item() == pytest.approx(0.5 * 0.1998, rel=0.05)
    back = bounced[:128, 0].mean().item()  # floor, roof, floor
    assert back == pytest.approx((0.5 * 0.1998) ** 2, rel=0.1) and bounced[:, 1].abs().max() == 0
    points, down = scenes.corners[128:].mean(dim=1), torch.tensor([0, 0, -1.0])
    factors = diffuse_light(vector_form_factor(points[:, None], scenes.corners[None, :128]), down).sum(dim=1)
    assert factors.max() > 1.4 * factors.min()  # above the middle of the floor it is brighter
    assert (bounced[128:, 0].mean(dim=(1, 2)) / (0.5 * factors) - 1).abs().mean() < 0.08


def test_light_is_smooth_across_the_triangles_of_a_surface_and_not_across_an_edge():
    wall = grid((0, 0, 0), (0, 0, 1), (1, 0, 0))  # stands on the floor's edge
    scenes = cast(np.concatenate([grid((0, 0, 0), (1, 0, 0), (0, 1, 0)), wall]), 0.5)
    light = torch.rand(256, 2, 4, 3, generator=torch.Generator().manual_seed(0))
    bounced = bounce(scenes, light)[:, 0].flatten(0, 1)
    corners = scenes.corners.flatten(0, 1)
    here = (corners - torch.tensor([0.5, 0, 0])).norm(dim=1) < 1e-6
    on_floor = here & (torch.arange(768) < 384)
    assert on_floor.sum() == 3 and (here & ~on_floor).sum() == 3
    assert torch.allclose(bounced[on_floor], bounced[on_floor][0]) and torch.allclose(
        bounced[here & ~on_floor], bounced[here][-1]
    )
    assert not torch.allclose(bounced[on_floor][0], bounced[here][-1], rtol=0.05)


# --- checkpoints and training -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tokens", ["none", "lookup", "encoder"])
def test_a_checkpoint_is_the_same_network_again(tokens, tmp_path, capsys):
    model, data = network(tokens=tokens), guided_batch()
    checkpoint.save(model.config, model.state_dict(), tmp_path, {"triangles": "12"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "model.safetensors"]
    again, trained_with = checkpoint.load(tmp_path)
    assert isinstance(again, GuidedNetwork) and again.config == model.config and trained_with == {"triangles": "12"}
    assert torch.equal(image(again, data), image(model, data)) and capsys.readouterr() == ("", "")
    wrapped = {f"module.{name}": value for name, value in model.state_dict().items()}
    save_file(wrapped, tmp_path / "model.safetensors")
    again, _ = checkpoint.load(tmp_path)
    assert torch.equal(image(again, data), image(model, data)) and "'module.'" in capsys.readouterr().err


def test_a_checkpoint_from_before_bounces_does_without_them(tmp_path):
    model = network(guide=GuideConfig(bounces=False))
    checkpoint.save(model.config, model.state_dict(), tmp_path)
    older = json.loads((tmp_path / "config.json").read_text())
    del older["guide"]["bounces"]
    (tmp_path / "config.json").write_text(json.dumps(older))
    again, _ = checkpoint.load(tmp_path)
    assert again.config == model.config and torch.equal(image(again, guided_batch()), image(model, guided_batch()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"architecture": "unknown"}, "architecture 'unknown' is unknown: guided, or none"),
        ({"extra": 1}, "unknown field extra"),
        ({"guide": {"light": True}}, "missing field guide.lobe, guide.mirror, guide.shadow_rays, guide.visibility"),
        ({"guide": {**vars(GuideConfig()), "bounces": 1}}, "bounces is '1', expected true or false"),
        ({"guide": 3}, "guide must be an object"),
        ({"tokens": "some"}, "tokens='some' is not supported: none, lookup or encoder"),
        ({"token_dim": 25}, "token_dim=25 must be a multiple of 6 model.token_heads=6"),
    ],
)
def test_a_config_that_means_something_else_is_refused(tmp_path, change, message):
    data = {**GuidedConfig(**SMALL).to_dict(), **change}
    (tmp_path / "config.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        load_config(tmp_path / "config.json")


def test_weights_of_another_network_are_refused(tmp_path):
    model = network()
    checkpoint.save(GuidedConfig(**{**SMALL, "head_dim": 32}), model.state_dict(), tmp_path)
    with pytest.raises(InputError, match="has shape"):
        checkpoint.load(tmp_path)


def test_guides_that_need_light_are_refused_without():
    with pytest.raises(InputError, match=r"model.guide.mirror=true needs model.guide.light=true"):
        GuideConfig(light=False)


def test_training_learns_and_goes_on_after_a_kill(tmp_path):
    """Targets are the closed form with more light on diffuse surfaces: E has to learn them."""
    torch.manual_seed(0)

    def batches(start: int, stop: int):
        for step in range(start, stop):
            data = guided_batch(step % 4)
            model = network(trained=False)
            target = to_radiance(model(*model.arguments(data, "cpu"))).detach().numpy()
            yield {**data, "image": target + 0.2 * target.mean()}

    def train(steps: list[int], folder) -> dict[str, Any]:
        for stop in steps:
            torch.manual_seed(1)
            model = build(GuidedConfig(**SMALL))
            config = FitConfig(steps=12, lr=3e-3, warmup=1, log_every=4, checkpoint_every=1, validate_every=12)
            stream = lambda start, end, stop=stop: batches(start, min(end, stop))  # noqa: E731
            validation = [next(iter(batches(0, 1)))]
            group = Group(torch.device("cpu"))
            fit(model, config, stream, validation, folder, group, say=lambda text: None)
        return dict(model.state_dict())

    whole, cut = train([12], tmp_path / "whole"), train([5, 12], tmp_path / "cut")
    assert all(torch.equal(whole[name], cut[name]) for name in whole)
    losses = [
        json.loads(line)["loss"] for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines() if "loss" in line
    ]
    assert losses[-1] < losses[0]


def test_operations_are_counted_part_by_part():
    config = GuidedConfig(**SMALL)
    whole = forward_flops(config, [12, 12], VIEWS, SIDE, SIDE)
    assert build(config).flops(guided_batch()).keys() == whole.keys() and all(count > 0 for count in whole.values())
    assert sum(forward_flops(GuidedConfig(**SMALL, tokens="none"), [12, 12], VIEWS, SIDE, SIDE).values()) < sum(whole.values())
