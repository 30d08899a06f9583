"""Guides: where rays land and which lights are seen, by hand, by brute force, and after every move that must not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.renderformer.dataset import BatchConfig, Batches, Needs, Sample, ShardDataset, collate, make_example, mirror, move
from stages.renderformer.dataset.augment import rotation_from_vector, take_bundles
from stages.renderformer.dataset.loader import choose, landed_bundles
from stages.renderformer.guides import GuideCaster
from stages.renderformer.guides.casting import POINTS, sample_ggx
from stages.renderformer.guides.records import (
    BOUNCE_RAYS,
    WEIGHT_STEPS,
    check_guides,
    decode_scene_guides,
    decode_view_guides,
    encode_scene_guides,
    encode_view_guides,
)
from stages.renderformer.records import SceneRecord
from stages.renderformer.s05_shard import Shard, ShardConfig
from tests.renderformer.fakes import commit_shards, dataset_inputs

SIDE = 16


def quad(a, b, c, d) -> list[np.ndarray]:
    """Two triangles, counter-clockwise."""
    return [np.array([a, b, c], float), np.array([a, c, d], float)]


def scene_of(triangles: list[np.ndarray], lights: int = 1, roughness: float = 0.01) -> SceneRecord:
    """A scene whose last ``lights`` triangles emit, seen from above at the side."""
    corners = np.array(triangles, np.float32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(corners)
    index = np.full(count, -1, np.int16)
    index[count - lights :] = np.arange(lights)
    position = np.array([0.0, -1.5, 1.0])
    backwards = position / np.linalg.norm(position)
    right = np.array([1.0, 0, 0])
    camera = np.eye(4, dtype=np.float32)
    camera[:3] = np.stack([right, np.cross(backwards, right), backwards, position], axis=1)
    grey, bright = np.full((count, 3), 0.5, np.float32), np.where(index[:, None] >= 0, 1000.0, np.zeros(3))
    return SceneRecord(
        "made-up", corners, np.repeat(normals[:, None], 3, axis=1).astype(np.float32), grey, grey,
        np.full(count, roughness, np.float32), bright.astype(np.float32),
        index, np.zeros(count, np.int16), camera[None], np.array([40], np.float32),
    )  # fmt: skip


FLOOR = quad([-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0])
LIGHT = [np.array([[-0.02, -0.02, 2], [0.02, -0.02, 2], [0, 0.02, 2]])]


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    path = tmp_path_factory.mktemp("guides")
    inputs = dataset_inputs(path, train=4, test=1, size=SIDE)
    return inputs, commit_shards(path / "store", inputs, Shard(), ShardConfig(guides=True, bounces=True), 4)


@pytest.fixture(scope="module")
def scene(shards) -> SceneRecord:
    """A scene of the laws, with objects, walls and lights."""
    inputs, _ = shards
    return SceneRecord.from_record(inputs["scene"].read(inputs["scene"].ids("train")[1]))


def points(scene: SceneRecord, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
    shares = np.concatenate([1 - weights.sum(axis=-1, keepdims=True), weights], axis=-1)
    return (scene.triangles[triangle].astype(float) * shares[..., None]).sum(axis=-2)


# --- by hand ----------------------------------------------------------------------------------------------------------------


def test_a_mirror_floor_shows_the_wall_where_reflection_says():
    wall = quad([-2, 1, 0], [2, 1, 0], [2, 1, 4], [-2, 1, 4])
    scene = scene_of([*FLOOR, *wall, *LIGHT])
    guides = GuideCaster(scene).view_guides(0, SIDE, SIDE)
    floor = np.isin(guides.hit[..., 0], [0, 1])
    assert floor.any() and (~floor).any()
    eye, first = scene.camera_to_world[0, :3, 3], points(scene, guides.hit[..., 0], guides.hit_weights[..., 0, :])
    way = first - eye
    reflected = way * [1, 1, -1]
    expected = first + reflected * ((1 - first[..., 1]) / reflected[..., 1])[..., None]
    assert np.isin(guides.mirror[floor], [2, 3]).all()
    np.testing.assert_allclose(points(scene, guides.mirror, guides.mirror_weights)[floor], expected[floor], atol=2e-4)
    # a surface as smooth as this draws its reflections where the mirror's lie
    lobe = points(scene, guides.lobe, guides.lobe_weights)[..., 0, :]
    np.testing.assert_allclose(lobe[floor], expected[floor], atol=5e-3)


def test_cameras_see_through_lights_and_mirrors_do_not():
    big = [np.array([[-3.0, 0.5, 0.01], [3, 0.5, 0.01], [0, 0.5, 4]])]  # a light across the view, in front of nothing
    guides = GuideCaster(scene_of([*FLOOR, *big])).view_guides(0, SIDE, SIDE)
    assert not (guides.hit == 2).any() and (guides.mirror == 2).any()


def test_what_stands_in_the_way_of_a_light_is_in_shadow():
    roof = quad([-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1])  # its shadow on the floor: |x|, |y| < 1
    scene = scene_of([*FLOOR, *roof, *LIGHT])
    caster = GuideCaster(scene)
    guides = caster.view_guides(0, SIDE, SIDE)
    floor = np.isin(guides.hit, [0, 1])
    where = points(scene, guides.hit, guides.hit_weights)
    far = np.abs(where[..., :2]).max(axis=-1)
    clear = floor & (np.abs(far - 1) > 0.05)
    assert np.array_equal(guides.light_seen[clear][:, 0], far[clear] > 1) and (far[clear] < 1).any()
    seen = caster.scene_guides().light_seen[..., 0]
    for triangle in (0, 1):
        far = np.abs(np.einsum("kc,cd->kd", POINTS, scene.triangles[triangle])[:, :2]).max(axis=-1)
        assert np.array_equal(seen[triangle], far > 1)
    assert seen[2].all() and seen[3].all() and not seen[4].any()  # the roof from above; a light does not light itself


def test_a_surface_that_faces_away_is_seen_from_its_other_side():
    upside_down = [corners[::-1] for corners in FLOOR]
    for floor in (FLOOR, upside_down):
        scene = scene_of([*floor, *LIGHT])
        assert GuideCaster(scene).scene_guides().light_seen[:2].all()
        guides = GuideCaster(scene).view_guides(0, 8, 8)
        assert np.array_equal(guides.light_seen[..., 0], guides.hit >= 0)


def test_sampled_facets_follow_the_visible_normals():
    """The mean reflection of many draws against the density D G1 (v h) / (n v), summed over a grid."""
    alpha, eye = 0.4, np.array([0.6, 0, 0.8])
    rng = np.random.default_rng(0)
    n = 200_000
    drawn = sample_ggx(np.tile(eye, (n, 1)), np.full(n, alpha), rng.random((n, 2)))
    assert np.allclose(np.linalg.norm(drawn, axis=1), 1) and (drawn[:, 2] > 0).all()
    z, phi = (axis.ravel() for axis in np.meshgrid((np.arange(600) + 0.5) / 600, 2 * np.pi * (np.arange(300) + 0.5) / 300))
    h = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=1)
    density = alpha**2 / (np.pi * (z**2 * (alpha**2 - 1) + 1) ** 2)
    tangent2 = 1 / eye[2] ** 2 - 1
    density = density * 2 / (1 + np.sqrt(1 + alpha**2 * tangent2)) * np.clip(h @ eye, 0, None) / eye[2]
    np.testing.assert_allclose(drawn.mean(axis=0), (h * density[:, None]).sum(axis=0) / density.sum(), atol=5e-3)


def test_rays_leave_both_sides_of_a_triangle_by_the_cosine():
    """A floor under a roof that covers all directions within 60 degrees: three quarters of the cosine."""
    ring = [np.array([np.cos(a), np.sin(a), 0]) * np.sqrt(3) for a in np.linspace(0, 2 * np.pi, 49)]
    top = np.array([0, 0, 1.0])
    roof = [np.array([top, top + b, top + a]) for a, b in zip(ring, ring[1:], strict=False)]
    spots = [np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]]) + [1e-4 * i, 0, 0] for i in range(40)]
    guides = GuideCaster(scene_of([*spots, *roof, *LIGHT])).scene_guides()
    up, down = guides.bounces[:40, 0], guides.bounces[:40, 1]
    assert (up >= 40).mean() == pytest.approx(0.75, abs=0.03) and (up < 0).mean() == pytest.approx(0.25, abs=0.03)
    assert not (down >= 40).any()
    assert guides.bounces.shape == (40 + 48 + 1, 2, BOUNCE_RAYS) and not (guides.bounces[40:88, 0] >= 0).any()  # roofs look up
    spread = np.bincount(up[up >= 40] - 40, minlength=49)[:48]
    np.testing.assert_allclose(spread.reshape(4, 12).sum(axis=1) / spread.sum(), 0.25, atol=0.03)


def test_corners_at_one_place_of_one_smooth_surface_are_one_vertex():
    wall = quad([-2, 2, 0], [2, 2, 0], [2, 2, 2], [-2, 2, 2])
    vertex = GuideCaster(scene_of([*FLOOR, *wall, *LIGHT])).scene_guides().vertex
    assert vertex.shape == (5, 3) and len(np.unique(vertex[:2])) == 4 and len(np.unique(vertex[:4])) == 8
    assert vertex[0, 0] == vertex[1, 0] and vertex[0, 2] == vertex[1, 1]


def test_more_lights_than_are_kept_one_by_one_are_refused():
    with pytest.raises(UserError, match="has 257 emitting triangles: guides take at most 256"):
        GuideCaster(scene_of([*FLOOR, *LIGHT * 257], lights=257))


# --- bytes ------------------------------------------------------------------------------------------------------------------


def test_bytes_hold_all_but_the_last_digits_of_weights(scene):
    caster = GuideCaster(scene)
    view, whole = caster.view_guides(0, SIDE, SIDE), caster.scene_guides()
    data = encode_view_guides(view)
    again, again_whole = decode_view_guides(data, "view"), decode_scene_guides(encode_scene_guides(whole), "scene")
    assert encode_view_guides(again) == data and encode_view_guides(caster.view_guides(0, SIDE, SIDE)) == data
    for name, values in vars(view).items():
        tolerance = 0.5001 / WEIGHT_STEPS if name.endswith("weights") else 0
        np.testing.assert_allclose(getattr(again, name), values, atol=tolerance, rtol=0)
    for name, values in vars(whole).items():
        tolerance = 0.5001 / WEIGHT_STEPS if name.endswith("weights") else 0
        np.testing.assert_allclose(getattr(again_whole, name), values, atol=tolerance, rtol=0)
    few = caster.scene_guides(bounces=False)
    assert few.bounces is None and decode_scene_guides(encode_scene_guides(few), "scene").bounces is None
    assert np.array_equal(few.light_seen, whole.light_seen)


def test_damaged_or_foreign_guides_are_refused(scene):
    caster = GuideCaster(scene)
    data = encode_view_guides(caster.view_guides(0, 8, 8))
    for broken in (data[:-20], b"", encode_scene_guides(caster.scene_guides())):
        with pytest.raises(UserError, match=r"view3.guides.npz of x cannot be decoded"):
            decode_view_guides(broken, "view3.guides.npz of x")
    with pytest.raises(UserError, match="are not those of a scene of 3 triangles"):
        check_guides(3, caster.scene_guides(), [caster.view_guides(0, 8, 8)])
    whole = caster.scene_guides()
    count = len(scene.triangles)
    check_guides(count, whole, [])
    for name, value in (("bounces", whole.bounces + count), ("vertex", whole.vertex + 3 * count), ("vertex", whole.vertex - 1)):
        with pytest.raises(UserError, match="are not those of a scene"):
            check_guides(count, replace(whole, **{name: value}), [])


# --- what must not matter ---------------------------------------------------------------------------------------------------


def sample_of(scene: SceneRecord, side: int = SIDE) -> Sample:
    caster = GuideCaster(scene)
    views = {view: caster.view_guides(view, side, side) for view in range(len(scene.fov_deg))}
    blank = {view: type("View", (), {"lights": np.zeros((scene.n_lights, side, side, 3), np.float32)})() for view in views}
    return Sample(scene, blank, caster.scene_guides(), views)


def moved_scene(scene: SceneRecord, example: dict) -> SceneRecord:
    names = ("triangles", "vertex_normals", "camera_to_world")
    return replace(scene, **{name: example[name] for name in names})


def share_of_equal(a: dict, b: dict, name: str) -> float:
    return float((a[name] == b[name]).mean())


@pytest.mark.parametrize("how", ["rotated", "mirrored"])
def test_guides_of_a_moved_scene_are_the_moved_guides(scene, how):
    views = np.arange(len(scene.fov_deg))
    example = make_example(sample_of(scene), views, None)
    if how == "rotated":
        changed = move(example, rotation_from_vector(np.array([0.4, -1.1, 0.7])), np.array([0.2, 0, -0.1]))
    else:
        changed = mirror(example)
    row, side = np.nonzero(example["guide_bounces"].reshape(-1, 32).max(axis=1) >= 0)[0], np.s_[:, 0, :]
    before, after = (
        points(given, e["guide_bounces"][side], e["guide_bounces_weights"][side])[row]
        for given, e in ((scene, example), (moved_scene(scene, changed), changed))
    )  # what was hit moves along
    if how == "rotated":
        before = before @ rotation_from_vector(np.array([0.4, -1.1, 0.7])).T + np.array([0.2, 0, -0.1])
    else:
        before = before * [-1, 1, 1]
    np.testing.assert_allclose(after, before, atol=1e-5)
    corners = moved_scene(scene, changed).triangles.reshape(-1, 3)
    first = np.full(changed["guide_vertex"].max() + 1, -1)
    first[changed["guide_vertex"].ravel()[::-1]] = np.arange(len(corners))[::-1]
    np.testing.assert_allclose(corners, corners[first[changed["guide_vertex"].ravel()]], atol=3e-4)
    recast = make_example(sample_of(moved_scene(scene, changed)), views, None)
    assert share_of_equal(changed, recast, "guide_hit") > 0.999
    assert share_of_equal(changed, recast, "guide_mirror") > (0.999 if how == "rotated" else 0.8)  # of another ray, if mirrored
    assert share_of_equal(changed, recast, "guide_triangle_seen") > (0.999 if how == "rotated" else 0.99)
    same = (changed["guide_hit"] == recast["guide_hit"]) & (changed["guide_hit"] >= 0)
    np.testing.assert_allclose(changed["guide_hit_weights"][same], recast["guide_hit_weights"][same], atol=2e-3)


def test_a_view_mirrored_twice_is_itself_and_its_mirror_starts_from_the_same_ray(scene):
    view = GuideCaster(scene).view_guides(0, SIDE, SIDE)
    once = view.mirrored()
    assert all(np.array_equal(getattr(once.mirrored(), name), values) for name, values in vars(view).items())
    for guides, column in ((view, slice(None)), (once, slice(None, None, -1))):
        main = np.take_along_axis(guides.hit, np.maximum(guides.main, 0)[..., None], axis=2)[..., 0]
        if column == slice(None):
            expected = main
        assert np.array_equal(main[:, column], expected)


def test_a_shard_holds_what_is_cast_at_inference(shards, scene):
    _, artifact = shards
    dataset = ShardDataset(artifact, "train")
    sample = dataset.read(dataset.ids.index(scene.id), guides=True)
    assert dataset.guided and list(sample.view_guides) == [0, 2, 3]
    cast = GuideCaster(sample.scene)
    for view, guides in sample.view_guides.items():
        assert (guides.hit == cast.view_guides(view, SIDE, SIDE).hit).mean() > 0.999
    assert (sample.guides.light_seen == cast.scene_guides().light_seen).mean() > 0.999
    assert dataset.read(0).guides is None


def test_the_card_lists_guides_with_their_bytes_only_where_there_are_any(shards, tmp_path):
    inputs, artifact = shards
    with_guides = artifact.file("README.md").read_text()
    assert r"view\<i>.guides.npz" in with_guides and "bytes a view" in with_guides
    plain = commit_shards(tmp_path, inputs, Shard(), ShardConfig(), 4)
    assert "guides.npz" not in plain.file("README.md").read_text()
    assert not ShardDataset(plain, "train").guided


def test_guides_and_visible_lights_exclude_one_another(shards):
    inputs, _ = shards
    inputs["render"].manifest["preimage"]["params"]["lights_visible"] = True
    try:
        with pytest.raises(UserError, match="render.lights_visible=true shows them"):
            Shard().open(ShardConfig(guides=True), inputs, {})
        Shard().open(ShardConfig(), inputs, {})
    finally:
        del inputs["render"].manifest["preimage"]["params"]["lights_visible"]


def test_batches_hold_guides_and_only_the_drawn_bundles(shards):
    _, artifact = shards
    dataset = ShardDataset(artifact, "train")
    config = BatchConfig(batch_scenes=2, views_per_scene=2, relight=False)
    whole = Batches(dataset, config, needs=Needs(guides=True))(0)
    lights, longest = whole["guide_light_triangles"].shape[1], whole["mask"].shape[1]
    assert whole["guide_hit"].shape == (2, 2, SIDE, SIDE, 4) and whole["guide_hit_weights"].shape == (2, 2, SIDE, SIDE, 4, 2)
    assert whole["guide_triangle_seen"].shape == (2, longest, 4, lights)
    assert whole["guide_light_seen"].shape == (2, 2, SIDE, SIDE, 4, lights)
    few = Batches(dataset, config.model_copy(update={"bundles_per_view": 3}), needs=Needs(guides=True))(0)
    assert few["bundles"].shape == (2, 2, 3) and few["image"].shape == (2, 2, 3, 64, 3)
    for scene in range(2):
        for view in range(2):
            for place, bundle in enumerate(few["bundles"][scene, view]):
                row, column = 8 * (bundle // 2), 8 * (bundle % 2)
                window = np.s_[scene, view, row : row + 8, column : column + 8]
                for name in ("image", "guide_hit", "guide_mirror_weights", "guide_light_seen"):
                    expected = whole[name][window]
                    assert np.array_equal(few[name][scene, view, place], expected.reshape(64, *expected.shape[2:])), name


def test_bundles_are_drawn_where_something_was_hit(shards):
    rng = np.random.default_rng(0)
    landed = np.arange(16) % 3 == 0  # six
    for _ in range(20):
        few, many = choose(rng, landed, 4), choose(rng, landed, 9)
        assert landed[few].all() and len(set(few)) == 4 and (few == np.sort(few)).all()
        assert landed[many].sum() == 6 and len(set(many)) == 9
    assert len({tuple(choose(rng, landed, 4)) for _ in range(200)}) == 15  # any four of six
    assert len(choose(rng, ~landed & landed, 4)) == 4
    main = np.full((2, 16, 16), -1)
    main[0, 7, 8], main[1, 15, 15] = 2, 0
    example = {"guide_main": main, "views": np.arange(2)}
    assert landed_bundles(example, 8, 4).tolist() == [[False, True, False, False], [False, False, False, True]]
    assert landed_bundles({"views": np.arange(2)}, 8, 4).all()


def test_bounces_without_guides_are_refused():
    with pytest.raises(ValueError, match=r"set shard.guides=true, too"):
        ShardConfig(bounces=True)


def test_padding_of_lights_is_marked(scene):
    one = scene_of([*FLOOR, *LIGHT])
    examples = [make_example(sample_of(s), np.array([0]), None) for s in (one, scene)]
    batch = collate(iter(examples), 2)
    rows = batch["guide_light_triangles"]
    assert (
        (rows[0, 1:] == -1).all()
        and rows[0, 0] == 2
        and np.array_equal(rows[1][rows[1] >= 0], GuideCaster(scene).light_triangles)
    )
    assert not batch["guide_light_seen"][0, ..., 1:].any()


def test_bundles_are_taken_row_by_row():
    pixels = np.arange(16 * 16 * 3).reshape(1, 16, 16, 3)
    taken = take_bundles({"image": pixels, "id": "x"}, np.array([[1, 2]]), 8)
    assert np.array_equal(taken["image"][0, 0], pixels[0, :8, 8:].reshape(64, 3)) and taken["id"] == "x"
    assert np.array_equal(taken["image"][0, 1], pixels[0, 8:, :8].reshape(64, 3))
