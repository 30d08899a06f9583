"""Formats that optional packages read, and those that have to be exported otherwise: what comes in, and what is said."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.errors import Reject, UserError
from stages.cli import main
from stages.graphics.geometry import load
from stages.renderformer.importing.convert import ImportSettings, import_scene
from stages.renderformer.inference.scene_files import load_scene
from stages.renderformer.scenes.meshes import areas

BOX = (1.0, 0.6, 0.4)
LIMITS = (1 << 24, 100_000)


def read(path: Path, **options) -> load.Loaded:
    return load.load_mesh(path, path.parent, *LIMITS, **options)


@pytest.fixture
def pxr():
    return pytest.importorskip("pxr", reason="usd-core is not installed (pip install usd-core)")


def usd_box(path: Path, up: str = "Z", **xform) -> Path:
    """A stage with a box of 1 x 0.6 x 0.4 of quads, doubled by its transform, in red."""
    from pxr import Gf, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    above = UsdGeom.Xform.Define(stage, "/root/Box")
    above.AddTranslateOp().Set((5, 0, 0))
    above.AddScaleOp().Set((2, 2, 2))
    mesh = UsdGeom.Mesh.Define(stage, "/root/Box/Mesh")
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * BOX
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, corner)) for corner in corners])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    quads = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
    mesh.CreateFaceVertexIndicesAttr(quads)
    mesh.CreateSubdivisionSchemeAttr("none")
    material = UsdShade.Material.Define(stage, "/root/Red")
    shader = UsdShade.Shader.Define(stage, "/root/Red/Shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", _types().Color3f).Set((0.7, 0.1, 0.05))
    shader.CreateInput("roughness", _types().Float).Set(0.3)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    return path


def _types():
    from pxr import Sdf

    return Sdf.ValueTypeNames


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd"])
def test_a_usd_mesh_is_read_with_its_transform_and_axis(pxr, tmp_path, suffix):
    mesh = read(usd_box(tmp_path / f"box{suffix}"))
    assert len(mesh.faces) == 12
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([2, 0.8, 1.2], abs=1e-6)  # turned: y is up
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(2 * 0.8 * 1.2, rel=1e-5)
    assert np.ptp(read(usd_box(tmp_path / f"up{suffix}", "Y")).vertices, axis=0) == pytest.approx([2, 1.2, 0.8], abs=1e-6)


def test_usd_layers_outside_the_folder_are_not_opened(pxr, tmp_path):
    (tmp_path / "in").mkdir()
    usd_box(tmp_path / "outside.usda")
    usd_box(tmp_path / "in" / "beside.usda")
    for name, reason in (("../outside.usda", "unsafe_path"), ("missing.usda", "unreadable"), ("beside.usda", None)):
        path = tmp_path / "in" / "top.usda"
        path.write_text(f"#usda 1.0\n(subLayers = [@{name}@])\n")
        if reason is None:
            assert len(read(path).faces) == 12
        else:
            with pytest.raises(Reject) as error:
                read(path)
            assert error.value.reason == reason
    (tmp_path / "in" / "text.usda").write_text("not a stage")
    with pytest.raises(Reject, match="unreadable"):
        read(tmp_path / "in" / "text.usda")


def test_a_usd_scene_with_lights_and_a_camera(pxr, tmp_path):
    from pxr import Usd, UsdGeom, UsdLux

    path = usd_box(tmp_path / "scene.usda")
    stage = Usd.Stage.Open(str(path))
    camera = UsdGeom.Camera.Define(stage, "/root/Camera")
    camera.AddTranslateOp().Set((6, -6, 1))
    camera.AddRotateXOp().Set(90.0)
    camera.CreateFocalLengthAttr(50.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(20.25)
    sphere = UsdLux.SphereLight.Define(stage, "/root/Lamp")
    sphere.AddTranslateOp().Set((6, 0, 4))
    sphere.CreateRadiusAttr(0.1)
    sphere.CreateIntensityAttr(500.0)
    panel = UsdLux.RectLight.Define(stage, "/root/Panel")
    panel.AddTranslateOp().Set((6, 0, 3))
    panel.CreateWidthAttr(1.0)
    panel.CreateHeightAttr(0.5)
    panel.CreateIntensityAttr(20.0)
    UsdLux.DomeLight.Define(stage, "/root/Sky")
    stage.GetRootLayer().Save()
    scene = load_scene(path)
    assert scene.meta["law"] == "imported" and scene.n_lights == 2
    assert scene.fov_deg == pytest.approx([np.degrees(2 * np.arctan(20.25 / 100))]) and scene.meta["aspect"] == [36 / 20.25]
    assert scene.diffuse[0] == pytest.approx([0.7 * 0.96, 0.1 * 0.96, 0.05 * 0.96], abs=1e-5)
    names = [entry["name"] for entry in scene.meta["objects"]]
    lamp = np.flatnonzero(scene.object_index == names.index("Lamp"))
    power = 2 * np.pi * areas(scene.triangles[lamp]) * scene.emission[lamp, 0]
    assert power == pytest.approx([4 * np.pi**2 * 0.1**2 * 500 / 4], rel=1e-4)  # the box of 2 is one scene unit
    rows = np.flatnonzero(scene.object_index == names.index("Panel"))
    assert scene.emission[rows] == pytest.approx(20) and areas(scene.triangles[rows]).sum() == pytest.approx(0.5 / 4)
    assert any("'Sky' is a sky" in note for note in scene.meta["notes"])
    ahead = -scene.camera_to_world[0, :3, 2]
    assert ahead == pytest.approx([0, 1, 0], abs=1e-6)
    out = tmp_path / "scene.h5"
    assert main(["import", str(path), "-o", str(out)]) == 0 and load_scene(out).n_lights >= 2


DAE = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g" name="g"><mesh>
<source id="p"><float_array id="pa" count="24">{points}</float_array><technique_common>
<accessor source="#pa" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><scale>2 2 2</scale><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def test_collada_is_read_with_its_transforms(tmp_path):
    pytest.importorskip("collada", reason="pycollada is not installed")
    box = trimesh.creation.box(BOX)
    points, faces = (" ".join(map(str, values.ravel())) for values in (box.vertices, box.faces))
    (tmp_path / "box.dae").write_text(DAE.format(points=points, faces=faces))
    assert np.ptp(read(tmp_path / "box.dae").vertices, axis=0) == pytest.approx([2, 1.2, 0.8])


def test_3mf_is_read(tmp_path):
    pytest.importorskip("lxml", reason="lxml is not installed")
    (tmp_path / "box.3mf").write_bytes(trimesh.Scene([trimesh.creation.box(BOX)]).export(file_type="3mf"))
    assert np.ptp(read(tmp_path / "box.3mf").vertices, axis=0) == pytest.approx(BOX)


@pytest.mark.parametrize(("suffix", "package"), [(".usdc", "usd-core"), (".3mf", "lxml"), (".dae", "pycollada")])
def test_a_missing_package_is_named(tmp_path, monkeypatch, suffix, package):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    (tmp_path / f"box{suffix}").write_bytes(b"anything")
    with pytest.raises(UserError, match=f"pip install {package}"):
        load_scene(tmp_path / f"box{suffix}")


@pytest.mark.parametrize("name", ["chair.fbx", "chair.blend"])
def test_what_is_not_read_names_the_export_to_choose(tmp_path, name, capsys):
    path = tmp_path / name
    path.write_bytes(b"anything")
    for words in (["trace", str(path), "-o", str(tmp_path / "x.exr")], ["import", str(path), "-o", str(tmp_path / "x.h5")]):
        assert main(words) == 2
        error = capsys.readouterr().err
        assert "export" in error.lower() and ".glb" in error and error.count("\n") == 1
    from stages.renderformer.s00_collect import FolderConfig, mesh_files

    with pytest.raises(UserError, match="glTF"):
        mesh_files(FolderConfig(path=str(tmp_path)))
    with pytest.raises(UserError, match="glTF"):
        import_scene(path, ImportSettings())
