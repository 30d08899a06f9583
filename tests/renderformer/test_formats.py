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


@pytest.mark.parametrize(
    ("change", "sides", "area"),
    [
        (("Y_UP", "Z_UP"), [2, 0.8, 1.2], 2 * (2 * 0.8 + 2 * 1.2 + 0.8 * 1.2)),  # turned: y is up
        (("<scale>2 2 2</scale>", "<scale>-2 2 2</scale>"), [2, 1.2, 0.8], 2 * (2 * 0.8 + 2 * 1.2 + 0.8 * 1.2)),
        (('<triangles count="12">', '<polylist count="3">', "</p></triangles>", "</p></polylist>", "</vertices>", "</vertices>",
          'offset="0"/><p>{faces}', 'offset="0"/><vcount>3 3 3</vcount><p>0 1 2 3 4 5 6 7 0'), None, None),
    ],
)  # fmt: skip
def test_collada_axes_mirrors_and_polygons(tmp_path, change, sides, area):
    pytest.importorskip("collada", reason="pycollada is not installed")
    box, text = trimesh.creation.box(BOX), DAE
    for old, new in zip(change[::2], change[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    points, faces = (" ".join(map(str, values.ravel())) for values in (box.vertices, box.faces))
    (tmp_path / "box.dae").write_text(text.format(points=points, faces=faces))
    mesh = read(tmp_path / "box.dae")
    if sides is None:
        assert len(mesh.faces) == 3
        return
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(sides)
    found = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert found.area == pytest.approx(area) and found.volume > 0


def test_what_a_collada_skin_moves_is_drawn_at_rest_and_said(tmp_path):
    pytest.importorskip("collada", reason="pycollada is not installed")
    box = trimesh.creation.box(BOX)
    points, faces = (" ".join(map(str, values.ravel())) for values in (box.vertices, box.faces))
    array = '<source id="{0}"><{1} id="{0}a" count="{2}">{3}</{1}><technique_common><accessor source="#{0}a" count="1" {4}>'
    array += '<param name="{5}" type="{6}"/></accessor></technique_common></source>'
    unit = " ".join(map(str, np.eye(4).ravel()))
    skin = f"""<library_controllers><controller id="c"><skin source="#g"><bind_shape_matrix>{unit.replace("1.0", "3.0", 1)}
</bind_shape_matrix>{array.format("j", "Name_array", 1, "J", "", "JOINT", "Name")}
{array.format("b", "float_array", 16, unit, 'stride="16"', "TRANSFORM", "float4x4")}
{array.format("w", "float_array", 1, "1", "", "WEIGHT", "float")}
<joints><input semantic="JOINT" source="#j"/><input semantic="INV_BIND_MATRIX" source="#b"/></joints>
<vertex_weights count="8"><input semantic="JOINT" source="#j" offset="0"/><input semantic="WEIGHT" source="#w" offset="1"/>
<vcount>{"1 " * 8}</vcount><v>{"0 0 " * 8}</v></vertex_weights></skin></controller></library_controllers>"""
    text = DAE.replace("<library_visual_scenes>", skin.replace("{", "{{").replace("}", "}}") + "<library_visual_scenes>")
    text = text.replace('<instance_geometry url="#g"/>', '<instance_controller url="#c"/>')
    (tmp_path / "box.dae").write_text(text.format(points=points, faces=faces))
    mesh = read(tmp_path / "box.dae", textures=True)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([3, 0.6, 0.4])
    assert any("moved by a skeleton" in note for note in mesh.notes)


def usd_mesh(stage, path: str, points, counts, index):
    from pxr import Gf, UsdGeom

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, point)) for point in points])
    mesh.CreateFaceVertexCountsAttr(counts)
    mesh.CreateFaceVertexIndicesAttr(index)
    return mesh


def usd_stage(path: Path):
    from pxr import Usd

    return Usd.Stage.CreateNew(str(path))


def saved(stage, **options) -> load.Loaded:
    stage.GetRootLayer().Save()
    return read(Path(stage.GetRootLayer().realPath), **options)


def test_usd_instancers_place_their_copies(pxr, tmp_path):
    from pxr import Gf, UsdGeom

    stage = usd_stage(tmp_path / "many.usda")
    instancer = UsdGeom.PointInstancer.Define(stage, "/many")
    instancer.AddScaleOp().Set((1, 1, 3))
    inner = UsdGeom.Xform.Define(stage, "/many/proto")
    inner.AddTranslateOp().Set((0, 0, 1))
    usd_mesh(stage, "/many/proto/square", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [4], [0, 1, 2, 3])
    instancer.CreatePrototypesRel().AddTarget("/many/proto")
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(5, 0, 0), Gf.Vec3f(0, 7, 0)])
    instancer.CreateScalesAttr([Gf.Vec3f(1, 1, 1), Gf.Vec3f(2, 1, 1), Gf.Vec3f(1, 1, 2)])
    mesh = saved(stage)
    assert len(mesh.faces) == 6  # the prototype itself is not drawn
    assert mesh.vertices.min(axis=0) == pytest.approx([0, 0, 3]) and mesh.vertices.max(axis=0) == pytest.approx([7, 8, 6])
    instancer.CreateInvisibleIdsAttr([1])
    assert len(saved(stage).faces) == 4
    instancer.CreateProtoIndicesAttr([0, 0, 1])
    with pytest.raises(Reject, match="/many: prototype 1 of 1"):
        saved(stage)


@pytest.mark.parametrize(
    ("kind", "fields", "sides", "volume"),
    [
        ("Cube", {"size": 2.0}, [2, 2, 2], 8),
        ("Sphere", {"radius": 0.5}, [1, 1, 1], np.pi / 6),
        ("Cylinder", {"radius": 1.0, "height": 3.0, "axis": "X"}, [3, 2, 2], 3 * np.pi),
        ("Cone", {"radius": 1.0, "height": 3.0, "axis": "Y"}, [2, 3, 2], np.pi),
        ("Capsule", {"radius": 1.0, "height": 3.0}, [2, 2, 5], 3 * np.pi + 4 / 3 * np.pi),
        ("Plane", {"width": 3.0, "length": 1.0, "axis": "X"}, [0, 1, 3], 0),
    ],
)
def test_usd_shapes_by_formula(pxr, tmp_path, kind, fields, sides, volume):
    from pxr import UsdGeom

    stage = usd_stage(tmp_path / "shape.usda")
    prim = getattr(UsdGeom, kind).Define(stage, "/shape").GetPrim()
    for name, value in fields.items():
        prim.GetAttribute(name).Set(value)
    mesh = saved(stage, textures=True)
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(sides, rel=0.01) and middle == pytest.approx([0, 0, 0], abs=1e-6)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(volume, rel=0.02, abs=1e-9)
    assert mesh.notes == [f"/shape: a {kind.lower()}, as {len(mesh.faces):,} triangles"]


def test_usd_polygons_with_inward_corners_and_holes(pxr, tmp_path):
    stage = usd_stage(tmp_path / "flat.usda")
    points = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (2, 1, 0), (0, 4, 0), (9, 0, 0), (9, 1, 0), (8, 0, 0)]
    mesh = usd_mesh(stage, "/m", points, [5, 3], [0, 1, 2, 3, 4, 5, 6, 7])
    mesh.CreateHoleIndicesAttr([1])
    found = saved(stage)
    assert trimesh.Trimesh(found.vertices, found.faces).area == pytest.approx(10) and len(found.faces) == 3


def test_what_of_a_usd_is_not_drawn_is_said(pxr, tmp_path):
    from pxr import UsdGeom, UsdShade

    stage = opened(usd_box(tmp_path / "more.usda"))
    UsdGeom.BasisCurves.Define(stage, "/hair")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/root/Box/Mesh"))
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("skel:jointIndices", _types().IntArray).Set([0] * 8)
    material = UsdShade.Material.Define(stage, "/root/Other")
    shader = UsdShade.Shader.Define(stage, "/root/Other/Shader")
    shader.CreateIdAttr("ND_standard_surface_surfaceshader")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    notes = saved(stage, textures=True).notes
    for words in ("/hair: BasisCurves is left out", "is moved by a skeleton", "'Other': it has no UsdPreviewSurface"):
        assert any(words in note for note in notes), notes


def opened(path: Path):
    from pxr import Usd

    return Usd.Stage.Open(str(path))


@pytest.mark.parametrize(("suffix", "package"), [(".usdc", "usd-core"), (".dae", "pycollada")])
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
