"""evaluate: baselines as strong as they claim to be, honest verdicts, a report that opens from disk."""

from __future__ import annotations

import base64
import io
import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from model.renderformer.config import ModelConfig
from pipeline.config import StageConfig, parse
from pipeline.errors import UserError
from pipeline.stage import Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.graphics.exr import decode_rgb
from stages.graphics.metrics import METRICS, log_error, measure_all
from stages.graphics.statistics import (
    BARS,
    JUDGED,
    METHODS,
    ROUGHNESS_BINS,
    TRIANGLE_BINS,
    bootstrap,
    decided,
    difference,
    summarise,
    worst_first,
)
from stages.graphics.tonemap import clamp
from stages.renderformer.dataset.encoding import encode_scene
from stages.renderformer.evaluation.baselines import best_constants, mean_images, measure_baseline
from stages.renderformer.evaluation.ceiling import ceiling, noise_pairs
from stages.renderformer.evaluation.plots import loss_curves
from stages.renderformer.evaluation.regions import REGIONS, region_errors, region_map, summarise_regions
from stages.renderformer.evaluation.runs import facts
from stages.renderformer.evaluation.tables import ceiling_lines, markdown
from stages.renderformer.records import SceneRecord, ViewRecord
from stages.renderformer.s07_evaluate import Evaluate, EvaluateConfig, training_images, visible_roughness
from stages.renderformer.views import encode_view
from tests.renderformer.fakes import FakeArtifact

SIZE = 16


def hdr(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.gamma(0.8, 0.6, shape).astype(np.float32)


def mean_psnr(images: np.ndarray, other: np.ndarray) -> float:
    """Mean over views, for colours and images alike."""
    return float(np.mean(-10 * np.log10(np.mean((clamp(images) - clamp(other)) ** 2, axis=(1, 2, 3), dtype=np.float64))))


class TestBaselines:
    def test_no_colour_beats_the_oracle_in_its_own_metric(self):
        rng = np.random.default_rng(0)
        images = hdr(rng, 4, 12, 12, 3) * np.array([0.1, 0.5, 1, 3], np.float32).reshape(4, 1, 1, 1)
        best = best_constants(images)
        psnr, error = mean_psnr(images, best["linear"]), log_error(images, best["log"])
        assert psnr > mean_psnr(images, clamp(images).mean(axis=(0, 1, 2)))  # the plain mean is not yet the best
        for _ in range(300):
            step = rng.normal(0, rng.choice([0.002, 0.02, 0.2]), 3)
            assert mean_psnr(images, np.maximum(best["linear"] + step, 0)) <= psnr + 1e-6
            assert log_error(images, np.maximum(best["log"] + step, 0)) >= error - 1e-6

    def test_each_metric_gets_the_colour_that_is_best_for_it(self):
        images = hdr(np.random.default_rng(1), 2, SIZE, SIZE, 3)
        best = best_constants(images)
        scores = measure_baseline(images, best)
        assert [list(row) for row in scores] == [list(METRICS)] * 2
        for name, metric in METRICS.items():
            totals = [
                sum(measure_all(image, np.broadcast_to(colour, image.shape))[name] for image in images)
                for colour in best.values()
            ]
            choose = max if metric.higher_is_better else min
            assert sum(row[name] for row in scores) == choose(totals), name

    def test_mean_images_are_the_pixelwise_optima(self):
        images = hdr(np.random.default_rng(2), 21, 8, 8, 3)
        means = mean_images(iter(np.split(images, 7)), limit=100)
        assert means["linear"] == pytest.approx(clamp(images).mean(axis=0), abs=1e-6)
        assert means["log"] == pytest.approx(np.median(images, axis=0), abs=5e-3)  # half floats
        assert mean_psnr(images, means["linear"]) > mean_psnr(images, means["log"])
        assert log_error(images, means["log"][None]) < log_error(images, means["linear"][None])

    def test_mean_images_read_no_more_than_asked(self):
        images = hdr(np.random.default_rng(3), 12, 8, 8, 3)
        read = []

        def blocks():
            for block in np.split(images, 3):
                read.append(len(block))
                yield block

        assert np.allclose(mean_images(blocks(), limit=6)["linear"], clamp(images[:6]).mean(axis=0), atol=1e-6)
        assert len(read) == 2
        with pytest.raises(ValueError, match="no training image"):
            mean_images(iter([]), limit=6)


def scores_like(value: float) -> dict[str, float]:
    return {name: value if metric.higher_is_better else -value for name, metric in METRICS.items()}


def scene(name: str, psnrs: list[float], bar: float, **facts) -> dict:
    view_facts = {"roughness": 0.3, "noise": {"log_error": None, "pair": None}}
    views = [
        {"index": i, **view_facts, "scores": {m: scores_like(value if m == "model" else bar) for m in METHODS}}
        for i, value in enumerate(psnrs)
    ]
    return {"id": name, "template": "box", "lights": 1, "triangles": 9, "resolution": 16, "views": views, **facts}


class TestStatistics:
    def test_bootstrap_resamples_scenes_and_averages_views(self):
        rng = np.random.default_rng(0)
        values = [list(rng.normal(rng.normal(0, 1), 0.1, rng.integers(1, 5))) for _ in range(100)]
        estimate = bootstrap(values)
        assert estimate["mean"] == pytest.approx(np.mean(np.concatenate(values)))
        assert estimate["low"] < estimate["mean"] < estimate["high"]
        # Scenes of spread 1, a hundred of them: an interval over the views would be narrower.
        assert 0.3 < estimate["high"] - estimate["low"] < 0.6
        assert bootstrap(values) == estimate
        assert bootstrap([[3.0, 5.0]]) == {"mean": 4, "low": None, "high": None}
        assert bootstrap([[3.0], [3.1]])["low"] is None and bootstrap([[0.8], [1.0], [0.9]], (0, 1))["high"] == 1
        assert not decided(bootstrap([[3.0, 5.0]])) and decided(bootstrap([[3.0], [3.1], [3.2]]))

    @pytest.mark.parametrize("count", [3, 4, 8, 23])
    def test_intervals_of_few_scenes_hold_the_truth_as_often_as_they_say(self, count):
        rng = np.random.default_rng(1)
        estimates = [bootstrap(rng.normal(size=(count, 1))) for _ in range(300)]
        assert 0.90 <= np.mean([one["low"] <= 0 <= one["high"] for one in estimates]) <= 0.98

    def test_a_model_that_loses_is_told_so(self):
        summary = summarise([scene("a", [10, 12], 11.5), scene("b", [11], 11.5)])
        assert summary["views"] == 3 and not summary["beats_baselines"]
        assert summary["gains"]["constant"]["psnr"]["mean"] == pytest.approx(-0.5)
        text = markdown({**summary, "ceiling": {}})
        assert text.count("does not beat") == 6 and "gain -0.50 dB" in text  # two bars and its closed form, in two metrics
        assert "gain -0.5000 (95 %" in text  # log error counts the other way round: a gain is less error

    def test_a_model_that_wins_in_one_metric_only_has_not_won(self):
        one = scene("a", [12], 11)
        one["views"][0]["scores"]["mean_image"]["log_error"] = -13
        assert not summarise([one])["beats_baselines"]
        assert summarise([scene("a", [12], 11)])["beats_baselines"]

    def test_breakdown_and_ranking(self):
        scenes = [scene("a", [10, 30], 0, template="floor"), scene("b", [20], 0, lights=3)]
        by = summarise(scenes)["by"]
        assert [(row["value"], row["views"], row["model"]["psnr"]) for row in by["template"]] == [
            ("box", 1, 20),
            ("floor", 2, 20),
        ]
        assert [row["value"] for row in by["lights"]] == [1, 3]
        ranks = [(rank, some["id"], view["index"]) for rank, (some,), (view,) in worst_first([scenes], 10)]
        assert ranks == [(1, "a", 0), (2, "b", 0), (3, "a", 1)]
        assert [rank for rank, _, _ in worst_first([scenes], 2)] == [1, 3]
        assert worst_first([scenes], 0) == []

    def test_breakdowns_put_views_into_the_bins_that_they_state(self):
        scenes = [scene(f"{n}", [psnr, 7.0], 0, triangles=n) for n, psnr in ((256, 10.0), (257, 20.0), (9000, 40.0))]
        for some, roughness in zip(scenes, (0.05, 0.1, None), strict=True):
            some["views"][1]["roughness"] = roughness
        by = summarise(scenes)["by"]
        assert [row["value"] for row in by["triangles"]] == [TRIANGLE_BINS[0], TRIANGLE_BINS[1], TRIANGLE_BINS[-1]]
        assert TRIANGLE_BINS[:2] == ("1–256", "257–384") and TRIANGLE_BINS[-1] == "> 8192"
        # the views of one scene may lie in different bins
        rough = {row["value"]: row for row in by["roughness"]}
        assert list(rough) == [ROUGHNESS_BINS[0], ROUGHNESS_BINS[1], "0.2–0.4", "nothing glossy"]
        assert (rough["0.2–0.4"]["scenes"], rough["0.2–0.4"]["views"]) == (3, 3)
        assert rough["0.2–0.4"]["model"]["psnr"] == pytest.approx((10 + 20 + 40) / 3)
        low, high = rough["0.2–0.4"]["interval"]["psnr"]
        assert 0 <= low < 10 and 40 < high <= 100  # three scenes do not span what a fourth may be
        assert rough["< 0.1"]["interval"]["psnr"] is None  # one scene has no spread

    def test_a_difference_between_runs_is_paired_and_positive_where_the_first_is_better(self):
        base = [scene(name, [psnr, psnr + 20], 0) for name, psnr in (("a", 10.0), ("b", 30.0), ("c", 50.0))]
        ours = [scene(some["id"], [view["scores"]["model"]["psnr"] + 1 for view in some["views"]], 0) for some in base]
        differences = difference(ours[::-1], base, {"a", "b", "c"})
        assert (differences["scenes"], differences["views"]) == (3, 6)
        for name in ("psnr", "flip"):  # a gain in every metric, and the same in every view: no spread is left
            assert differences["gains"][name] == pytest.approx({"mean": 1, "low": 1, "high": 1})
        assert difference(ours, base, {"a", "b"})["gains"]["psnr"]["low"] is None
        assert difference(ours, base, set()) is None

    def test_several_runs_rank_the_views_that_they_share_by_their_mean(self):
        runs = [[scene("a", [10, 30], 0), scene("b", [20], 0)], [scene("a", [40, 5], 0), scene("c", [1], 0)]]
        ranked = worst_first(runs, 10)
        assert [(rank, one["id"], view["index"]) for rank, (one, _), (view, _) in ranked] == [(1, "a", 1), (2, "a", 0)]
        assert [view["scores"]["model"]["psnr"] for _, _, views in ranked for view in views] == [30, 5, 10, 40]


class TestCeiling:
    def test_it_is_what_the_noiseless_truth_scores(self):
        """Three independent noisy renders of a known truth: the pair tells how the truth would score against the third."""
        from stages.renderformer.rendering.noise import error_of_one

        rng = np.random.default_rng(5)
        scenes, pairs, real = [], [], []
        for number in range(8):
            truth = np.broadcast_to(rng.uniform(0.3, 0.6, 3), (64, 64, 3))
            a, b, target = (truth + rng.normal(0, 0.02, truth.shape) for _ in range(3))
            scored = measure_all(target.astype(np.float32), truth.astype(np.float32))
            pairs.append([error_of_one(a, b)])
            some = scene(f"{number}", [20.0], 0)
            some["views"][0]["noise"]["log_error"] = scored["log_error"]
            scenes.append(some)
            real.append(scored)
        ceilings = ceiling(scenes, "test", pairs, "all splits")
        assert ceilings["psnr"]["mean"] == pytest.approx(np.mean([row["psnr"] for row in real]), abs=0.05)
        assert ceilings["log_error"]["mean"] == pytest.approx(np.mean([row["log_error"] for row in real]))
        assert (ceilings["psnr"]["of"], ceilings["log_error"]["of"]) == ("all splits", "test")
        for some in scenes:  # without estimates the pairs tell the log error as well
            some["views"][0]["noise"]["log_error"] = None
        ceilings = ceiling(scenes, "test", pairs, "test")
        assert ceilings["log_error"]["mean"] == pytest.approx(np.mean([row["log_error"] for row in real]), rel=0.02)
        assert ceiling(scenes, "test", [], "test") == {}

    def test_a_second_render_bounds_what_no_formula_tells(self, inputs, monkeypatch):
        """The truth of a noisy target scores better than a second noisy image, in each metric but the one with a formula."""
        from stages.renderformer.dataset import decode_sample
        from stages.renderformer.evaluation import ceiling as module

        params = {"seed": 3, "resolution": SIZE, "max_spp": 5, "denoise": False, "noise_share": 0.5}
        monkeypatch.setattr(module, "history", lambda inputs: {"render": {"params": params}})
        monkeypatch.setattr(module.backends, "choose", lambda: {"backend": "fake"})
        rng, asked = np.random.default_rng(1), []

        def render_again(scene, settings, backend, views):
            asked.append((scene.id, settings, views))
            image = decode_sample(inputs["shard"].read(scene.id)).views[views[0]].image
            return [SimpleNamespace(image=(image + rng.normal(0, 0.02, image.shape)).astype(np.float32))]

        monkeypatch.setattr(module, "render_views", render_again)
        ceilings = module.render_ceilings(inputs["shard"], "test", 2, METRICS)
        assert [(id, views) for id, _, views in asked] == [("test-0", [0]), ("test-2", [0])]
        seeds = {settings.seed for _, settings, _ in asked}
        assert len(seeds) == 2 and {(s.max_spp, s.resolution, s.denoise) for _, s, _ in asked} == {(5, SIZE, False)}
        assert set(ceilings) == set(METRICS) - {"psnr", "log_error"}  # which the data tells
        assert 0.3 < ceilings["ssim"]["mean"] < 1 and 0 < ceilings["flip"]["mean"] < 0.5
        assert {ceiling["from"] for name, ceiling in ceilings.items() if name != "psnr_tm"} == {"second renders"}
        assert ceilings["ssim"]["views"] == 2 and ceilings["ssim"]["of"] == "test" and ceilings["ssim"]["low"] is None
        lines = ceiling_lines({"ceiling": ceilings})
        assert len(lines) == 2 and "would score" in lines[0] and lines[1].startswith("SSIM; SSIM, tone-mapped; HDR-FLIP: ")
        assert module.render_ceilings(inputs["shard"], "test", 0, METRICS) == {}
        monkeypatch.setattr(module, "history", lambda inputs: {})
        assert module.render_ceilings(inputs["shard"], "test", 2, METRICS) == {}

    def test_pairs_are_looked_for_in_all_splits_where_the_evaluated_one_has_few(self, inputs):
        pairs, where = noise_pairs(inputs["shard"], "test")
        assert where == "all splits"
        assert pairs == [[{"psnr": 30.0, "log_error": 0.01}]] * 9  # of camera 2 of every scene


def test_roughness_of_a_view_is_that_of_what_it_shows(inputs):
    from stages.renderformer.dataset import decode_sample

    scene = decode_sample(inputs["shard"].read("test-0")).scene
    scene.roughness[:3], scene.specular[:3] = [0.1, 0.5, 0.9], [[0.2] * 3, [0.6] * 3, [0.0] * 3]
    assert visible_roughness(scene, np.array([[0, 1], [2, -1]])) == pytest.approx((0.2 * 0.1 + 0.6 * 0.5) / 0.8)
    assert visible_roughness(scene, np.array([[0, 0], [0, 1]])) == pytest.approx((0.6 * 0.1 + 0.6 * 0.5) / 1.2)
    assert visible_roughness(scene, np.array([[2, -1]])) is None


class Artifact(FakeArtifact):
    """With what evaluate reads besides records."""

    key = "0123456789abcdef" * 4

    def __init__(self, path, records):
        super().__init__(path, records)
        self.manifest["preimage"]["params"] = {"model": {"latent_dim": 8}, "note": "<b>"}

    def row(self, id):
        return SimpleNamespace(digest=f"of {id}")

    def groups(self):
        return sorted({row.group for row in self.rows()})


PAIR = {"psnr": 30.0, "log_error": 0.01}


def shard_record(name: str, rng: np.random.Generator, cameras: list[int], lights: int) -> Record:
    n = 6
    triangles = rng.uniform(-0.5, 0.5, (n, 3, 3))
    light_index = np.where(np.arange(n) < lights, np.arange(n), -1)
    noted = [{"index": i, "error": 0.02, **({"noise": {"sum": PAIR}} if i == 2 else {})} for i in range(4)]
    meta = {"template": "corner", "views": cameras, "render": {"views": noted}}
    scene = SceneRecord(
        name, triangles, np.ones((n, 3, 3)), np.ones((n, 3)), np.ones((n, 3)), np.ones(n), np.ones((n, 3)),
        light_index, np.zeros(n), np.tile(np.eye(4), (4, 1, 1)), np.full(4, 45.0), meta,
    )  # fmt: skip
    base = np.linspace(0.1, 1.2, SIZE)[:, None, None] * rng.uniform(0.3, 1, 3)
    members = {"scene.npz": encode_scene(scene), "meta.json": pack_json(meta)}
    for camera in cameras:
        layers = (base + hdr(rng, lights, SIZE, SIZE, 3) * 0.1).astype(np.float32) / lights
        flat = np.zeros((SIZE, SIZE, 3), np.float32)
        nothing = np.full(layers.shape[1:3], -1, np.int32)
        nothing[0, 0] = 1
        view = ViewRecord(
            layers, layers.sum(axis=0) * 0.6, flat, flat, flat[..., 0], flat[..., 0], nothing, nothing, {"index": camera}
        )
        members |= encode_view(view)
    return Record(name, members)


@pytest.fixture
def inputs(tmp_path) -> dict[str, Artifact]:
    from safetensors.numpy import save_file

    rng = np.random.default_rng(0)
    train = [("train", shard_record(f"train-{i}", rng, [0, 1, 2, 3], 1)) for i in range(6)]
    test = [("test", shard_record(f"test-{i}", rng, [0, 2], i + 1)) for i in range(3)]
    model = Artifact(tmp_path / "train", [])
    (model.files / "checkpoint").mkdir()
    config = ModelConfig(num_layers=2, view_transformer_n_layers=4)
    (model.files / "checkpoint" / "config.json").write_text(config.dumps())
    save_file(
        {"w": np.zeros((10, 7), np.float32), "b": np.zeros(3, np.float32)}, model.files / "checkpoint" / "model.safetensors"
    )
    rows = [
        {"step": step, "loss": 1 / step, **({"validation_log_error": 0.2} if step % 50 == 0 else {})}
        for step in range(10, 201, 10)
    ]
    (model.files / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return {"shard": Artifact(tmp_path / "shard", train + test), "train": model}


@pytest.fixture
def predictor(monkeypatch, inputs):
    """Stands in for the network: ``factor`` times the true image, or a scene's own factor."""
    from stages.renderformer.dataset import decode_sample

    fake = SimpleNamespace(factor=0.9, by_scene={}, closed_form=None)

    def predict_scene(model, scene, views, resolution, device):
        sample = decode_sample(inputs["shard"].read(scene.id))
        assert resolution == SIZE and device == "cpu"
        factor = fake.by_scene.get(scene.id, fake.factor) if model != "closed form" else 0.5
        return np.stack([sample.views[view].image for view in views]) * factor

    network = SimpleNamespace(without_learning=lambda: fake.closed_form)
    module = SimpleNamespace(load_model=lambda folder: network, predict_scene=predict_scene)
    monkeypatch.setitem(sys.modules, "stages.renderformer.inference.predict", module)
    return fake


def evaluate(config: EvaluateConfig, inputs, path) -> tuple[list[Record], Artifact]:
    config, stage = config.model_copy(update={"timing_scenes": 0}), Evaluate()  # no network is there to be timed
    worker = stage.open(config, inputs, {"device": "cpu"})
    items = list(stage.items(config, inputs))
    records = [record for item in items for record in stage.process(worker, item)]
    draft = Artifact(path, [(config.split, record) for record in records])
    stage.finish(config, inputs, draft)
    stage.check(draft)
    return records, draft


def test_records_hold_every_score_and_the_predictions(inputs, predictor, tmp_path):
    records, _ = evaluate(EvaluateConfig(), inputs, tmp_path / "out")
    assert [record.id for record in records] == ["test-0", "test-1", "test-2"]
    metrics = unpack_json(records[1].members["metrics.json"])
    assert (metrics["template"], metrics["lights"], metrics["triangles"], metrics["resolution"]) == ("corner", 2, 6, SIZE)
    assert [view["noise"] for view in metrics["views"]] == [{"log_error": 0.02, "pair": pair} for pair in (None, PAIR)]
    assert {view["roughness"] for view in metrics["views"]} == {1.0}
    assert [view["index"] for view in metrics["views"]] == [0, 2]  # camera indices, not positions
    for view in metrics["views"]:
        assert set(view["scores"]) == set(METHODS) - {"closed_form"}  # RenderFormer starts from no picture
        assert all(set(row) == set(METRICS) for row in view["scores"].values())
    from stages.renderformer.dataset import decode_sample

    truth = decode_sample(inputs["shard"].read("test-1")).views[2]
    prediction = decode_rgb(records[1].members["view2.prediction.exr"])
    assert prediction == pytest.approx(truth.image * 0.9, rel=1e-3)
    assert metrics["views"][1]["scores"]["model"] == measure_all(truth.image, truth.image * 0.9)
    assert metrics["views"][1]["scores"]["direct"] == measure_all(truth.image, truth.direct)
    again, _ = evaluate(EvaluateConfig(), inputs, tmp_path / "again")
    assert [record.members for record in again] == [record.members for record in records]


def test_the_report_is_one_page_with_the_truth_in_it(inputs, predictor, tmp_path):
    from PIL import Image

    _, draft = evaluate(EvaluateConfig(gallery=4), inputs, tmp_path / "out")
    page = (draft.files / "report.html").read_text()
    assert "The model beats both baselines" in page and page.count("✓") == 4 and "✗" not in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # nothing to fetch
    assert "<svg" in page and "73 parameters, 200 training steps" in page and "2 + 4 layers" in page
    assert "&lt;b&gt;" in page and "note = <b>" not in page  # autoescape is on
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 4 * 5
    assert Image.open(io.BytesIO(base64.b64decode(pictures[0]))).size == (SIZE, SIZE)
    numbers = json.loads((draft.files / "metrics.json").read_text())
    assert numbers["beats_baselines"] and numbers["scenes"] == 3 and numbers["views"] == 6
    assert numbers["data"]["scenes"] == {"test": 3, "train": 6}
    assert numbers["ceiling"]["psnr"]["mean"] == 30 and numbers["ceiling"]["log_error"]["mean"] == pytest.approx(0.02)
    assert page.count("the noiseless truth would score") == 2
    assert (
        f"**{METRICS['psnr'].format(numbers['methods']['model']['psnr']['mean'])}**" in (draft.files / "metrics.md").read_text()
    )
    assert draft.notes["metrics"]["model"]["psnr"] == round(numbers["methods"]["model"]["psnr"]["mean"], 2)


def test_a_black_model_is_reported_as_beaten(inputs, predictor, tmp_path):
    predictor.factor = 0.0
    _, draft = evaluate(EvaluateConfig(), inputs, tmp_path / "out")
    page = (draft.files / "report.html").read_text()
    assert "The model does not beat both baselines" in page and page.count("✗") == 4


def test_a_win_within_the_interval_is_called_close(inputs, predictor, tmp_path):
    predictor.by_scene = {"test-0": 0.0, "test-1": 0.0}
    _, draft = evaluate(EvaluateConfig(), inputs, tmp_path / "out")
    gains = json.loads((draft.files / "metrics.json").read_text())["gains"]
    close = sum(gains[bar][name]["low"] <= 0 <= gains[bar][name]["high"] for bar in BARS for name in JUDGED)
    assert close and (draft.files / "report.html").read_text().count("too close to call") == close


def test_a_diverged_model_stops_the_run(inputs, predictor, tmp_path):
    predictor.factor = np.nan
    with pytest.raises(UserError, match="test-0 holds NaN"):
        evaluate(EvaluateConfig(), inputs, tmp_path / "out")


def test_workers_read_the_mean_image_that_was_built_once(inputs, predictor, tmp_path, monkeypatch):
    import stages.renderformer.s07_evaluate as module

    stage, config, tmp = Evaluate(), EvaluateConfig(), tmp_path / "prepared"
    for _ in range(2):  # a run that continues prepares again
        stage.prepare(config, inputs, tmp)
    assert [path.name for path in tmp.iterdir()] == ["mean_images.npz"]
    alone = stage.open(config, inputs, {"device": "cpu"})
    monkeypatch.setattr(module, "training_images", None)  # no worker may read the training images
    worker = stage.open_prepared(config, inputs, {"device": "cpu"}, tmp)
    item = next(iter(stage.items(config, inputs)))
    (one,), (other,) = (list(stage.process(opened, item)) for opened in (alone, worker))
    assert one.members == other.members


def test_mean_image_sees_training_scenes_only_and_about_as_many_as_asked(inputs):
    assert sum(len(block) for block in training_images(inputs["shard"], 1000)) == 24
    assert sum(len(block) for block in training_images(inputs["shard"], 8)) == 8


def test_without_training_scenes_the_mean_image_is_that_of_the_others_and_the_report_says_so(inputs):
    only_test = Artifact(inputs["shard"].path, [("test", inputs["shard"].read(id)) for id in inputs["shard"].ids("test")])
    assert sum(len(block) for block in training_images(only_test, 1000)) == 6
    summary = {
        "train": dict(network="1 + 1 layers, width 8", parameters=1, steps=0, key="a"),
        "data": {"key": "b", "split": "test"},
        "per_scene": [{"resolution": 16}],
    }
    for scenes, mentioned in (({"test": 3}, True), ({"train": 6, "test": 3}, False)):
        summary["data"]["scenes"] = scenes
        assert ("mean training image" in facts(summary, "c")) == mentioned


def test_a_split_without_scenes_is_named(inputs):
    with pytest.raises(UserError, match="split=validation.*test, train"):
        list(Evaluate().items(EvaluateConfig(split="validation"), inputs))


def test_the_shipped_config_is_the_default_one():
    import yaml

    from tests.conftest import ROOT

    data = yaml.safe_load((ROOT / "conf" / "renderformer" / "evaluate" / "default.yaml").read_text())
    assert parse(EvaluateConfig, data, "evaluate") == EvaluateConfig()
    assert set(data) == set(EvaluateConfig.model_fields) - set(StageConfig.model_fields)  # those: config.yaml


def test_a_log_without_validation_still_draws():
    assert loss_curves({"model": [{"step": 1, "loss": 0.5}, {"step": 2, "loss": 0.4}]}).startswith("<svg")
    assert loss_curves({"given": []}) == ""


def test_what_a_network_starts_from_is_scored_beside_it(inputs, predictor, tmp_path):
    predictor.closed_form = "closed form"
    records, draft = evaluate(EvaluateConfig(), inputs, tmp_path / "evaluate")
    view = unpack_json(records[0].members["metrics.json"])["views"][0]
    assert view["scores"]["closed_form"]["psnr"] < view["scores"]["model"]["psnr"]
    summary = json.loads(draft.file("metrics.json").read_text())
    assert summary["gains"]["closed_form"]["psnr"]["mean"] > 0 and "closed_form" in summary["regions"][0]["error"]
    assert "beats the closed form alone, nothing learned in PSNR: gain +" in draft.file("metrics.md").read_text()


class TestRegions:
    """Two objects side by side, a third of the picture empty; the right one is a mirror."""

    @pytest.fixture
    def view(self) -> SimpleNamespace:
        triangle = np.full((12, 12), -1)
        triangle[:, :4], triangle[:, 4:8] = 0, 1
        image, direct = np.ones((12, 12, 3)), np.ones((12, 12, 3))
        direct[6:] = 0.1
        return SimpleNamespace(triangle=triangle, object=triangle, coverage=(triangle >= 0) * 1.0, image=image, direct=direct)

    @pytest.fixture
    def scene(self) -> SimpleNamespace:
        diffuse, specular = np.array([[0.9] * 3, [0.1] * 3]), np.array([[0.05] * 3, [0.8] * 3])
        return SimpleNamespace(diffuse=diffuse, specular=specular, roughness=np.array([0.1, 0.1]))

    def test_every_pixel_has_the_region_that_its_surface_says(self, scene, view):
        names = np.array(list(REGIONS))[region_map(scene, view)]
        assert (names[:6, :3] == "lit diffuse").all() and (names[6:, :3] == "shadowed diffuse").all()
        assert (names[:, 5:7] == "smooth specular").all() and (names[:, 8:] == "nothing").all()
        assert (names[:, [3, 4, 7]] == "silhouette").all()
        scene.roughness[1] = 0.5
        assert (np.array(list(REGIONS))[region_map(scene, view)][:, 5:7] == "rough specular").all()

    def test_errors_of_regions_add_up_to_that_of_the_picture(self, scene, view):
        test = view.image * np.linspace(1, 2, 12)[:, None]
        rows = region_errors(region_map(scene, view), view.image, {"model": test, "direct": view.direct})
        assert sum(row["pixels"] for row in rows.values()) == 144
        whole = np.abs(np.log10(1 + test) - np.log10(2)).mean()
        assert sum(row["pixels"] * row["model"] for row in rows.values()) / 144 == pytest.approx(whole, rel=1e-5)
        (first, *_) = summary = summarise_regions([{"views": [{"regions": rows}] * 2}])
        assert sum(row["part"]["model"] for row in summary) == pytest.approx(1)
        assert first["region"] == "silhouette" and first["share"] == pytest.approx(0.25)


@pytest.mark.parametrize("variant", [{}, {"use_dpt_decoder": False}, {"pe_type": "nerf", "use_dpt_decoder": False}])
def test_every_step_of_a_model_is_timed_and_nothing_stays_hooked(inputs, variant):
    from model.renderformer.config import ModelConfig
    from model.renderformer.network import RenderFormer
    from stages.renderformer.dataset import decode_sample
    from stages.renderformer.evaluation.timing import REPEATS, time_model

    small = dict(
        latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=128, num_register_tokens=2, texture_encode_patch_size=1,
        view_transformer_latent_dim=128, view_transformer_n_layers=4, view_transformer_n_heads=1,
        view_transformer_ffn_hidden_dim=128, dpt_features=8, dpt_out_channels=(8, 8, 8, 8),
    )  # fmt: skip
    model = RenderFormer(ModelConfig(**small | variant))
    runs = []
    model.view_transformer.register_forward_hook(lambda *_: runs.append(1))
    samples = [decode_sample(inputs["shard"].read(id)) for id in ("test-0", "test-2")]
    timing = time_model(model, samples, "cpu")
    assert len(runs) == 2 * (REPEATS + 1)
    assert [row["id"] for row in timing["scenes"]] == ["test-0", "test-2"] and timing["resolution"] == SIZE
    steps = ("encode", "project", "rays", "head")
    assert tuple(timing["median"]) == steps
    assert all(row[step] > 0 for row in timing["scenes"] for step in steps if step != "project" or "pe_type" not in variant)
    head = model.view_transformer.out_proj if "use_dpt_decoder" in variant else model.view_transformer.out_dpt
    assert not head._forward_pre_hooks
