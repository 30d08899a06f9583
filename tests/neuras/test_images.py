"""Captures of images alone: photos or a video in, poses and points by pycolmap."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.ndimage import gaussian_filter

from pipeline.config import parse
from pipeline.errors import UserError
from pipeline.run import run_pipeline
from pipeline.store.files import hash_file
from stages.graphics.video import frame_count, write_video
from stages.neuras.captures import images
from stages.neuras.records import CaptureInfo, frames, natural, point_sets
from stages.neuras.s00_capture import Capture
from tests.neuras.test_captures import POINT, colmap_model, dot_of, real


def run(path: Path, store: Path, **settings):
    capture = {"name": "images", "path": str(path), **settings}
    root = {"system": "neuras", "stage": "capture", "store": str(store), "workers": 0, "capture": capture}
    return run_pipeline(root, [], out=lambda line: None)["artifacts"]["capture"]


@pytest.fixture
def registered(tmp_path, monkeypatch):
    """A stand-in for pycolmap: it places the six photos of ``colmap_model``, all but the last."""
    made = colmap_model(tmp_path / "made", True)
    jobs = []

    def program(command, **_):
        job = json.loads(Path(command[-1]).read_text())
        pictures = {name: Image.open(Path(job["images"]) / name) for name in job["names"]}
        seen = {name: (picture.size, picture.getexif().get(images.ORIENTATION, 1)) for name, picture in pictures.items()}
        masks = {path.name: np.array(Image.open(path)) for path in Path(job["masks"] or "none").glob("*")}
        jobs.append(job | {"seen": seen, "masks": masks})
        shutil.copytree(made / "sparse", Path(job["folder"]) / "sparse", dirs_exist_ok=True)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(images.subprocess, "run", program)
    monkeypatch.setattr(images, "can_register", lambda: True)
    return made / "images", jobs


def test_photos_get_their_poses_and_one_that_cannot_be_placed_is_rejected(tmp_path, registered):
    photos, jobs = registered
    Image.open(photos / "00.png").rotate(180).save(photos / "lost.png")
    artifact = run(photos, tmp_path / "store")
    found = list(frames(artifact))
    assert len(found) == 6 and artifact.manifest["outputs"]["rejects"] == {"no_pose": 1}
    for frame in found:
        assert np.abs(dot_of(frame) - frame.camera.project(POINT)[0]).max() < 0.12
    assert [record.points.shape for record in point_sets(artifact)] == [(1, 3)]
    assert CaptureInfo.of(artifact).units == "arbitrary" and CaptureInfo.of(artifact).points == "sfm"
    assert jobs[0]["one_camera"] and not jobs[0]["sequential"] and len(jobs[0]["names"]) == 7


def test_files_that_are_no_photos_spare_the_others(tmp_path, registered):
    photos, jobs = registered
    (photos / "._00.png").write_bytes(b"what macOS leaves beside a photo")
    (photos / "broken.jpg").write_bytes(b"no picture")
    Image.new("L", (700, 700)).save(photos / "huge.png")
    artifact = run(photos, tmp_path / "store", max_pixels=400_000)
    rejects = artifact.manifest["outputs"]["rejects"]
    assert len(list(frames(artifact))) == 6 and rejects == {"unreadable": 1, "too_large": 1}
    assert len(jobs[0]["names"]) == 6 and jobs[0]["one_camera"]


def test_photos_that_lie_on_their_side_are_turned_first(tmp_path, registered):
    """As a phone stores them that was held upright: the sensor's rows, and a word of EXIF."""
    photos, jobs = registered
    upright = np.array(Image.open(photos / "02.png"))
    lying = Image.fromarray(np.rot90(upright))
    exif = lying.getexif()
    exif[images.ORIENTATION] = 6  # to be turned clockwise
    lying.save(photos / "02.png", exif=exif)
    cut = (photos / "02.png").read_bytes()
    (photos / "cut.png").write_bytes(cut[: len(cut) - 40])
    artifact = run(photos, tmp_path / "store")
    assert artifact.manifest["outputs"]["rejects"] == {"unreadable": 1}
    frame = next(frame for frame in frames(artifact) if frame.meta["file"] == "02.png")
    assert np.abs(dot_of(frame) - frame.camera.project(POINT)[0]).max() < 0.12 and frame.meta["orientation"] == 6
    assert len(jobs[0]["names"]) == 6 and jobs[0]["one_camera"] and not jobs[0]["masks"]
    assert set(jobs[0]["seen"].values()) == {(upright.shape[1::-1], 1)}
    assert all("orientation" not in frame.meta for frame in frames(artifact) if frame.meta["file"] != "02.png")


@pytest.mark.parametrize("named", ["00.png.png", "00.png"])
def test_masks_beside_the_photos_are_taken(tmp_path, registered, named):
    photos, jobs = registered
    mask = np.full(np.array(Image.open(photos / "00.png")).shape[:2], 255, np.uint8)
    mask[:9] = 0
    (photos / "masks").mkdir()
    Image.fromarray(mask).save(photos / "masks" / named)
    artifact = run(photos, tmp_path / "store")
    found = {frame.meta["file"]: frame.counts() for frame in frames(artifact)}
    assert len(found) == 6 and not found["00.png"][:8].any()
    assert np.array_equal(found["00.png"][40:], found["01.png"][40:]) and found["01.png"][:8].any()
    given = jobs[0]["masks"]  # pycolmap wants one for every photo
    assert set(given) == {f"{name}.png" for name in jobs[0]["names"]} and np.array_equal(given.pop("00.png.png"), mask)
    assert all(other.shape == mask.shape and (other == 255).all() for other in given.values())
    shutil.move(photos / "masks", photos.parent / "masks")  # a model of COLMAP has them beside its images
    by_colmap = next(frames(run(photos.parent, tmp_path / "store", name="colmap")))
    assert np.array_equal(by_colmap.counts(), found["00.png"])


def test_masks_of_no_image_are_told(tmp_path, registered):
    photos, _ = registered
    (photos / "masks").mkdir()
    for name in ("00.png.png", "01.png", "02_mask.png", ".DS_Store"):
        Image.new("L", (160, 120), 255).save(photos / "masks" / name, "PNG")
    config = parse(Capture.Config, {"name": "images", "path": str(photos)}, "capture")
    (note,) = images.read(config, photos).notes
    assert note.startswith("1 of the files in masks/ belong to no image, such as 02_mask.png")


def test_photos_of_other_kinds_are_told(tmp_path, registered):
    photos, _ = registered
    for name in ("a.HEIC", "b.heic", "c.webp"):
        (photos / name).write_bytes(b"what a phone wrote")
    config = parse(Capture.Config, {"name": "images", "path": str(photos)}, "capture")
    assert images.read(config, photos).notes == [
        "photos of other kinds were left out (2 .heic, 1 .webp): save them as JPEG or PNG"
    ]
    for path in photos.glob("*.png"):
        path.unlink()
    with pytest.raises(UserError, match="holds 0 photos.*2 .heic"):
        run(photos, tmp_path / "store")


def test_photos_are_taken_in_the_order_that_people_count_in(tmp_path):
    for number in (1, 2, 10, 9, 100):
        Image.new("RGB", (8, 8)).save(tmp_path / f"IMG_{number}.png")
    config = parse(Capture.Config, {"name": "images", "path": str(tmp_path)}, "capture")
    assert [shot.name for shot in images.read(config, tmp_path).shots] == [f"IMG_{n}.png" for n in (1, 2, 9, 10, 100)]
    assert sorted(["b", "a010", "a9" * 3, "a9", "9" * 9000], key=natural) == ["9" * 9000, "a9", "a9a9a9", "a010", "b"]


def test_every_photo_is_part_of_every_key(tmp_path, registered):
    photos, _ = registered
    stage = Capture()

    def items():
        return stage.identity(parse(stage.Config, {"name": "images", "path": str(photos)}, "capture"), hash_file)["items"]

    before = items()
    Image.open(photos / "03.png").rotate(180).save(photos / "03.png")
    turned = items()
    assert len(before) == 7 and all(before[id] != value for id, value in turned.items())  # all poses may be others
    (photos / "masks").mkdir()
    Image.new("L", Image.open(photos / "00.png").size, 255).save(photos / "masks" / "00.png.png")
    masked = items()
    assert all(turned[id] != value for id, value in masked.items())
    shutil.move(photos / "masks" / "00.png.png", photos / "masks" / "01.png.png")
    assert all(masked[id] != value for id, value in items().items())
    shutil.rmtree(photos / "masks")
    exif = Image.Exif()
    exif[images.ORIENTATION] = 3
    Image.open(photos / "03.png").save(photos / "03.png", exif=exif)
    with_word = items()
    assert all(turned[id] != value for id, value in with_word.items())


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_photo_is_turned_as_pillow_turns_it(tmp_path, orientation):
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (6, 9, 3), np.uint8))
    exif = picture.getexif()
    exif[images.ORIENTATION], exif[0x0110] = orientation, "a phone"
    picture.save(tmp_path / "lying.png", exif=exif)
    images._save_turned(Image.open(tmp_path / "lying.png"), orientation, tmp_path / "upright.png")
    upright = Image.open(tmp_path / "upright.png")
    assert np.array_equal(np.array(upright), np.array(ImageOps.exif_transpose(Image.open(tmp_path / "lying.png"))))
    assert upright.getexif()[0x0110] == "a phone" and upright.getexif()[images.ORIENTATION] == 1


def test_odd_photos_are_turned_too(tmp_path, monkeypatch):
    Image.new("RGBA", (9, 6)).save(tmp_path / "photo.jpg", "WEBP")  # called so by whoever saved it
    images._save_turned(Image.open(tmp_path / "photo.jpg"), 6, tmp_path / "upright.jpg")
    assert Image.open(tmp_path / "upright.jpg").size == (6, 9)
    monkeypatch.setattr(Image.Exif, "tobytes", lambda self: 1 / 0)  # as it fails where a byte is damaged
    images._save_turned(Image.open(tmp_path / "photo.jpg"), 6, tmp_path / "again.jpg")
    assert Image.open(tmp_path / "again.jpg").size == (6, 9)


def test_a_change_of_the_unit_registers_once_and_takes_the_frames_over(tmp_path, registered):
    photos, _ = registered
    first, second = run(photos, tmp_path / "store"), run(photos, tmp_path / "store", units="metre")
    assert first.key != second.key and CaptureInfo.of(second).metre == 1
    assert [first.digest_of(row.id) for row in first.rows()] == [second.digest_of(row.id) for row in second.rows()]


def test_a_video_is_cut_into_the_sharpest_frame_of_each_stretch(tmp_path):
    noise = np.random.default_rng(0).uniform(0, 255, (64, 96, 3))
    sharp = {2, 9, 11, 17}  # of four stretches of five

    def pictures():
        for number in range(20):
            picture = gaussian_filter(noise, (0.6, 0.6, 0) if number in sharp else (4, 4, 0))
            picture[:, :24] = 12 * number  # says which it is
            yield picture.astype(np.uint8)

    video = tmp_path / "drive.mp4"
    write_video(video, pictures())
    assert frame_count(video) == 20
    names = images._names(parse(Capture.Config, {"name": "images", "path": str(video), "video_frames": 4}, "capture"), video)
    images._cut(video, tmp_path, names)
    left = [np.array(Image.open(tmp_path / name))[:, 4:20].mean() / 12 for name in names]
    assert np.round(left).astype(int).tolist() == sorted(sharp)


def test_what_holds_no_images_is_told(tmp_path):
    with pytest.raises(UserError, match="a folder of photos or a video"):
        run(tmp_path / "none", tmp_path / "store")
    Image.new("RGB", (8, 8)).save(tmp_path / "one.png")
    with pytest.raises(UserError, match="holds 1 photos.*at least 3"):
        run(tmp_path, tmp_path / "store")
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with pytest.raises(UserError, match="no video that can be read"):
        run(tmp_path / "film.mp4", tmp_path / "store")


def test_without_pycolmap_it_says_what_to_install(tmp_path, monkeypatch):
    for number in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / f"{number}.png")
    monkeypatch.setattr(images, "can_register", lambda: False)
    with pytest.raises(UserError, match=r"pip install 'lightmill\[images\]'.*capture=colmap"):
        run(tmp_path, tmp_path / "store")


needs_pycolmap = pytest.mark.skipif(not images.can_register(), reason="pycolmap is not installed: the extra 'images'")


@needs_pycolmap
def test_pycolmap_places_real_photos_as_it_did_before(tmp_path, shared_data):
    source = real(shared_data, "caliterra-colmap") / "images"
    (tmp_path / "photos").mkdir()
    for path in sorted(source.iterdir())[4:12]:
        image = Image.open(path)
        image.resize((450, round(450 * image.height / image.width))).save(tmp_path / "photos" / path.name, quality=92)
    once, again = (run(tmp_path / "photos", tmp_path / f"store{number}") for number in range(2))
    assert len(list(frames(once))) == 8 and len(next(point_sets(once)).points) > 300
    apart = [a.camera.camera_to_world - b.camera.camera_to_world for a, b in zip(frames(once), frames(again), strict=True)]
    assert np.abs(apart).max() < 0.01 * CaptureInfo.of(once).radius


@needs_pycolmap
def test_images_that_show_nothing_alike_are_told(tmp_path):
    for number in range(4):
        noise = gaussian_filter(np.random.default_rng(number).uniform(0, 255, (120, 160, 3)), (1, 1, 0))
        Image.fromarray(noise.astype(np.uint8)).save(tmp_path / f"{number}.png")
    with pytest.raises(UserError, match="could place 0 of 4 images.*overlap|take more of them"):
        run(tmp_path, tmp_path / "store")
