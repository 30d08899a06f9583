"""Probes: edits of scenes are exact, what is computed beside the network is what the network computes, all runs end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.config import parse
from pipeline.errors import UserError
from pipeline.hydra_config import CONF, compose
from pipeline.plan import base_key, plan_stage
from stages.renderformer.inference.predict import single_lights
from stages.renderformer.probes import attention, built_scenes, edits, tokens
from stages.renderformer.probes.probe import slug
from stages.renderformer.probes.sweeps import ColouredLight, Lights, TriangleSize
from stages.renderformer.records import SceneRecord
from stages.renderformer.s03_import import ImportConfig
from stages.renderformer.s03_scene import SceneConfig
from stages.renderformer.s08_probe import PROBES, RunProbe
from tests.conftest import ROOT
from tests.renderformer.fakes import FakeArtifact, decimated, sharded
from tests.renderformer.test_rendering import jit  # noqa: F401

SCALAR = {"backend": "scalar"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Shards of a few scenes, the ladders of their objects, and a small network with random weights."""
    import torch

    from model.renderformer import checkpoint
    from model.renderformer.config import ModelConfig
    from model.renderformer.network import RenderFormer

    folder = tmp_path_factory.mktemp("probes")
    made_of, shard = sharded(folder, train=3, test=6)
    config = ModelConfig(
        latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=128, num_register_tokens=2, texture_encode_patch_size=1,
        view_transformer_latent_dim=128, view_transformer_n_layers=2, view_transformer_n_heads=1,
        view_transformer_ffn_hidden_dim=128, use_dpt_decoder=False,
    )  # fmt: skip
    torch.manual_seed(0)
    train = FakeArtifact(folder / "train", [])
    train.key = "0" * 64
    weights = RenderFormer(config).state_dict()
    checkpoint.save(config, weights, train.files / "checkpoint", {"triangles": "768", "resolution": "16"})
    return {"decimate": decimated(folder / "decimate"), "shard": shard, "train": train}


@pytest.fixture(scope="module")
def guided(inputs, tmp_path_factory):
    """The same with a guided network that has all kinds of tokens."""
    return with_guided(inputs, tmp_path_factory.mktemp("guided") / "train", "encoder")


@pytest.fixture(scope="module")
def pixels_alone(inputs, tmp_path_factory):
    """The same with a guided network as the default has it."""
    return with_guided(inputs, tmp_path_factory.mktemp("pixels") / "train", "none")


def with_guided(inputs, folder, tokens):
    import torch

    from model.renderformer import checkpoint
    from model.renderformer.guided.config import GuidedConfig
    from model.renderformer.guided.network import GuidedNetwork

    torch.manual_seed(0)
    model = GuidedNetwork(GuidedConfig(tokens=tokens, token_dim=24, token_layers=1, token_heads=1, head_dim=16, head_layers=1))
    train = FakeArtifact(folder, [])
    train.key = "1" * 64
    checkpoint.save(model.config, model.state_dict(), train.files / "checkpoint", {"triangles": "768", "resolution": "16"})
    return {**inputs, "train": train}


def scenes_of(inputs, split="test") -> list[SceneRecord]:
    from stages.renderformer.dataset import decode_sample

    return [decode_sample(inputs["shard"].read(id)).scene for id in inputs["shard"].ids(split)]


@pytest.fixture(scope="module")
def scene(inputs) -> SceneRecord:
    """One with several lights and an object of the ladder."""
    return next(s for s in scenes_of(inputs) if s.n_lights > 1 and any("object_id" in e for e in s.meta["objects"]))


def lights_of(scene):
    lit = scene.light_index >= 0
    return scene.triangles[lit], scene.emission[lit]


class TestEdits:
    def test_cut_lights_are_the_same_light(self, scene):
        cut = edits.subdivided_lights(scene, 2)
        assert np.allclose(edits.power(cut), edits.power(scene), rtol=1e-5)
        assert cut.n_lights == scene.n_lights and (cut.light_index >= 0).sum() == 16 * (scene.light_index >= 0).sum()
        for light in range(scene.n_lights):  # the pieces lie in the light's plane, within its corners
            whole, pieces = scene.triangles[scene.light_index == light][0], cut.triangles[cut.light_index == light]
            weights = np.linalg.lstsq((whole[1:] - whole[0]).T, (pieces.reshape(-1, 3) - whole[0]).T, rcond=None)[0]
            assert weights.min() > -1e-4 and weights.sum(axis=0).max() < 1 + 1e-4
            assert np.allclose(weights.T @ (whole[1:] - whole[0]) + whole[0], pieces.reshape(-1, 3), atol=1e-5)

    def test_larger_lights_keep_power_and_place(self, scene):
        large = edits.larger_lights(scene, 4)
        assert np.allclose(edits.power(large), edits.power(scene), rtol=1e-4)
        (before, _), (after, _) = lights_of(scene), lights_of(large)
        assert np.allclose(before.mean(axis=1), after.mean(axis=1), atol=1e-5)
        assert np.allclose(edits.areas(after), 16 * edits.areas(before), rtol=1e-3)

    def test_nearer_lights_give_the_centre_the_same(self, scene):
        near = edits.lights_at(scene, 0.5)
        (before, bright), (after, dim) = lights_of(scene), lights_of(near)
        distance = np.linalg.norm(before.mean(axis=1), axis=1)
        assert np.linalg.norm(after.mean(axis=1), axis=1) == pytest.approx(0.5, rel=1e-4)
        assert np.allclose(dim / 0.25, bright / distance[:, None] ** 2, rtol=1e-3)
        assert np.allclose(edits.areas(after), edits.areas(before), rtol=1e-3)

    def test_more_lights_keep_the_first_ones(self, scene):
        few, many = (edits.draw_nested_lights(scene, n, np.random.default_rng(1)) for n in (2, 12))
        assert few.n_lights == 2 and many.n_lights == 12
        assert np.array_equal(lights_of(few)[0], lights_of(many)[0][:2])
        assert np.allclose(lights_of(few)[1] * 2, lights_of(many)[1][:2] * 12, rtol=1e-5)
        solid = scene.light_index < 0
        assert np.array_equal(many.triangles[: solid.sum()], scene.triangles[solid])
        kinds = [many.meta["objects"][i]["kind"] for i in many.object_index]
        assert [kind == "light" for kind in kinds] == (many.light_index >= 0).tolist()

    def test_more_triangles_are_the_same_surfaces(self, scene):
        many = edits.bisected(scene, 3 * len(scene.triangles) + 1)
        assert len(many.triangles) == 3 * len(scene.triangles) + 1
        for index in range(len(scene.meta["objects"])):
            old, new = scene.object_index == index, many.object_index == index
            sizes = edits.areas(scene.triangles[old]), edits.areas(many.triangles[new])
            assert sizes[0].sum() == pytest.approx(sizes[1].sum(), rel=1e-4)
            assert np.allclose(sizes[0] @ scene.diffuse[old], sizes[1] @ many.diffuse[new], rtol=1e-4)
        assert np.array_equal(lights_of(many)[0], lights_of(scene)[0])
        assert np.linalg.norm(many.vertex_normals, axis=2) == pytest.approx(1, abs=1e-3)
        largest = edits.areas(many.triangles[many.light_index < 0]).max()
        assert largest < 0.6 * edits.areas(scene.triangles[scene.light_index < 0]).max()

    def test_another_rung_stands_in_the_same_place(self, inputs, scene):
        from stages.renderformer.objects.rungs import load_rungs

        entry = next(e for e in scene.meta["objects"] if "object_id" in e)
        rungs = load_rungs(inputs["decimate"].read(entry["object_id"]))
        now = rungs[int(entry["rung"])]
        same = edits.with_rung(scene, entry["name"], now, now)
        assert np.allclose(same.triangles, scene.triangles, atol=1e-4)  # shards quantise
        for rung in rungs.values():
            other = edits.with_rung(scene, entry["name"], now, rung)
            index = scene.meta["objects"].index(entry)
            assert (other.object_index == index).sum() == len(rung[1])
            rest = other.object_index != index
            assert np.array_equal(other.triangles[rest], scene.triangles[scene.object_index != index])
            # the mesh's own frame, moved rigidly and scaled as the scene's rung was: corners of both map by one affinity
            old = scene.triangles[scene.object_index == index].reshape(-1, 3)
            frame = np.linalg.lstsq(
                np.pad(now[0][now[1]].reshape(-1, 3), ((0, 0), (0, 1)), constant_values=1), old, rcond=None
            )[0]
            corners = rung[0][rung[1]].reshape(-1, 3)
            assert np.allclose(corners @ frame[:3] + frame[3], other.triangles[~rest].reshape(-1, 3), atol=2e-3)

    def test_a_closer_camera_looks_the_same_way(self, scene):
        near = edits.closer(scene, 0.5)
        assert np.array_equal(near.camera_to_world[:, :3, :3], scene.camera_to_world[:, :3, :3])
        moved = near.camera_to_world[:, :3, 3] - scene.camera_to_world[:, :3, 3]
        forward = -scene.camera_to_world[:, :3, 2]
        ahead = np.einsum("vi,vi->v", moved, forward)
        assert np.allclose(moved, ahead[:, None] * forward, atol=1e-5) and (ahead > 0.3).all()
        assert np.allclose(edits.closer(scene, 1).camera_to_world, scene.camera_to_world)

    def test_patterns_cover_everything_but_lights(self, scene):
        painted = edits.patterned(scene, 2, np.random.default_rng(0))
        assert painted.textured and np.array_equal(painted.patch_index >= 0, scene.light_index < 0)
        assert np.ptp(painted.patches[:, :3].astype(np.float32)) > 0.05
        plain = edits.without_textures(painted)
        assert not plain.textured and np.array_equal(plain.diffuse, painted.diffuse)

    @pytest.mark.parametrize("number", [1, 4, 9, 36])
    def test_plates_have_equal_triangles_and_area(self, number):
        vertices, faces = built_scenes.plates(number, 0.3)
        size = edits.areas(vertices[faces])
        assert len(faces) == 72 and np.allclose(size, size[0]) and size.sum() == pytest.approx(built_scenes.SHEET_SIDE**2)
        flat = np.round(vertices[:, :2] @ [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]], 6)
        gaps = np.diff(np.unique(flat[:, 0]))
        side = built_scenes.SHEET_SIDE / 6 - 1e-6
        assert (gaps > side).sum() + (gaps < side).sum() == len(gaps)
        assert len(np.unique(flat[:, 0])) == round(number**0.5) * (6 // round(number**0.5) + 1)  # gaps between plates


class TestMethods:
    """With a renderer that is linear in each channel of every light, all ways of putting a picture together agree."""

    @staticmethod
    def predict(scene: SceneRecord) -> np.ndarray:
        lit = scene.light_index >= 0
        weights = 1 / np.linalg.norm(scene.triangles[lit].mean(axis=1), axis=1) ** 2
        return np.broadcast_to(weights @ scene.emission[lit], (2, 2, 3)) * [1.0, 0.5, 0.25]

    def test_single_lights_add_up(self, scene):
        images = [image() for image in Lights().methods(None, self.predict, scene).values()]
        assert len(images) == 3 and all(np.allclose(image, images[0], rtol=1e-5) for image in images)
        assert len(list(single_lights(scene))) == scene.n_lights

    def test_channels_blend(self, scene):
        worker = SimpleNamespace(rng=lambda *_: np.random.default_rng(3))
        coloured = ColouredLight().edit(worker, scene, 1.0)
        assert not np.allclose(
            coloured.emission[coloured.light_index >= 0][:, 0], coloured.emission[coloured.light_index >= 0][:, 2]
        )
        images = [image() for image in ColouredLight().methods(None, self.predict, coloured).values()]
        assert np.allclose(*images, rtol=1e-5)
        assert np.array_equal(ColouredLight().edit(worker, scene, 0.0).emission, scene.emission)


class TestBesideTheNetwork:
    @pytest.mark.parametrize(("network", "layers"), [("inputs", 2), ("guided", 1)])
    def test_attention_weights_are_those_of_the_layers(self, network, layers, scene, request):
        import torch

        from model.renderformer import checkpoint
        from model.renderformer.layers import merge_heads

        model = checkpoint.load(request.getfixturevalue(network)["train"].file("checkpoint"))[0]
        scene = edits.one_view(scene, 0)
        calls = []
        hooks = [
            layer.multihead_attn.register_forward_hook(lambda cross, given, out: calls.append((cross, given, out)))
            for layer in model.gathering_layers()
        ]
        weights = attention.cross_attention(model, scene, 16)
        assert weights.shape == (layers, 4, model.config.registers + len(scene.triangles))
        assert np.allclose(weights.sum(axis=-1), 1, atol=1e-5)
        for row, (cross, given, out) in zip(weights, calls, strict=True):
            mixed = torch.from_numpy(row) @ given[2][0]  # one head: weights times values
            assert torch.allclose(cross.out_proj(merge_heads(mixed[None])), out, atol=1e-5)
        for hook in hooks:
            hook.remove()

    def test_bundles_are_chosen_where_objects_are(self):
        triangle = np.full((32, 32), -1)
        triangle[8:32], triangle[:8, 24:] = 0, 1
        assert attention.choose_bundles(triangle, np.array([0, 1]), 2, 8)[1] == 3  # the only one that sees object 1
        assert attention.choose_bundles(triangle, np.array([0, 1]), 1, 8)[0] // 4 in (1, 2)

    def test_textures_lie_on_the_triangle_as_texels_say(self, scene):
        pose = np.eye(4, dtype=np.float32)
        pose[2, 3] = 2
        corners = np.float32([[[-0.5, -0.5, 0], [0.5, -0.5, 0], [-0.5, 0.5, 0]]])
        one = replace(edits.rows(scene, [0]), triangles=corners, camera_to_world=pose[None], fov_deg=np.float32([40]))
        textures = np.zeros((1, 8, 8, 3), np.float32)
        textures[0, ..., 0], textures[0, ..., 1] = np.arange(8), np.arange(8)[:, None]  # red by column, green by row
        seen = np.where(np.arange(32)[::-1, None] > np.arange(32) + 40, -1, 0)
        image = tokens.draw_textures(one, seen, np.array([0]), textures)
        lower_left, lower_right, upper_left = image[26, 6], image[26, 22], image[9, 6]
        assert lower_right[0] > lower_left[0] + 2 and upper_left[1] > lower_left[1] + 2
        turned = replace(one, triangles=corners[:, [0, 2, 1]])
        assert not tokens.draw_textures(turned, seen, np.array([0]), textures).any()  # its back has no texture

    def test_errors_of_textures_come_apart(self):
        rng = np.random.default_rng(0)
        truth, met = rng.random((3, 4, 4, 3)).astype(np.float32), np.ones((3, 4, 4), bool)
        texel, mean, rest = tokens.errors_of(truth + 0.1, truth, met)
        assert (texel, mean) == pytest.approx((0.1, 0.1), rel=1e-4) and rest == pytest.approx(0, abs=1e-6)
        flat = np.broadcast_to(tokens.means(truth, met), truth.shape)
        texel, mean, rest = tokens.errors_of(flat, truth, met)
        assert mean == pytest.approx(0, abs=1e-6) and rest == pytest.approx(texel)

    def test_the_decoder_learns_what_tokens_say_and_registers_too(self):
        import torch

        from stages.renderformer.probes.decoder import decode, fit_decoder

        config = tokens.TokensConfig(size=4, steps=200, batch=64, width=64, lr=3e-3)
        generator = torch.Generator().manual_seed(0)
        samples, faces = [], np.arange(48, dtype=np.int32)
        met = np.broadcast_to(np.add.outer(range(4), range(4)) <= 4, (48, 4, 4))
        for scene in range(13):
            sign = -1 if scene % 2 else 1  # what the registers alone know of the scene
            triangles = torch.randn(48, 8, generator=generator)
            registers = sign * torch.tensor([[1.0, -1.0] * 4]) + 0.1 * torch.randn(1, 8, generator=generator)
            level = triangles[:, 0].numpy() / 8 + 0.3 * sign + 1
            radiance = np.broadcast_to(level[:, None, None, None], (48, 4, 4, 3)).astype(np.float16)
            samples.append((registers, triangles, {"faces": faces, "radiance": radiance, "met": met}))
        *fit, (registers, triangles, truth) = samples
        decoded = decode(fit_decoder(fit, config), registers, triangles, faces, 4)
        texel, *_ = tokens.errors_of(decoded, truth["radiance"], met)
        assert texel < 0.08  # without the registers 0.3, without the tokens 0.1


class Draft(FakeArtifact):
    def environment(self):
        return {"device": "cpu", "renderer": SCALAR}

    def rejects(self):
        return []


def run(inputs, path, **values) -> Draft:
    """A probe from config to files, without the engine."""
    stage = RunProbe()
    config = parse(RunProbe.Config, values, "probe")
    chosen = {name: inputs[name] for name in stage.reads(config)}
    worker = stage.open(config, chosen, {"device": "cpu", "renderer": SCALAR})
    items = sorted(stage.items(config, chosen), key=lambda item: (item.group, item.id))
    draft = Draft(path, [(item.group, record) for item in items for record in stage.process(worker, item)])
    stage.finish(config, chosen, draft)
    stage.check(draft)
    return draft


TINY = {"scenes": 2, "resolution": 16, "max_spp": 1, "target_error": 0}
CHEAP = {
    "lights": {"values": [1, 3]},
    "triangle_size": {"values": [48, 768]},
    "bounces": {"values": [0, 2], "scenes": 1},
    "attention": {"drawn_px": 24, "bundles": 2},
    "equal_time": {"values": [1, 2], "repeats": 1, "threads": 1},
    "timing": {"values": [300, 900], "scenes": 1, "repeats": 1, "frames": 2, "tracer_spp": 1, "threads": 1},
}


@pytest.mark.parametrize("name", CHEAP)
def test_a_probe_runs_from_config_to_figure(name, inputs, tmp_path):
    from PIL import Image

    draft = run(inputs, tmp_path / "probe", name=name, **(TINY | CHEAP[name]))
    probe_json = json.loads((draft.files / "probe.json").read_text())
    assert {"name", "title", "question", "setting", "model", "columns", "rows", "notes"} == set(probe_json)
    assert probe_json["name"] == name and probe_json["rows"]
    assert all(len(row) == len(probe_json["columns"]) for row in probe_json["rows"])
    assert probe_json["model"]["width"] == 128 and probe_json["model"]["trained_with"]["triangles"] == "768"
    assert min(Image.open(draft.files / "figure.png").size) > 200
    table = (draft.files / "table.md").read_text()
    assert all(note in table for note in probe_json["notes"]) and table.count("\n| ") == len(probe_json["rows"]) + 2


@pytest.mark.parametrize("name", ["attention", "equal_time", "timing"])
def test_a_guided_model_is_probed_as_well(name, guided, tmp_path):
    draft = run(guided, tmp_path / "probe", name=name, **(TINY | CHEAP[name]))
    probe_json = json.loads((draft.files / "probe.json").read_text())
    assert probe_json["rows"] and "guided by hits" in probe_json["model"]["network"]
    if name == "equal_time":
        assert any("casting hits" in note for note in probe_json["notes"])
    if name == "timing":
        assert any("casting hits" in column for column in probe_json["columns"])


@pytest.mark.parametrize("name", ["equal_time", "timing"])
def test_times_of_a_model_without_tokens(name, pixels_alone, tmp_path):
    draft = run(pixels_alone, tmp_path / "probe", name=name, **(TINY | CHEAP[name]))
    rows, columns = (json.loads((draft.files / "probe.json").read_text())[part] for part in ("rows", "columns"))
    assert rows
    if name == "timing":
        assert {float(row[columns.index("GFLOP, view-independent")]) for row in rows} == {0.0}


def test_a_probe_that_says_nothing_of_a_network_is_refused(guided, pixels_alone, tmp_path):
    with pytest.raises(UserError, match="probe=attention: ray bundles of this model look at no triangles"):
        run(pixels_alone, tmp_path / "attention", name="attention", **(TINY | CHEAP["attention"]))
    with pytest.raises(UserError, match="probe=tokens: a guided model is given each triangle's light"):
        run(guided, tmp_path / "probe", name="tokens", **TINY)


def test_the_table_says_what_the_records_say(inputs, tmp_path):
    from stages.graphics.arrays import unpack_json

    draft = run(inputs, tmp_path / "probe", name="triangle_size", **(TINY | CHEAP["triangle_size"]))
    rows = json.loads((draft.files / "probe.json").read_text())["rows"]
    records = [unpack_json(draft.read(id).members["metrics.json"]) for id in draft.ids()]
    for value, row in zip((48, 768), rows, strict=True):
        at_value = [record for record in records if record["value"] == value]
        assert row[0] == f"{value}" and float(row[1].replace(",", "")) == round(np.mean([r["triangles"] for r in at_value]))
        assert float(row[2].split()[0]) == pytest.approx(np.mean([r["scores"]["model"]["psnr"] for r in at_value]), abs=0.006)
    assert float(rows[0][1].replace(",", "")) < float(rows[1][1].replace(",", ""))


def test_records_do_not_depend_on_the_clock_or_on_other_values(inputs, tmp_path):
    first = run(inputs, tmp_path / "a", name="fov", **(TINY | {"values": [40, 80]}))
    again = run(inputs, tmp_path / "b", name="fov", **(TINY | {"values": [80, 100]}))
    both = set(first.ids()) & set(again.ids())
    assert len(both) == 2 and all(first.read(id).members == again.read(id).members for id in both)


def test_tokens_are_decoded_on_held_out_scenes(inputs, jit, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setitem(globals(), "SCALAR", jit)
    small = {"fit_scenes": 2, "triangles": 8, "size": 4, "spp": 1, "steps": 10, "width": 16, "drawn_px": 24, "scenes": 1}
    draft = run(inputs, tmp_path / "probe", name="tokens", **(TINY | small))
    rows = json.loads((draft.files / "probe.json").read_text())["rows"]
    assert len(rows) == 4 and float(rows[3][2].split()[0]) == 0  # the truth's own means have no error in the mean
    with pytest.raises(UserError, match="fit_split"):
        run(inputs, tmp_path / "other", name="tokens", split="train", **(TINY | small))


@pytest.mark.parametrize("name", PROBES)
def test_every_probe_has_a_config_and_a_section_in_the_docs(name):
    config = parse(RunProbe.Config, compose([f"probe={name}"])["probe"], "probe")
    assert config.name == name and (CONF / "renderformer" / "probe" / f"{name}.yaml").is_file()
    assert config == PROBES[name].Config()  # the file says what the code would do without it
    assert f"`probe={name}`" in (ROOT / "docs" / "probes.md").read_text()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "lights", "values": [0]}, "from 1 to 16"),
        ({"name": "lights", "values": [2, 2]}, "given twice"),
        ({"name": "occluders", "values": [2]}, "0, 1, 4, 9, 36"),
        ({"name": "light"}, "name"),
    ],
)
def test_bad_values_are_named(values, message):
    with pytest.raises(UserError, match=message):
        parse(RunProbe.Config, values, "probe")


def test_a_probe_that_no_scene_suits_says_so(inputs, tmp_path):
    class Never(TriangleSize):
        def suits(self, meta):
            return False

    with pytest.raises(UserError, match="none of them suits"):
        Never().scene_ids(Never.Config(), inputs)
    with pytest.raises(UserError, match="ladder"):
        RunProbe().agree(Never.Config(), {"scene": ImportConfig(path=str(tmp_path))})
    RunProbe().agree(Never.Config(), {"scene": SceneConfig()})


def test_what_a_record_holds_is_in_its_key():
    """equal_time has all values in one record; of timing's settings none is in a record, but its artifact depends on them."""

    def keys(name: str, **values) -> tuple[str, str]:
        config = parse(RunProbe.Config, {"name": name, **values}, "probe")
        planned = plan_stage("renderformer", RunProbe(), config, {"shard": "a", "train": "b"}, str)
        return planned.key, base_key(planned)

    for one, other, same_items in (
        (keys("equal_time"), keys("equal_time", values=[4, 128]), False),
        (keys("timing"), keys("timing", frames=48, tracer_spp=16, repeats=1, threads=1), True),
        (keys("fov"), keys("fov", values=[50], scenes=2), True),
    ):
        assert one[0] != other[0] and (one[1] == other[1]) == same_items


def test_values_make_distinct_ids():
    values = [0.25, 0.3, 2.5, 25, 1e-3, 4096]
    assert len({slug(value) for value in values}) == len(values) and all("-" not in slug(value) for value in values)
