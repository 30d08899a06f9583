"""What evaluate says of a scene, and a drive through one."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy import linalg
from scipy.spatial.transform import Rotation

from pipeline.errors import UserError
from pipeline.run import run_pipeline
from pipeline.store import Store
from stages import cli
from stages.graphics import metrics
from stages.graphics.arrays import unpack_json
from stages.graphics.browser import find_browser
from stages.graphics.cameras import Camera
from stages.neuras.baking import drawing
from stages.neuras.evaluation import costs, distributions, drive, paths, report, scores, summary
from stages.neuras.evaluation.renderers import as_bytes, opengl
from stages.neuras.evaluation.warping import Warping
from stages.neuras.rasterizing.photos import Source, beside, nearest
from stages.neuras.records import FrameRecord
from tests.model import inception, lpips
from tests.neuras import line, scenes

QUICK = {"video_frames": 4, "timing_frames": 1, "timing_size": [64, 36], "page_views": 0}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """run(evaluate={...}, ...) -> artifacts by stage, and the lines printed. The stages are made once."""
    store = tmp_path_factory.mktemp("evaluation") / "store"

    def go(**sections):
        lines: list[str] = []
        root = {"system": "tests.neuras.line", "stage": "evaluate", "store": str(store), "workers": 0}
        root |= {name: {} for name in line.SYSTEM.modules} | {"evaluate": QUICK} | sections
        return run_pipeline(root, ["test"], lines.append)["artifacts"], lines

    return go


@pytest.fixture
def no_opengl(monkeypatch):
    def fails():
        raise UserError(f"OpenGL does not start here: {drawing.INSTALL}")

    monkeypatch.setattr(drawing, "context", fails)


def needs_opengl():
    if opengl() is None:
        pytest.skip(drawing.INSTALL)


def views_of(artifact) -> dict:
    return {id: unpack_json(artifact.read(id).members["metrics.json"]) for id in artifact.ids()}


def picture(artifact, id: str, name: str) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(artifact.read(id).members[f"{name}.png"])))


# -- scores


def noisy(seed: int = 0, sigma: float = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    photo = np.asarray(Image.fromarray(rng.integers(0, 256, (8, 12, 3), np.uint8)).resize((60, 40), Image.Resampling.BICUBIC))
    return photo, np.clip(photo + rng.normal(0, sigma, photo.shape), 0, 255).astype(np.uint8)


def test_without_a_mask_the_scores_are_those_of_the_whole_picture():
    photo, other = noisy()
    found = scores.score(photo, other, np.ones((40, 60), bool), scores.scorers((), None))
    assert found["mse"] == pytest.approx(np.mean((photo / 255 - other / 255) ** 2), abs=1e-6)
    assert found["psnr"] == pytest.approx(-10 * np.log10(np.mean((photo / 255 - other / 255) ** 2)), abs=1e-4)
    assert found["ssim"] == pytest.approx(metrics.ssim(photo / 255, other / 255), abs=1e-6)


def test_what_a_mask_leaves_out_changes_no_score():
    photo, other = noisy()
    counts = np.ones((40, 60), bool)
    counts[:, 20:] = False
    black = other.copy()
    black[~counts] = 0
    known = scores.scorers((), None)
    assert scores.score(photo, other, counts, known) == scores.score(photo, black, counts, known)
    assert scores.score(photo, other, counts, known) != scores.score(photo, other, np.ones_like(counts), known)
    wrong = other.copy()
    wrong[10:20, 5:15] = 255 - wrong[10:20, 5:15]
    better, worse = scores.score(photo, other, counts, known), scores.score(photo, wrong, counts, known)
    assert worse["psnr"] < better["psnr"] - 3 and worse["ssim"] < better["ssim"] - 0.02


def test_the_error_is_divided_by_depth():
    photo = np.zeros((2, 4, 3), np.uint8)
    other = photo.copy()
    other[0] = 10  # squared error 300 in each pixel of row 0
    other[1, 0] = 20  # 1200
    depth = np.array([[10.0, 10.0, 0.0, 0.0], [5.0, 0.0, 7.0, 7.0]])
    true = np.array([[10.3, 12.0, 0.0, 4.0], [5.0, 0.0, 0.0, 7.0]])
    found = scores.error_places(photo, other, np.ones((2, 4), bool), depth, true, 0.05)
    assert {place: row["pixels"] for place, row in found.items()} == {
        "right_depth": 0.375,
        "wrong_depth": 0.375,
        "background": 0.25,
    }
    shares = {place: row["squared_error"] for place, row in found.items()}
    assert shares == {"right_depth": 0.625, "wrong_depth": 0.25, "background": 0.125}


def test_agreement_is_in_steps_of_eight_bits():
    one = np.full((10, 10, 3), 0.5)
    other = one.copy()
    other[..., 1] += 1 / 255
    other[0, :5, 2] += 6 / 255
    found = scores.agreement(one, other)
    assert found["median"] == pytest.approx(1) and found["seen"] == pytest.approx(0.05) and found["p99"] == pytest.approx(6)


# -- warping


def test_a_frame_is_timed_once_its_residuals_are_there():
    drawn = []
    counter = SimpleNamespace(draw=drawn.append, finish=lambda: None)
    assert len(costs.frame_times(counter, [1, 2, 3])) == 3
    assert drawn == [1, 1, 2, 2, 3, 3]  # the first time files are read


def test_warping_shows_a_photo_at_its_own_place_and_reads_the_nearest_alone():
    scene = line.truth()
    cameras = [scenes.looking_at(position) for _, _, position in line.PLACES.values()]
    asked = []

    def source(index: int) -> Source:
        asked.append(index)
        camera = cameras[index]
        image = scene.render(camera)
        return Source(camera, image, np.ones(image.shape[:2], bool), scene.caster.view(camera))

    warping = Warping(scene.caster, cameras, source, 5.0, nearest=1)
    image, seen = warping.render(cameras[2])
    assert asked == [2] and seen.mean() > 0.98
    assert np.median(np.abs(image - scene.render(cameras[2]))) < 1e-3
    moved, _ = warping.render(scenes.looking_at((4.7, 1.2, 2.1)))
    truth = scene.render(scenes.looking_at((4.7, 1.2, 2.1)))
    assert np.abs(moved - truth).mean() < 0.5 * np.abs(image - truth).mean()


# -- the summary


def view(id: str, shift: float, ours: float, warping: float, split: str = "shift") -> dict:
    row = {name: {"psnr": value, "ssim": 0.5, "mse": 0.01} for name, value in (("ours", ours), ("warping", warping))}
    return {"id": id, "split": split, "shift": shift, "scores": row, "errors": None, "agreement": {}}


def test_sides_are_told_apart_and_averaged():
    views = [
        view("a", 0.0, 26, 27, "test"),
        *(view(f"l{i}", -2.0, 20 + i, 21 + i) for i in range(4)),
        *(view(f"r{i}", 2.0, 23 + i, 21 + i) for i in range(4)),
        view("far", 3.0, 20, 19),
    ]
    groups = {group["label"]: group for group in summary.summarise(views)["groups"]}
    assert list(groups) == ["between frames", "2 m to the left", "2 m to the right", "2 m, both sides", "3 m to the right"]
    gains = {label: group["gains"]["ours"]["psnr"]["mean"] for label, group in groups.items()}
    assert gains == {
        "between frames": -1,
        "2 m to the left": -1,
        "2 m to the right": 2,
        "2 m, both sides": 0.5,
        "3 m to the right": 1,
    }
    assert groups["2 m, both sides"]["gains"]["ours"]["mse"]["mean"] == 0
    interval = groups["2 m to the left"]["methods"]["ours"]["psnr"]
    assert interval["low"] < 21.5 < interval["high"] and groups["between frames"]["methods"]["ours"]["psnr"]["low"] is None
    main = [group["label"] for group in report.main_groups(summary.summarise(views))]
    assert main == ["between frames", "2 m, both sides", "3 m to the right"]


# -- the stage


def test_ours_and_warping_are_scored_apart_and_the_shader_agrees(run):
    needs_opengl()
    artifacts, lines = run()
    views = views_of(artifacts["evaluate"])
    assert set(views) == {id for id, (split, _, _) in line.PLACES.items() if split != "train"}
    for id, row in views.items():
        photo = np.array(Image.open(io.BytesIO(artifacts["capture"].read(id).members["image.png"])))
        assert np.array_equal(picture(artifacts["evaluate"], id, "photo"), photo)
        for method in ("ours", "warping", "shader"):
            error = np.mean((photo / 255 - picture(artifacts["evaluate"], id, method) / 255) ** 2)
            assert row["scores"][method]["mse"] == pytest.approx(error, abs=1e-6)
        assert row["scores"]["ours"]["psnr"] != row["scores"]["warping"]["psnr"]
        assert row["agreement"]["fp16"]["seen"] < 0.01  # pixels of the silhouette may go either way
        assert row["agreement"]["fp16"]["median"] < 0.5 < row["agreement"]["rgba8"]["p99"]
        assert sum(place["pixels"] for place in row["errors"].values()) == pytest.approx(1, abs=1e-5)
        assert row["errors"]["right_depth"]["pixels"] > 0.2 and row["errors"]["background"]["pixels"] > 0.2
    files = artifacts["evaluate"].path / "files"
    assert {path.name for path in files.iterdir()} == {
        "report.html",
        "metrics.json",
        "overview.png",
        "timing.json",
        "drive.mp4",
        "lane_change.mp4",
    }
    timing = json.loads((files / "timing.json").read_bytes())["opengl"]
    assert timing["size"] == [64, 36] and timing["neural_fps"] > 0 and timing["plain_fps"] > 0
    html = (files / "report.html").read_text()
    assert "2 m, both sides" in html and "video/mp4" in html and "difference ×4" in html
    assert any("site/index.html" in text for text in lines)


def test_a_perfect_fit_scores_as_the_photos_eight_bits_allow(run):
    artifacts, _ = run(fit={"error": 0.0})
    assert all(row["scores"]["ours"]["psnr"] > 99 for row in views_of(artifacts["evaluate"]).values())


def test_masked_pixels_are_left_out(run):
    artifacts, _ = run(capture={"masked": True}, fit={"error": 0.0})
    for id, row in views_of(artifacts["evaluate"]).items():
        assert row["counted"] == 0.5 and row["scores"]["ours"]["psnr"] > 99  # the white half would leave 10 dB
        assert not picture(artifacts["evaluate"], id, "difference")[:32].any()


def test_exposure_is_found_on_the_left_half_and_scored_on_the_right(run):
    dim = {"capture": {"gain": 0.6}, "fit": {"error": 0.0}, "bake": {"residuals": 0}}  # they would show the photos' exposure
    plain, _ = run(**dim)
    artifacts, _ = run(**dim, evaluate=QUICK | {"exposure": "half"})
    before = views_of(plain["evaluate"])
    for id, row in views_of(artifacts["evaluate"]).items():
        assert row["counted"] == 0.5 and row["scores"]["ours"]["psnr"] > 45 > 25 > before[id]["scores"]["ours"]["psnr"]
    assert "found on its left half" in (artifacts["evaluate"].path / "files/report.html").read_text()
    assert "found on its left half" not in (plain["evaluate"].path / "files/report.html").read_text()


@pytest.mark.parametrize("setting", ["exposure", "poses"])
def test_a_view_whose_left_half_is_masked_tells_neither_exposure_nor_pose(run, setting):
    artifacts, _ = run(capture={"beside": True}, evaluate=QUICK | {setting: "half"})
    assert artifacts["evaluate"].manifest["outputs"]["rejects"] == {"masked": 1}
    plain, _ = run(capture={"beside": True})
    assert "frame-drive_01" in plain["evaluate"].ids() and "frame-drive_01" not in artifacts["evaluate"].ids()


def test_a_view_is_aligned_on_the_left_half_and_scored_on_the_right(run):
    turned = {"capture": {"turned": 0.02}, "fit": {"error": 0.0}}
    plain, _ = run(**turned)
    artifacts, _ = run(**turned, evaluate=QUICK | {"poses": "half"})
    before = views_of(plain["evaluate"])
    for id, row in views_of(artifacts["evaluate"]).items():
        if row["split"] == "test":
            assert row["counted"] == 0.5 and row["scores"]["ours"]["psnr"] > before[id]["scores"]["ours"]["psnr"] + 3
    assert "turned and shifted" in (artifacts["evaluate"].path / "files/report.html").read_text()
    assert "turned and shifted" not in (plain["evaluate"].path / "files/report.html").read_text()


def test_without_opengl_and_browser_the_report_says_what_is_missing(run, no_opengl, monkeypatch):
    monkeypatch.setattr("stages.graphics.browser.find_browser", lambda: None)
    artifacts, _ = run(evaluate={**QUICK, "video_frames": 2, "page_views": 2, "depth_tolerance": 0.06})
    views = views_of(artifacts["evaluate"])
    assert all(set(row["scores"]) == {"ours", "textures", "warping"} and not row["agreement"] for row in views.values())
    html = artifacts["evaluate"].file("report.html").read_text()
    for words in ("libegl1", "install chromium", "LPIPS", "FID and KID", "force=evaluate"):
        assert words in html
    assert artifacts["evaluate"].file("drive.mp4").stat().st_size > 500
    assert json.loads(artifacts["evaluate"].file("timing.json").read_bytes()) == {}

    assert "lightmill weights lpips" in html and "lightmill weights inception" in html


# -- with weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with random weights of every network, in the published layout."""
    folder = tmp_path_factory.mktemp("weights")
    lpips.write_weights(folder, "alex")
    inception.write_weights(folder)
    return str(folder)


WEIGHED = {**QUICK, "video_frames": 0, "timing_frames": 0}


def test_lpips_is_in_records_report_and_table_where_weights_are(run, weights, capsys):
    artifacts, _ = run(evaluate={**WEIGHED, "lpips": "alex", "lpips_folder": weights})
    for id, row in views_of(artifacts["evaluate"]).items():
        photo, ours = (picture(artifacts["evaluate"], id, name).transpose(2, 0, 1) / 255 for name in ("photo", "ours"))
        assert row["scores"]["ours"]["lpips_alex"] == pytest.approx(
            lpips.distance(Path(weights), "alex", photo, ours), rel=1e-3
        )
    html = artifacts["evaluate"].file("report.html").read_text()
    assert "LPIPS (AlexNet)" in html and "lightmill weights lpips" not in html
    artifact = artifacts["evaluate"]
    assert lightmill("scores", f"a={artifact.key}", f"b={artifact.key}", "--store", str(artifact.path.parents[2])) == 0
    assert "between frames: LPIPS (AlexNet)" in capsys.readouterr().out


def test_fid_and_kid_are_of_the_pictures_beside_the_drive(run, weights, capsys):
    artifacts, _ = run(evaluate={**WEIGHED, "inception": True, "inception_folder": weights})
    artifact, capture = artifacts["evaluate"], artifacts["capture"]
    sets = {row["label"]: row for row in json.loads(artifact.file("metrics.json").read_bytes())["distributions"]}
    assert set(sets) == {"2 m to the left", "2 m, both sides"}  # one view to the right is too few
    ids = [id for id, (split, _, _) in line.PLACES.items() if split == "shift"]
    photos = [id for id, (split, _, _) in line.PLACES.items() if split != "shift"]
    features = distributions.extractor(weights)
    images = (np.array(Image.open(io.BytesIO(capture.read(id).members["image.png"]))) for id in photos)
    reference = np.array([features(image) for image in images])
    row = sets["2 m, both sides"]
    assert row["views"] == len(ids) and row["photos"] == len(photos)
    for method, found in row["methods"].items():
        of_method = np.array([features(picture(artifact, id, method)) for id in ids])
        assert found["fid"] == pytest.approx(distributions.frechet(reference, of_method), rel=1e-5)
        assert found["kid"] == pytest.approx(distributions.kernel_distance(reference, of_method), abs=1e-5)
    assert set(row["methods"]) >= {"photo", "ours", "warping"} and row["methods"]["photo"] != row["methods"]["ours"]
    html = artifact.file("report.html").read_text()
    assert "FID" in html and f"{len(ids)} views against {len(photos)} photos" in html and "the truth there" in html
    assert "lightmill weights inception" not in html
    assert lightmill("scores", f"a={artifact.key}", f"b={artifact.key}", "--store", str(artifact.path.parents[2])) == 0
    assert "2 m, both sides: FID" in capsys.readouterr().out


def test_without_frames_beside_the_drive_the_cameras_are_moved(run, weights):
    values = {**WEIGHED, "splits": ["test"], "inception": True, "inception_folder": weights, "shifts_m": [0.5, 1.5]}
    artifacts, _ = run(evaluate=values)
    rows = json.loads(artifacts["evaluate"].file("metrics.json").read_bytes())["distributions"]
    sets = {row["label"]: row for row in rows}
    assert list(sets) == [
        f"{metres} m{where}" for metres in ("0.5", "1.5") for where in (" to the left", " to the right", ", both sides")
    ]
    assert [row["views"] for row in rows] == [2, 2, 4] * 2 and set(rows[0]["methods"]) == {"ours", "warping"}
    values = [row["methods"]["ours"]["fid"] for row in rows]
    assert len(set(values)) == len(values)


def test_missing_weights_are_missed_before_anything_runs(run, tmp_path):
    for name in ("lpips", "inception"):
        chosen = {"lpips": "vgg"} if name == "lpips" else {"inception": True}
        with pytest.raises(ValueError, match=f"lightmill weights {name}"):
            run(evaluate={**WEIGHED, **chosen, f"{name}_folder": str(tmp_path)}, fit={"error": 0.123})


# -- distributions


def sets(seed: int, count: int, dimensions: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0.3 * seed, 1, (count, dimensions)) @ rng.normal(0, 1, (dimensions, dimensions))


@pytest.mark.parametrize(("counts", "dimensions"), [((60, 90), 20), ((9, 12), 20)])
def test_frechet_distance_equals_the_formula_of_covariances(counts, dimensions):
    a, b = sets(1, counts[0], dimensions), sets(2, counts[1], dimensions)
    covariances = [np.cov(x, rowvar=False) for x in (a, b)]
    root = linalg.sqrtm(covariances[0] @ covariances[1] + 1e-9 * np.eye(dimensions))
    trace = np.trace(covariances[0] + covariances[1] - 2 * np.real(root))
    wanted = np.square(a.mean(axis=0) - b.mean(axis=0)).sum() + trace
    assert distributions.frechet(a, b) == pytest.approx(wanted, rel=1e-4)
    assert distributions.frechet(a, a) == pytest.approx(0, abs=1e-6 * wanted)


def test_kernel_distance_equals_its_sums_and_has_no_bias():
    a, b = sets(1, 7, 4), sets(2, 5, 4)

    def kernel(x, y):
        return (float(np.dot(x, y)) / 4 + 1) ** 3

    within = [np.mean([kernel(x[i], x[j]) for i in range(len(x)) for j in range(len(x)) if i != j]) for x in (a, b)]
    wanted = sum(within) - 2 * np.mean([kernel(x, y) for x in a for y in b])
    assert distributions.kernel_distance(a, b) == pytest.approx(wanted, rel=1e-9)
    rng = np.random.default_rng(3)
    values = [distributions.kernel_distance(rng.normal(size=(6, 3)), rng.normal(size=(9, 3))) for _ in range(2000)]
    assert abs(np.mean(values)) < 3 * np.std(values) / np.sqrt(len(values))


def test_the_page_is_compared_with_torch(run):
    needs_opengl()
    if find_browser() is None:
        pytest.skip("install chromium")
    artifacts, _ = run(evaluate={**QUICK, "video_frames": 0, "page_views": 2})
    rows = json.loads(artifacts["evaluate"].file("metrics.json").read_bytes())["page"]
    assert len(rows) == 2 and all(0 < row["median"] < 1.5 for row in rows)
    assert "the page in a browser" in artifacts["evaluate"].file("report.html").read_text()


def test_a_capture_that_holds_nothing_out_is_an_error(run):
    with pytest.raises(UserError, match="evaluate.splits"):
        run(evaluate={**QUICK, "splits": ["validation"]})


def test_runs_stand_side_by_side(run, capsys):
    quick = {**QUICK, "video_frames": 0}
    good, bad, other = (
        run(evaluate=quick, **sections)[0]["evaluate"]
        for sections in ({"fit": {"error": 0.0}}, {}, {"capture": {"masked": True}})
    )
    store = str(good.path.parents[2])
    assert lightmill("scores", f"good={good.key}", f"bad={bad.key}", "--store", store) == 0
    table = capsys.readouterr().out.splitlines()
    assert "| good | bad | multi-view warping | good better than bad |" in table[0]
    row = next(text for text in table if text.startswith("| 2 m, both sides: PSNR"))
    means, gain = row.split("|")[2:4], row.split("|")[5]
    assert float(gain.split()[0]) == pytest.approx(float(means[0]) - float(means[1]), abs=0.011) and float(gain.split()[0]) > 10
    assert table[-1].startswith("| stored (MB) |")
    halved = run(evaluate={**quick, "exposure": "half"})[0]["evaluate"]
    cases = ((other.key, "not of the same frames"), ("ball/bake", "no evaluation"), (halved.key, "evaluate.exposure=half"))
    for wrong, said in cases:
        assert lightmill("scores", good.key, wrong, "--store", store) != 0
        assert said in capsys.readouterr().err


# -- drives


def opened(folder) -> list[np.ndarray]:
    return [np.array(Image.open(path)) for path in sorted(folder.glob("*.png"))]


def lightmill(*words: str) -> int:
    return cli.main(list(words))


def test_a_drive_along_poses_equals_the_shader_at_those_poses(run, tmp_path):
    needs_opengl()
    artifacts, _ = run()
    cameras = [scenes.looking_at((5.0, y, 2.0)) for y in (0.0, 0.7, 1.4)]
    poses = [camera.camera_to_world.tolist() for camera in cameras]
    (tmp_path / "bare.json").write_text(json.dumps(poses))
    lens = dict(zip(paths.LENS, (50, 50, 30, 20, 60, 40), strict=True))
    entries = [{"transform_matrix": pose} for pose in poses]
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": entries}))
    words = ("drive", artifacts["bake"].key, "--store", str(artifacts["bake"].path.parents[2]), "--trajectory")
    assert lightmill(*words, str(tmp_path / "bare.json"), "-o", str(tmp_path / "bare")) == 0
    assert lightmill(*words, str(tmp_path / "transforms.json"), "-o", str(tmp_path / "lens")) == 0
    scene, _ = drive.scene_of(Store(artifacts["bake"].path.parents[2]), artifacts["bake"].key)
    images = opened(tmp_path / "bare")
    with scene.drawing() as shader:
        assert all(
            np.array_equal(as_bytes(shader.render(camera)), image) for camera, image in zip(cameras, images, strict=True)
        )
    assert np.abs(images[0].astype(int) - images[1]).mean() > 2
    assert [image.shape for image in opened(tmp_path / "lens")] == [(40, 60, 3)] * 3


def test_a_lane_shift_moves_the_camera_to_its_right(run, tmp_path):
    artifacts, _ = run()
    store = Store(artifacts["bake"].path.parents[2])
    middle, right = (drive.Trip(shift=shift, frames=5).cameras(artifacts["capture"], 1.0) for shift in (0.0, 1.0))
    for a, b in zip(middle, right, strict=True):
        assert np.allclose(b.position - a.position, a.camera_to_world[:3, 0])
    ends = [line.PLACES[id][2] for id in ("frame-drive_00", "frame-drive_04")]
    assert np.allclose([middle[0].position, middle[-1].position], ends)
    for shift in (0.0, 1.0):
        drive.drive(store, "ball/bake", drive.Trip(shift=shift, frames=2, size=(48, 32)), tmp_path / str(shift), "torch")
    assert np.abs(opened(tmp_path / "0.0")[0].astype(int) - opened(tmp_path / "1.0")[0]).mean() > 2


def test_without_opengl_torch_drives_and_says_so(run, no_opengl, tmp_path):
    artifacts, _ = run(evaluate={**QUICK, "video_frames": 0, "depth_tolerance": 0.07})
    store, trip = Store(artifacts["bake"].path.parents[2]), drive.Trip(frames=3, size=(49, 33))
    said = drive.drive(store, artifacts["evaluate"].key, trip, tmp_path / "out.mp4")
    assert "torch" in said[0] and "libegl1" in said[0] and (tmp_path / "out.mp4").stat().st_size > 500
    with pytest.raises(UserError, match="libegl1"):
        drive.drive(store, artifacts["bake"].key, trip, tmp_path / "other.mp4", "opengl")


@pytest.mark.parametrize(
    "document, said",
    [
        ("[]", "holds no poses"),
        ("{", "cannot be read as JSON"),
        ("[[1, 2, 3]]", "pose 0 is no finite 4 x 4"),
        ('["north"]', "pose 0 is no matrix"),
        (json.dumps([np.diag([1, 1, -1, 1]).tolist()]), "pose 0 is not rigid"),
        (json.dumps([(2 * np.eye(4)).tolist()]), "pose 0 is not rigid"),
        (json.dumps({"w": 4, "frames": [np.eye(4).tolist()]}), "give all of"),
    ],
)
def test_a_bad_trajectory_is_named(tmp_path, document, said):
    (tmp_path / "path.json").write_text(document)
    with pytest.raises(UserError, match=said):
        paths.read(tmp_path / "path.json", scenes.looking_at((5.0, 0.0, 0.0)))


def test_what_is_no_baked_scene_or_no_output_is_an_error(run, tmp_path):
    artifacts, _ = run()
    store = Store(artifacts["bake"].path.parents[2])
    with pytest.raises(UserError, match="no baked scene"):
        drive.drive(store, artifacts["capture"].key, drive.Trip(), tmp_path / "out")
    with pytest.raises(UserError, match=r"FILE\.mp4"):
        drive.drive(store, artifacts["bake"].key, drive.Trip(frames=1), tmp_path / "out.avi")


def test_a_smooth_path_goes_through_its_cameras_at_one_speed():
    cameras = [scenes.looking_at((5.0, y, 0.0)) for y in (0.0, 1.0, 1.0, 3.0)]
    way = paths.smooth(cameras, 7)
    steps = np.linalg.norm(np.diff([camera.position for camera in way], axis=0), axis=1)
    assert np.allclose(steps, steps[0], rtol=0.02)
    assert np.allclose(way[2].camera_to_world, cameras[1].camera_to_world, atol=1e-6)
    assert paths.smooth(cameras[:1], 3) == [cameras[0]] * 3


def test_a_lane_change_begins_and_ends_on_the_lane():
    shifts = paths.lane_change(21, -3.0)
    assert shifts[0] == shifts[-1] == 0 and shifts[10] == -3 and np.abs(np.diff(shifts)).max() < 1


def test_a_picture_of_another_shape_keeps_the_lens():
    camera = scenes.looking_at((5.0, 0.0, 0.0), size=(96, 64))
    wide = paths.framed(camera, 192, 64)
    assert wide.fx == camera.fx and wide.directions()[10, 58] == pytest.approx(camera.directions()[10, 10])


def test_frames_of_a_drive_are_in_order_of_time():
    cameras = [scenes.looking_at((5.0, y, 0.0)) for y in (0.0, 1.0, 2.0)]
    late, early = (FrameRecord(id, cameras[i], b"", "train", time=time) for i, id, time in ((0, "a", 2.0), (1, "b", 1.0)))
    beside = FrameRecord("c", cameras[2], b"", "shift", time=0.0)
    assert paths.driven([late, early, beside]) == [cameras[1], cameras[0]]
    unpadded = [FrameRecord(f"frame-{number}", cameras[i], b"", "train") for i, number in enumerate((10, 9, 100))]
    assert paths.driven(unpadded) == [cameras[1], cameras[0], cameras[2]]


def test_a_drive_of_several_cameras_is_that_of_the_one_that_looks_ahead():
    def camera(x: float, angle: float) -> Camera:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix() @ np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
        pose[:3, 3] = x, 0, 0
        return replace(scenes.looking_at((5.0, 0.0, 0.0)), camera_to_world=pose)

    ahead, left = ([camera(float(x), angle) for x in range(3)] for angle in (0, 90))
    assert np.allclose(ahead[0].forward, (1, 0, 0)) and np.allclose(left[0].forward, (0, 1, 0))
    frames = [
        FrameRecord(f"frame-{name}-{number}", one, b"", "train", time=float(number), meta={"camera": name})
        for name, along in (("a-left", left), ("front", ahead))
        for number, one in enumerate(along)
    ]
    assert paths.driven(frames) == ahead
    both = [*left, *ahead]
    assert nearest(both, ahead[1], 4) == [4, 3, 5, 1]  # however near the others are
    assert beside(both, 4, 2) == [3, 5]
