"""A surface and cameras that were disturbed go back to where the photos say they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.stage import Item, Record
from stages.graphics.arrays import pack_arrays, pack_json
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.graphics.page import png
from stages.neuras.records import FrameRecord, Mesh, refined_poses, scaffold_mesh
from stages.neuras.s02_refine import Refine, RefineConfig
from stages.neuras.surfaces import photometric, surfels
from stages.neuras.surfaces.photometric import Photo, Settings

POSITIONS = [(-0.8, -0.6, 4.0), (0.0, -0.8, 4.1), (0.8, -0.6, 4.0), (-0.5, 0.7, 4.0), (0.6, 0.6, 4.2)]
SETTINGS = Settings(vertices=True, blurs=(2.0, 1.0), rounds=3, stride=1, smoothness=3.0, closeness=0.01)


class Folder:
    """An artifact of records, as stages read it."""

    def __init__(self, *records: Record):
        self.records = {record.id: record for record in records}

    def rows(self) -> list[Record]:
        return list(self.records.values())

    def read(self, id: str) -> Record:
        return self.records[id]


def hills(side: int = 25) -> Mesh:
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-2.5, 2.5, side)] * 2))
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    squares = np.stack([first, first + 1, first + side + 1, first + side], axis=1)
    height = 0.25 * np.sin(1.3 * x) * np.cos(1.1 * y)
    faces = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    return Mesh(np.stack([x, y, height], axis=1).astype(np.float32), faces.astype(np.int32))


def painted(mesh: Mesh, camera: Camera) -> Photo:
    """A photo of the mesh with waves of many lengths as its colour."""
    view = Caster(mesh.vertices, mesh.faces).view(camera)
    x, y, _ = np.moveaxis(camera.position + camera.directions() * view.depth[..., None], -1, 0)
    rng = np.random.default_rng(0)
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-14, 14, (24, 3))]
    grey = np.where(view.hit, 0.5 + 0.07 * np.sum(waves, axis=0), 0.0)
    image = np.repeat(np.round(255 * np.clip(grey, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)
    return Photo(camera, image, np.ones(image.shape[:2], bool))


@pytest.fixture(scope="module")
def truth() -> tuple[Mesh, list[Photo]]:
    mesh, photos = hills(), []
    for number, position in enumerate(POSITIONS):
        pose = np.eye(4)
        pose[:3, 3] = position
        camera = photometric.moved(Camera.from_fov(96, 80, 40, pose), np.array([0.02, -0.03, 0.05 * number, 0, 0, 0]))
        photos.append(painted(mesh, camera))
    return mesh, photos


def errors(mesh: Mesh, true: Mesh) -> float:
    """Root mean square of heights, away from the border that no two photos see."""
    inner = np.abs(true.vertices[:, :2]).max(axis=1) < 1.2
    return float(np.sqrt(np.square(mesh.vertices[inner, 2] - true.vertices[inner, 2]).mean()))


def off(cameras: list[Camera], photos: list[Photo], points: np.ndarray) -> float:
    """Pixels that ``points`` appear away from where they are, less what all cameras share."""
    moves = [
        (camera.project(points)[0] - photo.camera.project(points)[0]) for camera, photo in zip(cameras, photos, strict=True)
    ]
    return float(np.sqrt(np.square(np.array(moves) - np.mean(moves, axis=0)).mean()))


def bumped(mesh: Mesh) -> Mesh:
    x, y, z = mesh.vertices.T
    return Mesh(np.stack([x, y, z + 0.12 * np.exp(-2 * (x**2 + y**2))], axis=1).astype(np.float32), mesh.faces)


def shaken(photos: list[Photo]) -> list[Photo]:
    rng = np.random.default_rng(3)
    motions = np.concatenate([rng.normal(0, 0.012, (len(photos), 3)), rng.normal(0, 0.01, (len(photos), 3))], axis=1)
    return [
        replace(photo, camera=photometric.moved(photo.camera, motion)) for photo, motion in zip(photos, motions, strict=True)
    ]


def test_a_bump_that_the_photos_lack_goes(truth):
    mesh, photos = truth
    found, cameras = photometric.refine(bumped(mesh), photos, replace(SETTINGS, cameras=False))
    assert errors(bumped(mesh), mesh) > 0.03
    assert errors(found, mesh) < 0.3 * errors(bumped(mesh), mesh)
    assert all(np.array_equal(a.camera_to_world, b.camera.camera_to_world) for a, b in zip(cameras, photos, strict=True))


def test_the_true_surface_stays(truth):
    mesh, photos = truth
    found, cameras = photometric.refine(mesh, photos, replace(SETTINGS, least_gain=0.0))
    assert errors(found, mesh) < 0.004
    assert off(cameras, photos, mesh.vertices.astype(float)) < 0.1


def test_where_nothing_is_to_be_gained_nothing_moves(truth):
    mesh, photos = truth
    lines = []
    found, cameras = photometric.refine(mesh, photos, replace(SETTINGS, rounds=1, least_gain=0.5), lines.append)
    assert found is mesh and all(camera is photo.camera for camera, photo in zip(cameras, photos, strict=True))
    assert "nothing is moved" in lines[-1]


def test_shaken_cameras_agree_again(truth):
    mesh, photos = truth
    wrong = shaken(photos)
    points = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 1].astype(float)
    found, cameras = photometric.refine(mesh, wrong, replace(SETTINGS, vertices=False))
    assert np.array_equal(found.vertices, mesh.vertices)
    before = off([photo.camera for photo in wrong], photos, points)
    assert before > 1.0 and off(cameras, photos, points) < 0.15 * before


def test_both_at_once(truth):
    mesh, photos = truth
    points = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 1].astype(float)
    found, cameras = photometric.refine(bumped(mesh), shaken(photos), replace(SETTINGS, rounds=5))
    assert off(cameras, photos, points) < 0.4 * off([photo.camera for photo in shaken(photos)], photos, points)


def test_a_held_out_photo_is_aligned_by_what_may_be_looked_at(truth):
    mesh, photos = truth
    wrong = shaken(photos)[0]
    half = np.arange(96) < 48
    changed = np.where(half[:, None], wrong.image, 255 - wrong.image)  # the other half says nothing
    camera = photometric.align(Photo(wrong.camera, changed, np.tile(half, (80, 1))), mesh, photos[1:], SETTINGS)
    points = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 1].astype(float)
    away = [np.abs(one.project(points)[0] - photos[0].camera.project(points)[0]).mean() for one in (wrong.camera, camera)]
    assert away[1] < 0.25 * away[0]


def test_a_camera_without_a_photo_follows_those_beside_it(truth):
    _, photos = truth
    before = [photo.camera for photo in photos]
    same = [photometric.moved(camera, np.array([0.01, 0.02, -0.03, 0.1, 0.2, 0.3])) for camera in before]
    led = photometric.follow(before[0].moved(np.array([0.1, 0.1, 0.0])), before, same)
    wanted = photometric.moved(before[0].moved(np.array([0.1, 0.1, 0.0])), np.array([0.01, 0.02, -0.03, 0.1, 0.2, 0.3]))
    assert np.allclose(led.camera_to_world, wanted.camera_to_world, atol=1e-9)
    alone = [same[0], *before[1:]]
    assert np.allclose(photometric.follow(before[0], before, alone).position, same[0].position, atol=2e-3)
    assert np.allclose(photometric.follow(before[4], before, alone).camera_to_world, before[4].camera_to_world, atol=1e-3)


SHIFT = np.array([[0, 0, 0, 0.3], [0, 0, 0, -0.1], [0, 0, 0, 0.2], [0, 0, 0, 0]])  # of a pose, in the world


def test_a_camera_follows_those_that_look_alike(truth):
    """On the next line of a flight cameras look the other way, and what is ahead for them is behind for it."""
    _, photos = truth
    here = photos[0].camera
    back = here.camera_to_world.copy()
    back[:3, :2] *= -1  # half a turn about the axis that it looks along
    other_line = [replace(here, camera_to_world=back).moved(np.array([0.02 * n, 0.0, 0.0])) for n in range(1, 4)]
    own_line = [here.moved(np.array([0.5 * n, 0.0, 0.0])) for n in range(1, 3)]
    before = [*other_line, *own_line]
    after = [replace(camera, camera_to_world=camera.camera_to_world + SHIFT) for camera in before]
    assert np.allclose(photometric.follow(here, before, after).camera_to_world - here.camera_to_world, SHIFT, atol=1e-9)
    assert photometric.follow(here, other_line, after[:3]) is here


def test_the_stage_moves_cameras_and_those_of_held_out_frames_with_them(truth):
    mesh, photos = truth
    scaffold = Folder(Record("mesh", {"mesh.npz": pack_arrays(vars(mesh)), "mesh.json": pack_json({"faces": {}})}))

    def refined(photos: list[Photo]) -> dict[str, np.ndarray]:
        """The training photos, and the first one once more as a test photo that shows nothing."""
        pictures = [(f"frame-{n}", photo, photo.image, "train") for n, photo in enumerate(photos)]
        pictures.append(("frame-held_out", photos[0], 0 * photos[0].image, "test"))
        records = [FrameRecord(id, photo.camera, png(image), split).to_record() for id, photo, image, split in pictures]
        (record,) = Refine().process((RefineConfig(stride=1, least_gain=0.5), Folder(*records), scaffold), Item("mesh"))
        assert record.members["mesh.npz"] == scaffold.read("mesh").members["mesh.npz"]
        return refined_poses(Folder(record))

    assert refined(photos) == {}
    wrong = shaken(photos)
    poses, points = refined(wrong), mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 1].astype(float)
    cameras = [replace(photo.camera, camera_to_world=poses[f"frame-{n}"]) for n, photo in enumerate(wrong)]
    assert off(cameras, photos, points) < 0.3 * off([photo.camera for photo in wrong], photos, points)
    assert np.abs(poses["frame-held_out"] - poses["frame-0"]).max() < 1e-3


def test_surfels_that_training_photos_see_through_go(truth):
    """One patch over the surface that photos do not show. A held-out photo of another colour says nothing."""
    mesh, photos = truth
    places = np.array([[0.1, 0.0, 1.2], [-0.2, 0.1, -50.0]])  # over the surface; where none looks
    squares = surfels.at_points(places, places + [0, 0, 1.0], 0.3)
    whole = Mesh.joined(mesh, squares)
    members = {"mesh.npz": pack_arrays(vars(whole)), "mesh.json": pack_json({"faces": {"surfels": 4}})}
    pictures = [(f"frame-{n}", photo, photo.image, "train") for n, photo in enumerate(photos)]
    pictures.append(("frame-held_out", photos[0], 0 * photos[0].image, "test"))
    records = [FrameRecord(id, photo.camera, png(image), split).to_record() for id, photo, image, split in pictures]
    kept = {}
    for flag in (True, False):
        config = RefineConfig(cameras=False, surfels=flag)
        (record,) = Refine().process((config, Folder(*records), Folder(Record("mesh", members))), Item("mesh"))
        kept[flag] = scaffold_mesh(Folder(record))
    assert (kept[False].faces == whole.faces).all()
    expected = Mesh.compact(whole.vertices, np.delete(whole.faces, [len(mesh.faces), len(mesh.faces) + 1], axis=0))
    assert (kept[True].faces == expected.faces).all() and np.allclose(kept[True].vertices, expected.vertices)


def test_exposure_pulls_at_nothing(truth):
    mesh, photos = truth
    bright = [replace(photo, image=np.round(photo.image * (1 - 0.08 * n)).astype(np.uint8)) for n, photo in enumerate(photos)]
    found, _ = photometric.refine(mesh, bright, replace(SETTINGS, cameras=False))
    assert errors(found, mesh) < 0.006


def test_derivatives_of_pixels_are_those_of_small_steps(truth):
    mesh, photos = truth
    camera, points, step = photos[1].camera, mesh.vertices[::7].astype(float), 1e-6
    _, by_point, by_motion = photometric.project(camera, points)
    for axis in range(3):
        change = (camera.project(points + step * np.eye(3)[axis])[0] - camera.project(points - step * np.eye(3)[axis])[0]) / (
            2 * step
        )
        assert np.allclose(by_point[:, :, axis], change, atol=1e-5)
    for k in range(6):
        ahead, behind = (photometric.moved(camera, sign * step * np.eye(6)[k]) for sign in (1, -1))
        change = (ahead.project(points)[0] - behind.project(points)[0]) / (2 * step)
        assert np.allclose(by_motion[:, :, k], change, atol=1e-4)


def test_the_pull_is_the_slope_of_the_difference(truth):
    mesh, photos = truth
    pair = [photos[0], shaken(photos)[1]]
    levels = [photometric.normalised(photo, 2.0) for photo in pair]

    def total(camera: Camera) -> float:
        made = photometric.differences(mesh, [pair[0].camera, camera], levels, {0: [1]}, 1)
        return made.difference * made.count

    made = photometric.differences(mesh, [photo.camera for photo in pair], levels, {0: [1]}, 1)
    for k in range(3):
        step = 1e-4 * np.eye(6)[k]
        slope = (total(photometric.moved(pair[1].camera, step)) - total(photometric.moved(pair[1].camera, -step))) / 2e-4
        assert -2 * made.motion_pull[1, k] / photometric.ROBUST**2 == pytest.approx(slope, rel=0.1, abs=0.02 * made.count)


def test_the_same_bytes_twice(truth):
    mesh, photos = truth
    (one, first), (two, second) = (
        photometric.refine(bumped(mesh), shaken(photos), replace(SETTINGS, rounds=1)) for _ in range(2)
    )
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert all(a.camera_to_world.tobytes() == b.camera_to_world.tobytes() for a, b in zip(first, second, strict=True))
