"""The whole line, small: from made-up meshes to a report, then what a second run, a change and a sweep do."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.store import Store

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
SMALL = [
    "collect.per_family=1", "remesh.resolution=48", "decimate.budgets=[64,128]",
    "scene.count.train=8", "scene.count.validation=2", "scene.count.test=3", "scene.cameras.views=2",
    "render.resolution=32", "render.max_spp=2", "shard.shard_mb=0.2",
    "train.steps=3", "train.batch_scenes=2", "train.views_per_scene=2", "train.warmup=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("line")


def run(folder: Path, *words: str, status: int = 0) -> str:
    command = [sys.executable, "-m", "pipeline", *SMALL, f"store={folder}/store", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def first(folder) -> str:
    return run(folder, "stage=evaluate")


def test_from_nothing_to_a_report(first, folder):
    assert first.strip().splitlines()[-1].startswith("report.html: ")
    report = Path(first.strip().splitlines()[-1].partition(": ")[2])
    page = report.read_text()
    assert "<img" in page
    assert not re.search(
        r"""(src|href)\s*=\s*["']?(https?:)?//""", page.replace('xlink:href="#', "")
    )  # opens from disk, offline
    metrics = json.loads((report.parent / "metrics.json").read_text())
    assert metrics["methods"]["model"]["psnr"]["mean"] > 0
    # The renderer's estimate, in every view; and second renders
    assert set(metrics["ceiling"]) >= {"log_error", "ssim", "flip"} and 0 < metrics["ceiling"]["ssim"]["mean"] < 1
    assert json.loads((report.parent / "timing.json").read_text())["median"]["encode"] > 0


def test_second_run_computes_nothing(first, folder):
    again = run(folder, "stage=evaluate")
    assert "running" not in again
    assert again.count("up to date") == 8


def test_a_change_reruns_its_stage_and_what_follows(first, folder):
    plan = run(folder, "stage=evaluate", "plan=true", "render.max_spp=3")
    states = {line.split()[1]: line.split(None, 2)[2] for line in plan.splitlines() if line[:2].isdigit()}
    assert [name for name, state in states.items() if state.startswith("up to date")] == [
        "collect", "remesh", "decimate", "scene",
    ]  # fmt: skip
    assert [name for name, state in states.items() if state.startswith("to make")] == ["render", "shard", "train", "evaluate"]
    command = [sys.executable, "-m", "stages.cli", "why", "--store", f"{folder}/store", "render", *SMALL, "render.max_spp=3"]
    why = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "render.max_spp: 2 -> 3" in why


def test_more_scenes_render_only_the_new_ones(first, folder):
    more = run(folder, "stage=render", "scene.count.train=12")
    assert "4 of them already there" not in more
    old = Store(folder / "store").resolve("scene")
    assert f"{len(old.rows())} items" in more
    kept = int(more.split("04 render     running")[1].split(" of them")[0].split(",")[1])
    assert kept >= 11


def test_force_reports_equal_and_artifacts_verify(first, folder):
    assert "equal to before" in run(folder, "stage=render", "force=render")
    store = Store(folder / "store")
    assert not [problem for artifact in store.artifacts() for problem in artifact.verify(deep=True)]


def test_sweep_trains_variants_on_the_same_data(first, folder):
    swept = run(folder, "stage=train", "model=tiny,no_dpt", "model.latent_dim=128", "train.steps=1", "-m", *TINY)
    assert swept.count("05 shard      up to date") == 2
    trained = [a for a in Store(folder / "store").artifacts("train")]
    assert len(trained) == 3
    assert len({a.manifest["preimage"]["inputs"]["shard"] for a in trained}) == 1


def test_a_probe_with_one_more_value_computes_only_that(first, folder):
    words = ["stage=probe", "probe=fov", "probe.scenes=1", "probe.resolution=16", "probe.max_spp=2"]
    once = run(folder, *words, "probe.values=[45]")
    figure = Path(once.strip().splitlines()[-1].partition(": ")[2])
    assert figure.is_file() and json.loads((figure.parent / "probe.json").read_text())["name"] == "fov"
    assert "2 items, 1 of them already there" in run(folder, *words, "probe.values=[45,90]")


def test_the_rows_of_a_table_share_the_data_and_end_in_it(first, folder):
    words = ["sweep", "table1_small", "--rows", "full,world_space", "-o", f"{folder}/table", "jobs=2", f"store={folder}/store"]
    words += [*SMALL, "train.steps=2", *TINY, "model.latent_dim=128"]
    words += [f"hydra.run.dir={folder}/runs"]
    for again in (False, True):
        swept = subprocess.run([sys.executable, "-m", "stages.cli", *words], cwd=ROOT, capture_output=True, text=True)
        assert swept.returncode == 0, swept.stdout + swept.stderr
        assert ("running" in swept.stdout) != again
    store = Store(folder / "store")
    table = json.loads((folder / "table" / "table.json").read_text())
    evaluations = {row["name"]: store.resolve(row["evaluate"]) for row in table["rows"] if "ours" in row}
    assert list(evaluations) == ["full", "world_space"] and table["shard"] == store.resolve("shard").key
    for artifact in evaluations.values():
        assert artifact.manifest["preimage"]["inputs"]["shard"] == table["shard"]
    views = json.loads(evaluations["full"].file("metrics.json").read_text())["views"]
    assert f"{views} views" in (folder / "table" / "table.md").read_text()


TINY = [
    "model.num_heads=1", "model.dim_feedforward=512", "model.num_layers=1", "model.view_transformer_latent_dim=128",
    "model.view_transformer_n_heads=1", "model.view_transformer_ffn_hidden_dim=512", "model.view_transformer_n_layers=4",
]  # fmt: skip


def test_a_folder_of_meshes_is_a_source(shared_data, folder):
    words = ["collect=folder", f"collect.path={shared_data / 'meshes' / 'dungeon'}", "remesh.resolution=48"]
    small = [word for word in SMALL if not word.startswith("collect.per_family")]
    command = [sys.executable, "-m", "pipeline", *words, *small, f"store={folder}/store"]
    done = subprocess.run([*command, "stage=scene"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    store = Store(folder / "store")
    catalogue = json.loads(store.resolve("collect").file("objects.json").read_text())
    splits = [entry["split"] for entry in catalogue]
    assert len(catalogue) == 14 and min(splits.count(s) for s in ("train", "validation", "test")) >= 2
    used = {}
    scenes = store.resolve("scene")
    for row in scenes.rows():
        for entry in json.loads(scenes.read(row.id).members["meta.json"])["objects"]:
            if entry.get("object_id"):
                assert used.setdefault(entry["object_id"], row.group) == row.group


def test_too_few_meshes_stop_the_run_and_say_how_many(folder, tmp_path):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    words = [
        "collect=folder",
        f"collect.path={tmp_path}",
        "stage=collect",
        f"store={tmp_path}/s",
    ]
    done = subprocess.run([sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert "6" in done.stderr and len(done.stderr.splitlines()) == 1
