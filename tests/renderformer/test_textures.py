"""Textured triangles: baked where the image says, rendered where they were baked, read back from released files."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from pipeline.config import parse
from pipeline.errors import UserError
from pipeline.keys import canonical
from pipeline.stage import Record
from stages.graphics.arrays import unpack_arrays
from stages.graphics.geometry import colours, load
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.graphics.tonemap import from_picture, to_picture
from stages.renderformer.records import PATCH_INSIDE, PATCH_KEPT, SceneRecord, patch_means
from stages.renderformer.s00_collect import Collect, made_up_texture
from stages.renderformer.s03_scene import SampleScene, SceneConfig, SceneCount
from stages.renderformer.scenes import textures
from stages.renderformer.scenes.laws import TextureLaw
from tests.renderformer.fakes import FakeArtifact, blob, decimated, path_traced
from tests.renderformer.test_collect import CORNERS, FACES, gltf, words
from tests.renderformer.test_rendering import SCALAR, backend, build, camera, clutter, hashed, jit, quad  # noqa: F401 (fixtures)

ROW, COLUMN = np.indices((32, 32))
FIRST, SECOND = (COLUMN + 0.5) / 32, (ROW + 0.5) / 32  # weights of corners 1 and 2 at the texels' centres


def patches_of(triangles, colour, specular=0.0, roughness=1.0):
    """(F, 7, 32, 32) float16: ``colour(points (..., 3))`` as diffuse, the rest constant or a function of the points."""
    a, b, c = np.moveaxis(np.asarray(triangles, np.float64), 1, 0)[:, :, None, None]
    points = a + FIRST[..., None] * (b - a) + SECOND[..., None] * (c - a)
    value = [v(points) if callable(v) else np.broadcast_to(v, points.shape[:-1]) for v in (specular, roughness)]
    channels = [*np.moveaxis(np.broadcast_to(colour(points), points.shape), -1, 0), value[0], value[0], value[0], value[1]]
    return (np.stack(channels, axis=1) * PATCH_KEPT).astype(np.float16)


def textured(scene: SceneRecord, faces, patches) -> SceneRecord:
    """The scene with these faces textured."""
    scene.patch_index = np.full(len(scene.triangles), -1, np.int32)
    scene.patch_index[faces] = np.arange(len(patches))
    scene.patches = patches
    for name, values in patch_means(patches).items():
        column = getattr(scene, name).copy()
        column[faces] = values
        setattr(scene, name, column)
    return scene


# --- baking -----------------------------------------------------------------------------------------------------------


def ramp(width=256, height=128):
    """An image that is linear in light: red rises to the right, green downwards."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return to_picture(np.stack([x, y, np.full_like(x, 0.25)], axis=-1))


def test_a_linear_image_is_baked_where_it_lies():
    """Texel [row, column] shows the image at its weights of corners 1 (column) and 2 (row), v downwards."""
    uv = np.array([[[0.1, 0.2], [0.9, 0.3], [0.2, 0.8]], [[0.8, 0.8], [0.2, 0.7], [0.7, 0.1]]])
    baked = textures.bake(ramp(), uv)
    place = uv[:, None, None, 0] + FIRST[..., None] * (uv[:, 1] - uv[:, 0])[:, None, None]
    place = place + SECOND[..., None] * (uv[:, 2] - uv[:, 0])[:, None, None]
    assert np.abs(baked[..., :2] - place)[:, PATCH_KEPT].max() < 0.01  # 8 bits of sRGB are up to 0.009 apart in light
    assert np.abs(baked[..., 2] - 0.25)[:, PATCH_KEPT].max() < 0.01
    assert (baked[:, ~PATCH_KEPT] == 0).all()


def test_texels_are_means_in_linear_light():
    """A pattern finer than a texel becomes its mean light, not a moire nor the mean of its bytes."""
    image = np.zeros((512, 512, 3), np.uint8)
    image[::2, 1::2] = image[1::2, ::2] = 255
    baked = textures.bake(image, np.array([[[0, 0], [1, 0], [0, 1]]]))
    assert np.abs(baked[0, PATCH_INSIDE] - 0.5).max() < 0.06
    assert abs(baked[0, PATCH_INSIDE].mean() - 0.5) < 0.005


def test_coordinates_outside_the_image_wrap_clamp_or_mirror():
    image = ramp(64, 64)
    at = {name: textures.look_up(image, np.array([[1.25, 0.5]]), (i, i))[0, 0] for i, name in enumerate(TextureRecord.WRAPS)}
    assert at["repeat"] == pytest.approx(0.25, abs=0.01)
    assert at["clamp"] == pytest.approx(63.5 / 64, abs=0.01)
    assert at["mirror"] == pytest.approx(0.75, abs=0.01)
    seam = textures.look_up(image, np.array([[0.0, 0.5], [1.0, 0.5]]), (0, 0))[:, 0]
    assert seam == pytest.approx([0.5, 0.5], abs=0.02)  # between the last and the first column


def test_what_lies_beside_a_triangle_in_the_atlas_does_not_bleed_in():
    """Red above the diagonal, green below: a triangle on one side gets none of the other, at whatever scale."""
    y, x = np.indices((256, 256))
    image = np.where((x + y < 256 - 2)[..., None], [255, 0, 0], [0, 255, 0]).astype(np.uint8)
    baked = textures.bake(image, np.array([[[0, 0], [0.985, 0], [0, 0.985]]]))
    assert baked[0, PATCH_KEPT][:, 1].max() < 0.01 and baked[0, PATCH_KEPT][:, 0].min() > 0.99


def test_a_remeshed_surface_gets_the_colours_of_the_nearest_points():
    """The coarse square below takes what the fine one above it shows, whatever its triangles."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[[0, 1], [1, 1], [1, 0]], [[0, 1], [1, 0], [0, 0]]])  # image upright: v runs down, y up
    one = np.zeros(1, np.int16)
    texture = TextureRecord(
        "a", uv, np.zeros(2, np.int16), np.float32([[0.5, 1, 1]]), one, np.zeros((1, 2), np.uint8), [ramp()]
    )
    rng = np.random.default_rng(0)
    triangles = rng.uniform(0.1, 0.9, (5, 3, 3)) * [1, 1, 0] - [0, 0, 0.01]
    got = textures.transfer(texture, corners, faces, triangles)
    a, b, c = np.moveaxis(triangles, 1, 0)[:, :, None, None]
    points = a + FIRST[..., None] * (b - a) + SECOND[..., None] * (c - a)
    expected = np.stack([0.5 * points[..., 0], 1 - points[..., 1]], axis=-1)
    assert np.abs(got[..., :2] - expected)[:, PATCH_INSIDE].max() < 0.01


def test_hidden_faces_lend_no_colours():
    """A green box inside a red one: rays from outside meet only the red one, though the green one may be nearer."""
    from stages.renderformer.objects.procedural import box, join

    vertices, faces = join(box((1, 1, 1)), box((0.98, 0.98, 0.98)))
    half = len(faces) // 2
    material = np.repeat(np.int16([0, 1]), half)
    plain = np.full(2, -1, np.int16)
    colour, wrap = np.float32([[1, 0, 0], [0, 1, 0]]), np.zeros((2, 2), np.uint8)
    texture = TextureRecord("a", np.zeros((len(faces), 3, 2)), material, colour, plain, wrap, [])
    seen = textures.seen_faces(vertices, faces)
    assert seen[:half].all() and not seen[half:].any()
    below = vertices[faces[:half]] * 0.983  # nearer to the inner box
    assert textures.transfer(texture, vertices, faces, below)[:, PATCH_INSIDE, 1].min() > 0.99
    assert textures.transfer(texture, vertices, faces, below, seen)[:, PATCH_INSIDE, 0].min() > 0.99


# --- collect: images of strangers' files ------------------------------------------------------------------------------


def png(pixels: np.ndarray, claimed: tuple[int, int] | None = None) -> bytes:
    """A PNG file; ``claimed``: a width and height that its header states instead of its own."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="png")
    data = bytearray(buffer.getvalue())
    if claimed:
        data[16:24] = struct.pack(">II", *claimed)
        data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    return bytes(data)


RED_GREEN = np.uint8([[[255, 0, 0], [0, 255, 0]]] * 2)  # left red, right green
UV = np.where(CORNERS[:, :1] > 5, [[0.75, 0.5]], [[0.25, 0.5]]).astype("<f4")  # low x red, high x green


def textured_gltf(image: dict, **changes) -> bytes:
    """The box of test_collect with texture coordinates and one image."""
    tree = gltf(**changes)
    tree["accessors"].append({"bufferView": 2, "componentType": 5126, "count": len(UV), "type": "VEC2"})
    tree["bufferViews"].append({"buffer": 1, "byteLength": UV.nbytes})
    uri = "data:application/octet-stream;base64," + base64.b64encode(UV.tobytes()).decode()
    tree["buffers"].append({"byteLength": UV.nbytes, "uri": uri})
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"], primitive["material"] = 2, 0
    tree |= {"images": [image], "textures": [{"source": 0, "sampler": 0}], "samplers": [{"wrapS": 33071}]}
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0.5, 1, 1]}}]
    return json.dumps(tree).encode()


def data_uri(data: bytes) -> dict:
    return {"uri": "data:image/png;base64," + base64.b64encode(data).decode()}


def load_textured(path):
    return load.load_mesh(path, path.parent, 1 << 24, 50_000, textures=True)


def corner_colours(loaded: load.Loaded) -> np.ndarray:
    """(F, 3, 3) linear colours at the corners."""
    t = loaded.texture
    looked = [textures.look_up(t.images[t.image[0]], uv, tuple(t.wrap[0])) for uv in t.uv]
    return np.array(looked) * t.colour[0]


def test_gltf_and_obj_keep_their_images_on_the_right_corners(tmp_path):
    (tmp_path / "a.gltf").write_bytes(textured_gltf(data_uri(png(RED_GREEN))))
    lines = ["mtllib a.mtl", *("v " + words(v) for v in CORNERS), *(f"vt {u} {v}" for u, v in UV), "usemtl paint"]
    lines += ["f " + " ".join(f"{i}/{i}" for i in f + 1) for f in FACES]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    (tmp_path / "a.mtl").write_text("newmtl paint\nKd 0 0 0\nmap_Kd -clamp on maps/red green.png\n".replace("red green", "rg"))
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "rg.png").write_bytes(png(RED_GREEN))
    for name, green in (("a.gltf", 0.5), ("a.obj", 1.0)):  # the glTF has a base colour factor; Kd beside an image means nothing
        loaded = load_textured(tmp_path / name)
        right = loaded.vertices[loaded.faces][..., 0] > 5
        expected = np.where(right[..., None], [0, green, 0], [1, 0, 0])
        assert np.allclose(corner_colours(loaded), expected, atol=1e-6), name
        assert TextureRecord.WRAPS[loaded.texture.wrap[0, 0]] == "clamp"
        plain = load.load_mesh(tmp_path / name, tmp_path, 1 << 24, 50_000)
        assert plain.texture is None
        assert np.array_equal(plain.vertices, loaded.vertices) and np.array_equal(plain.faces, loaded.faces)


def test_texture_transforms_and_integer_coordinates(tmp_path):
    """An offset by half an image swaps the colours; so do 16-bit coordinates that say the same."""
    tree = json.loads(textured_gltf(data_uri(png(RED_GREEN))))
    tree["samplers"] = [{}]
    texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    texture["extensions"] = {"KHR_texture_transform": {"offset": [0.5, 0]}}
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    small = np.round(UV * 65535).astype("<u2")
    tree["accessors"][-1] |= {"componentType": 5123, "normalized": True}
    tree["buffers"][1] = {"byteLength": small.nbytes, "uri": "data:;base64," + base64.b64encode(small.tobytes()).decode()}
    tree["bufferViews"][2]["byteLength"] = small.nbytes
    (tmp_path / "b.gltf").write_text(json.dumps(tree))
    for name in ("a.gltf", "b.gltf"):
        loaded = load_textured(tmp_path / name)
        right = loaded.vertices[loaded.faces][..., 0] > 5
        assert np.allclose(corner_colours(loaded), np.where(right[..., None], [1, 0, 0], [0, 0.5, 0]), atol=1e-3)


@pytest.mark.parametrize(
    ("image", "note"),
    [
        (data_uri(b"not an image"), "no image in a format that is read (.bmp"),
        (data_uri(png(RED_GREEN)[:44]), "a damaged image"),
        (data_uri(png(RED_GREEN, claimed=(9000, 9000))), "9000 x 9000 pixels"),
        (data_uri(png(RED_GREEN, claimed=(60000, 60000))), "over 67108864 pixels"),
        ({"uri": "../secret.png"}, "refers to"),
        ({"uri": "/etc/secret.png"}, "refers to"),
        ({"uri": "link.png"}, "refers to"),
        ({"uri": "notes.txt"}, "not one of"),
        ({"uri": "none.png"}, "missing"),
        ({"bufferView": 99}, "buffer view 99 does not exist"),
        ({}, "neither a uri nor a buffer view"),
    ],
)
def test_a_bad_image_costs_its_colour_and_not_the_mesh(tmp_path, image, note):
    (tmp_path / "secret.png").write_bytes(png(RED_GREEN))
    root = tmp_path / "root"
    root.mkdir()
    (root / "notes.txt").write_bytes(png(RED_GREEN))
    (root / "link.png").symlink_to(tmp_path / "secret.png")
    (root / "a.gltf").write_bytes(textured_gltf(image))
    loaded = load_textured(root / "a.gltf")
    assert len(loaded.faces) == 12 and loaded.texture is None
    assert len(loaded.notes) == 1 and note in loaded.notes[0]


def test_broken_texture_coordinates_cost_the_colours_and_not_the_mesh(tmp_path):
    tree = json.loads(textured_gltf(data_uri(png(RED_GREEN))))
    tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 77
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    loaded = load_textured(tmp_path / "a.gltf")
    assert len(loaded.faces) == 12 and loaded.texture is None and loaded.notes


def test_large_images_are_averaged_in_linear_light():
    checks = np.zeros((2048, 1500, 3), np.uint8)
    checks[::2, ::2] = checks[1::2, 1::2] = 255
    kept = colours.decode_image(png(checks))
    assert kept.shape == (1024, 750, 3) and abs(from_picture(kept).mean() - 0.5) < 0.01
    deep = io.BytesIO()
    Image.fromarray(np.full((4, 4), 0x8000, np.uint16)).save(deep, format="png")
    assert (colours.decode_image(deep.getvalue()) == 128).all()  # 16 bits


def test_material_colours_alone_are_base_colours(shared_data):
    """A tractor without images shows the colours of its materials, and a bowl its one."""
    market = shared_data / "meshes" / "market"
    tractor, bowl = (load_textured(market / name) for name in ("tractor.gltf", "bowl.gltf"))
    assert len(tractor.texture.colour) == 7 and tractor.texture.images == []
    assert bowl.texture.colour.shape == (1, 3) and bowl.texture.images == []


def test_a_folder_with_textures_keeps_its_meshes_and_knows_its_images(tmp_path):
    (tmp_path / "in").mkdir()
    for number in range(6):
        stretched = CORNERS * [1, 1 + number, 1]
        image = {"uri": "paint.png"} if number else data_uri(png(RED_GREEN))
        (tmp_path / "in" / f"{number}.gltf").write_bytes(textured_gltf(image, vertices=stretched))
    (tmp_path / "in" / "paint.png").write_bytes(png(RED_GREEN))

    def collect(textures: bool):
        config = parse(Collect.Config, {"name": "folder", "path": str(tmp_path / "in"), "textures": textures}, "collect")
        stage = Collect()
        worker = stage.open(config, {}, {})
        records = [("", record) for item in stage.items(config, {}) for record in stage.process(worker, item)]
        draft = FakeArtifact(tmp_path / f"out{textures}", records)
        stage.finish(config, {}, draft)
        return config, draft, stage.identity(config, lambda path: path.read_bytes().hex())

    (_, plain, _), (config, kept, before) = collect(False), collect(True)
    assert len(plain.ids()) == 6 and len(kept.ids()) == 12
    assert all(kept.read(id).members == plain.read(id).members for id in plain.ids())  # remesh need not run again
    assert kept.file("objects.json").read_bytes() == plain.file("objects.json").read_bytes()
    assert not plain.file("textures.json").exists()
    assert {entry["textured"] for entry in json.loads(kept.file("textures.json").read_text()).values()} == {True}
    record = kept.read(kept.ids()[1])
    assert TextureRecord.from_record(record).to_record().members == record.members
    (tmp_path / "in" / "paint.png").write_bytes(png(RED_GREEN[:, ::-1]))
    after = Collect().identity(config, lambda path: path.read_bytes().hex())
    changed = [name for name in before["items"] if before["items"][name] != after["items"][name]]
    assert changed == [f"{number}.gltf" for number in range(1, 6)]  # another image is another object


# --- scenes -----------------------------------------------------------------------------------------------------------


BARE = ("blob1", "blob2")  # those without base colours


def scene_inputs(tmp_path):
    """Blobs, some with a pattern."""
    decimate, records = decimated(tmp_path / "decimate"), []
    for id in decimate.ids():
        vertices, faces = blob(7, int(id[-1]))
        records.append(("", MeshRecord(id, vertices, faces, {}).to_record()))
        texture = made_up_texture(vertices, faces, np.random.default_rng(3))
        texture.id = id + TextureRecord.SUFFIX
        if not id.endswith(BARE):
            records.append(("", texture.to_record()))
    collect = FakeArtifact(tmp_path / "collect", records)
    return {"decimate": decimate, "collect": collect}


def sampled(config, inputs):
    stage = SampleScene()
    worker = stage.open(config, inputs, {})
    return [SceneRecord.from_record(next(iter(stage.process(worker, item)))) for item in stage.items(config, inputs)]


def test_textured_scenes_follow_their_law_and_leave_the_rest_alone(tmp_path):
    inputs = scene_inputs(tmp_path)
    inputs["collect"].file("textures.json").write_text("{}")
    kept = {"count": SceneCount(train=16, validation=0, test=0), "max_triangles": 640}
    plain = sampled(SceneConfig(**kept), inputs)
    config = SceneConfig(**kept, textures=TextureLaw(share=0.6, wall_share=0.3))
    scenes = sampled(config, inputs)
    states = Counter()
    for before, scene in zip(plain, scenes, strict=True):
        assert before.patches is None
        untouched = ("triangles", "vertex_normals", "emission", "light_index", "object_index", "camera_to_world", "fov_deg")
        assert all(np.array_equal(getattr(before, name), getattr(scene, name)) for name in untouched)
        textured = np.zeros(len(scene.triangles), bool) if scene.patch_index is None else scene.patch_index >= 0
        for number, (old, new) in enumerate(zip(before.meta["objects"], scene.meta["objects"], strict=True)):
            faces = scene.object_index == number
            states[new["kind"], new.get("textured", "texture" in new)] += 1
            if new.get("object_id", "").endswith(BARE):
                assert new.get("textured") in (None, False)
            if "texture" not in new:
                assert not textured[faces].any() and old == {k: v for k, v in new.items() if k != "textured"}
                for name in ("diffuse", "specular", "roughness"):
                    assert np.array_equal(getattr(before, name)[faces], getattr(scene, name)[faces])
                continue
            assert textured[faces].all()
            patches = scene.patches[scene.patch_index[faces]].astype(float)
            material = new["material"]
            assert patches[:, :3].max() <= material["bound"] + 1e-3 and patches[:, :3].std() > 0
            assert (patches[:, :3].max(axis=1) + patches[:, 3]).max() <= 1 + 1e-3
            assert np.allclose(scene.specular[faces], material["specular"], atol=1e-3)
            assert np.allclose(scene.diffuse[faces], patches[:, :3, PATCH_INSIDE].mean(axis=2), atol=1e-3)
    assert min(states[kind, flag] for kind in ("object", "wall") for flag in (True, False)) > 2

    stage, draft = SampleScene(), FakeArtifact(tmp_path / "draft", [("", scene.to_record()) for scene in scenes])
    stage.finish(config, inputs, draft)
    counts = draft.notes["scenes"]["textures"]
    assert counts["object_without_base_colours"] > 0 and counts["wall_textured"] == states["wall", True]
    again = sampled(config.model_copy(update={"count": SceneCount(train=3, validation=0, test=0)}), inputs)
    assert [s.to_record().members for s in again] == [s.to_record().members for s in scenes[:3]]


def test_textures_need_collected_colours_and_only_then_read_collect(tmp_path):
    stage, inputs = SampleScene(), scene_inputs(tmp_path)

    def missing(name):
        raise UserError(f"there is no file {name}")

    inputs["collect"].file = missing
    config = SceneConfig(textures=TextureLaw(share=0.5))
    with pytest.raises(UserError, match="collect.textures=true"):
        list(stage.items(config, inputs))
    walls = SceneConfig(textures=TextureLaw(wall_share=0.5))
    assert stage.reads(config) == ("collect", "decimate") and stage.reads(walls) == stage.reads(SceneConfig()) == ("decimate",)
    assert "textures" not in canonical(SceneConfig()) and "textures" in canonical(walls)
    assert "textures" not in canonical(parse(Collect.Config, {"name": "procedural"}, "collect"))


# --- records ----------------------------------------------------------------------------------------------------------


def test_scenes_carry_patches_only_where_there_are_textures():
    plain = clutter()
    before = plain.to_record()
    scene = textured(clutter(), [0, 3], patches_of(clutter().triangles[[0, 3]], lambda p: np.full(3, 0.5)))
    members = scene.to_record().members
    back = SceneRecord.from_record(Record("test", members))
    assert back.textured and back.patch_index.tolist()[:4] == [0, -1, -1, 1] and back.patch_index.dtype == np.int32
    assert np.array_equal(back.patches, scene.patches) and back.patches.dtype == np.float16
    scene.patch_index[:] = -1
    plain.patch_index = scene.patch_index
    assert plain.to_record().members == before.members  # nothing textured: nothing stored
    again = SceneRecord.from_record(before)
    assert not again.textured and again.patch_index is None and "patches" not in unpack_arrays(before.members["scene.npz"])


# --- path tracing -----------------------------------------------------------------------------------------------------


def picture(points):
    """Colours that tell left from right, up from down, and change fast enough to show a misplaced texel."""
    x, z = points[..., 0], points[..., 2]
    return np.stack([0.5 + 0.9 * x, 0.5 + 0.9 * z, 0.5 + 0.4 * np.sin(10 * (x + 0.5 * z))], axis=-1)


def furnace(patches=None, diffuse=0.5, specular=0.0, roughness=1.0):
    """A unit square in the xz plane that fills the camera's picture, inside a closed light of radiance 1."""
    axes = np.eye(3)
    faces = [quad(s * axes[i] * 3, axes[(i + 1) % 3] * 3, axes[(i + 2) % 3] * 3) for i in range(3) for s in (-1.0, 1.0)]
    square = quad((0, 0, 0), (0.5, 0, 0), (0, 0, 0.5))
    fov = 2 * np.degrees(np.arctan(0.25))
    scene = build([(square, diffuse, specular, roughness)], [(np.concatenate(faces), 1)], [camera((0, -2, 0))], fov=fov)
    return textured(scene, [0, 1], patches(square)) if patches else scene


def pixel_points(size):
    x, z = np.meshgrid((np.arange(size) + 0.5) / size - 0.5, 0.5 - (np.arange(size) + 0.5) / size)
    return np.stack([x, 0 * x, z], axis=-1)


def test_a_textured_square_shows_its_patches_where_they_lie(backend):  # noqa: F811
    """Under light from everywhere radiance is the diffuse colour itself: two triangles, one picture, no seam."""
    scene = furnace(lambda square: patches_of(square, picture))
    view = path_traced(scene, 32, max_spp=64, seed=0, backend=backend, denoise=False)[0]
    expected = picture(pixel_points(32))
    inside = np.abs(pixel_points(32)[..., [0, 2]]).max(axis=-1) < 0.45
    # clamped look-up is up to half a texel off along a triangle's first two sides, here on the diagonal
    assert np.abs(view.albedo - expected)[inside].max() < 0.04 and np.abs(view.albedo - expected)[inside].mean() < 0.005
    blocks = [image.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (view.image, expected)]  # against the noise
    assert np.abs(blocks[0] - blocks[1]).max() < 0.04


def test_specular_and_roughness_patches_act(backend):  # noqa: F811
    """Left diffuse, right specular: the same light from everywhere, but below a small lamp only the right side mirrors it."""
    share = {"specular": lambda p: 0.9 * (p[..., 0] > 0), "roughness": lambda p: np.where(p[..., 2] > 0, 0.7, 0.1)}
    scene = furnace(lambda square: patches_of(square, lambda p: 0.8 * (p[..., :1] <= 0) * np.ones(3), **share))
    view = path_traced(scene, 16, max_spp=256, seed=0, backend=backend, denoise=False)[0]
    left, right = slice(2, 7), slice(9, 14)
    assert np.allclose(view.albedo[2:14, left], 0.8, atol=0.01) and np.allclose(view.albedo[2:14, right], 0.9, atol=0.01)
    assert np.allclose(view.image[2:14, left].mean(), 0.8, atol=0.02)
    # a rough surface loses light in its single scattering, a smooth one does not
    assert np.allclose(view.image[9:14, right].mean(), 0.9, atol=0.02)

    square = quad((0, 0, 0), (0.5, 0, 0), (0, 0, 0.5))
    lamp = np.array([[[-0.02, -2, 0], [0.02, -2, 0], [0, -2, 0.03]]])
    above = build([(square, 0.5, 0, 1)], [(lamp, 5000)], [camera((0, -1.9, 0))], fov=29.0)
    above = textured(above, [0, 1], patches_of(square, lambda p: 0.8 * (p[..., :1] <= 0) * np.ones(3), **share))
    image = path_traced(above, 16, max_spp=256, seed=0, backend=backend, denoise=False)[0].image.mean(axis=-1)
    assert image[8:10, 8:10].mean() > 5 * image[6:8, 8:10].mean() > 5 * image[6:8, 6:8].mean() * 0.2
    assert image[2:6, 10:14].mean() > 3 * image[10:14, 10:14].mean()  # far from the mirror direction only the rough one shines


def constant_patches(scene, faces):
    values = np.concatenate([scene.diffuse[faces], scene.specular[faces], scene.roughness[faces, None]], axis=1)
    return (values[..., None, None] * PATCH_KEPT).astype(np.float16)


def rounded(scene):
    """The scene with the parameters that half-floats can hold."""
    for name in ("diffuse", "specular", "roughness"):
        setattr(scene, name, getattr(scene, name).astype(np.float16).astype(np.float32))
    return scene


def test_constant_patches_change_nothing(backend):  # noqa: F811
    scene = rounded(clutter())
    faces = [0, 1, 4, 5]
    same = textured(rounded(clutter()), faces, constant_patches(scene, faces))
    runs = [hashed(path_traced(s, 16, max_spp=8, seed=2, backend=backend, denoise=False)) for s in (scene, same)]
    assert runs[0] == runs[1]


def test_the_atlas_renders_like_face_attributes(jit):  # noqa: F811
    """One far triangle that varies puts all others into the atlas: they must look as before."""
    scene, size = rounded(clutter()), 16
    speck = np.array([[[50.0, 50, 50], [50.01, 50, 50], [50, 50.01, 50]]])

    def with_speck(patches):
        base = rounded(clutter())
        parts = {name: getattr(base, name) for name in SceneRecord.DTYPES if name not in ("camera_to_world", "fov_deg")}
        for name, values in parts.items():
            more = speck if name == "triangles" else values[:1]
            setattr(base, name, np.concatenate([values, more]).astype(values.dtype))
        faces = [0, 1, 4, 5, len(base.triangles) - 1]
        mixed = np.concatenate([constant_patches(scene, faces[:4]), patches])
        return textured(base, faces, mixed)

    varied = patches_of(speck, lambda p: np.broadcast_to(FIRST[..., None], (*p.shape[:-1], 3)), FIRST * 0.5, 0.5 + FIRST / 2)
    a = path_traced(scene, size, max_spp=32, seed=2, backend=jit, denoise=False)
    b = path_traced(with_speck(varied), size, max_spp=32, seed=2, backend=jit, denoise=False)
    for one, two in zip(a, b, strict=True):
        close = np.isclose(one.image, two.image, rtol=1e-3, atol=1e-4).all(axis=-1)
        assert close.mean() > 0.97  # a rounding may end a path or turn it
        assert np.allclose(one.albedo, two.albedo, atol=1e-3)
        assert np.allclose(one.image.mean(), two.image.mean(), rtol=0.02)


def test_textured_emitters_are_black(jit):  # noqa: F811
    scene = clutter(lights=1, cameras=1)
    light = int(np.flatnonzero(scene.light_index >= 0)[0])
    lit = textured(clutter(lights=1, cameras=1), [light], patches_of(scene.triangles[[light]], picture))
    lit.diffuse, lit.specular, lit.roughness = scene.diffuse, scene.specular, scene.roughness
    runs = [hashed(path_traced(s, 16, max_spp=8, seed=2, backend=jit, denoise=False)) for s in (scene, lit)]
    assert runs[0] == runs[1]
