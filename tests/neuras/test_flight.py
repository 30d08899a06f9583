"""The drone preset through the whole line, on very small blocks of houses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stages.graphics.arrays import unpack_json
from stages.neuras.records import CaptureInfo, frames, scaffold_mesh
from tests.neuras.processes import artifact, run_pipeline

pytestmark = pytest.mark.slow
SMALL = [
    "system=neuras", "stage=evaluate", "capture.preset=drone", "capture.length=100", "capture.texture_size=64",
    "capture.training_frames=6", "capture.width=96", "capture.height=72", "capture.spp=2", "capture.columns=240",
    "capture.beams=48", "scaffold.voxel_m=0.4", "scaffold.depth=8", "scaffold.faces=6000", "scaffold.speck_faces=4",
    "scaffold.cull_rays=1", "fit.steps=150", "fit.sky_side=32", "fit.codes=128", "evaluate.video_frames=0",
    "evaluate.timing_frames=0", "evaluate.page_views=0", "workers=2",
]  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    run_pipeline(*SMALL, f"store={folder}")
    return folder


def test_cameras_look_down_from_above_and_a_random_half_is_held_out(store):
    capture = artifact(store, "capture")
    views = list(frames(capture))
    back = np.array([view.camera.camera_to_world[2, 2] for view in views])
    assert len(views) == 12 and (back > 0.999).sum() == 6 and back.min() > 0.6  # half straight down, half at a slant
    assert min(view.camera.position[2] for view in views) > 40
    held_out = [view.split != "train" for view in views]
    assert sum(held_out) == 6 and {view.split for view in views} == {"train", "validation", "test"}
    assert held_out not in ([n % 2 == 0 for n in range(12)], [n % 2 == 1 for n in range(12)])
    info = CaptureInfo.of(capture)
    assert info.source["preset"] == "drone" and "random half" in info.split_rule


def test_the_scaffold_has_roofs_and_ground_around_the_flight(store):
    mesh = scaffold_mesh(artifact(store, "scaffold"))
    assert np.ptp(mesh.vertices[:, :2], axis=0).min() > 60 and 6 < np.ptp(mesh.vertices[:, 2]) < 60
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    assert normal[:, 2].sum() > 0.3 * np.linalg.norm(normal, axis=1).sum()  # most of what is seen faces up


def test_what_is_learned_beats_each_frames_mean_colour(store):
    made = artifact(store, "evaluate")
    ours = {id: unpack_json(made.read(id).members["metrics.json"])["scores"]["ours"]["psnr"] for id in made.ids()}
    views = {view.id: view for view in frames(artifact(store, "capture"), "test")}
    assert ours.keys() == views.keys() and len(ours) >= 4
    floors = {id: -10 * np.log10((view.image() / 255).var(axis=(0, 1)).mean()) for id, view in views.items()}
    gains = np.array([ours[id] - floors[id] for id in ours])
    assert gains.mean() > 1.5 and (gains > 0).mean() > 0.7, (ours, floors)
    summary = json.loads((made.path / "files" / "metrics.json").read_bytes())
    assert "shift" not in {row.group for row in made.rows()} and summary


def test_the_page_of_a_flight_holds_its_frames(store):
    scene = json.loads((artifact(store, "bake").file("site") / "scene.json").read_bytes())
    assert [frame["name"] for frame in scene["frames"]] == [f"flight_{n:04}" for n in range(12)]
    assert {frame["split"] for frame in scene["frames"]} == {"train", "validation", "test"}
