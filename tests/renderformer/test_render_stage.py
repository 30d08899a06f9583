"""The render stage: what it keeps and drops, its reports, the noise floor, the sheets."""

from __future__ import annotations

import os
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline import commands
from pipeline.errors import Reject, UserError
from pipeline.stage import Item, Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.graphics.metrics import log_error, psnr
from stages.graphics.mitsuba import backend
from stages.graphics.tonemap import clamp
from stages.renderformer.records import ViewRecord
from stages.renderformer.rendering import noise, sheet
from stages.renderformer.s04_render import Render, RenderConfig
from stages.renderformer.s08_probe import RunProbe
from stages.renderformer.views import decode_view, encode_view, view_members
from tests.renderformer.fakes import FakeArtifact, path_traced
from tests.renderformer.test_rendering import SCALAR, camera, clutter

CONFIG = {"resolution": 16, "max_spp": 4, "target_error": 0.0}


def labelled(scene, id="test"):
    """The scene as the scene stage would hand it over."""
    scene.id, scene.meta = id, {"template": "floor", "variant": "multi"}
    return scene


def with_bad_views():
    """Camera 0 sees something, camera 1 looks away, camera 2 stands at the wall."""
    scene = labelled(clutter(lights=2, cameras=3), "good")
    scene.camera_to_world = scene.camera_to_world.copy()
    scene.camera_to_world[1] = camera((0, -2, 0), (0, -4, 0))
    scene.camera_to_world[2] = camera((0, 0.495, 0.2), (0, 0.6, 0.2))
    return scene


def rendered(path, scenes, **config):
    """The records that the stage makes of the scenes, as a draft, and the stage's config."""
    inputs = {"scene": FakeArtifact(path / "scene", [("train", scene.to_record()) for scene in scenes])}
    stage, config = Render(), RenderConfig(**{**CONFIG, **config})
    worker = stage.open(config, inputs, SCALAR)
    records = [("train", record) for item in stage.items(config, inputs) for record in stage.process(worker, item)]
    return FakeArtifact(path / "render", records), config


# --- the stage --------------------------------------------------------------------------------------------------------


def test_stage_renders_drops_and_rejects(tmp_path):
    dark = labelled(clutter(lights=2), "dark")
    dark.emission = dark.emission * 1e-6
    scenes = [("train", scene.to_record()) for scene in (with_bad_views(), dark)]
    inputs = {"scene": FakeArtifact(tmp_path, scenes)}
    stage, config = Render(), RenderConfig(**CONFIG, noise_share=1)
    dark_item, item = stage.items(config, inputs)
    assert item == Item("good", "train", (("scene", "good"),))
    worker = stage.open(config, inputs, SCALAR)
    (record,) = stage.process(worker, item)
    assert sorted(record.members) == ["meta.json", "view0.aov.exr", "view0.exr"]
    meta = unpack_json(record.members["meta.json"])
    assert {name: meta[name] for name in meta if name != "views"} == {"template": "floor", "variant": "multi", "lights": 2}
    assert [view["status"] for view in meta["views"]] == ["ok", "dark", "too_close"]
    assert [view["index"] for view in meta["views"] if "noise" in view] == [0]  # nobody asks for the noise of what is dropped
    assert decode_view(record.members, 0).lights.shape == (2, 16, 16, 3)
    with pytest.raises(Reject) as caught:
        list(stage.process(worker, dark_item))
    assert caught.value.reason == "dark"


def test_an_interrupted_artifact_keeps_its_backend():
    stage = Render()
    assert stage.environment(RenderConfig(), SCALAR) == SCALAR
    with pytest.raises(UserError, match="begun with the backend llvm with /none"):
        stage.environment(RenderConfig(), {"backend": "llvm", "library": "/none/libLLVM.so"})


@pytest.fixture
def libraries(tmp_path, monkeypatch):
    """libraries("lib/libLLVM.so.19.1", ..): what this machine has of LLVM, in order; -> their paths. All of them work."""
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(backend, "_proof", lambda candidate: True)
    monkeypatch.setattr(backend, "visible_gpus", lambda: [])

    def install(*names: str) -> list[str]:
        paths = [tmp_path / name for name in names]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
        monkeypatch.setattr(backend, "llvm_libraries", lambda: [str(path) for path in paths])
        return [str(path) for path in paths]

    return install


def test_an_upgrade_of_llvm_within_its_major_version_changes_nothing(libraries):
    """Drafts are finished and earlier artifacts taken over; those that name LLVM by path too."""
    stage, config = Render(), RenderConfig()
    old = libraries("a/libLLVM.so.19.1")
    begun = stage.environment(config, None)
    assert begun == {"backend": "llvm", "llvm": 19}
    by_path = {"backend": "llvm", "library": old[0]}
    os.remove(old[0])
    new = libraries("b/libLLVM.so.20.1", "b/libLLVM-19.1.7.so", "b/libLLVM.so.19.0")
    for environment in (begun, by_path):
        assert stage.environment(config, environment) == begun  # finished with 19 although 20 would be chosen
        assert stage.same_environment(environment, begun) and stage.same_environment(begun, environment)
        assert not stage.same_environment(environment, stage.environment(config, None))
    assert stage.environment(config, None) == {"backend": "llvm", "llvm": 20}
    assert backend.llvm_library(begun) == backend.llvm_library(by_path) == new[1]
    assert backend.candidates("llvm") == [{"backend": "llvm", "llvm": number} for number in (20, 19)]
    libraries("c/libLLVM-18.so.1")
    with pytest.raises(UserError, match="begun with the backend llvm with LLVM 19"):
        stage.environment(config, by_path)
    with pytest.raises(UserError, match="LLVM 19 is not on this machine"):
        backend.activate(begun)
    probe = RunProbe()
    assert probe.same_environment({"device": "cpu", "renderer": begun}, {"device": "cpu", "renderer": by_path})
    assert not probe.same_environment({"device": "cpu", "renderer": begun}, {"device": "cuda", "renderer": begun})


def test_the_version_of_a_library_is_read_off_its_path(libraries):
    names = {
        "x/libLLVM-14.so.1": 14, "x/libLLVM.so.19.1": 19, "x/libLLVM-15.0.7.so": 15, "llvm-17/lib/libLLVM.so": 17,
        "Cellar/llvm/20.1.8/lib/libLLVM.dylib": 20, "llvm@16/lib/libLLVM.dylib": 16,
    }  # fmt: skip
    for path, version in zip(libraries(*names), names.values(), strict=True):
        assert backend.llvm_backend(path) == {"backend": "llvm", "llvm": version}
    (plain,) = libraries("own/libLLVM.so")
    assert Render().environment(RenderConfig(), None) == {"backend": "llvm", "library": plain}


@pytest.mark.parametrize("visible, number", [(["GPU-a", "GPU-b"], 2), (["GPU-a"], 1), ([], 1)])
def test_one_process_renders_on_each_gpu(monkeypatch, visible, number):
    """Each claims a GPU of its own: test_rendering.py."""
    monkeypatch.setattr(backend, "visible_gpus", lambda: visible)
    assert Render().max_workers(RenderConfig(), {"backend": "cuda"}) == number
    for other in (SCALAR, {"backend": "llvm", "llvm": 19}):
        assert Render().max_workers(RenderConfig(), other) is None
    for device, renderer, most in (
        ("cpu", "cuda", number),
        ("cuda", "cuda", 1),
        ("cuda", "scalar", 1),
        ("cpu", "scalar", None),
    ):
        assert RunProbe().max_workers(None, {"device": device, "renderer": {"backend": renderer}}) == most


def test_summary_tells_samples_errors_and_the_noise_floor(tmp_path, capsys):
    """What ``lightmill show render`` prints, of views whose numbers are given."""

    def view(index, **facts):
        return {"index": index, "status": "ok", "spp": 16, "error": 0.001, "clamped": 0, "stalled": False, **facts}

    pair = {"sum": {"log_error": 0.002, "psnr": 40.0}, "reweighted": [{"log_error": e, "psnr": 30.0} for e in (0.001, 0.005)]}
    metas = {
        "a": [view(0), view(1, spp=64, error=0.003, noise=pair), view(2, spp=64, error=0.002)],
        "b": [view(0, spp=32), view(1, spp=48, error=0.9, clamped=7, stalled=True), view(2, status="dark", spp=64, error=0.0)],
    }
    picture = np.ones((8, 8, 3), np.float32)
    meta = {"index": 0, "spp": 16, "error": None}
    nothing = np.full(picture.shape[:2], -1, np.int32)
    image = encode_view(
        ViewRecord(picture[None], picture, picture, picture, picture[..., 0], picture[..., 0], nothing, nothing, meta)
    )
    records = []
    for id, views in metas.items():
        members = {}
        for facts in views:
            if facts["status"] == "ok":
                members |= dict(zip(view_members(facts["index"]), image.values(), strict=True))
        views = [{**facts, "mean": 0.001} for facts in views]
        noted = {"template": "wall", "variant": "single", "lights": 1, "views": views}
        records.append(("train", Record(id, {**members, "meta.json": pack_json(noted)})))
    draft = FakeArtifact(tmp_path, records)
    Render().finish(RenderConfig(max_spp=64, target_error=0.002), {}, draft)
    for name, value in draft.notes.items():
        commands._summary(name, value)
    assert [line.removeprefix("  summary   ") for line in capsys.readouterr().out.splitlines()] == [
        "views: clamped_values 7, dark 1, ok 5, too_close 0",
        "samples: p0 16.0, p10 22.4, p50 48.0, p90 64.0, p100 64.0",
        "estimated_error: p0 0.001, p10 0.001, p50 0.002, p90 0.5412, p100 0.9",
        "share_over_target_at_max_spp = 0.2",
        "stalled_views = 1",
        "noise_floor.reweighted.log_error: mean 0.003, p10 0.0014, p50 0.003, p90 0.0046",
        "noise_floor.reweighted.psnr: mean 30.0, p10 30.0, p50 30.0, p90 30.0",
        "noise_floor.sum.log_error: mean 0.002, p10 0.002, p50 0.002, p90 0.002",
        "noise_floor.sum.psnr: mean 40.0, p10 40.0, p50 40.0, p90 40.0",
        "noise_floor.views = 1",
    ]


# --- the noise floor --------------------------------------------------------------------------------------------------


def test_pairs_change_no_image_and_are_the_same_on_every_run(tmp_path):
    scene = labelled(clutter(lights=3, cameras=2))
    first, config = rendered(tmp_path / "a", [scene], noise_share=1)
    again, _ = rendered(tmp_path / "b", [scene], noise_share=1)
    without, _ = rendered(tmp_path / "c", [scene], noise_share=0)
    assert first.read("test").members == again.read("test").members
    for index in (0, 1):
        a, b = (decode_view(records.read("test").members, index) for records in (first, without))
        assert (a.lights == b.lights).all()
        assert a.meta.pop("noise") and a.meta == b.meta
    Render().finish(config, {}, first)
    assert first.notes["noise_floor"]["views"] == 2
    # not zero, as it would be if both renders shared their random numbers
    assert first.notes["noise_floor"]["sum"]["log_error"]["p10"] > 1e-4
    Render().finish(RenderConfig(noise_share=0), {}, without)
    assert "render.noise_share" in without.notes["noise_floor"]


def stub(index, status="ok"):
    return SimpleNamespace(meta={"index": index, "status": status})


def test_lot_is_fair_and_depends_on_seed_and_camera_alone(monkeypatch):
    monkeypatch.setattr(noise, "pair_error", lambda a, b, rng: (a.meta["index"], b.meta["index"]))

    def drawn(seed, share, indices):
        views = [stub(index) for index in indices]
        noise.add_pairs(views, lambda chosen: [stub(index) for index in chosen], seed, share)
        return {view.meta["index"] for view in views if view.meta.get("noise") == (view.meta["index"],) * 2}

    counts = {share: [drawn(seed, share, range(4)) for seed in range(500)] for share in (0.0, 0.1, 0.3, 1.0)}
    means = {share: np.mean([len(chosen) / 4 for chosen in each]) for share, each in counts.items()}
    assert means[0.0] == 0 and means[1.0] == 1
    assert means[0.1] == pytest.approx(0.1, abs=0.03) and means[0.3] == pytest.approx(0.3, abs=0.04)
    assert all(few <= more for few, more in zip(counts[0.1], counts[0.3], strict=True))  # a larger share adds views
    assert all(drawn(seed, 0.3, [2]) == counts[0.3][seed] & {2} for seed in range(50))
    dropped = [stub(0, "dark"), stub(1, "too_close")]
    noise.add_pairs(dropped, lambda chosen: pytest.fail("nothing is to be rendered"), 0, 1.0)


def test_noise_floor_is_the_known_noise_of_synthetic_pairs():
    """Gaussian noise on every layer: the error of one image against the truth, for the sum and the reweightings."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.05, 0.2, (3, 96, 96, 3)).astype(np.float32)
    blank = np.zeros((96, 96, 3), np.float32)

    def noisy():
        lights = truth + rng.normal(scale=0.01, size=truth.shape).astype(np.float32)
        nothing = np.full(blank.shape[:2], -1, np.int32)
        return ViewRecord(lights, blank, blank, blank, blank[..., 0], blank[..., 0], nothing, nothing)

    a, b = noisy(), noisy()
    errors = noise.pair_error(a, b, np.random.default_rng(7))
    expected_psnr = -10 * np.log10(3 * 0.01**2)  # three layers
    assert errors["sum"]["psnr"] == pytest.approx(expected_psnr, abs=0.1)
    assert errors["sum"]["log_error"] == pytest.approx(log_error(a.image, truth.sum(axis=0)), rel=0.02)
    again = np.random.default_rng(7)
    assert len(errors["reweighted"]) == noise.REWEIGHTINGS == 4
    for one in errors["reweighted"]:
        factors = noise.draw_light_factors(noise.LIGHTING, again, 3)
        image, clean = noise.relit(a, factors), np.einsum("lhwc,lc->hwc", truth, factors)
        assert one["log_error"] == pytest.approx(log_error(image, clean), rel=0.03)
        assert one["psnr"] == pytest.approx(psnr(clamp(image), clamp(clean)), abs=0.2)
    assert noise.error_of_one(a.image, a.image) == {"log_error": 0.0, "psnr": 100.0}


def test_noise_floor_is_the_true_error_of_a_real_scene():
    scene, kept = clutter(cameras=1), {"backend": SCALAR, "denoise": False}
    (truth,) = path_traced(scene, 24, max_spp=4096, seed=9, **kept)
    (a,), (b,) = (path_traced(scene, 24, max_spp=48, seed=seed, **kept) for seed in (0, 1))
    errors = noise.pair_error(a, b, np.random.default_rng(0))
    assert errors["sum"]["log_error"] == pytest.approx(log_error(a.image, truth.image), rel=0.25)
    rng = np.random.default_rng(0)
    for one in errors["reweighted"]:
        factors = noise.draw_light_factors(noise.LIGHTING, rng, 3)
        true = log_error(noise.relit(a, factors), noise.relit(truth, factors))
        assert one["log_error"] == pytest.approx(true, rel=0.25)


# --- contact sheets ---------------------------------------------------------------------------------------------------


def made_up(id, *, variant="single", lights=2, side=16, statuses=("ok", "dark", "ok"), template="floor"):
    """A record as the stage writes it; view i has the constant radiance 0.1 (i + 1) per light."""
    members, metas = {}, []
    flat = np.ones((side, side), np.float32)
    for index, status in enumerate(statuses):
        meta = {"index": index, "status": status, "spp": 16, "error": 0.0123, "mean": 0.001, "nearest": 0.5, "clamped": 0}
        metas.append(meta)
        if status == "ok":
            colour = np.full((side, side, 3), 0.1 * (index + 1), np.float32)
            face_index = np.arange(flat.size, dtype=np.int32).reshape(flat.shape) - 1
            view = ViewRecord(np.stack([colour] * lights), colour, colour, colour, flat, flat, face_index, face_index, meta)
            members |= encode_view(view)
    noted = {"template": template, "variant": variant, "lights": lights, "views": metas}
    return Record(id, {**members, "meta.json": pack_json(noted)})


class Reads:
    """A draft that remembers what was read from it."""

    def __init__(self, records):
        self.records, self.log = {record.id: record for record in records}, []

    def __call__(self, id, only):
        self.log.append((id, tuple(only)))
        return Record(id, {name: self.records[id].members[name] for name in only})


def test_sheets_read_a_few_scenes_of_a_large_dataset(tmp_path):
    records = [made_up(f"s{number:03}") for number in range(200)] + [made_up("one", variant="multi_patch", template="wall")]
    read = Reads(records)
    ids = [record.id for record in records[:200]]
    sheet.write_sheets(tmp_path, {("floor", "single"): ids, ("wall", "multi_patch"): ["one"]}, read)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "contact-floor.png", "contact-wall.png", "layers-floor.png", "layers-wall.png",
    ]  # fmt: skip
    assert len({id for id, _ in read.log}) == sheet.SCENES + 1
    # of all but the scenes on the layer sheets, the image alone
    assert sum(names[-1].endswith(".aov.exr") for _, names in read.log) == 2
    assert sheet.choose(ids) == sheet.choose(ids[::-1])  # the order does not matter ...
    assert len(set(sheet.choose(ids)) & set(sheet.choose(ids + [f"t{number}" for number in range(20)]))) >= 5  # nor growth


@pytest.mark.parametrize(
    ("side", "lights", "views"), [(8, 1, 1), (64, 8, 4), (200, 11, 4), (30, 2, 11)], ids=["tiny", "default", "large", "many"]
)
def test_sheets_take_any_number_of_pixels_lights_and_views(tmp_path, side, lights, views):
    record = made_up("a", side=side, lights=lights, statuses=("ok",) * views)
    for make in (sheet.contact_sheet, sheet.layer_sheet):
        page = make("floor", {"single": ["a"]}, Reads([record]))
        assert page.width == sheet.Page.WIDTH and page.height < 500


def test_contact_sheet_shows_every_view_and_why_one_was_dropped():
    """Both kept views at their common exposure in their places, between them the grey of the dropped one."""
    page = np.asarray(sheet.contact_sheet("floor", {"single": ["a"]}, Reads([made_up("a")])))
    top = page.shape[0] - sheet.GAP - sheet.LINE - sheet.CELL
    corners = [page[top + 5, sheet.GAP + index * (sheet.CELL + sheet.GAP) + 5] for index in range(3)]
    exposure = 1.0  # brings 0.6, the brighter view, nearest to 0.7
    expected = [sheet.to_picture(np.full(3, value), exposure) for value in (0.2, 0.6)]
    assert (corners[0] == expected[0]).all() and (corners[2] == expected[1]).all()
    assert (corners[1] == sheet.DROPPED).all()


def test_fit_repeats_small_pictures_and_averages_large_ones():
    rng = np.random.default_rng(0)
    small, large = rng.uniform(size=(40, 40, 3)), rng.uniform(size=(200, 200, 3)).astype(np.float32)
    assert (sheet.fit(small)[::3, ::3] == small).all() and sheet.fit(small).shape == (120, 120, 3)
    assert sheet.fit(large).shape == (128, 128, 3)
    assert np.allclose(sheet.fit(large).mean(axis=(0, 1)), large.mean(axis=(0, 1)), atol=2e-3)
    assert sheet.fit(large[..., 0]).shape == (128, 128)
