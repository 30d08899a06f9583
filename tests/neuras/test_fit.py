"""Stage fit on a capture of a painted ball under a sky."""

from __future__ import annotations

import dataclasses
import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from model.neuras.baked import Baked
from model.neuras.losses import vgg_file
from model.neuras.sampling import Pyramid
from pipeline.errors import UserError
from pipeline.plan import plan_stage
from pipeline.stage import Record
from pipeline.store.draft import Draft
from pipeline.store.files import hash_file
from stages.graphics.arrays import pack_json
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.graphics.page import png
from stages.neuras import s04_fit
from stages.neuras.evaluation.renderers import Reference
from stages.neuras.records import FRAME, CaptureInfo, FrameRecord, save
from stages.neuras.s04_fit import Fit, FitStageConfig
from tests.model.lpips import write_weights
from tests.neuras import scenes

CONFIG = FitStageConfig(
    steps=40, patch=4, patches=64, codes=64, sky_side=16, network_lr=0.01, sky_near_m=20, sky_far_m=80, skyboxes=3,
    checkpoint_every=15, log_every=10, pictures=1, block=2,
)  # fmt: skip


def frame(number: int, split: str, flat) -> FrameRecord:
    """From 6 units away, around the ball: colours are those of places on it, and of directions beside it."""
    angle = number / 4
    back = np.array([np.cos(angle), np.sin(angle), 0.3]) / np.sqrt(1.09)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = 6 * back
    camera = Camera.from_fov(40, 32, 60, pose)
    seen = Caster(flat.vertices, flat.faces).view(camera)
    places = seen.interpolate(flat.faces, flat.vertices)
    colours = np.where(seen.hit[..., None], 0.5 + 0.4 * np.sin(2 * places), 0.5 + 0.3 * camera.directions())
    buffer = io.BytesIO()
    Image.fromarray(np.round(255 * colours).astype(np.uint8)).save(buffer, "png")
    return FrameRecord(f"{FRAME}{number:03d}", camera, buffer.getvalue(), split)


class Folder:
    """An artifact of records and files, as stages read it."""

    def __init__(self, path, records=()):
        self.path, self.records = path, {record.id: record for record in records}
        (path / "files").mkdir(parents=True)

    def rows(self):
        return [SimpleNamespace(id=id) for id in sorted(self.records)]

    def read(self, id):
        return self.records[id]

    def file(self, name):
        return self.path / "files" / name


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    root, flat = tmp_path_factory.mktemp("inputs"), scenes.atlas()
    records = [frame(i, "test" if i == 5 else "validation" if i == 9 else "train", flat).to_record() for i in range(12)]
    capture, atlas = Folder(root / "capture", records), Folder(root / "atlas")
    info = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 8.0, "none", "by hand")
    capture.file("capture.json").write_bytes(pack_json(info.to_json()))
    save(atlas.file("atlas.npz"), flat)
    return {"capture": capture, "scaffold": Folder(root / "scaffold", [Record("mesh", {})]), "atlas": atlas}


def draft(path) -> Draft:
    return Draft(path, "fit", "0" * 64, {}, out=lambda text: None)


def run(path, inputs, config=CONFIG):
    made = draft(path)
    products = Fit().run(config, inputs, made)
    return made, {name: (made.files / name).read_bytes() for name in products}


def test_files_of_a_fit(tmp_path, inputs):
    made, products = run(tmp_path, inputs)
    assert sorted(products) == ["model.json", "model.safetensors", "poses.json"]
    assert json.loads(products["poses.json"]) == {}
    baked = Baked.load(made.files)
    flat = scenes.atlas()
    assert baked.mesh_size == Pyramid(flat.width, flat.height, 3).sheet and baked.sky_size == (3, 16)
    assert (baked.sky_half_sizes[0] >= 20).all() and (baked.sky_half_sizes[-1] >= 80).all()
    assert made.summary["fitting"]["psnr"] > 24
    curve = (made.files / "curve.csv").read_text().splitlines()
    assert curve[0].startswith("step,") and len(curve) == 1 + 4 + 1  # four intervals and the validation
    picture = Image.open(made.files / "validation" / "step-0000040.png")
    assert picture.size == (40, 64)
    assert (made.files / "curve.png").exists() and any((made.files / "tensorboard").iterdir())
    assert "seconds" not in json.dumps(json.loads(products["model.json"]))


def test_cameras_are_those_that_were_refined(tmp_path, inputs):
    """A capture whose poses are off, refined to the true ones, gives the same scene."""
    whole = run(tmp_path / "true", inputs)[1]
    poses, wrong = {}, []
    for record in inputs["capture"].records.values():
        photo = FrameRecord.from_record(record)
        if photo.split == "train":
            poses[photo.id] = photo.camera.camera_to_world.tolist()
            photo = dataclasses.replace(photo, camera=photo.camera.moved(np.array([0.3, 0.0, 0.0])))
        wrong.append(photo.to_record())
    capture = Folder(tmp_path / "capture", wrong)
    capture.file("capture.json").write_bytes(inputs["capture"].file("capture.json").read_bytes())
    scaffold = Folder(tmp_path / "scaffold", [Record("mesh", {"poses.json": pack_json(poses)})])
    refined = run(tmp_path / "refined", {**inputs, "capture": capture, "scaffold": scaffold})[1]
    assert refined["model.safetensors"] == whole["model.safetensors"]
    assert json.loads(refined["poses.json"]) == poses
    assert run(tmp_path / "wrong", {**inputs, "capture": capture})[1]["model.safetensors"] != whole["model.safetensors"]


@pytest.mark.parametrize("focal, side", [(274.0, 256), (657.0, 512), (10.0, 64), (400.0, 384)])
def test_texels_of_the_sky_follow_the_photos(focal, side):
    assert FitStageConfig().fit(1.0, focal).sky_side == side
    assert FitStageConfig(sky_side=100).fit(1.0, focal).sky_side == 100


def test_the_unseen_frame_is_rendered_well(tmp_path, inputs):
    baked, flat, unseen = Baked.load(run(tmp_path, inputs)[0].files), scenes.atlas(), frame(5, "test", scenes.atlas())
    rgb, truth = Reference(baked, flat).render(unseen.camera), unseen.image() / 255
    assert -10 * np.log10(np.square(rgb - truth).mean()) > 24
    assert -10 * np.log10(np.square(truth.mean(axis=(0, 1)) - truth).mean()) < 15


def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path, inputs, monkeypatch):
    from model.neuras import fitting

    whole = run(tmp_path / "whole", inputs)[1]
    step = fitting.Trainer.train_step

    def until_20(self, batch):
        if self.step == 20:
            raise KeyboardInterrupt
        step(self, batch)

    monkeypatch.setattr(fitting.Trainer, "train_step", until_20)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "cut", inputs)
    monkeypatch.setattr(fitting.Trainer, "train_step", step)
    assert run(tmp_path / "cut", inputs)[1] == whole


def test_photos_of_other_exposure_leave_the_scene_as_it_is(tmp_path, inputs):
    """Every other training photo is dark or bright: with the option, the unseen frame comes out as without the trouble."""
    flat, truth = scenes.atlas(), frame(5, "test", scenes.atlas())

    def exposed(record, gain):
        picture = io.BytesIO()
        Image.fromarray(np.clip(record.image() * gain, 0, 255).astype(np.uint8)).save(picture, "png")
        return dataclasses.replace(record, picture=picture.getvalue())

    records = [exposed(frame(i, "train", flat), (0.7, 1.3)[i % 2]).to_record() for i in range(12) if i != 5]
    capture = Folder(tmp_path / "capture", records)
    capture.file("capture.json").write_bytes(inputs["capture"].file("capture.json").read_bytes())

    def error(name, **settings):
        made, _ = run(tmp_path / name, inputs | {"capture": capture}, CONFIG.model_copy(update=settings))
        return np.square(Reference(Baked.load(made.files), flat).render(truth.camera) - truth.image() / 255).mean()

    assert error("with", exposure=True, steps=120) < 0.7 * error("without", steps=120)


def test_without_training_frames_it_says_so(tmp_path, inputs):
    only_tests = Folder(tmp_path / "capture", [inputs["capture"].records[f"{FRAME}005"]])
    only_tests.file("capture.json").write_bytes(inputs["capture"].file("capture.json").read_bytes())
    with pytest.raises(UserError, match="no training frame"):
        run(tmp_path / "out", {**inputs, "capture": only_tests})


# -- the perceptual loss by VGG


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    write_weights(folder, "vgg")
    return folder


def with_vgg(folder, **values) -> FitStageConfig:
    chosen = {
        "perceptual_network": "vgg",
        "perceptual": 0.01,
        "lpips_folder": str(folder),
        "patch": 16,
        "patches": 4,
        "steps": 6,
    }
    return FitStageConfig(**{**CONFIG.model_dump(), **chosen, "checkpoint_every": 2, **values})


def test_vgg_enters_the_fit_and_its_key_by_content(tmp_path, inputs, weights, monkeypatch):
    config = with_vgg(weights)
    made, products = run(tmp_path / "vgg", inputs, config)
    rows = [json.loads(text) for text in (made.state / "log.jsonl").read_text().splitlines()]
    assert rows[0]["perceptual"] > 0
    assert run(tmp_path / "again", inputs, config)[1] == products
    without = with_vgg(weights, perceptual_network="gradients")
    assert run(tmp_path / "gradients", inputs, without)[1]["model.safetensors"] != products["model.safetensors"]

    def key(config: FitStageConfig) -> str:
        return plan_stage("neuras", Fit(), config, {}, hash_file).key

    other = tmp_path / "other"
    other.mkdir()
    file_of_vgg = vgg_file(weights)
    (other / file_of_vgg.name).write_bytes(file_of_vgg.read_bytes())
    assert key(with_vgg(other)) == key(config) != key(without)
    with (other / file_of_vgg.name).open("ab") as file:
        file.write(b"0")
    assert key(with_vgg(other)) != key(config)
    with pytest.raises(ValueError, match="lightmill weights lpips"):
        key(with_vgg(tmp_path))
    assert key(with_vgg(tmp_path, perceptual_network="gradients")) == key(without)  # which looks for no weights


def test_masked_pixels_teach_nothing_through_vgg(tmp_path, inputs, weights):
    def spoiled(value: int):
        records = {}
        for id, record in inputs["capture"].records.items():
            frame = FrameRecord.from_record(record)
            image, mask = frame.image().copy(), np.full(frame.image().shape[:2], 255, np.uint8)
            image[4:14, 8:20], mask[4:14, 8:20] = value, 0
            records[id] = dataclasses.replace(frame, picture=png(image), mask=png(mask)).to_record()
        capture = Folder(tmp_path / f"capture{value}", records.values())
        capture.file("capture.json").write_bytes(inputs["capture"].file("capture.json").read_bytes())
        return {**inputs, "capture": capture}

    black, white = (run(tmp_path / f"{value}", spoiled(value), with_vgg(weights))[1] for value in (0, 255))
    assert black["model.safetensors"] == white["model.safetensors"]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"layers": 1}, "layers=1"),
        ({"sky_far_m": 10}, "sky_far_m=10"),
        ({"perceptual_network": "vgg", "perceptual": 0.1}, "patch=8 is too small for VGG16.*patch=32 patches=8"),
        ({"perceptual_network": "vgg", "patch": 32}, "perceptual=0"),
    ],
)
def test_settings_that_cannot_be_are_refused(values, words):
    with pytest.raises(ValidationError, match=words):
        FitStageConfig(**values)


def test_every_setting_reaches_the_loop():
    """A field of the loop that the stage forgot would silently keep its default."""
    from model.neuras.scene import FitConfig, ShaderConfig

    names = {field.name for kind in (FitConfig, ShaderConfig) for field in dataclasses.fields(kind)}
    assert names - set(FitStageConfig.model_fields) == {"shader", "voxel"}
    assert FitStageConfig(voxel_m=0.5).fit(metre=2.0, focal=300).voxel == 1.0


def test_photos_that_do_not_fit_into_memory_are_told_before_they_are_read(monkeypatch):
    cameras = [Camera.from_fov(4000, 3000, 60, np.eye(4))] * 50
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=30e9))
    with pytest.raises(UserError, match=r"44 GB of memory, and 30 GB are free.*capture.max_side"):
        s04_fit._check_memory(cameras, on_cpu=True)
    s04_fit._check_memory(cameras, on_cpu=False)  # half of it is on the device
