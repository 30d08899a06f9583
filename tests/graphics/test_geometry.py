"""Remesh and decimate: closed, outward, close to what was seen from outside, on budget; the cases that broke simpler
ways."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse
from pipeline.errors import Reject
from pipeline.stage import Item
from stages.graphics.geometry import decimator, measure, remesher
from stages.graphics.geometry.load import load_mesh, normalise
from stages.graphics.geometry.records import MeshRecord
from stages.renderformer.objects.procedural import FAMILIES, box, join, moved, quads, superellipsoid
from stages.renderformer.objects.rungs import load_rungs, rung_faces
from stages.renderformer.s01_remesh import Remesh
from stages.renderformer.s02_decimate import Decimate

GRID = 48


def sphere(radius: float = 0.5, columns: int = 96) -> tuple[np.ndarray, np.ndarray]:
    latitude = np.linspace(-np.pi / 2, np.pi / 2, columns // 2 + 1)[:, None]
    longitude = np.arange(columns) / columns * 2 * np.pi
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    return quads(radius * np.stack([x, y, np.sin(latitude) + 0 * x], axis=-1), wrap_columns=True)


def remeshed(mesh: tuple[np.ndarray, np.ndarray], grid: int = GRID) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = remesher.remesh(*mesh, grid)
    assert measure.watertight(faces, len(vertices)) and measure.volume(vertices, faces) > 0
    assert measure.face_areas(vertices.astype(np.float32), faces).min() > 1e-11
    return vertices, faces


def components(mesh: tuple[np.ndarray, np.ndarray]) -> int:
    return int(measure.vertex_components(mesh[1], len(mesh[0])).max()) + 1


def test_sphere_at_64_is_within_a_tenth_of_a_voxel() -> None:
    vertices, faces = remeshed(sphere(), 64)
    voxel = 1 / (64 - 2 * remesher.MARGIN)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.5).max() < 0.1 * voxel
    assert measure.volume(vertices, faces) == pytest.approx(np.pi / 6, rel=0.01)


def test_inside_out_and_unmerged_input_comes_out_outward() -> None:
    vertices, faces = sphere()
    soup = vertices[faces[:, ::-1]].reshape(-1, 3)
    result = remeshed((soup, np.arange(len(soup)).reshape(-1, 3)))
    assert measure.volume(*result) == pytest.approx(np.pi / 6, rel=0.02)


def test_interior_and_specks_go_and_parts_stay() -> None:
    inner, speck = sphere(0.25), moved(sphere(0.004, 16), (0.49, 0.49, 0.49))
    far = moved(sphere(0.1), (0, 0, 0.9))
    assert components(remeshed(join(sphere(), inner, box((0.1, 0.2, 0.3))))) == 1
    assert components(remeshed(join(sphere(), far))) == 2
    assert components(remesher_without_specks(join(sphere(), speck))) == 1


def remesher_without_specks(mesh: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """At a share of area that makes the speck one."""
    return remesher.remesh(*mesh, GRID, min_area_share=1e-2)


def test_overlapping_parts_become_one() -> None:
    result = remeshed(join(box((1, 0.3, 0.3)), box((0.3, 1, 0.3))))
    assert components(result) == 1
    assert measure.volume(*result) == pytest.approx(2 * 0.09 - 0.027, rel=0.05)


def test_open_sheet_is_kept_and_gets_two_sides() -> None:
    sheet = FAMILIES["leaf"](np.random.default_rng(3))
    vertices = normalise(sheet[0]).astype(float)
    compared = measure.Reference(vertices, sheet[1]).compare(*remeshed((vertices, sheet[1]), 64))
    assert compared["kept"] > 0.95 and compared["distance"] < 0.01


def test_bag_with_a_narrow_opening_is_filled_and_a_cup_is_not() -> None:
    vertices, faces = sphere()
    bag = faces[(vertices[faces][:, :, 2] < 0.485).all(axis=1)]  # opening of a quarter of the radius
    assert measure.volume(*remeshed((vertices, bag))) == pytest.approx(np.pi / 6, rel=0.05)
    cup = faces[(vertices[faces][:, :, 2] < 0.05).all(axis=1)]
    assert measure.volume(*remeshed((vertices, cup))) < 0.25 * np.pi / 6


def test_voxels_seen_from_outside() -> None:
    free = np.ones((9, 9, 9), bool)
    free[2:7, 2:7, 2:7] = False
    free[3:6, 3:6, 3:6] = True  # a closed hollow
    seen = remesher.seen_from_outside(free)
    assert seen[~free].sum() == 0 and not seen[3:6, 3:6, 3:6].any()
    assert (seen == free)[[0, 1, 7, 8]].all()
    free[3:6, 3:6, 6:] = True  # the hollow gets a way out
    assert remesher.seen_from_outside(free)[4, 4, 3:].all()


def test_remesh_repeats_bit_for_bit_and_does_not_depend_on_face_order() -> None:
    vertices, faces = FAMILIES["chair"](np.random.default_rng(5))
    first, second = (remesher.remesh(vertices, faces, GRID) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    other = remesher.remesh(vertices, faces[::-1], GRID)
    np.testing.assert_allclose(other[0], first[0], atol=1e-9)


def test_tiny_detail_alone_leaves_a_mesh_or_a_reason() -> None:
    line = np.array([[0, 0, 0], [1, 0, 0], [1, 1e-7, 0]], float)
    try:
        remeshed((line, np.array([[0, 1, 2]])))
    except Reject as reject:
        assert reject.reason in Remesh.reasons


def test_watertight_means_closed_manifold_and_consistent() -> None:
    vertices, faces = box((1, 1, 1))
    assert measure.watertight(faces, len(vertices))
    assert not measure.watertight(faces[1:], len(vertices))
    assert not measure.watertight(np.concatenate([faces, faces[:1]]), len(vertices))
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert not measure.watertight(turned, len(vertices))
    assert not measure.watertight(faces[:0], 0)


def test_measures_of_known_shapes() -> None:
    cube = box((1, 1, 1))
    assert measure.measures(*cube)["area"] == pytest.approx(6) and measure.measures(*cube)["volume"] == pytest.approx(1)
    compared = measure.Reference(*cube).compare(*box((1.1, 1.1, 1.1)))
    assert compared["distance"] == pytest.approx(0.05 / np.sqrt(3), rel=0.1) and compared["inside"] == 0 == compared["flipped"]
    vertices, faces = box((1, 1, 1))
    assert measure.Reference(*cube).compare(vertices, faces[:, ::-1])["flipped"] > 0.9
    hidden = join(box((1, 1, 1)), box((0.5, 0.5, 0.5)))
    assert len(measure.Reference(*hidden).points) / 4000 == pytest.approx(6 / 7.5, abs=0.01)
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    assert measure.min_angle_deg(triangle, np.array([[0, 1, 2]]))[0] == pytest.approx(45)


def qslim(mesh: tuple[np.ndarray, np.ndarray], budget: int) -> tuple[np.ndarray, np.ndarray]:
    return decimator.collapse(*mesh, budget, "pymeshlab", 0.003)


def test_ladder_is_on_budget_watertight_and_close() -> None:
    mesh = superellipsoid(np.random.default_rng(1))
    vertices = normalise(mesh[0]).astype(float)
    gates = decimator.Gates(measure.Reference(vertices, mesh[1]), {"distance": 0.02, "flipped": 0.01, "slivers": 0.05})
    budgets = [64, 100, 301, 512]
    rungs = decimator.ladder([lambda: remesher.remesh(vertices, mesh[1], GRID)], budgets, [qslim], gates, 0.5)
    assert sorted(rungs) == budgets
    for budget, rung in rungs.items():
        assert budget - 3 <= len(rung.faces) <= budget and rung.measures["watertight"] and rung.measures["flipped"] <= 0.01
    assert rungs[512].measures["distance"] < rungs[64].measures["distance"] <= 0.02
    assert rungs[512].measures["area_spread"] < 0.7


def test_collapse_forgets_the_call_before() -> None:
    """pymeshlab keeps the parameters of a process's last call as defaults."""
    mesh = remesher.remesh(*sphere(), 32)
    first = decimator.collapse(*mesh, 300, "pymeshlab", 0.001)
    other = decimator.collapse(*mesh, 300, "pymeshlab", 0.1)
    again = decimator.collapse(*mesh, 300, "pymeshlab", 0.001)
    assert not np.array_equal(first[0], other[0])
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_first_reduction_is_watertight_or_none() -> None:
    mesh = remesher.remesh(*sphere(), GRID)
    nearer = decimator.brought_nearer(*mesh, 4000)
    assert len(nearer[1]) <= 4000 < len(mesh[1]) and measure.watertight(nearer[1], len(nearer[0]))
    open_mesh = mesh[0], mesh[1][len(mesh[1]) // 2 :]
    assert decimator.brought_nearer(*open_mesh, 4000)[1] is open_mesh[1]
    assert decimator.brought_nearer(*mesh, 10**6)[1] is mesh[1]


def test_gates_refuse_what_they_name() -> None:
    cube = box((1, 1, 1))
    reference = measure.Reference(*cube)
    assert decimator.Gates(reference, {"distance": 0.01, "crossing": 0.0, "slivers": 0.0}, {"kept": 0.99})(cube, 16)
    assert measure.crossing(*cube) == 0
    through = join(box((1, 1, 1)), moved(box((0.3, 0.3, 1.2)), (0.1, 0.05, 0)))
    needle = join(box((1, 1, 1)), moved(box((0.001, 0.001, 1)), (0.5, 0.5, 0)))
    inward = join(box((1, 1, 1)), (box((0.5, 0.5, 0.5))[0], box((0.5, 0.5, 0.5))[1][:, ::-1]))
    for mesh, most, said in (
        (through, {"crossing": 0.05}, "crossing"),
        (needle, {"slivers": 0.05}, "slivers"),
        (box((1, 1, 1.5)), {"distance": 0.01}, "distance"),
        (inward, {}, "collapsed"),
        ((cube[0], cube[1][1:]), {}, "not watertight"),
        ((cube[0], np.repeat(cube[1], 9, axis=0)), {}, "faces"),
    ):
        gates = decimator.Gates(reference, most)
        assert gates(mesh, 100) is None and said in gates.refused[100]
    small = decimator.Gates(reference, {}, least={"kept": 2.0}, least_coarse={"kept": 0.5})
    assert small(cube, 128) is not None and small(cube, 256) is None and "kept" in small.refused[256]


def test_ladder_tries_the_next_source_and_leaves_out_what_stays_bad() -> None:
    asked = []

    def gates(mesh: tuple[np.ndarray, np.ndarray], budget: int) -> decimator.Rung | None:
        asked.append(budget)
        return decimator.Rung(*mesh, {"area_spread": 1.0}) if budget == 200 or (budget == 100 and len(mesh[1]) == 16) else None

    sources = [lambda: sphere(), lambda: None, lambda: box((1, 1, 1))]
    rungs = decimator.ladder(sources, [10, 100, 200], [qslim], gates, 0.5)
    assert sorted(rungs) == [100, 200] and len(rungs[100].faces) == 16
    assert asked == [200, 100, 10, 100, 10]  # the second time only what was missing


def test_ladder_takes_the_first_even_rung_else_the_evenest() -> None:
    fine, asked = sphere(), []

    def reducer(name: str) -> object:
        def reduce(mesh: tuple[np.ndarray, np.ndarray], budget: int) -> tuple[np.ndarray, np.ndarray]:
            asked.append((budget, name, mesh[0] is fine[0]))
            return mesh if budget > 400 else box((1, 1, 1)) if name == "close" else box((1, 1, 2))

        return reduce

    def gates(mesh: tuple[np.ndarray, np.ndarray], budget: int) -> decimator.Rung | None:
        spread = {(400, 1.0): 0.4, (300, 1.0): 0.9, (300, 2.0): 0.7, (200, 1.0): 0.6, (200, 2.0): 0.8}
        return decimator.Rung(*mesh, {"area_spread": spread[budget, np.ptp(mesh[0][:, 2])]})

    rungs = decimator.ladder([lambda: fine], [200, 300, 400], [reducer("close"), reducer("even")], gates, 0.5)
    assert {b: np.ptp(rung.vertices[:, 2]) for b, rung in rungs.items()} == {400: 1, 300: 2, 200: 1}
    assert asked.pop(0) == (800, "close", True)  # the way to twice the largest budget is gone once
    assert [a[:2] for a in asked] == [(400, "close"), (300, "close"), (300, "even"), (200, "close"), (200, "even")]


@pytest.mark.parametrize("method", ["pymeshlab", "fast_simplification"])
def test_both_methods_reduce(method: str) -> None:
    mesh = remesher.remesh(*sphere(), 32)
    assert len(decimator.collapse(*mesh, 300, method, 0.003)[1]) <= 320
    assert decimator.collapse(*box((1, 1, 1)), 64, method, 0.003)[1].shape == (16, 3)


# -- the stages


class FakeArtifact:
    """Records and files by name."""

    def __init__(self, records: dict, files: Path):
        self.records, self.files, self.notes = records, files, {}

    def read(self, id: str) -> object:
        return self.records[id]

    def __contains__(self, id: str) -> bool:
        return id in self.records

    def file(self, name: str) -> Path:
        return self.files / name

    def rows(self) -> list:
        return [types.SimpleNamespace(id=id, item=id) for id in self.records]

    def note(self, name: str, value: object) -> None:
        self.notes[name] = value


def run(stage: object, config: object, inputs: dict, files: Path) -> FakeArtifact:
    files.mkdir()
    worker, records = stage.open(config, inputs, {}), {}
    for item in stage.items(config, inputs):
        records |= {record.id: record for record in stage.process(worker, item)}
    draft = FakeArtifact(records, files)
    stage.finish(config, inputs, draft)
    stage.check(draft)
    return draft


def test_stages_hand_on_the_catalogue(tmp_path: Path) -> None:
    objects, records = [], {}
    families = ("star", "mug", "blob", "table", "shell", "stairs")
    for number, (family, split) in enumerate(zip(families, ["train", "test", "validation"] * 2, strict=True)):
        vertices, faces = FAMILIES[family](np.random.default_rng(number))
        vertices, id = normalise(vertices), f"{family}-1"
        meta = {
            "object_id": id,
            "content_hash": {"train": "f", "validation": "2", "test": "0"}[split]
            + f"{number:063x}",  # where the split is its own
            "family": family,
            "source": "s",
            "origin": "o",
            "licence": "l",
        }
        records[id] = MeshRecord(id, vertices, faces.astype(np.int32), meta).to_record()
        objects.append({**meta, "faces": len(faces), "split": split})
    (tmp_path / "collect").mkdir()
    (tmp_path / "collect" / "objects.json").write_text(json.dumps(objects))
    inputs = {"collect": FakeArtifact(records, tmp_path / "collect")}
    inputs["remesh"] = run(Remesh(), parse(Remesh.Config, {"resolution": GRID}, "remesh"), inputs, tmp_path / "remesh")
    assert set(inputs["remesh"].records) == set(records)
    config = parse(Decimate.Config, {"budgets": [128, 300], "coarser": [32]}, "decimate")
    draft = run(Decimate(), config, inputs, tmp_path / "decimate")
    listed = json.loads((tmp_path / "decimate" / "objects.json").read_bytes())
    assert [o["object_id"] for o in listed] == [o["object_id"] for o in objects]
    assert [o["split"] for o in listed] == [o["split"] for o in objects]
    for o in listed:
        rungs = load_rungs(draft.read(o["object_id"]))
        assert {str(b): len(faces) for b, (_, faces) in rungs.items()} == o["rungs"] and rungs
        vertices = rungs[max(rungs)][0]
        assert vertices.dtype == np.float32 and 0.95 < np.ptp(vertices, axis=0).max() < 1.05
        meta = json.loads(draft.read(o["object_id"]).members["meta.json"])
        assert rung_faces(meta) == {int(b): n for b, n in o["rungs"].items()}
    assert (tmp_path / "decimate" / "contact_sheet.png").stat().st_size > 1000
    assert draft.notes["summary"]["rung_300"]["objects"] == 6


@pytest.mark.parametrize("name", ["scans/plane_holes.obj", "dungeon/keg.gltf.glb", "market/guitar.gltf", "odd/multibody.stl"])
def test_real_meshes_through_both_stages(name: str, shared_data: Path, tmp_path: Path) -> None:
    root = shared_data / "meshes"
    mesh = load_mesh(root / name, root, 1 << 28, 2_000_000)
    meta = {"object_id": "a", "content_hash": "0", "family": "", "source": "", "origin": "", "licence": "", "kept": 1.0}
    record = MeshRecord("a", normalise(mesh.vertices), mesh.faces.astype(np.int32), meta).to_record()
    (tmp_path / "collect").mkdir()
    inputs = {"collect": FakeArtifact({"a": record}, tmp_path / "collect")}
    remesh, decimate = Remesh(), Decimate()
    config = parse(Remesh.Config, {"resolution": 96}, "remesh")
    (fine,) = remesh.process(remesh.open(config, inputs, {}), Item("a"))
    inputs["remesh"] = FakeArtifact({"a": fine}, tmp_path / "collect")
    config = parse(Decimate.Config, {"budgets": [512, 1024], "coarser": []}, "decimate")
    (result,) = decimate.process(decimate.open(config, inputs, {}), Item("a"))
    stated = MeshRecord.from_record(fine).meta
    assert stated["watertight"] and stated["distance"] < 0.008 and stated["kept"] > 0.65
    vertices, faces = load_rungs(result)[1024]
    assert len(faces) == 1024 and measure.watertight(faces, len(vertices))
    rung = json.loads(result.members["meta.json"])["rungs"]["1024"]
    assert rung["distance"] < 0.01 and rung["flipped"] < 0.01 and rung["crossing"] < 0.05 and rung["slivers"] < 0.05


def test_gates_reject_with_a_reason(tmp_path: Path) -> None:
    vertices, faces = FAMILIES["tree"](np.random.default_rng(0))
    meta = {"object_id": "a", "content_hash": "0", "family": "", "source": "", "origin": "", "licence": "", "kept": 1.0}
    record = MeshRecord("a", normalise(vertices), faces.astype(np.int32), meta).to_record()
    inputs = {"collect": FakeArtifact({"a": record}, tmp_path), "remesh": FakeArtifact({"a": record}, tmp_path)}
    stage = Decimate()
    config = parse(Decimate.Config, {"budgets": [16], "coarser": [], "max_distance": 1e-6}, "decimate")
    with pytest.raises(Reject) as caught:
        list(stage.process(stage.open(config, inputs, {}), Item("a")))
    assert caught.value.reason in Decimate.reasons
    remesh = Remesh()
    apart = [moved(box((0.1, 0.1, 0.1)), (x, 0, 0)) for x in np.linspace(-0.45, 0.45, 4)]
    pieces = MeshRecord(
        "a", *(part.astype(kind) for part, kind in zip(join(*apart), (np.float32, np.int32), strict=True)), meta
    )
    for given, settings, reason in (
        (record, {"min_kept": 1.0}, "lost"),
        (pieces.to_record(), {"max_components": 3}, "scattered"),
    ):
        config = parse(Remesh.Config, {"resolution": 24, **settings}, "remesh")
        with pytest.raises(Reject) as caught:
            list(remesh.process(remesh.open(config, {"collect": FakeArtifact({"a": given}, tmp_path)}, {}), Item("a")))
        assert caught.value.reason == reason and reason in Remesh.reasons


def test_native_libraries_keep_to_one_thread_though_they_are_loaded_already():
    program = """
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
from stages.graphics.geometry import one_thread
one_thread()
print(max(pool["num_threads"] for pool in threadpool_info()))
"""
    many = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "2")
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=many)
    assert told.stdout.split() == ["1"], told.stderr
