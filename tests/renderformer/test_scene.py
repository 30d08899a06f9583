"""Scenes follow their laws: ranges, means and shares of what is drawn; budgets; bytes that stay the same."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from omegaconf import OmegaConf

from pipeline.config import parse
from pipeline.errors import Reject, UserError
from pipeline.hydra_config import compose
from pipeline.keys import canonical_json
from pipeline.stage import Item
from stages.graphics.geometry.measure import face_normals
from stages.renderformer.records import SceneRecord
from stages.renderformer.s03_scene import SampleScene, SceneConfig
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.assemble import choose_rungs, place
from stages.renderformer.scenes.laws import TEMPLATES, WALLS, LightLaw, Material, Placement, draw_plan
from tests.renderformer.fakes import decimated

N = 2000


def config_of(name: str, **overrides) -> SceneConfig:
    data = OmegaConf.merge(OmegaConf.create(compose([f"scene={name}", "seed=0"])["scene"]), overrides)
    return parse(SceneConfig, OmegaConf.to_container(data), "scene")


@pytest.fixture(scope="module")
def plans() -> dict:
    laws = {name: config_of(name).laws() for name in ("released", "paper")}
    return {name: [draw_plan(law, np.random.default_rng(i), 50) for i in range(N)] for name, law in laws.items()}


def uniform(values, low, high):
    """The values look uniform between low and high: range, mean within 5 sigma, and both ends reached."""
    values = np.asarray(values, float).ravel()
    width = high - low
    assert values.min() >= low - 1e-9 and values.max() <= high + 1e-9
    assert abs(values.mean() - (low + high) / 2) < 5 * width / math.sqrt(12 * len(values))
    assert abs(values.std() - width / math.sqrt(12)) < 0.12 * width
    if len(values) > 200:
        assert values.min() < low + 0.05 * width and values.max() > high - 0.05 * width


def share(hits, n, expected):
    assert abs(hits / n - expected) < 5 * math.sqrt(expected * (1 - expected) / n) + 1e-12


def test_files_state_the_defaults():
    assert canonical_json(config_of("released")) == canonical_json(SceneConfig())
    assert config_of("paper").material.roughness == (0.01, 1.0)


def test_kinds_of_scene(plans):
    tally = Counter((p.template, p.variant, p.patch) for p in plans["released"])
    expected = {("floor", "thin", False): 8, ("floor", "special", False): 2, ("corner", "special", False): 2}
    for template in TEMPLATES:
        expected |= {(template, "single", False): 3, (template, "multi", False): 3, (template, "empty", False): 1}
        if template != "floor":
            expected |= {(template, "single", True): 1, (template, "multi", True): 1}
    assert sum(expected.values()) == 46 and set(tally) == set(expected)
    for kind, weight in expected.items():
        share(tally[kind], N, weight / 46)
    for template in TEMPLATES:
        share(sum(p.template == template for p in plans["paper"]), N, 1 / 4)
    for number in (1, 2, 3):
        share(sum(len(p.objects) == number for p in plans["paper"]), N, 1 / 3)


def test_objects(plans):
    ranges = {"single": (1.2, 2.2), "multi": (0.8, 1.8), "thin": (1.4, 1.6), "special": (1.6, 2.1)}
    numbers = {"single": {1}, "thin": {1}, "special": {1}, "empty": {0}}
    scales: dict = {}
    for plan in plans["released"]:
        box = plan.template == "box"
        assert len(plan.objects) in numbers.get(plan.variant, {1, 2} if box else {2, 3})
        indices = [item.index for item in plan.objects if not item.shape]
        assert len(set(indices)) == len(indices)
        for item in plan.objects:
            assert item.scale[0] == item.scale[1] == item.scale[2] and bool(item.shape) == (plan.variant == "special")
            scales.setdefault((plan.variant, box and plan.variant == "single"), []).append(item.scale[0])
    for (variant, box), values in scales.items():
        uniform(values, *((1.8, 2.0) if box else ranges[variant]))
    objects = [item for plan in plans["released"] for item in plan.objects]
    uniform([item.translation for item in objects], -1, 1)
    uniform([item.rotation_deg for item in objects], -180, 180)
    special = [item.material.smooth for item in objects if item.shape]
    share(sum(special), len(special), 0.25)


def test_walls(plans):
    drawn: dict = {}
    for plan in plans["released"]:
        assert tuple(wall.name for wall in plan.walls) == TEMPLATES[plan.template]
        for wall in plan.walls:
            axis, template = WALLS[wall.name], plan.template
            drawn.setdefault("spin", []).append(wall.rotation_deg[axis])
            tilts = [angle for i, angle in enumerate(wall.rotation_deg) if i != axis]
            if plan.patch:
                assert tilts == [0, 0] and wall.scale == [1, 1, 1] and wall.translation == [0, 0, 0]
                continue
            place_of = "box" if template == "box" else "open"
            drawn.setdefault(("tilt", place_of), []).append(tilts)
            drawn.setdefault(("scale", place_of), []).append(wall.scale)
            for i, offset in enumerate(wall.translation):
                if wall.name == "floor" and i == 2 and template != "box":
                    drawn.setdefault("height", []).append(offset)
                elif wall.name != "floor" and (template == "wall" and i == 1 or template == "corner" and i == axis):
                    drawn.setdefault("along", []).append(offset)
                else:
                    drawn.setdefault("offset", []).append(offset)
    uniform(drawn["spin"], -180, 180)
    uniform(drawn["tilt", "open"], -10, 10)
    uniform(drawn["tilt", "box"], -3, 3)
    uniform(drawn["scale", "open"], 0.9, 1.35)
    uniform(drawn["scale", "box"], 1.0, 1.35)
    uniform(drawn["along"], -0.25, 0.25)
    uniform(drawn["offset"], -0.05, 0.05)
    height = np.array(drawn["height"])
    assert height.min() >= -0.05 and height.max() <= 0.25
    share((height > 0.15).sum(), len(height), 0.5 + 0.5 / 3)


def test_materials(plans):
    for law, low in (("released", 0.01), ("paper", 0.01)):
        walls = [wall.material for plan in plans[law] for wall in plan.walls]
        roughness = np.array([m.roughness for m in walls])
        assert roughness.min() >= low and roughness.max() <= 1
        if law == "paper":
            uniform(np.log(roughness), math.log(0.01), 0)
        else:
            uniform(np.log(roughness[roughness < 1] + 0.05), math.log(0.06), math.log(1.05))
            share((roughness == 1).sum(), len(roughness), math.log(1.055 / 1.05) / math.log(1.055 / 0.06))
        specular, diffuse = np.array([m.specular for m in walls]), np.array([m.diffuse for m in walls])
        assert specular.max() <= 1 and (specular + diffuse.max(axis=1)).max() <= 1 + 1e-9
        assert abs(specular.mean() - 0.475) < 0.03 and abs(diffuse.mean() - 0.2375) < 0.02
        share(sum(m.smooth for m in walls), len(walls), 0.5)
        share(sum(m.vary for m in walls), len(walls), 0.25 if law == "released" else 0.5)
        if law == "released":
            assert all(m.smooth for m in walls if m.vary)


def test_lights(plans):
    released = plans["released"]
    for number in range(1, 9):
        share(sum(len(p.lights) == number for p in released), N, 1 / 8)
    lights = [(plan, light) for plan in released for light in plan.lights]
    uniform([light.radiance * len(plan.lights) for plan, light in lights], 2500, 5000)
    uniform([light.scale for _, light in lights], 2.0, 2.5)
    uniform([light.rotation_deg for _, light in lights], -180, 180)
    uniform([light.distance for _, light in lights], 2.1, 2.7)
    uniform([light.target for _, light in lights], -0.2, 0.2)
    for plan, light in lights:
        assert np.linalg.norm(np.subtract(light.position, light.target)) == pytest.approx(light.distance)
        d = np.array(light.shell) / 0.866
        assert np.linalg.norm(d) == pytest.approx(1) and d[2] >= 0
        if plan.template == "corner":
            assert d[0] + d[1] <= 0
        if plan.template == "box":
            assert d[2] >= 0.5 and d[1] <= 0
    for plan in released:
        shells = np.array([light.shell for light in plan.lights])
        gaps = np.linalg.norm(shells[:, None] - shells[None], axis=2)[np.triu_indices(len(shells), 1)]
        assert gaps.size == 0 or gaps.min() >= 0.3
    # Uniform on the hemisphere: by Archimedes the height is uniform (the separation hardly shows for a single light).
    uniform([p.lights[0].shell[2] / 0.866 for p in released if p.template in ("floor", "wall")], 0, 1)


def test_beyond_the_paper_changes_nothing_else(plans):
    everything = config_of(
        "released",
        lights={"coloured_share": 0.5, "large_share": 0.25, "inside_share": 0.3},
        cameras={"inside_share": 0.4},
    ).laws()
    beyond = [draw_plan(everything, np.random.default_rng(i), 50) for i in range(N)]
    pairs = [
        (a, b)
        for before, after in zip(plans["released"], beyond, strict=True)
        for a, b in zip(before.lights, after.lights, strict=True)
    ]
    for before, after in zip(plans["released"], beyond, strict=True):
        assert (before.walls, before.objects, before.template) == (after.walls, after.objects, after.template)
    lights = [b for _, b in pairs]
    large = [b for a, b in pairs if a.scale != b.scale]
    coloured = [b for b in lights if b.tint != [1, 1, 1]]
    inside = [(a, b) for a, b in pairs if b.inside]
    for hits, expected in ((coloured, 0.5), (large, 0.25), (inside, 0.3)):
        share(len(hits), len(lights), expected)
    assert all(max(b.tint) == 1 and min(b.tint) >= 0.1 for b in coloured)
    uniform([b.scale for b in large], 4, 10)
    uniform([b.position for _, b in inside], -0.45, 0.45)
    uniform([b.radiance / a.radiance for a, b in inside if a.scale == b.scale], 0.01, 0.05)
    assert all(a == b for a, b in pairs if not b.inside and b.tint == [1, 1, 1] and a.scale == b.scale)
    cameras = [c for plan in beyond for c in plan.cameras]
    within = [c for c in cameras if c.inside]
    share(len(within), len(cameras), 0.4)
    uniform([c.fov_deg for c in within], 50, 90)
    for c in within:
        assert max(map(abs, c.position)) <= 0.45
        assert np.linalg.norm(np.subtract(c.position, c.look_at)) == pytest.approx(c.distance) and c.distance >= 0.3


def test_more_than_eight_lights():
    law = config_of("released", lights={"count": [12, 16], "separation": 0.2}).laws()
    plans = [draw_plan(law, np.random.default_rng(i), 50) for i in range(20)]
    assert {len(plan.lights) for plan in plans} <= set(range(12, 17)) and {plan.template for plan in plans} >= {"box", "floor"}


def test_light_triangle():
    edges = np.linalg.norm(meshes.LIGHT_TRIANGLE - np.roll(meshes.LIGHT_TRIANGLE, 1, axis=0), axis=1)
    area = np.linalg.norm(np.cross(*(meshes.LIGHT_TRIANGLE[1:] - meshes.LIGHT_TRIANGLE[0]))) / 2
    assert edges == pytest.approx(0.0707, abs=1e-4) and area == pytest.approx(0.0022, abs=5e-5)


def test_cameras(plans):
    cameras = [(plan.template, camera) for plan in plans["released"] for camera in plan.cameras]
    assert all(len(plan.cameras) == 4 for plan in plans["released"])
    uniform([c.distance for _, c in cameras], 1.5, 2.0)
    uniform([c.look_at for _, c in cameras], -0.2, 0.2)
    uniform([c.fov_deg for _, c in cameras], 30, 60)
    uniform(np.array([c.up for _, c in cameras]) - [0, 0, 1], -0.1, 0.1)
    for template, camera in cameras:
        assert np.linalg.norm(np.subtract(camera.position, camera.look_at)) == pytest.approx(camera.distance)
        x, y, z = camera.shell
        if template == "box":
            assert y == -3 and abs(x) <= 1 and abs(z) <= 1
        else:
            assert z >= 0 and (template == "floor" or x <= 0) and (template != "corner" or y <= 0)
    uniform([c.shell[2] / 0.866 for t, c in cameras if t != "box"], 0, 1)


def test_walls_face_inwards():
    for name, inward in {"floor": [0, 0, 1], "back": [0, -1, 0], "right": [-1, 0, 0], "left": [1, 0, 0]}.items():
        vertices, faces = meshes.wall(name)
        assert len(vertices) == 81 and len(faces) == 128
        still = Placement(name, "wall", [0, 0, 0], [1, 1, 1], [0, 0, 0], Material([0, 0, 0], 0, 1, False, False, 0))
        placed = place(vertices, still)
        assert np.allclose(face_normals(placed[faces]), inward)
        assert np.allclose(placed @ inward, -0.5) and np.abs(placed).max() == 0.5


def test_order_of_transform():
    """Rotate about x, then y, then z; scale along world axes; halve; translate by half."""
    item = Placement("o", "object", [90, 0, 90], [1, 2, 3], [1, 0, 0], Material([0, 0, 0], 0, 1, False, False, 0))
    # (0, 1, 0) -x-> (0, 0, 1) -z-> (0, 0, 1) -scale-> (0, 0, 3) -halve-> (0, 0, 1.5), moved by 0.5
    assert np.allclose(place(np.array([[0.0, 1, 0], [1, 0, 0]]), item), [[0.5, 0, 1.5], [0.5, 1, 0]])


@pytest.mark.parametrize("shape", ["sphere", "cube", "cylinder", "cone", "torus"])
def test_special_shapes_are_closed_and_face_outwards(shape):
    for n in (1, 2, 5):
        vertices, faces = meshes.special(shape, n)
        directed = Counter(map(tuple, faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()))
        assert all(directed[b, a] == 1 and number == 1 for (a, b), number in directed.items())
        a, b, c = vertices[faces].transpose(1, 0, 2)
        assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0
    assert min(meshes.special_rungs(shape).values()) <= 96


def test_crease_angle():
    vertices, faces = meshes.special("cube", 4)
    groups = meshes.shading_groups(vertices, faces, 30)
    assert len(set(groups)) == 6
    assert np.allclose(meshes.smooth_normals(vertices, faces, groups), face_normals(vertices[faces])[:, None])
    vertices, faces = meshes.special("sphere", 7)
    groups = meshes.shading_groups(vertices, faces, 30)
    assert len(set(groups)) == 1
    assert np.abs(meshes.smooth_normals(vertices, faces, groups) - vertices[faces]).max() < 0.1


def test_rungs_use_the_budget():
    ladder = {"48": 48, "192": 190, "768": 760}
    assert choose_rungs([ladder, ladder], 1000, 5000) == ["768", "192"]
    assert choose_rungs([ladder, ladder], 1000, 500) == ["192", "192"]
    assert choose_rungs([ladder, ladder], 96, 500) == ["48", "48"]
    assert choose_rungs([ladder, ladder], 95, 500) is None
    assert choose_rungs([], 0, 10) == []


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    inputs = {"decimate": decimated(tmp_path_factory.mktemp("decimate"))}
    stage, config = SampleScene(), config_of("released", count={"train": 60})
    worker = stage.open(config, inputs, {})
    return stage, config, inputs, worker, [next(iter(stage.process(worker, item))) for item in stage.items(config, inputs)]


def test_scene_arrays(sampled):
    _, config, _, worker, records = sampled
    for record in records:
        scene = SceneRecord.from_record(record)
        meta, n = scene.meta, len(scene.triangles)
        assert n == meta["n_triangles"] == sum(entry["faces"] for entry in meta["objects"]) <= config.max_triangles
        assert np.isfinite(scene.triangles).all() and np.allclose(np.linalg.norm(scene.vertex_normals, axis=2), 1, atol=1e-5)
        assert scene.n_lights == meta["n_lights"] and ((scene.light_index >= 0) == (scene.emission[:, 0] > 0)).all()
        kinds = [meta["objects"][i]["kind"] for i in scene.object_index]
        assert kinds == sorted(kinds, key=["wall", "object", "light"].index)
        assert (scene.diffuse.max(axis=1) + scene.specular.max(axis=1)).max() <= 1 + 1e-6
        assert scene.roughness.min() >= 0.01 and scene.roughness.max() <= 1
        rotation = scene.camera_to_world[:, :3, :3]
        assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-5)
        assert (np.linalg.det(rotation) > 0.99).all()
        for entry in meta["objects"]:
            if entry["kind"] == "object" and "object_id" in entry:
                assert entry["object_id"].startswith(meta["split"]) and entry["licence"] == "CC0"
                corners = scene.triangles[[meta["objects"][i]["name"] == entry["name"] for i in scene.object_index]]
                centre = np.array(entry["translation"]) / 2
                assert np.linalg.norm(corners - centre, axis=2).max() == pytest.approx(0.25 * entry["scale"][0], rel=1e-4)
        if meta["variant"] == "thin":
            assert any(entry.get("object_id", "").endswith("blob0") for entry in meta["objects"])


def test_same_item_same_bytes_and_more_scenes_change_nothing(sampled):
    stage, config, inputs, _, records = sampled
    more = config_of("released", count={"train": 90})
    worker, by_id = stage.open(more, inputs, {}), {record.id: record for record in records}
    items = [item for item in stage.items(more, inputs)]
    assert len(items) == len(records) + 30
    for item in items[:10] + items[-3:]:
        if item.id in by_id:
            assert next(iter(stage.process(worker, item))).members == by_id[item.id].members


def test_refusals(sampled, tmp_path):
    stage, config, inputs, _, _ = sampled
    few = {"decimate": decimated(tmp_path, per_split=1)}
    with pytest.raises(UserError, match="at least 2"):
        list(stage.items(config, few))
    small = config_of("released", max_triangles=200, weights={name: 0 for name in dict(config.weights)} | {"wall_single": 1})
    with pytest.raises(Reject, match="over_budget"):
        next(iter(stage.process(stage.open(small, inputs, {}), Item("train-000000", "train"))))
    with pytest.raises(UserError, match="do not fit.*separation"):
        from stages.renderformer.scenes.laws import draw_lights

        draw_lights(LightLaw(count=(8, 8), separation=1.7), np.random.default_rng(0), "floor")


def test_statistics(sampled, tmp_path):
    from tests.renderformer.fakes import FakeArtifact

    stage, config, inputs, _, records = sampled
    draft = FakeArtifact(tmp_path, [(record.id.split("-")[0], record) for record in records])
    stage.finish(config, inputs, draft)
    assert draft.notes["scenes"]["split"] == {"test": 24, "train": 60, "validation": 16}
    assert draft.file("statistics.json").is_file()
