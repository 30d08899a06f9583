"""What photos know beyond the textures is shown near them and fades away from them, by torch, OpenGL and the page alike."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pipeline.errors import UserError
from stages.graphics.browser import find_browser
from stages.graphics.cameras import Camera
from stages.neuras.baking import browser, drawing, residuals
from stages.neuras.baking.residuals import LEAST, MASKED, Residuals
from stages.neuras.baking.site import sizes, write_site
from stages.neuras.evaluation.renderers import Reference
from stages.neuras.records import CaptureInfo, FrameRecord
from tests.neuras import scenes

PLACES = [(4.0, 3.0, 2.0), (4.3, 2.6, 2.0), (4.6, 2.2, 2.0), (4.8, 1.8, 2.0), (5.0, 1.4, 2.0), (5.1, 1.0, 2.0)]
RANGE = (0.1, 100.0)
INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "none", "every other")
CENTRE = (5e4, -4e5, 30.0)  # of the world: single precision knows it to centimetres alone


def moved(place: Sequence[float], size: tuple[int, int] = (96, 64)) -> Camera:
    return scenes.looking_at(tuple(np.add(CENTRE, place)), CENTRE, size)


def turned(camera: Camera) -> Camera:
    """So far to the side that it looks neither alike nor quite elsewhere."""
    pose = camera.camera_to_world.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 60, degrees=True).as_matrix()
    return replace(camera, camera_to_world=pose)


class World:
    """A scene whose photos are its own pictures, changed by ``change(picture, number)``, values in [0, 255]. aside: numbers of
    photos that are `turned`."""

    def __init__(
        self, site: Path, change, masks=None, nearest: int = 4, angle: float = 5.0, size=(96, 64), rays: int = 1, aside=()
    ):
        self.atlas = scenes.atlas(centre=CENTRE)
        self.baked = replace(scenes.baked(self.atlas, centre=CENTRE), rays=rays)
        self.plain = Reference(self.baked, self.atlas)
        self.frames = []
        for number, place in enumerate(PLACES):
            camera = turned(moved(place, size)) if number in aside else moved(place, size)
            picture = np.clip(np.rint(change(255 * self.plain.render(camera), number)), 0, 255).astype(np.uint8)
            mask = None if masks is None else _png(np.uint8(255) * masks(picture.shape[:2], number))
            self.frames.append(FrameRecord(f"frame-drive_{number}", camera, _png(picture), "train", mask=mask))
        site.mkdir(parents=True, exist_ok=True)
        self.residuals = Residuals.make(site, self.plain, self.frames, self.baked.sky_centre, RANGE, 0.001, 5.0, nearest, angle)
        self.both = Reference(self.baked, self.atlas, self.residuals)
        self.site = site


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def half(picture: np.ndarray, number: int) -> np.ndarray:
    """Into the middle of the range, so that nothing is cut off, and a little brighter."""
    return 64 + picture / 2 + 12


def test_where_a_photo_was_taken_the_view_is_the_photo(tmp_path):
    world = World(tmp_path, half)
    for frame in (world.frames[0], world.frames[3]):
        drawn, photo = world.both.render(frame.camera), frame.image() / 255
        inner = (slice(3, -3), slice(3, -3))  # its border fades
        assert np.abs(drawn - photo)[inner].max() < 1.2 / 255
        assert np.abs(world.plain.render(frame.camera) - photo)[inner].mean() > 10 / 255


def test_between_photos_the_view_is_nearer_to_the_truth_and_far_beside_it_is_that_of_the_textures(tmp_path):
    """The change is of the surface itself, so it is right from everywhere; only nearby is it shown."""
    world = World(tmp_path, half, angle=10)
    gains = []
    for place in [(4.15, 2.8, 2.0), (4.0, 2.4, 2.6), (2.0, 5.0, 2.0)]:
        camera = moved(place)
        truth = np.clip(half(255 * world.plain.render(camera), 0), 0, 255) / 255
        on_mesh = world.plain.caster.view(camera).hit
        errors = [np.abs(one.render(camera) - truth)[on_mesh].mean() for one in (world.plain, world.both)]
        gains.append(errors[1] / errors[0])
    assert gains[0] < 0.5 and gains[0] < gains[1] < gains[2] and gains[2] > 0.98


def test_a_view_depends_on_no_photo_that_is_masked_and_on_none_that_sees_something_else(tmp_path):
    def white(picture, number):
        return np.full_like(picture, 255) if number == 2 else picture

    masked = World(tmp_path / "a", white, masks=lambda shape, number: np.full(shape, number != 2, np.uint8))
    camera = masked.frames[2].camera
    assert (masked.residuals.source(2).depths == MASKED).all()
    assert np.abs(masked.both.render(camera) - masked.plain.render(camera)).max() < 1.1 / 255
    seen = World(tmp_path / "b", white)
    behind = moved((-4.6, -2.2, -2.0))  # the other side of the ball, which no photo shows
    on_mesh = seen.plain.caster.view(behind).hit
    assert np.array_equal(seen.both.render(behind)[on_mesh], seen.plain.render(behind)[on_mesh])
    assert np.abs(seen.both.render(camera) - 1)[3:-3, 3:-3].max() < 0.51  # residuals reach half of the range


def test_no_photo_comes_or_goes_at_once(tmp_path):
    residuals = World(tmp_path, half).residuals
    path = np.linspace(np.add(PLACES[0], (0.1, 0.3, 0)), PLACES[-1], 2001)
    turns = np.linspace(0, np.pi, len(path))  # meanwhile the view turns until it looks away
    before = None
    for eye, turn in zip(path, turns, strict=True):
        look = Rotation.from_euler("z", turn).apply(moved(PLACES[0]).forward)
        weights = np.zeros(len(PLACES))
        chosen, shares = residuals.chosen(eye, look)
        weights[chosen] = shares
        assert weights.sum() == pytest.approx(1) and len(chosen) == 4
        assert before is None or np.abs(weights - before).max() < 0.05
        before = weights


def test_photos_that_look_elsewhere_come_behind_those_that_look_alike(tmp_path):
    residuals = World(tmp_path, half, nearest=2).residuals
    camera = moved(PLACES[2])
    eye = camera.position - np.array(CENTRE)
    assert residuals.chosen(eye, camera.forward)[0] == [2, 3]
    residuals.looks[[2, 3]] *= -1
    assert residuals.chosen(eye, camera.forward)[0] == [1, 4]
    assert residuals.chosen(eye, -camera.forward)[0] == [2, 3]


def test_a_photo_alone_fades_where_it_weighs_little(tmp_path):
    """Between `LEAST` and nothing a photo's share falls in proportion."""
    world = World(tmp_path, half, masks=lambda shape, number: np.full(shape, number == 3, np.uint8))
    gains = []
    for share in (0.0, 0.5, 0.9, 1.0):
        camera = moved(tuple(np.add(PLACES[0], share * np.subtract(PLACES[1], PLACES[0]))))
        chosen, weights = world.residuals.chosen(camera.position - np.array(CENTRE), camera.forward)
        weight = dict(zip(chosen, weights, strict=True)).get(3, 0)
        added = np.abs(world.both.render(camera) - world.plain.render(camera)).mean()
        gains.append((weight, added))
    assert all(added == 0 for weight, added in gains if weight == 0)
    small = [(weight, added) for weight, added in gains if 0 < weight < LEAST]
    assert len(small) >= 1 and all(added < 0.02 for _, added in small)


def test_exposure_is_no_part_of_a_residual(tmp_path):
    world = World(tmp_path / "a", lambda picture, number: picture)
    frames = []
    for number, frame in enumerate(world.frames):
        picture = np.clip(frame.image() * (0.6 + 0.05 * number) + 20, 0, 255)
        frames.append(replace(frame, picture=_png(np.rint(picture).astype(np.uint8))))
    for exposure, most in ((True, 3), (False, 100)):
        made = Residuals.make(
            tmp_path / str(exposure), world.plain, frames, world.baked.sky_centre, RANGE, 0.001, 5.0, 4, 5.0, exposure
        )
        away = np.abs(made.source(1).values.astype(int) - 128)
        assert (np.percentile(away, 99) <= most) == exposure or not exposure and np.percentile(away, 50) > 10


def test_the_angle_is_the_largest_that_held_out_frames_bear(tmp_path):
    """What is the surface's own is right from everywhere. What is a photo's own is wrong elsewhere."""

    def own(picture: np.ndarray, number: int) -> np.ndarray:
        return picture + checkered(0 * picture, number) - 64

    def no_change(picture: np.ndarray, _: int) -> np.ndarray:
        return picture

    near, far = [(4.15, 2.8, 2.0), (4.7, 2.0, 2.0)], [(3.6, 3.6, 2.5), (5.2, 1.2, 3.0)]
    for change, truth, places, expected in (
        (half, half, far, 10),
        (half, half, near, 5),  # no more than these frames can tell
        (own, no_change, far, 5),
    ):
        world = World(tmp_path / f"{change.__name__}-{places[0][0]}", change)
        held_out = []
        for place in places:
            picture = np.rint(truth(255 * world.plain.render(moved(place)), 0)).astype(np.uint8)
            held_out.append(FrameRecord(f"frame-drive_{len(held_out)}", moved(place), _png(picture), "validation"))
        assert world.residuals.fit_angle(world.plain, held_out, world.baked.sky_centre) == expected
        assert world.residuals.about["angle"] == world.residuals.angle == pytest.approx(np.radians(expected))
    camera = held_out[0].camera
    away = Camera(*list(vars(camera).values())[:6], camera.camera_to_world @ np.diag([-1.0, 1, -1, 1]))
    masked = replace(held_out[0], mask=_png(np.zeros((64, 96), np.uint8)))
    blind = [replace(held_out[0], camera=away), masked]  # they see no mesh, or nothing that counts
    assert not world.plain.caster.view(away).hit.any()
    world.residuals.fit_angle(world.plain, held_out, world.baked.sky_centre)
    before = world.residuals.angle
    assert world.residuals.fit_angle(world.plain, blind + held_out, world.baked.sky_centre) == np.degrees(before)
    for none in ([], blind):
        assert world.residuals.fit_angle(world.plain, none, world.baked.sky_centre) is None
    assert world.residuals.angle == before


def test_the_same_photos_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        World(tmp_path / name, half)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.png"))
    assert len(files) == 2 * len(PLACES)
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_a_site_that_was_tampered_with_is_refused(tmp_path):
    world = World(tmp_path / "site", half)
    about = world.residuals.about
    folder = tmp_path / "site" / residuals.FOLDER
    for name in ("../frames/x", "/etc/x", "a/b", ""):
        with pytest.raises(UserError, match="outside of its folder"):
            Residuals(folder, about | {"sources": [about["sources"][0] | {"name": name}]})
    with pytest.raises(UserError, match="not of the size"):
        Residuals(folder, about | {"sources": [about["sources"][0] | {"width": 4000}]}).source(0)


SHOWN = [(4.15, 2.8, 2.0), (4.6, 2.2, 2.2), (4.9, 1.2, 1.9), (5.1, 1.0, 2.0)]


def checkered(picture: np.ndarray, number: int) -> np.ndarray:
    """A pattern of the photo's own, so that the wrong photo or place is seen."""
    rows, columns = np.indices(picture.shape[:2])
    return 64 + picture / 2 + 25 * np.sin(rows / 5 + number)[..., None] + 25 * np.sin(columns / 7)[..., None]


def test_opengl_draws_what_torch_computes(tmp_path, monkeypatch):
    """With fewer layers than photos, so that layers are used again."""
    try:
        drawing.context().release()
    except UserError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(residuals, "LAYERS", 4)
    world = World(tmp_path, checkered, aside=(1, 2))
    assert world.residuals.layers == 4 < len(PLACES)
    with drawing.Drawing(world.baked, world.atlas, *RANGE, residuals=world.residuals) as scene:
        for place in [*SHOWN, SHOWN[0]]:
            truth, drawn = world.both.render(moved(place)), scene.render(moved(place))
            difference = np.abs(drawn - truth).max(axis=2) * 255
            assert np.abs(truth - world.plain.render(moved(place))).mean() > 0.02
            assert np.median(difference) < 0.6 and (difference > 4).mean() < 0.01


def test_the_page_draws_what_torch_computes_and_can_do_without(tmp_path):
    if find_browser() is None:
        pytest.skip("no Chromium: install chromium")
    world = World(tmp_path, checkered, size=(160, 120), aside=(1, 2))
    shown = [FrameRecord(f"frame-held_{n}", moved(place, (160, 120)), _png(np.zeros((120, 160, 3), np.uint8)), "test")
             for n, place in enumerate(SHOWN)]  # fmt: skip
    write_site(tmp_path, world.baked, world.atlas, INFO, shown, RANGE, "fp16", photos=world.residuals)
    assert sizes(tmp_path)["residuals"] > 10_000
    assert np.array_equal(Residuals.load(tmp_path).eyes, world.residuals.eyes)
    images, _ = browser.pictures(tmp_path, [f"frame={n}" for n in range(len(SHOWN))])
    for frame, image in zip(shown, images, strict=True):
        difference = np.abs(image - 255 * world.both.render(frame.camera)).max(axis=2)
        assert np.median(difference) < 1.2 and (difference > 8).mean() < 0.03
    with browser.opened(tmp_path, "still=1") as page:
        page.value("lightmill.follow('#still=1&frame=0')")
        page.until(browser.SETTLED)
        page.value("document.getElementById('residuals').click()")
        page.value("lightmill.draw()")
        difference = np.abs(page.canvas() - 255 * world.plain.render(shown[0].camera)).max(axis=2)
        assert np.median(difference) < 1.2 and (difference > 8).mean() < 0.03
