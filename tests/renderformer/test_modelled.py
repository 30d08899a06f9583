"""Scenes of modelling tools: what becomes of objects, materials, lights and cameras, and that all three commands draw them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.errors import UserError
from stages.cli import main
from stages.graphics.exr import read_rgb
from stages.renderformer.importing.convert import FAR, ImportSettings, converted, import_scene
from stages.renderformer.importing.described import LUMENS_PER_WATT, Described, Part, Surface
from stages.renderformer.inference.scene_files import load_scene
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes.meshes import areas
from stages.renderformer.scenes.released import load_scene as load_released
from tests.renderformer.modelled import WATT, Gltf, looking, studio


@pytest.fixture(scope="module")
def glb(tmp_path_factory) -> Path:
    return studio().write(tmp_path_factory.mktemp("studio") / "studio.glb")


@pytest.fixture(scope="module")
def scene(glb) -> SceneRecord:
    return import_scene(glb, ImportSettings(2000))


def of(scene: SceneRecord, name: str) -> np.ndarray:
    """Rows of the triangles of an object."""
    return np.flatnonzero(scene.object_index == [entry["name"] for entry in scene.meta["objects"]].index(name))


def imported(gltf: Gltf, tmp_path: Path, settings: ImportSettings | None = None) -> SceneRecord:
    path = gltf.write(tmp_path / "made.glb")
    return import_scene(path, settings)


def boxed(**material) -> Gltf:
    """A box of one material, a camera and a light."""
    gltf = Gltf()
    number = gltf.material("Only", **material)
    gltf.node("Box", mesh=gltf.mesh("Box", trimesh.creation.box((1, 1, 1)), number))
    gltf.light("Lamp", "point", WATT, translation=[0, 3, 0])
    gltf.camera("Camera", 0.8, 1.0, **looking([0, 0, 4], [0, 0, 0]))
    return gltf


def test_nodes_place_their_objects(scene):
    """The floor of 6 m is one unit; the cube of 1.2 m stands on it, turned, 1 m to the left and 0.3 m to the front."""
    floor, cube = (scene.triangles[of(scene, name)].reshape(-1, 3) for name in ("Floor", "Cube"))
    assert np.ptp(floor, axis=0) == pytest.approx([1, 1, 0], abs=1e-6)
    assert cube[:, 2].min() == pytest.approx(floor[0, 2], abs=1e-6) and np.ptp(cube[:, 2]) == pytest.approx(0.2, abs=1e-6)
    middle = (cube.min(axis=0) + cube.max(axis=0)) / 2
    assert middle[:2] == pytest.approx([-1 / 6, -0.3 / 6], abs=1e-6)  # glTF's z points to the viewer: here -y
    turned = 0.2 * (np.cos(np.pi / 6) + np.sin(np.pi / 6))
    assert np.ptp(cube, axis=0)[:2] == pytest.approx([turned, turned], abs=1e-6)


def test_materials_become_diffuse_and_specular(scene):
    cube, ball, floor = (of(scene, name) for name in ("Cube", "Ball", "Floor"))
    assert scene.diffuse[cube] == pytest.approx(np.tile([0.8 * 0.96, 0.05 * 0.96, 0.03 * 0.96], (len(cube), 1)), abs=1e-5)
    assert scene.specular[cube] == pytest.approx(0.04, abs=1e-6) and scene.roughness[cube] == pytest.approx(0.5)
    assert scene.diffuse[ball] == pytest.approx(0, abs=1e-6)
    assert scene.specular[ball] == pytest.approx(np.tile([0.9, 0.8, 0.5], (len(ball), 1)), abs=1e-5)
    light = ((np.array([200, 190, 170]) / 255 + 0.055) / 1.055) ** 2.4
    dark = ((np.array([90, 100, 120]) / 255 + 0.055) / 1.055) ** 2.4
    tiles = scene.diffuse[floor] / 0.96
    assert len(floor) == 128  # 8 tiles a side: two triangles each, all of one colour but for the texture's blur
    assert np.minimum(abs(tiles - light).max(axis=1), abs(tiles - dark).max(axis=1)).max() < 0.12
    assert tiles.mean(axis=0) == pytest.approx((light + dark) / 2, abs=0.01)


def test_a_point_light_keeps_its_power(scene):
    """500 W in a scene that shrinks to a sixth: power goes with the square, so that radiance stays."""
    (row,) = of(scene, "Lamp")
    power = 2 * np.pi * areas(scene.triangles[[row]])[0] * scene.emission[row]
    assert power == pytest.approx(np.full(3, 500 / 36), rel=1e-5)
    assert scene.triangles[row].mean(axis=0)[:2] == pytest.approx([2 / 6, -2 / 6], abs=1e-6)
    assert any("'Lamp' (point, 500 W)" in note for note in scene.meta["notes"])


def test_a_spot_light_keeps_its_power_and_axis(scene):
    (row,) = of(scene, "Spot")
    inner, outer = np.cos(0.3), np.cos(0.5)
    cosines = np.linspace(outer, 1, 100_001)
    falloff = np.clip((cosines - outer) / (inner - outer), 0, 1) ** 2  # as the extension's specification recommends
    watts = 400 / (4 * np.pi) * 2 * np.pi * np.trapezoid(falloff, cosines)
    power = 2 * np.pi * areas(scene.triangles[[row]])[0] * scene.emission[row, 0]
    assert power == pytest.approx(watts / 36, rel=1e-3)
    a, b, c = scene.triangles[row].astype(float)
    normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    axis = np.array([2, 1.7, -3.4])  # (2, -3.4, -1.7) with z up
    assert normal == pytest.approx(axis / np.linalg.norm(axis), abs=1e-4)
    assert any("'Spot'" in note and "no cone" in note for note in scene.meta["notes"])


def test_a_directional_light_lights_the_middle_as_strongly(tmp_path):
    gltf = boxed()
    gltf.light("Sun", "directional", 3 * LUMENS_PER_WATT, **looking([0, 5, 5], [0, 0, 0]))
    scene = imported(gltf, tmp_path)
    (row,) = of(scene, "Sun")
    centre = scene.triangles[row].mean(axis=0)
    assert centre == pytest.approx([0, -FAR / np.sqrt(2), FAR / np.sqrt(2)], abs=1e-5)
    area = areas(scene.triangles[[row]])[0]
    assert scene.emission[row] * area / FAR**2 == pytest.approx(np.full(3, 3), rel=1e-5)


def test_emission_and_its_strength(tmp_path):
    strength = {"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 40}}}
    scene = imported(boxed(emissiveFactor=[1, 0.5, 0], **strength), tmp_path)
    rows = of(scene, "Box")
    assert scene.emission[rows] == pytest.approx(np.tile([40, 20, 0], (len(rows), 1)))
    assert (scene.light_index[rows] == scene.light_index[rows[0]]).all() and scene.n_lights == 2


def test_cameras_keep_place_lens_and_aspect(scene):
    assert scene.fov_deg == pytest.approx([np.degrees(0.6)])
    assert scene.meta["aspect"] == pytest.approx([16 / 9])
    assert scene.picture_size(0, 512) == (288, 512) and scene.picture_size(0, 100, 8) == (56, 100)
    position = scene.camera_to_world[0, :3, 3]
    cube_floor = scene.triangles[of(scene, "Floor")][..., 2].min()
    assert position[:2] == pytest.approx([3 / 6, -7 / 6], abs=1e-6) and position[2] - cube_floor == pytest.approx(3.2 / 6)
    ahead = -scene.camera_to_world[0, :3, 2]
    assert ahead == pytest.approx(np.array([-3, 7, -2.6]) / np.linalg.norm([-3, 7, -2.6]), abs=1e-5)


def test_an_orbit_keeps_the_aspect(scene):
    from stages.renderformer.inference.orbit import orbit

    assert [orbit(scene, 5).picture_size(view, 64) for view in range(5)] == [(36, 64)] * 5


def test_an_orthographic_camera_sees_the_middle_as_large(tmp_path):
    gltf = boxed()
    gltf.tree["cameras"][0] = {"type": "orthographic", "orthographic": {"xmag": 2, "ymag": 1, "znear": 0, "zfar": 9}}
    scene = imported(gltf, tmp_path)
    distance = np.linalg.norm(scene.camera_to_world[0, :3, 3])
    assert 2 * distance * np.tan(np.radians(scene.fov_deg[0]) / 2) == pytest.approx(2, rel=1e-5)
    assert scene.meta["aspect"] == [2.0] and any("orthographic" in note for note in scene.meta["notes"])


def test_too_many_triangles_are_decimated_and_large_ones_subdivided(glb):
    scene = import_scene(glb, ImportSettings(600))
    assert len(scene.triangles) <= 600 and len(of(scene, "Floor")) == 128 and len(of(scene, "Ball")) <= 422
    assert scene.specular[of(scene, "Ball")] == pytest.approx(np.tile([0.9, 0.8, 0.5], (len(of(scene, "Ball")), 1)), abs=1e-5)
    radius = np.linalg.norm(scene.triangles[of(scene, "Ball")] - [1 / 6, 0, 0.7 / 6 + scene.triangles[..., 2].min()], axis=-1)
    assert radius == pytest.approx(0.7 / 6, rel=0.06)
    assert sum("decimated to" in note or "subdivided" in note for note in scene.meta["notes"]) == 3


def test_a_texture_follows_a_decimated_object(tmp_path):
    """A finely divided plane, half red and half green by its corner colours, in 200 triangles."""
    steps = np.linspace(0, 1, 41)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    points = np.stack([x, y, 0.05 * np.sin(9 * x) * np.sin(9 * y)], axis=-1)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).reshape(-1, 1)
    faces = np.concatenate([np.hstack([corner, corner + 41, corner + 42]), np.hstack([corner, corner + 42, corner + 1])])
    corners = points.reshape(-1, 3)[faces]
    tint = np.where(corners[..., :1] < 0.5, [1.0, 0, 0], [0, 1.0, 0])
    part = Part("Sheet", corners, Surface(metallic=0.0), tint=tint)
    scene = converted(tmp_path / "sheet.glb", Described([part], [], [], "z"), ImportSettings(203))
    rows = of(scene, "Sheet")
    assert 100 < len(rows) <= 200
    x = scene.triangles[rows][..., 0]  # scene units: the border is at 0
    left, right = (x < -0.05).all(axis=1), (x > 0.05).all(axis=1)
    assert left.sum() > 30 and right.sum() > 30
    assert scene.diffuse[rows][left] == pytest.approx(np.tile([0.96, 0, 0], (left.sum(), 1)), abs=1e-3)
    assert scene.diffuse[rows][right] == pytest.approx(np.tile([0, 0.96, 0], (right.sum(), 1)), abs=1e-3)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"alphaMode": "BLEND"}, "see-through"),
        ({"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}}, "lets light through"),
        ({"pbrMetallicRoughness": {"baseColorFactor": [3, 1, 1, 1]}}, "baseColorFactor: colours reach 3"),
    ],
)
def test_what_the_model_cannot_express_is_said(tmp_path, fields, words):
    assert any("'Only'" in note and words in note for note in imported(boxed(**fields), tmp_path).meta["notes"])


def test_specular_reflectance_of_the_extensions(tmp_path):
    glass = {"KHR_materials_ior": {"ior": 2.0}, "KHR_materials_specular": {"specularFactor": 0.5}}
    scene = imported(boxed(pbrMetallicRoughness={"metallicFactor": 0}, extensions=glass), tmp_path)
    assert scene.specular[0] == pytest.approx(np.full(3, 0.5 / 9), rel=1e-5)


def test_a_light_or_camera_that_is_nothing_is_left_out(tmp_path):
    gltf = boxed()
    gltf.tree["extensions"]["KHR_lights_punctual"]["lights"][0] |= {"type": "spot", "spot": {"outerConeAngle": 0.0}}
    next(node for node in gltf.tree["nodes"] if node["name"] == "Camera")["scale"] = [0, 0, 0]
    scene = imported(gltf, tmp_path)
    assert scene.emission.max() > 0 and np.linalg.det(scene.camera_to_world[0, :3, :3]) == pytest.approx(1)
    for words in ("'Lamp' has no strength", "'Camera' is scaled to nothing", "no light in the file", "no camera in the file"):
        assert any(words in note for note in scene.meta["notes"])


def test_a_scene_without_light_or_camera_gets_them(tmp_path):
    gltf = Gltf()
    gltf.node("Box", mesh=gltf.mesh("Box", trimesh.creation.box((1, 1, 1)), gltf.material("Plain")))
    scene = imported(gltf, tmp_path)
    assert scene.n_lights == 3 and len(scene.fov_deg) == 1
    assert sum(note.startswith(("no light", "no camera")) for note in scene.meta["notes"]) == 2


@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_an_imported_scene_is_read_again_as_it_was(glb, tmp_path, suffix, capsys):
    out = tmp_path / f"studio{suffix}"
    assert main(["import", str(glb), "-o", str(out), "--triangles", "2000"]) == 0
    assert "note: light 'Lamp' (point, 500 W)" in capsys.readouterr().out
    before, after = import_scene(glb, ImportSettings(2000)), load_released(out)

    def sums(scene: SceneRecord) -> np.ndarray:
        area = areas(scene.triangles)[:, None]
        values = [scene.diffuse, scene.specular, scene.roughness[:, None], scene.emission, scene.triangles.mean(axis=1)]
        return np.concatenate([(area * value).sum(axis=0) for value in values])

    assert len(after.triangles) == len(before.triangles) and after.n_lights == 2
    assert sums(after) == pytest.approx(sums(before), rel=2e-3, abs=1e-4)
    assert after.camera_to_world == pytest.approx(before.camera_to_world, abs=1e-6)
    assert after.fov_deg == pytest.approx(before.fov_deg) and after.meta["aspect"] == pytest.approx(before.meta["aspect"])


def test_all_three_commands_draw_it(glb, tmp_path, capsys):
    """The path traced picture has the red cube left of the middle, and is as wide as the camera says."""
    small = ["--resolution", "64"]
    assert main(["trace", str(glb), "-o", str(tmp_path / "out.exr"), "--spp", "16", *small]) == 0
    assert main(["predict", str(glb), "-o", str(tmp_path / "out.png"), *small, "--device", "cpu"]) == 0
    assert main(["compare", str(glb), "-o", str(tmp_path / "both.png"), "--spp", "4", *small, "--json", "--device", "cpu"]) == 0
    assert "note: light 'Spot'" in capsys.readouterr().err
    image = read_rgb(tmp_path / "out.exr")
    assert image.shape == (36, 64, 3)
    red = image[..., 0] > 4 * image[..., 2] + 0.02
    rows, columns = np.nonzero(red)
    assert 15 < len(rows) < 200 and columns.mean() < 32 and (tmp_path / "out.png").is_file()


def test_square_and_wide_pictures_show_the_same(glb):
    """A wide picture is a square one with the same field of view across the height, and more at its sides."""
    from stages.graphics.mitsuba.backend import choose
    from stages.renderformer.rendering.render import render_views
    from stages.renderformer.rendering.settings import RenderSettings

    scene = load_scene(glb)
    for backend in ("scalar", "auto"):
        square, wide = (
            render_views(scene, RenderSettings(size, 16, denoise=False), choose(backend))[0] for size in (24, (24, 40))
        )
        assert wide.image.shape == (24, 40, 3)
        assert np.isclose(wide.depth[:, 8:32], square.depth, rtol=0.05).mean() > 0.95  # edges are where the samples fall
        assert (wide.depth[:, :8] > 0).any() and (wide.depth[:, 32:] > 0).any()


def test_a_mesh_stays_a_mesh_where_the_room_is_chosen(glb):
    from stages.renderformer.inference.room import Room

    assert load_scene(glb).meta["law"] == "imported"
    assert load_scene(glb, Room("floor", None, 900)).meta["law"] == "room"


def test_bad_files_and_arguments_are_said(tmp_path, glb, capsys):
    broken = tmp_path / "broken.glb"
    tree = studio()
    tree.tree["accessors"][0]["count"] = 10**6
    tree.write(broken)
    for words, said in (
        (["import", str(glb)], "give -o OUT"),
        (["import", str(glb), "-o", str(tmp_path / "out.obj")], "must end in"),
        (["import", str(broken), "-o", str(tmp_path / "out.h5")], "accessor 0"),
        (["import", str(tmp_path / "none.glb"), "-o", str(tmp_path / "out.h5")], "is not a file"),
        (["import", str(glb), "-o", str(tmp_path / "out.h5"), "scene.split=test"], "unknown arguments"),
    ):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_node_cycles_and_missing_parts_are_refused(tmp_path):
    gltf = boxed()
    gltf.tree["nodes"][0]["children"] = [0]
    path = gltf.write(tmp_path / "cycle.glb")
    with pytest.raises(UserError, match="cycle"):
        import_scene(path)
    gltf = boxed()
    gltf.tree["nodes"][0]["mesh"] = 7
    with pytest.raises(UserError, match="cycle.glb"):
        import_scene(gltf.write(path))
