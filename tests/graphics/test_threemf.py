"""3MF: what the build places, components, other models of the archive, colours; and what a reject names."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import Reject
from stages.graphics.geometry.load import Loaded, load_mesh
from stages.graphics.tonemap import srgb_decode
from tests.graphics.habits import BOX, TRIANGLES

CORE = 'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"'
PRODUCTION = 'xmlns:x="http://schemas.microsoft.com/3dmanufacturing/production/2015/06" requiredextensions="x"'
LATTICE = 'xmlns:b="http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02" requiredextensions="b"'
ROOT = "3D/3dmodel.model"


def mesh(scale: float = 1, first: str = "") -> str:
    """The box of `habits`, ``scale`` times as long; ``first``: attributes of its first triangle."""
    vertices = "".join(f'<vertex x="{x * scale}" y="{y}" z="{z}"/>' for x, y, z in BOX)
    marks = [first, *[""] * (len(TRIANGLES) - 1)]
    triangles = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}" {mark}/>' for (a, b, c), mark in zip(TRIANGLES, marks, strict=True)
    )
    return f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"


def model(resources: str, build: str = "", more: str = "") -> str:
    return f"<model {CORE} {more}><resources>{resources}</resources><build>{build}</build></model>"


def read(folder: Path, models: dict[str, str], max_faces: int = 5000) -> Loaded:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in models.items():
            archive.writestr(name, text)
    (folder / "a.3mf").write_bytes(data.getvalue())
    return load_mesh(folder / "a.3mf", folder, 1 << 24, max_faces, True)


def move(x: float, y: float, z: float, length: float = 1) -> str:
    return f'transform="{length} 0 0 0 1 0 0 0 1 {x} {y} {z}"'


@pytest.mark.parametrize(
    ("resources", "build", "faces", "sides"),
    [
        (f'<object id="1">{mesh()}</object>', '<item objectid="1"/>', 12, [2, 1, 0.5]),
        (f'<object id="1">{mesh()}</object>', f'<item objectid="1"/><item objectid="1" {move(9, 0, 0, -1)}/>', 24, [9, 1, 0.5]),
        (f'<object id="1">{mesh()}</object><object id="2">{mesh(9)}</object>', '<item objectid="1"/>', 12, [2, 1, 0.5]),
        (
            f'<object id="1">{mesh()}</object><object id="2"><components><component objectid="1" {move(0, 0, 0, 2)}/>'
            f'<component objectid="1" {move(0, 3, 0)}/></components></object>',
            f'<item objectid="2" {move(5, 5, 5, 3)}/>', 24, [12, 4, 0.5],
        ),
        (f'<object id="1">{mesh()}</object><object id="2" type="other">{mesh(9)}</object>',
         '<item objectid="1"/><item objectid="2"/>', 12, [2, 1, 0.5]),
    ],
)  # fmt: skip
def test_the_build_decides_what_there_is(tmp_path: Path, resources: str, build: str, faces: int, sides: list[float]) -> None:
    loaded = read(tmp_path, {ROOT: model(resources, build)})
    assert len(loaded.faces) == faces and np.ptp(loaded.vertices, axis=0) == pytest.approx(sides)
    assert np.linalg.det(loaded.vertices[loaded.faces]).sum() > 0  # outward, mirrored or not


def test_objects_of_other_models_keep_their_own_numbers(tmp_path: Path) -> None:
    """Both files have an object 1; the root may have another name, and the extension any prefix."""
    component = '<object id="2"><components><component x:path="/3D/Objects/o.model" objectid="1"/></components></object>'
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    models = {
        "_rels/.rels": f'<Relationships><Relationship Type="{kind}" Target="/3D/Other.model"/></Relationships>',
        "3D/Other.model": model(f'<object id="1">{mesh()}</object>{component}', '<item objectid="2"/>', PRODUCTION),
        "3D/Objects/o.model": model(f'<object id="1">{mesh(3)}</object>'),
    }
    assert np.ptp(read(tmp_path, models).vertices, axis=0) == pytest.approx([6, 1, 0.5])


def test_colours_of_objects_and_triangles(tmp_path: Path) -> None:
    base = (
        '<basematerials id="5"><base name="a" displaycolor="#FF8000FF"/><base name="b" displaycolor="#0000FF"/></basematerials>'
    )
    resources = f"""{base}<object id="1" pid="5" pindex="0">{mesh(first='pid="5" p1="1"')}</object>"""
    texture = read(tmp_path, {ROOT: model(resources, '<item objectid="1"/>')}).texture
    assert texture is not None and texture.tint[0] == pytest.approx(np.tile([0, 0, 1], (3, 1)))
    assert texture.tint[1] == pytest.approx(np.tile(srgb_decode(np.array([1, 128 / 255, 0])), (3, 1)), abs=1e-6)


@pytest.mark.parametrize(
    ("models", "reason", "words"),
    [
        ({}, "unreadable", "the archive has no model '3D/3dmodel.model'"),
        ({ROOT: "<model"}, "unreadable", "3D/3dmodel.model: line 1, column 1: this is not XML"),
        ({ROOT: model(f'<object id="1">{mesh()}</object>')}, "no_faces", "its build has no item"),
        ({ROOT: model("", '<item objectid="7"/>')}, "unreadable", "object '7' does not exist"),
        ({ROOT: model(f'<object id="1">{mesh().replace("v1=", "w1=", 1)}</object>')}, "unreadable", "0: 'v1' is missing"),
        ({ROOT: model(f'<object id="1">{mesh().replace("2.0", "two", 1)}</object>')}, "unreadable", "vertex 4: 'two' is not a"),
        ({ROOT: model(f'<object id="1">{mesh()}</object>', '<item objectid="1" transform="1 0"/>')}, "unreadable",
         "build item 0: transform of 2 numbers, expected 12"),
        ({ROOT: model(f'<object id="1">{mesh()}</object>', '<item objectid="1"/>', LATTICE)}, "unsupported", "beamlattice"),
        ({ROOT: model('<object id="1"><components><component objectid="1"/></components></object>', '<item objectid="1"/>')},
         "unreadable", "components nest over 32 deep"),
        ({ROOT: model(f'<object id="1">{mesh().replace(chr(34) + "7" + chr(34), chr(34) + "77" + chr(34))}</object>',
                      '<item objectid="1"/>')}, "bad_indices", "vertex 77 of 8"),
        ({ROOT: model(f'<object id="1">{mesh()}</object>', '<item objectid="1"/>' * 500)}, "too_large", "over 5000 faces"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, models: dict[str, str], reason: str, words: str) -> None:
    with pytest.raises(Reject) as caught:
        read(tmp_path, models)
    assert caught.value.reason == reason and words in caught.value.detail


def test_an_archive_that_grows_too_much_is_not_unpacked(tmp_path: Path) -> None:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(ROOT, " " * (1 << 25))
    (tmp_path / "a.3mf").write_bytes(data.getvalue())
    with pytest.raises(Reject, match="an archive of .* bytes that states 33,554,432"):
        load_mesh(tmp_path / "a.3mf", tmp_path, 1 << 24, 5000)
