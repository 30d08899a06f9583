"""The whole line on a very small street, through the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.store import Store
from stages.neuras.records import CaptureInfo, frames, load_atlas, refined_poses, scaffold_mesh
from tests.neuras.processes import artifact, run_pipeline

SMALL = [
    "system=neuras", "capture.length=90", "capture.texture_size=64", "capture.training_frames=3", "capture.width=96",
    "capture.height=54", "capture.spp=1", "capture.shifts=[2.0]", "capture.shift_frames=1", "capture.columns=90",
    "capture.beams=32", "scaffold.voxel_m=0.2", "scaffold.depth=8", "scaffold.faces=4000", "scaffold.speck_faces=4",
    "scaffold.cull_rays=1", "atlas.tile_faces=1500", "fit.steps=30", "fit.sky_side=32", "fit.codes=64",
    "fit.checkpoint_every=10", "workers=2",
]  # fmt: skip

QUICK = ["evaluate.video_frames=2", "evaluate.timing_frames=1", "evaluate.timing_size=[64,36]", "evaluate.page_views=0"]


def run(store: Path, *words: str) -> str:
    return run_pipeline(*SMALL, f"store={store}", *words, timeout=900)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    store = tmp_path_factory.mktemp("neuras")
    return store, run(store, "stage=bake")


def test_from_nothing_to_a_page(line):
    store, output = line
    assert "site/index.html" in output.splitlines()[-1]
    capture = artifact(store, "capture")
    views = list(frames(capture))
    assert {view.split for view in views} == {"train", "validation", "test", "shift"} or len(views) >= 5
    assert CaptureInfo.of(capture).units == "metre"
    mesh, atlas = scaffold_mesh(artifact(store, "scaffold")), load_atlas(artifact(store, "atlas").file("atlas.npz"))
    refined = scaffold_mesh(artifact(store, "refine"))
    assert set(refined_poses(artifact(store, "refine"))) in (set(), {view.id for view in views})
    faces = artifact(store, "scaffold").manifest["summary"]["summary"]["faces"]
    surface, gone = faces["kept"] - faces["surfels"], len(mesh.faces) - len(refined.faces)
    assert len(mesh.faces) == faces["kept"] and 500 < surface <= 4100 and faces["surfels"] > 100
    assert np.array_equal(mesh.vertices[mesh.faces[:surface]], refined.vertices[refined.faces[:surface]])
    assert 0 < gone < faces["surfels"] and gone % 2 == 0 and len(atlas.faces) == len(refined.faces)  # photos see through some
    site = artifact(store, "bake").path / "files" / "site"
    assert {"index.html", "viewer.js", "scene.json", "geometry.glb", "mesh_codes.png"} <= {path.name for path in site.iterdir()}


def test_a_second_run_computes_nothing(line):
    store, _ = line
    assert run(store, "stage=bake").count("up to date") == 6


def test_the_line_ends_with_a_report_that_says_where_the_page_is(line):
    store, _ = line
    output = run(store, "stage=evaluate", *QUICK).splitlines()
    assert output[-1].endswith("report.html") and Path(output[-1].split(": ")[1]).is_file()
    overview = np.array(Image.open(Path(output[-1].split(": ")[1]).with_name("overview.png")))
    assert overview.shape[0] == 2 * 54 and not np.array_equal(overview[:54], overview[54:])  # photo above, ours below
    assert any("site/index.html" in text for text in output)
    made = artifact(store, "evaluate")
    assert {row.group for row in made.rows()} == {"test", "shift"}
    assert run(store, "stage=evaluate", *QUICK).count("up to date") == 7
    assert "equal to before" in run(store, "stage=evaluate", *QUICK, "force=evaluate", "workers=0")


def test_rows_of_a_table_are_made_where_they_are_missing_and_end_on_its_page(line, tmp_path):
    store, _ = line
    small = [word for word in SMALL if not word.startswith("fit.codes")]
    words = ["sweep", "table4", "-o", str(tmp_path), f"hydra.run.dir={tmp_path}/runs", *small, *QUICK, f"store={store}"]
    output = run_pipeline(*words, module="stages.cli", timeout=900)
    assert output.splitlines()[-1] == str(tmp_path / "report.html")
    assert "sweep: 2 jobs share capture, scaffold" in output and "artifacts of their own: fit 2, bake 2, evaluate 2" in output
    (table,), store_ = json.loads((tmp_path / "report.json").read_text()), Store(store)
    with_codes, without = table["rows"]
    assert with_codes["ours"]["psnr"]["mean"] > 10 and with_codes["published"]["stored"] == 394
    assert without["ours"]["stored"]["mean"] > with_codes["ours"]["stored"]["mean"] and without["gain"]["mean"] != 0
    for row, codes in ((with_codes, 1024), (without, 0)):
        fit = store_.by_key(store_.by_key(row["evaluate"]).manifest["preimage"]["inputs"]["fit"])
        assert fit.manifest["config"]["codes"] == codes
    again = run_pipeline(*words, module="stages.cli", timeout=900)
    assert "running" not in again and again.splitlines()[-1] == str(tmp_path / "report.html")


def test_other_steps_fit_anew_and_render_no_street(line):
    store, _ = line
    before = {fit.digest for fit in Store(store).artifacts("neuras/fit")}
    output = run(store, "stage=bake", "fit.steps=31")
    assert output.count("up to date") == 4
    after = {fit.digest for fit in Store(store).artifacts("neuras/fit")}
    assert before and len(after - before) == 1


def test_the_same_line_elsewhere_has_the_same_bytes_with_other_workers(line, tmp_path):
    store, _ = line
    run(tmp_path, "stage=bake", "workers=0")
    for stage in ("capture", "scaffold", "refine", "atlas", "fit", "bake"):
        others = {other.key: other.digest for other in Store(store).artifacts(f"neuras/{stage}")}
        again = artifact(tmp_path, stage)
        assert again.digest == others[again.key], stage
