"""What is learned of a scene: samples, rows, codes, shading, and a small scene from start to end."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from model.errors import InputError
from model.neuras import fitting, quantization, shading, skyboxes, tables
from model.neuras.baked import Baked
from model.neuras.maps import Maps, blocks, voxels
from model.neuras.rays import Pixels, View
from model.neuras.sampling import Pyramid, bilinear, gather
from model.neuras.scene import FitConfig, Scene, Surroundings


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_gather_and_its_gradient_equal_grid_sample():
    generator = torch.Generator().manual_seed(1)
    rows = torch.rand(7 * 9, 5, generator=generator, requires_grad=True)
    other = rows.detach().clone().requires_grad_()
    uv = torch.rand(300, 2, generator=generator) * 1.2 - 0.1
    texels, weights = bilinear(uv, 9, 7)
    ours = gather(rows, texels, weights)
    image = other.view(7, 9, 5).permute(2, 0, 1)[None]
    theirs = F.grid_sample(image, (2 * uv - 1)[None, None], padding_mode="border", align_corners=False)[0, :, 0].T
    pull = torch.rand(300, 5, generator=generator)
    ((ours - theirs).abs().max() < 1e-5) or pytest.fail("samples differ")
    (ours * pull).sum().backward()
    (theirs * pull).sum().backward()
    assert torch.allclose(rows.grad, other.grad, atol=1e-4)


def test_packed_rows_follow_sparse_adam():
    generator = torch.Generator().manual_seed(2)
    start = torch.rand(40, 3, generator=generator)
    table = tables.Table(start.clone())
    weight = torch.nn.Embedding(40, 3, sparse=True, _weight=start.clone())
    adam = torch.optim.SparseAdam(weight.parameters(), lr=0.02, betas=tables.BETAS, eps=tables.EPSILON)
    for step in range(1, 8):
        rows = torch.randperm(40, generator=generator)[:9].sort().values
        gradient = torch.randn(9, 3, generator=generator)
        table.update(rows, gradient, torch.full((3,), 0.02), step)
        weight.weight.grad = torch.sparse_coo_tensor(rows[None], gradient, (40, 3))
        adam.step()
    assert torch.allclose(table.values, weight.weight, atol=1e-6)
    assert not torch.equal(table.values, start)


@pytest.mark.parametrize("count", [5, 64, 1000])
def test_nearest_codes(count):
    generator = torch.Generator().manual_seed(3)
    rows, codes = torch.randn(1300, 12, generator=generator), torch.randn(count, 12, generator=generator)
    assert torch.equal(quantization.nearest(rows, codes), torch.cdist(rows, codes).argmin(dim=1))


def test_straight_through_and_the_two_halves_of_the_loss():
    rows = torch.tensor([[0.0, 0.0], [0.9, 1.0]], requires_grad=True)
    codes = torch.tensor([[0.1, 0.0], [1.0, 1.0], [9.0, 9.0]], requires_grad=True)
    quantized, loss = quantization.straight_through(rows, codes, commitment=0.25)
    assert torch.allclose(quantized, codes[:2])
    pull = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    (quantized * pull).sum().backward(retain_graph=True)
    assert torch.equal(rows.grad, pull) and codes.grad is None
    assert loss.item() == pytest.approx(1.25 * (0.01 + 0.01) / 2, rel=1e-5)
    rows.grad = None
    loss.backward()
    assert torch.allclose(codes.grad, torch.tensor([[0.1, 0.0], [0.1, 0.0], [0.0, 0.0]]), atol=1e-6)  # 2 (code - row) / 2
    assert torch.allclose(rows.grad, torch.tensor([[-0.025, 0.0], [-0.025, 0.0]]), atol=1e-6)  # 0.25 of that, the other way


def test_clusters_find_the_colours():
    centres = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    rows = centres.repeat(200, 1) + 0.01 * torch.randn(600, 2, generator=torch.Generator().manual_seed(4))
    codes = quantization.clusters(rows, 16, 10, torch.Generator().manual_seed(5))
    assert torch.cdist(centres, codes).min(dim=1).values.max() < 0.02


def test_compositing_is_the_loop_of_equation_4():
    generator = torch.Generator().manual_seed(6)
    colours, opacities = torch.rand(50, 6, 3, generator=generator), torch.rand(50, 6, generator=generator)
    expected = torch.zeros(50, 3)
    for ray in range(50):
        passed = 1.0
        for layer in range(6):
            expected[ray] += passed * opacities[ray, layer] * colours[ray, layer]
            passed *= 1 - opacities[ray, layer]
    assert torch.allclose(shading.composite(colours, opacities), expected, atol=1e-6)


def test_opacity_does_not_depend_on_the_view_and_colour_does():
    torch.manual_seed(7)
    shader = shading.SkyShader(shading.ShaderConfig())
    features = torch.rand(20, 12)
    one, other = (F.normalize(torch.randn(20, 3), dim=1) for _ in range(2))
    (colour_1, opacity_1), (colour_2, opacity_2) = shader(features, one), shader(features, other)
    assert torch.equal(opacity_1, opacity_2) and not torch.allclose(colour_1, colour_2, atol=1e-3)


@pytest.mark.parametrize("layers", [0, 2, 3, 4])
def test_networks_start_as_colours_and_opacities(layers):
    torch.manual_seed(8)
    config = shading.ShaderConfig(layers=layers, view_direction=layers > 2)
    features, directions = torch.zeros(30, 12), F.normalize(torch.randn(30, 3), dim=1)
    features[:, :3], features[:, 3] = torch.rand(30, 3), torch.linspace(-3, 3, 30)
    colours, opacities = shading.SkyShader(config)(features, directions)
    assert (opacities - torch.sigmoid(features[:, 3])).abs().max() < 1e-5
    on_mesh = features.clone()
    on_mesh[:, 3] = 0  # a mesh has no opacity: its texels start without
    for found in (colours, shading.MeshShader(config)(on_mesh, directions)):
        assert (found - features[:, :3]).abs().max() < 0.15


def test_rays_leave_the_cuboid_where_the_table_says():
    half = torch.tensor([2.0, 3.0, 4.0])
    directions = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    face, uv = skyboxes.intersect(torch.tensor([0.5, -1.5, 2.0]), directions, half)
    assert face.tolist() == [0, 1, 2, 3, 4, 5]
    a, b, c = (0.5 / 2 + 1) / 2, (-1.5 / 3 + 1) / 2, (2.0 / 4 + 1) / 2
    assert torch.allclose(uv, torch.tensor([[b, c], [b, c], [a, c], [a, c], [a, b], [a, b]]))


def test_points_on_the_cuboid_are_hit_from_anywhere_inside():
    rng = np.random.default_rng(9)
    half = np.array([2.0, 3.0, 4.0])
    points = rng.uniform(-1, 1, (500, 3))
    axis, side = rng.integers(3, size=500), rng.choice([-1.0, 1.0], 500)
    points[np.arange(500), axis] = side
    starts = rng.uniform(-0.9, 0.9, (500, 3)) * half
    rays = points * half - starts
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    face, uv = skyboxes.intersect(*(torch.tensor(v, dtype=torch.float32) for v in (starts, rays, half)))
    others = np.array(skyboxes.OTHER_AXES)[axis]
    expected = (np.take_along_axis(points, others, axis=1) + 1) / 2
    same = face.numpy() == 2 * axis + (side < 0)
    assert same.mean() > 0.995  # a point near an edge may round to its neighbour
    assert np.abs(uv.numpy() - expected)[same].max() < 1e-4


def test_skyboxes_hold_the_inner_cuboid_and_grow_geometrically():
    sizes = skyboxes.half_sizes(np.array([400.0, 40.0, 10.0]), 150.0, 2400.0, 5)
    assert sizes[0].tolist() == [400.0, 150.0, 150.0] and sizes[-1].tolist() == [6400.0, 2400.0, 2400.0]
    assert np.allclose(sizes[1:] / sizes[:-1], 2.0)


def test_texels_that_no_ray_touched_have_the_mean_of_their_smallest_cell():
    touched = np.array([True, True, False, False, True, False, False, False])
    cells = [np.array([0, 0, 0, 1, 2, 2, 3, 3]), np.array([0, 0, 0, 0, 0, 0, 1, 1])]
    start = torch.tensor([[1.0], [3.0], [8.0]])
    maps = Maps(touched, touched, cells[:1], cells, start)
    values = maps.features_of_all()[maps.row_of.long()][:, 0]
    assert values.tolist() == [1, 3, 2, 4, 8, 8, 4, 4]  # cell 0; all of level 1; itself; cell 2; everything


def test_texels_take_no_value_from_those_that_do_not_lend():
    touched = np.array([True, True, False, True, False])
    start = torch.tensor([[1.0], [3.0], [8.0]])
    cells = [np.array([0, 0, 0, 1, 1])]
    values = [
        maps.features_of_all()[maps.row_of.long()][:, 0].tolist()
        for lending in ([False, True, True, False, True], [False] * 5)
        for maps in [Maps(touched, np.array(lending), [], cells, start)]
    ]
    assert values == [[1, 3, 3, 8, 3], [1, 3, 2, 8, 8]]  # where none lends, all do


def test_a_coarse_level_moves_the_neighbours():
    maps = Maps(np.full(3, True), np.full(3, True), [np.array([0, 0, 1])], [], torch.zeros(3, 2))
    maps.update(torch.tensor([0]), torch.ones(1, 2), torch.full((2,), 0.1), step=1)
    values = maps.features(torch.arange(3))[:, 0]
    assert values.tolist() == pytest.approx([-0.2, -0.1, 0.0], abs=1e-6)


def test_cells_are_blocks_of_a_face_and_voxels_of_the_world():
    edges = blocks(2, 4, 2).reshape(2, 6, 4, 4)
    assert len(np.unique(edges)) == 2 * 6 * 4 and (edges[0, 0, :2, :2] == edges[0, 0, 0, 0]).all()
    assert edges[0, 0, 0, 2] != edges[0, 0, 0, 1]
    assert voxels(np.array([[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [-0.1, 0, 0]]), 1.0).tolist() == [1, 1, 2, 0]


def test_a_pyramid_mixes_the_two_levels_of_a_pixels_size():
    pyramid = Pyramid(16, 8, 3)
    assert pyramid.sheet == (8, 24) and pyramid.corner(1) == (0, 16) and pyramid.corner(2) == (4, 16)
    levels = [torch.rand(*pyramid.size(k), 3) for k in range(3)]
    sheet = torch.full((*pyramid.sheet, 3), torch.nan)
    for k, values in enumerate(levels):
        row, column = pyramid.corner(k)
        sheet[row : row + len(values), column : column + values.shape[1]] = values
    uv = torch.cat([torch.rand(500, 2), torch.tensor([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0]])])  # no sample leaves its level
    alone = [
        F.grid_sample(values.permute(2, 0, 1)[None], 2 * uv[None, None] - 1, padding_mode="border", align_corners=False)[
            0, :, 0
        ].T
        for values in levels
    ]
    for detail, expected in (
        (-3.0, alone[0]),
        (0.25, 0.75 * alone[0] + 0.25 * alone[1]),
        (1.0, alone[1]),
        (1.5, 0.5 * alone[1] + 0.5 * alone[2]),
        (9.0, alone[2]),
    ):
        texels, weights = pyramid.sample(uv, torch.zeros_like(uv), torch.full((len(uv),), detail))
        assert torch.allclose(gather(sheet.reshape(-1, 3), texels, weights), expected, atol=1e-5)
    spread = torch.tensor([[0.05, -0.02]]).expand(len(uv), 2)
    sides = [
        gather(sheet.reshape(-1, 3), *pyramid.sample(uv + s, 0 * spread, torch.full((len(uv),), 0.7)))
        for s in (spread, -spread)
    ]
    both = gather(sheet.reshape(-1, 3), *pyramid.sample(uv, spread, torch.full((len(uv),), 0.7)))
    assert torch.allclose(both, (sides[0] + sides[1]) / 2, atol=1e-5) and not torch.allclose(both, sides[0], atol=1e-2)
    with pytest.raises(InputError, match="multiples of 8"):
        Pyramid(12, 16, 4)


# --- a small scene: a wall with a pattern and a highlight that moves, before a sky ------------------------------------


def view(x: float) -> View:
    """From (x, 0, 0) along +y: a wall at y = 4 for z < 0.5, sky above."""
    height = width = 32
    u, v = np.meshgrid((np.arange(width) + 0.5) / width - 0.5, 0.5 - (np.arange(height) + 0.5) / height)
    directions = np.stack([u, np.ones_like(u), v], axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    places = np.array([x, 0, 0]) + directions * (4 / directions[..., 1:2])
    hit = places[..., 2] < 0.5
    uv = np.stack([(places[..., 0] + 5) / 10, (places[..., 2] + 5) / 10], axis=-1)
    wall = 0.4 + 0.2 * np.sin(3 * places) + 0.3 * np.exp(-20 * (directions[..., :1] ** 2))
    sky = np.stack([0.3 + 0.2 * directions[..., 0], 0.4 + directions[..., 2], np.full_like(u, 0.9)], axis=-1)
    rgb = np.clip(np.where(hit[..., None], wall, sky), 0, 1)
    return View(
        origin=np.array([x, 0.0, 0.0]),
        directions=directions.astype(np.float32),
        uv=np.where(hit[..., None], uv, 0).astype(np.float32),
        spread=np.zeros((*hit.shape, 2), np.float32),
        detail=np.log2(64 / 10 * 4 / 32 / directions[..., 1]).astype(np.float32),
        hit=hit,
        rgb=np.round(255 * rgb).astype(np.uint8),
        counts=np.ones(hit.shape, bool),
    )


def surroundings() -> Surroundings:
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    positions = np.stack([10 * u - 5, np.full_like(u, 4.0), 10 * v - 5], axis=-1)
    sizes = skyboxes.half_sizes(np.array([5.0, 4.0, 5.0]), 20.0, 80.0, 3)
    pyramid = Pyramid(64, 64, 2)
    sheet, inside = np.zeros((*pyramid.sheet, 3), np.float32), np.zeros(pyramid.sheet, bool)
    sheet[:, :64], inside[:, :64] = positions, True
    sheet[:32, 64:], inside[:32, 64:] = positions.reshape(32, 2, 32, 2, 3).mean(axis=(1, 3)), True
    return Surroundings(pyramid, sheet, inside, np.zeros(3), sizes)


CONFIG = FitConfig(
    steps=60,
    patch=4,
    patches=64,
    codes=128,
    voxel=0.5,
    block=2,
    sky_side=16,
    coarser_share=0.15,
    checkpoint_every=20,
    validate_every=40,
    log_every=10,
)  # fmt: skip
LONG = dataclasses.replace(CONFIG, steps=300, network_lr=0.01)  # enough to learn what depends on the view


def run(folder, config=CONFIG, views=None):
    xs = np.linspace(-1.5, 1.5, 12)
    shown = []
    outputs = fitting.Outputs(folder, lambda text: None, lambda step, a, b: shown.append(step) or np.zeros((4, 4, 3), np.uint8))
    found = fitting.fit(config, surroundings(), views or [view(x) for x in xs], [view(0.07), view(1.0)], outputs)
    return *found, shown


def rendered(baked: Baked, seen: View) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) and opacities (N, 1 + L) of a view's pixels."""
    return baked.render(
        seen.uv.reshape(-1, 2),
        seen.spread.reshape(-1, 2),
        seen.detail.ravel(),
        seen.hit.ravel(),
        seen.origin,
        seen.directions.reshape(-1, 3),
    )


def psnr(baked: Baked, seen: View) -> float:
    rgb, _ = rendered(baked, seen)
    return float(-10 * np.log10(np.square(rgb.reshape(32, 32, 3) - seen.rgb / 255).mean()))


def test_a_scene_is_learned_far_better_than_its_mean_colour(tmp_path):
    baked, summary, shown = run(tmp_path, LONG)
    seen = view(0.07)
    mean = -10 * np.log10(np.square(seen.rgb / 255 - seen.rgb.mean(axis=(0, 1)) / 255).mean())
    assert psnr(baked, seen) > mean + 10
    assert summary["psnr"] == pytest.approx((psnr(baked, seen) + psnr(baked, view(1.0))) / 2, abs=0.01)
    assert shown == [*range(40, 300, 40), 300]


def test_the_view_direction_explains_the_highlight(tmp_path):
    blind = dataclasses.replace(LONG, shader=shading.ShaderConfig(view_direction=False))
    with_direction, without = (run(tmp_path / name, config)[0] for name, config in (("a", LONG), ("b", blind)))
    assert with_direction.view_dependent and not without.view_dependent
    assert psnr(with_direction, view(0.07)) > psnr(without, view(0.07)) + 5


class Killed(Exception):
    pass


@pytest.mark.parametrize(
    ("change", "sky"), [({}, True), ({"quantize_from": 0.9}, True), ({}, False)], ids=["default", "codes wait", "no sky"]
)
def test_a_run_that_was_killed_ends_with_the_same_bytes(tmp_path, monkeypatch, change, sky):
    """Also where some parameters had no gradient yet, so that the optimizer knows nothing of them."""
    config = dataclasses.replace(CONFIG, **change)
    views = [dataclasses.replace(one, counts=one.counts if sky else one.hit) for one in map(view, np.linspace(-1.5, 1.5, 12))]
    run(tmp_path / "whole", config, views)[0].save(tmp_path / "whole" / "out")
    step = fitting.Trainer.train_step
    for stop in (17, 45):

        def train_step(self, batch, stop=stop):
            if self.step == stop:
                raise Killed
            step(self, batch)

        monkeypatch.setattr(fitting.Trainer, "train_step", train_step)
        with pytest.raises(Killed):
            run(tmp_path / "cut", config, views)
    monkeypatch.setattr(fitting.Trainer, "train_step", step)
    for _ in range(2):  # and once more, with everything done
        run(tmp_path / "cut", config, views)[0].save(tmp_path / "cut" / "out")
        for name in ("model.safetensors", "model.json"):
            assert (tmp_path / "cut" / "out" / name).read_bytes() == (tmp_path / "whole" / "out" / name).read_bytes()
    assert (tmp_path / "cut" / "log.jsonl").read_text() == (tmp_path / "whole" / "log.jsonl").read_text()


def test_another_configurations_state_is_refused(tmp_path):
    run(tmp_path, dataclasses.replace(CONFIG, steps=2))
    with pytest.raises(InputError, match="another configuration"):
        run(tmp_path, dataclasses.replace(CONFIG, steps=3))


@pytest.mark.parametrize(
    "change",
    [
        {"codes": 0},
        {"shader": shading.ShaderConfig(layers=0, channels=4)},
        {"direction_noise": 0.08},
        {"coarser_share": 0.0},
        {"perceptual": 0.02},
        {"shared_levels": 0},
        {"quantize_from": 0.5},
    ],
    ids=lambda change: next(iter(change)),
)
def test_every_variant_learns_and_survives_its_files(tmp_path, change):
    baked = run(tmp_path, dataclasses.replace(CONFIG, **change))[0]
    other = run(tmp_path / "plain")[0]
    seen = view(0.07)
    assert psnr(baked, seen) > 22
    assert not np.array_equal(rendered(baked, seen)[0], rendered(other, seen)[0])
    baked.save(tmp_path / "saved")
    assert psnr(Baked.load(tmp_path / "saved"), seen) == psnr(baked, seen)
    assert Baked.load(tmp_path / "saved").quantized == ("codes" not in change)


def test_levels_that_training_pixels_only_mix_are_learned_one_by_one(tmp_path):
    """A picture of half the size reads them alone."""

    def widened(x: float, detail: float) -> View:
        seen = view(x)
        return dataclasses.replace(seen, detail=seen.detail + np.float32(detail))

    found = {}
    for share in (0.0, 0.15):
        views = [widened(x, 0.4) for x in np.linspace(-1.5, 1.5, 12)]
        baked = run(tmp_path / str(share), dataclasses.replace(CONFIG, coarser_share=share), views)[0]
        for size, detail in (("fitted", 0.4), ("half", 1.4)):
            seen = widened(0.07, detail)
            rgb, _ = rendered(baked, seen)
            error = np.square(rgb.reshape(32, 32, 3) - seen.rgb / 255)[seen.hit].mean()
            found[size, share] = -10 * np.log10(error)
    assert found["half", 0.15] > found["half", 0.0] + 2
    assert found["fitted", 0.15] > found["fitted", 0.0] - 1


def test_masked_pixels_teach_nothing(tmp_path):
    def spoiled(seen: View, rgb: int) -> View:
        counts, colours = seen.counts.copy(), seen.rgb.copy()
        counts[8:24, 8:24] = False
        colours[8:24, 8:24] = rgb
        return dataclasses.replace(seen, counts=counts, rgb=colours)

    for rgb in (0, 255):
        run(tmp_path / str(rgb), dataclasses.replace(CONFIG, steps=3), [spoiled(view(x), rgb) for x in (0.0, 0.5)])[0].save(
            tmp_path / f"out{rgb}"
        )
    assert (tmp_path / "out0" / "model.safetensors").read_bytes() == (tmp_path / "out255" / "model.safetensors").read_bytes()


@pytest.mark.parametrize("codes", [128, 0])
@pytest.mark.parametrize("seen", ["mesh", "sky"])
def test_a_scene_whose_photos_show_the_mesh_alone_or_none_of_it_is_learned(tmp_path, seen, codes):
    """A flight that looks straight down, masks without sky, masks of all that the mesh holds."""

    def part(one: View) -> View:
        return dataclasses.replace(one, counts=one.hit if seen == "mesh" else ~one.hit)

    baked = run(tmp_path, dataclasses.replace(CONFIG, codes=codes), [part(view(x)) for x in np.linspace(-1.5, 1.5, 6)])[0]
    other = view(0.07)
    colours, opacity = rendered(baked, other)
    known = part(other).counts.ravel()
    truth = other.rgb.reshape(-1, 3) / 255
    assert np.square(colours - truth)[known].mean() < 0.01
    assert np.allclose(colours[~known], truth[known].mean(axis=0), atol=0.15)  # the photos' mean, and no hole
    if seen == "mesh":
        assert opacity[~known].min() < 1.01  # skyboxes stay as they are made


def test_frames_that_masks_hide_are_no_part_of_the_validation(tmp_path):
    hidden = dataclasses.replace(view(1.0), counts=np.zeros((32, 32), bool))
    said: list[str] = []
    outputs = fitting.Outputs(tmp_path, said.append, None)
    training = [view(x) for x in (0.0, 0.5)]
    quick = dataclasses.replace(CONFIG, steps=3, validate_every=0)
    _, summary = fitting.fit(quick, surroundings(), training, [view(0.07), hidden], outputs)
    assert np.isfinite(summary["psnr"]) and "over 1 views" in said[-1]
    outputs = fitting.Outputs(tmp_path / "none", said.append, None)
    assert "psnr" not in fitting.fit(quick, surroundings(), training, [hidden], outputs)[1]


def test_an_epoch_goes_through_every_pixel_and_steps_are_a_pure_function():
    pixels = Pixels([view(0.0), view(1.0)], np.zeros(3), 4, torch.device("cpu"))
    views, corners = pixels._epoch(0, 0)
    seen = np.zeros((2, 32, 32), bool)
    for number, (row, column) in zip(views, corners, strict=True):
        seen[number, row : row + 4, column : column + 4] = True
    assert seen.all()
    whole = list(pixels.patches(3, 40, 0, 9))
    later = list(pixels.patches(3, 40, 4, 9))
    assert len(whole) == 9 and len(later) == 5
    assert all(torch.equal(a.uv, b.uv) and torch.equal(a.rgb, b.rgb) for a, b in zip(whole[4:], later, strict=True))
    assert not torch.equal(whole[0].rgb, whole[1].rgb)


def test_what_is_wrong_is_said(tmp_path):
    with pytest.raises(InputError, match="no training frame"):
        Pixels([], np.zeros(3), 4, torch.device("cpu"))
    with pytest.raises(InputError, match="smaller patch"):
        Pixels([view(0.0)], np.zeros(3), 64, torch.device("cpu"))
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(InputError, match="no fitted scene"):
        Baked.load(tmp_path)


def test_rendering_is_the_baked_maps():
    pixels = Pixels([view(0.0)], np.zeros(3), 4, torch.device("cpu"))
    scene = Scene(CONFIG, surroundings(), pixels)
    ours = scene.render(pixels)[0]
    seen = view(0.0)
    rgb, opacity = rendered(scene.baked({}), seen)
    assert np.abs(ours.reshape(-1, 3) - rgb).max() < 1e-5
    assert (opacity[seen.hit.ravel()] == [1, 0, 0, 0]).all() and (opacity[~seen.hit.ravel(), 0] == 0).all()
