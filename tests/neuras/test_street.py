"""The made-up street: what stands in it, where cameras and LiDAR are, and how its frames look."""

import io

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from stages.graphics.casting import Caster
from stages.graphics.mitsuba import backend
from stages.neuras.street import lidar
from stages.neuras.street.cameras import poses
from stages.neuras.street.city import City, make
from stages.neuras.street.settings import StreetConfig
from stages.neuras.street.source import StreetSource, prepare

SMALL = StreetConfig(
    length=90, training_frames=4, texture_size=128, width=96, height=54, spp=2, beams=12, columns=90, shift_frames=2
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("street")
    prepare(SMALL, path)
    return path


@pytest.fixture(scope="module")
def source(folder):
    backend.activate(backend.choose(), threads=1)
    return StreetSource(SMALL, folder)


@pytest.fixture(scope="module")
def caster(folder):
    return Caster(*City.load(folder).mesh())


def test_the_default_street_is_large_and_varied():
    config = StreetConfig()
    city = make("street", config.seed, config.length, 64)
    _, faces = city.mesh()
    assert len(faces) >= 200_000 and city.houses >= 40
    walls = {group.name for group in city.groups if group.name.startswith("wall")}
    assert len(walls) >= 12 and len(city.groups) >= 60
    assert {group.kind for group in city.groups} == {"matt", "satin", "gloss", "metal"}


@pytest.mark.parametrize("preset", ["street", "drone"])
def test_a_seed_gives_one_place_and_another_seed_another(preset):
    first, again, other = (make(preset, seed, 90, 64) for seed in (0, 0, 1))
    for a, b in zip(first.groups, again.groups, strict=True):
        assert a.name == b.name
        for name in ("vertices", "faces", "uvs", "texture"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(first.sky, again.sky)
    assert other.mesh()[0].shape != first.mesh()[0].shape
    assert np.abs(other.sky - first.sky).mean() > 0.01


def test_a_saved_city_reads_back(folder):
    made, read = make("street", SMALL.seed, SMALL.length, SMALL.texture_size), City.load(folder)
    np.testing.assert_array_equal(made.mesh()[0], read.mesh()[0])
    assert [group.kind for group in made.groups] == [group.kind for group in read.groups] and made.houses == read.houses


def test_the_default_drive_keeps_its_promises():
    config = StreetConfig()
    frames = poses(config)
    x = {
        split: np.array([p.camera.position[0] for p in frames if p.split == split]) for split in ("train", "test", "validation")
    }
    assert len(x["train"]) == 24 and np.ptp(x["train"]) >= 45 and np.diff(x["train"]).max() <= 3.0
    assert len(x["test"]) >= 8 and len(x["validation"]) >= 3
    held_out = np.concatenate([x["test"], x["validation"]])
    assert np.abs(held_out[:, None] - x["train"]).min() >= 0.99  # halfway between, not beside
    for shift in (-3.0, -2.0, 2.0, 3.0):
        lane = [p for p in frames if p.shift == shift]
        assert len(lane) == 5 and {p.split for p in lane} == {"shift"}
        drive = min(
            (p for p in frames if p.trajectory == "drive"), key=lambda p: abs(p.camera.position[0] - lane[2].camera.position[0])
        )
        offset = (lane[2].camera.position - drive.camera.position) @ drive.camera.camera_to_world[:3, 0]
        assert offset == pytest.approx(shift, abs=0.05)  # to the right


def test_a_flight_holds_out_half():
    frames = poses(StreetConfig(preset="drone", length=200))
    splits = [p.split for p in frames]
    assert splits.count("train") == 24 and splits.count("test") + splits.count("validation") == 24
    down = [p.camera.camera_to_world[2, 2] for p in frames]
    assert sum(value > 0.999 for value in down) == 24 and min(down) < 0.8


@pytest.mark.parametrize("preset", ["street", "drone"])
def test_no_sweep_is_near_a_held_out_frame(preset):
    config = StreetConfig(preset=preset)
    held_out = np.array([p.camera.position for p in poses(config) if p.split in ("test", "validation")])
    sensors = lidar.sensors(config)
    distance = np.linalg.norm((sensors[:, None] - held_out)[..., : 2 if preset == "street" else 3], axis=2)
    assert len(sensors) >= 10 and distance.min() >= 1.0


def test_no_camera_stands_inside_anything(caster):
    for pose in poses(SMALL):
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        face, _, distance = caster.cast(np.broadcast_to(pose.camera.position, around.shape), around)
        assert distance[face >= 0].min() > 0.7, pose.id
        face, _, distance = caster.cast(pose.camera.position[None], np.array([[0, 0, -1.0]]))
        assert distance[0] == pytest.approx(1.6, abs=0.05), pose.id  # the road, no roof of a car


def test_lidar_lies_on_surfaces(source, caster):
    record = source.points("points-sweep_0003")
    assert len(record.points) > 300
    rays = record.points - record.sensor
    distance = np.linalg.norm(rays, axis=1)
    _, _, true = caster.cast(np.broadcast_to(record.sensor, rays.shape), rays / distance[:, None])
    error = np.abs(true - distance)
    assert np.median(error) == pytest.approx(0.02 * 0.674, rel=0.25) and np.quantile(error, 0.98) < 0.1
    assert distance.max() < lidar.REACH["street"] + 0.2
    np.testing.assert_array_equal(record.points, source.points("points-sweep_0003").points)


def test_items_need_no_folder(source):
    items = StreetSource(SMALL).items()
    assert items == source.items() and len({id for id, _ in items}) == len(items)
    assert {group for _, group in items} == {"train", "validation", "test", "shift", "points"}
    with pytest.raises(ValueError, match="prepare"):
        StreetSource(SMALL).points("points-sweep_0000")


def test_a_frame_is_rich_and_the_same_in_any_worker(source, folder):
    id = "frame-drive_0003"
    frame = source.frame(id)
    image = frame.image()
    out = io.BytesIO()
    Image.fromarray(image).save(out, "JPEG", quality=90)
    assert 8 * len(out.getvalue()) / image[..., 0].size > 1.8  # bits a pixel
    assert 60 < image.mean() < 190 and (image < 8).all(axis=2).mean() < 0.05  # neither dark nor full of holes
    again = StreetSource(SMALL, folder)
    again.frame("frame-drive_0001")
    assert again.frame(id).picture == frame.picture


def test_depth_agrees_with_the_lidar(source):
    frame = source.frame("frame-drive_0002")
    points = source.points("points-sweep_0003").points
    pixels, ahead = frame.camera.project(points)
    inside = (ahead > 1) & (pixels > 1).all(axis=1) & (pixels < [95, 53]).all(axis=1)
    column, row = pixels[inside].astype(int).T
    distance = np.linalg.norm(points[inside] - frame.camera.position, axis=1)
    assert inside.sum() > 30
    assert np.median(np.abs(frame.depth[row, column] - distance) / distance) < 0.05


@pytest.mark.parametrize(
    "wrong, says",
    [({"shifts": [4.0]}, "parked cars"), ({"length": 90, "training_frames": 40}, "length="), ({"spacing": 2.0}, "1.5")],
)
def test_settings_that_make_no_sense_are_told(wrong, says):
    with pytest.raises(ValidationError, match=says):
        StreetConfig(**wrong)


# --- objects ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("thing", ["car", "house", "tree"])
def test_an_object_is_seen_whole_from_all_sides_and_scanned(thing, tmp_path):
    config = StreetConfig(
        preset="object", object=thing, texture_size=64, width=40, height=40, fov_deg=40, training_frames=6, spp=2, columns=60
    )
    prepare(config, tmp_path)
    backend.activate(backend.choose(), threads=1)
    source = StreetSource(config, tmp_path)
    ids = [id for id, _ in source.items()]
    splits = [split for _, split in source.items()]
    assert splits.count("train") == 6 and splits.count("test") + splits.count("validation") == 6
    positions = []
    for id in [id for id in ids if id.startswith("frame-")][::4]:
        frame = source.frame(id)
        positions.append(frame.camera.position)
        border = np.ones((40, 40), bool)
        border[1:-1, 1:-1] = False
        assert (frame.image()[border] > 250).mean() > 0.99 and (frame.depth[border] == 0).all()  # white around it
        seen = frame.depth > 0
        assert seen.mean() > 0.05 and frame.image()[seen].mean() < 250
    assert np.ptp(np.array(positions), axis=0).min() > 2
    _, faces = City.load(tmp_path).mesh()
    points = source.points(next(id for id in ids if id.startswith("points-"))).points
    assert len(faces) > 1000 and len(points) > 100
    assert source.mesh() is None and source.info().source["object"] == thing


def test_the_true_mesh_ends_where_the_lidar_does(folder):
    given = StreetSource(SMALL.model_copy(update={"true_mesh": True}), folder).mesh()
    vertices, faces = City.load(folder).mesh()
    assert 0.5 * len(faces) < len(given.faces) < len(faces)
    places = np.array([pose.camera.position for pose in poses(SMALL) if pose.split == "train"])
    assert np.abs(given.vertices[:, :2] - places.mean(axis=0)[:2]).max() < 160 < np.abs(vertices[:, :2]).max()
