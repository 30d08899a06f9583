"""Inference as a user meets it: scenes and meshes to images and videos, what is beyond the limits, and what is wrong."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from model.renderformer import checkpoint as files
from model.renderformer.config import ModelConfig
from pipeline.errors import UserError
from stages.cli import main
from stages.graphics.tonemap import TONE_MAPPERS, to_picture
from stages.renderformer.inference.limits import beyond_limits, light_radiance
from stages.renderformer.inference.orbit import centre, orbit
from stages.renderformer.inference.output import Output
from stages.renderformer.inference.predict import light_passes, predict_frames, predict_scene, single_lights
from stages.renderformer.inference.renderer import LimitWarning, Renderer, predict
from stages.renderformer.inference.room import Room
from stages.renderformer.inference.scene_files import load_scene
from stages.renderformer.inference.settings import PredictSettings

MICRO = dict(
    latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=64, num_register_tokens=2, texture_encode_patch_size=1,
    view_transformer_latent_dim=128, view_transformer_n_layers=4, view_transformer_n_heads=1,
    view_transformer_ffn_hidden_dim=64, dpt_features=8, dpt_out_channels=(8, 8, 8, 8),
)  # fmt: skip


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """A released-format folder with random weights that says it was trained with 900 triangles at 16 px."""
    import torch

    from model.renderformer.network import RenderFormer

    torch.manual_seed(0)
    folder, config = tmp_path_factory.mktemp("checkpoint"), ModelConfig(**MICRO)
    files.save(config, RenderFormer(config).state_dict(), folder, {"triangles": "900", "resolution": "16"})
    return folder


@pytest.fixture(scope="module")
def renderer(checkpoint) -> Renderer:
    return Renderer(checkpoint, "cpu")


@pytest.fixture
def cube(tmp_path) -> Path:
    trimesh.creation.box((2, 3, 1)).export(tmp_path / "cube.obj")
    return tmp_path / "cube.obj"


@pytest.fixture
def scene_json(tmp_path):
    """Writes a scene of one triangle and one light, changed as asked for; returns its path."""
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 0.5 0 0\nv 0 0.5 0\nf 1 2 3\n")
    (tmp_path / "lamp.obj").write_text("v 0 0 2.3\nv 0.15 0 2.3\nv 0 0.15 2.3\nf 1 2 3\n")

    def write(change=lambda scene: None) -> Path:
        scene = {
            "objects": {
                "one": {"mesh_path": "one.obj", "material": {"diffuse": [0.5, 0.5, 0.5]}},
                "lamp": {"mesh_path": "lamp.obj", "material": {"emissive": [3000, 3000, 3000]}},
            },
            "cameras": [{"position": [0, -1.5, 0.5], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}],
        }
        change(scene)
        (tmp_path / "scene.json").write_text(json.dumps(scene))
        return tmp_path / "scene.json"

    return write


def object_of(scene) -> np.ndarray:
    """(F, 3, 3) triangles of the room's object."""
    index = next(i for i, entry in enumerate(scene.meta["objects"]) if entry["kind"] == "object")
    return scene.triangles[scene.object_index == index]


# --- scenes and checkpoints -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "scene"),
    [("base", "cbox.h5"), ("no-dpt", "veach-mis.json"), ("swin", "init-template.h5"), ("two-heads-dpt-layers", "cbox.json")],
)
def test_released_checkpoints_render_released_scenes(shared_data, model, scene, tmp_path, capsys):
    words = ["predict", str(shared_data / "scenes" / scene), "--checkpoint", str(shared_data / "parity" / model)]
    assert main([*words, "-o", str(tmp_path / "out.png"), "--resolution", "64", "--device", "cpu"]) == 0
    assert Image.open(tmp_path / "out.png").size == (64, 64)
    assert ("trained with at most 4,096" in capsys.readouterr().err) == (scene != "init-template.h5")


def test_three_lines_of_python(cube, checkpoint):
    from lightmill import Renderer

    renderer = Renderer(checkpoint)
    image = renderer.render(cube)
    assert image.shape == (16, 16, 3) and image.dtype == np.float32 and (image >= 0).all()  # as it was trained


@pytest.mark.parametrize("size", [8, 24, (16, 40)])
def test_any_multiple_of_8(renderer, cube, size):
    with warnings.catch_warnings(action="ignore"):
        height, width = (size, size) if isinstance(size, int) else size
        assert renderer.render(cube, resolution=size).shape == (height, width, 3)


def test_frames_are_rendered_a_few_at_a_time_from_one_encoding(renderer, cube, monkeypatch):
    """A long animation must not be held in memory, nor its scene be encoded again."""
    scene = orbit(renderer.load(cube), 12)
    calls = []
    for name in ("encode", "decode"):
        whole = getattr(renderer.model, name)
        monkeypatch.setattr(renderer.model, name, lambda *a, name=name, whole=whole: calls.append(name) or whole(*a))
    frames = predict_frames(renderer.model, scene, range(12), 128)
    first = next(frames)
    assert calls == ["encode", "decode"]
    assert 1 + len(list(frames)) == 12 and calls.count("encode") == 1 and calls.count("decode") == 3
    assert first == pytest.approx(predict_scene(renderer.model, scene, [0], 128)[0], abs=1e-5)


def test_composited_lights_are_the_sum_of_one_pass_per_light(renderer, cube):
    scene = renderer.load(cube)
    alone = list(single_lights(scene))
    assert len(alone) == 3
    assert sum(lit.emission for lit in alone) == pytest.approx(scene.emission)
    lights = scene.light_index >= 0
    for number, lit in enumerate(alone):  # an unlit light is black, as in the path tracer
        others = lights & (scene.light_index != number)
        assert not lit.emission[others].any() and not lit.diffuse[others].any()
    warnings.simplefilter("ignore")  # each is dimmer than the training data's single lights
    composite = renderer.render(scene, composite_lights=True)
    passes = list(light_passes(scene))
    assert sum(share for _, share in passes) == pytest.approx(1)
    for (lit, share), single in zip(passes, alone, strict=True):  # each as bright as all together, which the share takes back
        assert light_radiance(lit).sum() == pytest.approx(light_radiance(scene).sum())
        assert share * lit.emission == pytest.approx(single.emission, rel=1e-5)
    assert composite == pytest.approx(sum(share * renderer.render(lit) for lit, share in passes), rel=1e-5)
    assert np.abs(composite - renderer.render(scene)).max() > 2e-6  # a network is not linear


# --- the room ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("template", ["floor", "wall", "corner", "box"])
def test_a_mesh_stands_in_its_room_in_front_of_the_camera(cube, template):
    scene = load_scene(cube, Room(template, triangles=4096))
    corners = object_of(scene)
    floor = scene.triangles[scene.object_index == 0]
    assert corners[..., 2].min() == pytest.approx(floor[..., 2].max(), abs=1e-3)
    pose, fov = scene.camera_to_world[0].astype(float), np.radians(scene.fov_deg[0])
    seen = (corners.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
    placed = seen[:, :2] / -seen[:, 2:] / np.tan(fov / 2)  # -1..1 over the picture
    assert (seen[:, 2] < 0).all() and np.abs(placed).max() < 0.9 and np.ptp(placed, axis=0).max() > 0.8
    assert beyond_limits(scene, [0], (512, 512), {}) == []  # a model sees what it was trained with


def test_the_room_is_lit_and_no_wall_hides_the_object(cube):
    from tests.renderformer.fakes import path_traced

    scene = load_scene(cube, Room("corner"))
    (view,) = path_traced(scene, 32, max_spp=12, seed=0, backend={"backend": "scalar"}, denoise=False)
    index = next(i for i, entry in enumerate(scene.meta["objects"]) if entry["kind"] == "object")
    assert (view.object == index).mean() > 0.1
    bright = view.image[view.object == index].mean(axis=1)
    assert 0.1 < np.median(bright) < 0.9 and 0.1 < view.image.mean() < 0.8


def test_up_is_y_but_for_stl_and_can_be_chosen(tmp_path):
    tall = trimesh.creation.box((1, 4, 1))
    heights = {}
    for name, up in (("a.obj", None), ("a.stl", None), ("b.stl", "y"), ("c.obj", "-y"), ("d.obj", "x")):
        tall.export(tmp_path / name)
        heights[name] = np.ptp(object_of(load_scene(tmp_path / name, Room(up=up, triangles=4096)))[..., 2])
    assert [heights[name] > 0.7 for name in ("a.obj", "b.stl", "c.obj")] == [True] * 3
    assert [heights[name] < 0.25 for name in ("a.stl", "d.obj")] == [True] * 2


def test_base_colours_come_along_also_when_decimated(tmp_path):
    parts = [trimesh.creation.icosphere(subdivisions=4, radius=1) for _ in range(2)]
    for part, colour, x in zip(parts, ([255, 0, 0, 255], [0, 0, 255, 255]), (-1.5, 1.5), strict=True):
        part.apply_translation([x, 0, 0])
        part.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=colour))
    trimesh.Scene(parts).export(tmp_path / "two.glb")
    scene = load_scene(tmp_path / "two.glb", Room(triangles=1200))
    assert len(scene.triangles) <= 1200 and "decimated" in scene.meta["notes"][0]
    of_object = scene.object_index == 3
    left = scene.triangles[of_object].mean(axis=1)[:, 0] < object_of(scene)[..., 0].mean()
    diffuse = scene.diffuse[of_object]
    assert (diffuse[left] == diffuse[left][0]).all() and diffuse[left][0, 0] > 0.8 > 0.01 > diffuse[left][0, 2]
    assert diffuse[~left][0, 2] > 0.8 > 0.01 > diffuse[~left][0, 0]


def test_a_large_mesh_is_decimated_to_what_the_checkpoint_knows(renderer, tmp_path):
    trimesh.creation.icosphere(subdivisions=5).export(tmp_path / "ball.ply")  # 20,480 triangles
    scene = renderer.load(tmp_path / "ball.ply")
    assert 600 < len(scene.triangles) <= 900
    assert "20,480 triangles remeshed and decimated" in scene.meta["notes"][0]
    assert len(load_scene(tmp_path / "ball.ply").triangles) == 20480 + 3 * 128 + 3  # the path tracer needs no limit


def test_a_mesh_that_remeshing_refuses_is_decimated_as_it_is(tmp_path):
    beads = [
        trimesh.creation.icosphere(subdivisions=2).apply_translation([4 * x, 4 * y, 0]) for x in range(5) for y in range(5)
    ]
    trimesh.util.concatenate(beads).export(tmp_path / "beads.stl")  # more pieces than remesh takes
    scene = load_scene(tmp_path / "beads.stl", Room(triangles=1600))
    assert len(scene.triangles) <= 1600 and "scattered" in scene.meta["notes"][0]


def test_few_large_triangles_are_subdivided_where_there_is_room(cube):
    assert len(object_of(load_scene(cube))) == 12
    assert len(object_of(load_scene(cube, Room(triangles=4096)))) == 12 * 16


def test_a_small_budget_gets_a_room_with_fewer_walls(cube):
    templates = [load_scene(cube, Room(triangles=triangles)).meta["template"] for triangles in (4096, 320, 200)]
    assert templates == ["corner", "wall", "floor"]


# --- orbits and videos ------------------------------------------------------------------------------------------------


def test_an_orbit_is_a_video_that_plays_and_its_frames(checkpoint, cube, tmp_path, capsys):
    import av

    out = tmp_path / "spin.mp4"
    words = ["predict", str(cube), "--checkpoint", str(checkpoint), "-o", str(out), "--orbit", "48", "--resolution", "16"]
    assert main([*words, "--fps", "12", "--room", "floor", "--device", "cpu", "--exposure", "auto"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == str(out)
    with av.open(str(out)) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 12)
        decoded = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    pngs = sorted((tmp_path / "spin").iterdir())
    assert [path.name for path in pngs] == [f"{index:04}.png" for index in range(48)]
    assert len(decoded) == 48 and decoded[0].shape == (16, 16, 3)
    for frame, path in zip(decoded, pngs, strict=True):
        assert np.abs(frame.astype(int) - np.asarray(Image.open(path))).mean() < 6  # the codec halves colours' resolution


def test_an_orbit_goes_around_and_starts_at_the_scenes_own_camera(cube):
    scene = load_scene(cube, Room("floor", triangles=4096))
    pivot = centre(scene, 0)
    around = orbit(scene, 4)
    assert around.camera_to_world[0] == pytest.approx(scene.camera_to_world[0], abs=1e-6)
    positions = around.camera_to_world[:, :3, 3] - pivot
    assert np.linalg.norm(positions, axis=1) == pytest.approx([np.linalg.norm(positions[0])] * 4)
    assert positions[2, :2] == pytest.approx(-positions[0, :2], abs=1e-5)  # half a turn
    assert around.camera_to_world[:, :3, 2] @ [0, 0, 1] == pytest.approx([scene.camera_to_world[0, 2, 2]] * 4)
    for pose in around.camera_to_world:  # and always looks at the pivot
        towards = (pivot - pose[:3, 3]) / np.linalg.norm(pivot - pose[:3, 3])
        assert towards == pytest.approx(-pose[:3, 2], abs=1e-5)


def test_between_walls_an_orbit_swings_and_never_goes_behind_them(cube):
    scene = load_scene(cube, Room("corner", triangles=4096))
    swing = orbit(scene, 32)
    assert swing.camera_to_world[0] == pytest.approx(scene.camera_to_world[0], abs=1e-6)
    positions = swing.camera_to_world[:, :3, 3]
    assert positions[:, :2].max() < 0.55  # walls stand at x and y = 0.5; beside them is not behind them
    steps = np.linalg.norm(np.diff(np.concatenate([positions, positions[:1]]), axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)  # closed, without a jump
    assert "swings" in swing.meta["notes"][-1]
    assert np.ptp(orbit(scene, 32, arc_deg=360).camera_to_world[:, 0, 3]) > np.ptp(positions[:, 0])


def test_a_shorter_video_leaves_no_frame_of_a_longer_one(renderer, cube, tmp_path):
    for frames in (3, 2):
        predict(renderer, cube, Output(tmp_path / "a{b}.mp4"), PredictSettings(frames=frames, resolution=16), Room("floor"))
    assert [path.name for path in sorted((tmp_path / "a{b}").iterdir())] == ["0000.png", "0001.png"]


def test_all_cameras_and_an_orbit_as_single_images(checkpoint, cube, tmp_path):
    words = ["predict", str(cube), "--checkpoint", str(checkpoint), "--resolution", "8", "--device", "cpu"]
    assert main([*words, "-o", str(tmp_path / "a.exr"), "--orbit", "2", "--arc", "20"]) == 0
    assert main([*words, "-o", str(tmp_path / "b.png"), "--view", "all", "--tonemap", "agx"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"cube.obj", "a-0.exr", "a-1.exr", "b-0.png"}


# --- tone mappers -----------------------------------------------------------------------------------------------------


def test_tone_mappers_give_what_is_published():
    """8-bit greys of linear 0.18, 1 and 5, as three.js r180 computes them; the others by their formulas."""
    greys = np.array([0.18, 1.0, 5.0])[:, None] * np.ones(3)
    expected = {"none": (118, 255, 255), "agx": (128, 202, 242), "aces": (127, 226, 251), "pbr_neutral": (105, 240, 254)}
    for name, values in expected.items():
        assert tuple(to_picture(greys, mapper=name)[:, 0]) == values
    assert TONE_MAPPERS["reinhard"](greys) == pytest.approx(greys / (1 + greys))
    assert TONE_MAPPERS["filmic"](np.full(3, 5.6)) == pytest.approx(1.0)  # linear white 11.2 at exposure 2
    for mapper in TONE_MAPPERS.values():
        ramp = mapper(np.linspace(0, 20, 200)[:, None] * np.ones(3))
        assert np.isfinite(ramp).all() and (np.diff(ramp[:, 0]) >= -1e-6).all() and abs(ramp[0]).max() < 2e-3


# --- beyond the limits ------------------------------------------------------------------------------------------------


def moved(scene, factor: float):
    pose = scene.camera_to_world.copy()
    pose[:, :3, 3] *= factor
    return replace(scene, camera_to_world=pose)


def many_lights(scene, count: int):
    """The scene's last triangles as so many lights."""
    index = np.full(len(scene.triangles), -1, np.int16)
    index[-count:] = np.arange(count)
    emission = np.where(index[:, None] >= 0, np.float32(3000 / count), np.float32(0)) * np.ones(3, np.float32)
    return replace(scene, light_index=index, emission=emission)


def with_light(scene, **changes):
    """The scene with its lights' triangles or emission mapped."""
    lit = scene.light_index >= 0
    arrays = {name: getattr(scene, name).copy() for name in changes}
    for name, change in changes.items():
        arrays[name][lit] = change(arrays[name][lit])
    return replace(scene, **arrays)


BEYOND = {
    "901 triangles": lambda s: s,
    "12 lights: the training data has 1 to 8": lambda s: many_lights(s, 12),
    "a camera 5.": lambda s: moved(s, 3.0),
    "a camera 0.9": lambda s: moved(s, 0.5),
    "field of view of 100.0 degrees": lambda s: replace(s, fov_deg=np.float32([100])),
    "a roughness of 1.50": lambda s: replace(s, roughness=s.roughness * np.float32(1.5)),
    "add up to": lambda s: replace(s, specular=s.specular + np.float32(0.8)),
    "total radiance of 25,000": lambda s: with_light(s, emission=lambda e: e * np.float32(10)),
    "coloured light": lambda s: with_light(s, emission=lambda e: e * np.float32([1, 0.5, 0.2])),
    "a light of area": lambda s: with_light(s, triangles=lambda t: t.mean(axis=1, keepdims=True) * -9 + t * 10),
    "a light 1.": lambda s: with_light(s, triangles=lambda t: t - t.mean(axis=1, keepdims=True) / 2),
    "the scene reaches": lambda s: replace(s, triangles=s.triangles * np.float32(4)),
    "a triangle of area": lambda s: replace(s, triangles=s.triangles * np.float32([1, 1, 6])),
    "resolution 24x24: the checkpoint was trained with 16x16": lambda s: s,
}


@pytest.mark.parametrize("sentence", BEYOND)
def test_what_is_beyond_a_limit_is_rendered_with_a_warning_that_names_it(renderer, cube, sentence):
    scene = load_scene(cube, Room("floor", triangles=1000 if "901" in sentence else 640))
    if "901" in sentence:
        spare = np.repeat(np.arange(len(scene.triangles)), 900)[: 901 - len(scene.triangles)]
        keep = np.concatenate([np.arange(len(scene.triangles)), spare * 0])
        arrays = {name: getattr(scene, name)[keep] for name in scene.DTYPES if name not in ("camera_to_world", "fov_deg")}
        scene = replace(scene, **arrays)
    resolution = 24 if "resolution" in sentence else 16
    with pytest.warns(LimitWarning) as caught:
        frames = renderer.frames(BEYOND[sentence](scene), resolution=resolution)
    assert any(sentence in str(warning.message) for warning in caught), [str(w.message) for w in caught]
    assert np.isfinite(next(frames)).all()


def test_a_scene_without_light_has_no_lights_to_composite(renderer, cube):
    scene = load_scene(cube)
    dark = replace(scene, emission=scene.emission * 0, light_index=np.full_like(scene.light_index, -1))
    for render in (renderer.render, lambda dark, **how: renderer.frames(dark, [0], **how)):
        with pytest.raises(UserError, match=f"{dark.id} has no light.*emissive colour above 0"):
            render(dark, composite_lights=True)


def test_composited_lights_have_no_limit_in_number(cube):
    scene = many_lights(load_scene(cube, Room("floor", triangles=640)), 12)
    sentences = [beyond_limits(scene, [0], (16, 16), {}, composite) for composite in (False, True)]
    assert any("12 lights" in s for s in sentences[0]) and not any("12 lights" in s for s in sentences[1])
    # together they emit what the law says, and so does each in its pass
    assert not any("total radiance" in s for s in sentences[0] + sentences[1])


def test_twenty_thousand_triangles_are_a_warning(renderer, tmp_path, scene_json):
    trimesh.creation.icosphere(subdivisions=5, radius=0.4).export(tmp_path / "one.obj")
    with pytest.warns(LimitWarning, match=r"scene: 20,481 triangles: the checkpoint was trained with at most 900"):
        renderer.frames(scene_json())  # nothing is rendered before the first frame is asked for


# --- bad input --------------------------------------------------------------------------------------------------------


def bad_scenes() -> dict:
    def without_light(scene):
        del scene["objects"]["lamp"]

    def missing_mesh(scene):
        scene["objects"]["one"]["mesh_path"] = "gone.obj"

    def nan_vertex(scene):
        scene["objects"]["one"]["mesh_path"] = "nan.obj"

    def no_camera(scene):
        scene["cameras"] = []

    return {
        "gone.obj does not exist": missing_mesh,
        "nan.obj: line 2: a coordinate": nan_vertex,
        "has no light": without_light,
        "has no camera": no_camera,
    }


@pytest.mark.parametrize("message", bad_scenes())
@pytest.mark.parametrize("command", ["predict", "trace", "compare"])
def test_a_bad_scene_is_named_in_one_line(checkpoint, scene_json, tmp_path, capsys, message, command):
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 0 0.5 0\nf 1 2 3\n")
    out = tmp_path / ("out.png" if command == "compare" else "out.exr")
    words = [command, str(scene_json(bad_scenes()[message])), "-o", str(out)]
    assert main(words + (["--checkpoint", str(checkpoint)] if command != "trace" else [])) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("nan.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "infinite or not a number"),
        ("empty.stl", b"solid a\nendsolid a\n", "there is no triangle in it"),
        ("text.glb", b"not a mesh", "truncated, malformed"),
        ("line.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no area"),
        ("scene.blend", b"", "in Blender, and choose File > Export > glTF"),
        ("scene.txt", b"", "neither a scene nor a mesh"),
        ("scene.json", b"{", "is not JSON"),
        ("scene.json", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "is a Git LFS pointer"),
        ("scene.h5", b"<!DOCTYPE html>", "is an HTML page"),
        ("scene.h5", b"\x89HDF", "is not an HDF5 file"),
    ],
)
def test_a_bad_file_is_named(renderer, tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=message) as caught:
        renderer.load(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(renderer, tmp_path):
    with pytest.raises(UserError, match=r"chair\.glb does not exist"):
        renderer.load(tmp_path / "chair.glb")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resolution", "100"], "resolution 100 must be a multiple of 8 pixels for this checkpoint, at most 8,192: for "
                                  "example 96 or 104"),
        (["--resolution", "0"], "resolution 0 must be a multiple of 8"),
        (["--resolution", "16x20"], "resolution 20 must be a multiple of 8"),
        (["--view", "1"], "view 1 of"),
        (["--orbit", "0"], "an orbit of 0 frames"),
        (["--orbit", "2", "--arc", "400"], "an arc of 400 degrees"),
        (["--orbit", "2", "--view", "all"], "an orbit starts at one camera"),
        (["--orbit", "2", "-o", "taken.mp4"], "taken is for the video's frames and holds chair.glb"),
        (["--orbit", "2", "-o", "file.mp4"], "file is a file"),
        (["--tonemap", "sepia"], "none, reinhard, filmic, aces, agx, pbr_neutral"),
        (["--fps", "0"], "0 frames per second"),
        (["-o", "out.jpg"], "must end in .exr"),
        (["-o", "nowhere/out.png"], "nowhere does not exist"),
        (["--triangles", "40"], "a room of 40 triangles: an object on a floor needs at least 195"),
    ],
)  # fmt: skip
def test_what_cannot_be_asked_for_is_said(checkpoint, cube, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    if "-o" not in words:
        words = [*words, "-o", "out.png"]
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "chair.glb").write_bytes(b"")
    (tmp_path / "file").write_bytes(b"")
    assert main(["predict", str(cube), "--checkpoint", str(checkpoint), "--device", "cpu", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def wrong_checkpoints(folder: Path, good: Path) -> dict[str, Path]:
    """message -> path."""
    names = ("empty", "cut", "other", "bare", "nan", "unknown")
    folders = {name: folder / name for name in names}
    for name in names[1:]:
        shutil.copytree(good, folders[name])
    folders["empty"].mkdir()
    weights = (good / "model.safetensors").read_bytes()
    (folders["cut"] / "model.safetensors").write_bytes(weights[:1000])
    config = json.loads((good / "config.json").read_text())
    (folders["other"] / "config.json").write_text(json.dumps(config | {"dim_feedforward": 128}))
    (folders["unknown"] / "config.json").write_text(json.dumps(config | {"novel": 1}))
    (folders["bare"] / "model.safetensors").unlink()
    from model.renderformer.network import RenderFormer

    model = RenderFormer(ModelConfig(**MICRO))
    model.tri_token.data.fill_(np.nan)
    files.save(model.config, model.state_dict(), folders["nan"])
    return {
        "it has no config.json": folders["empty"],
        "is not a safetensors file": folders["cut"],
        "has shape": folders["other"],
        "unknown field novel": folders["unknown"],
        "model.safetensors is missing": folders["bare"],
        "predicts NaN or infinity": folders["nan"],
        "is a file: a checkpoint is the folder": folders["other"] / "config.json",
        "no-such-folder": folder / "no-such-folder",
    }


def test_a_wrong_checkpoint_is_named_in_one_line(checkpoint, cube, tmp_path, capsys):
    for message, path in wrong_checkpoints(tmp_path, checkpoint).items():
        words = ["predict", str(cube), "--checkpoint", str(path), "--device", "cpu", "--store", str(tmp_path / "store")]
        assert main([*words, "--resolution", "8", "-o", str(tmp_path / "out.png")]) == 2
        error = capsys.readouterr().err.splitlines()
        assert error[-1].startswith("error: ") and message in error[-1], (message, error)
        assert not (tmp_path / "out.png").exists()


def test_trace_takes_meshes_too(cube, tmp_path):
    from stages.graphics.exr import read_rgb

    words = ["trace", str(cube), "-o", str(tmp_path / "out.exr"), "--resolution", "8", "--spp", "2", "--room", "floor"]
    assert main(words) == 0 and read_rgb(tmp_path / "out.exr").mean() > 0.05


def test_a_traced_picture_shows_lights_where_asked(tmp_path, scene_json):
    """The training data hides them from the camera, and so does trace unless told."""
    from stages.graphics.exr import read_rgb

    def look_up(scene):
        scene["cameras"][0] |= {"position": [0.05, 0.05, 0.5], "look_at": [0.05, 0.05, 2.3], "up": [0, 1, 0]}

    words = ["trace", str(scene_json(look_up)), "-o", str(tmp_path / "out.exr"), "--resolution", "16", "--spp", "4"]
    for more, seen in (([], False), (["--lights-visible"], True)):
        assert main([*words, "--no-denoise", *more]) == 0
        assert (read_rgb(tmp_path / "out.exr").max() > 1000) == seen
