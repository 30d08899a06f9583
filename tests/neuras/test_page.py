"""The page's controls, moved as a person moves them: each would fail here if it did nothing."""

from __future__ import annotations

import io
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from stages.graphics.browser import find_browser
from stages.neuras.baking import browser
from stages.neuras.baking.site import write_site
from stages.neuras.records import CaptureInfo, FrameRecord
from tests.neuras import scenes

PLACES = [(4.0, 3.0, 2.0), (4.5, 2.0, 2.0), (5.0, 1.0, 2.0)]
INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "none", "every other")
SIZE = (160, 30)  # of a frame; small pictures without networks, as software OpenGL draws each frame of the page
RED = (230, 20, 20)  # of the photos: no colour of the scene


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    if find_browser() is None:
        pytest.skip("no Chromium: install chromium")
    site, flat = tmp_path_factory.mktemp("site"), scenes.atlas()
    photo = io.BytesIO()
    Image.new("RGB", SIZE, RED).save(photo, "PNG")
    cameras = [scenes.looking_at(place, size=SIZE) for place in PLACES]
    frames = [FrameRecord(f"frame-drive_{n}", camera, photo.getvalue(), "train") for n, camera in enumerate(cameras)]
    write_site(site, replace(scenes.baked(flat, networks=False), rays=2), flat, INFO, frames, (0.1, 100.0), "fp16")
    with browser.opened(site, size=(700, 520)) as page:
        yield page


@pytest.fixture
def page(opened):
    """The page as it is at first."""
    opened.value("if (document.getElementById('compare').checked) document.getElementById('compare').click()")
    opened.value("lightmill.follow('#')")
    return opened


def until(answer, wait_s: float = 60.0):
    """The answer, once it is true. A busy machine draws slowly."""
    end = time.monotonic() + wait_s
    while not (found := answer()):
        assert time.monotonic() < end, "the control did nothing"
        time.sleep(0.02)
    return found


def pose(page) -> dict[str, np.ndarray]:
    """Unit vectors and the eye, with the lane shift in it."""
    return {name: np.array(values) for name, values in page.value("lightmill.camera()").items()}


def moved(page, before: dict[str, np.ndarray]) -> np.ndarray:
    """How far the eye is from where it was."""
    return pose(page)["eye"] - before["eye"]


def redrawn(page, before: np.ndarray) -> np.ndarray:
    """The canvas, once it is another picture than ``before``."""

    def other():
        picture = page.canvas()
        return (picture,) if picture.shape != before.shape or not np.array_equal(picture, before) else None

    return until(other)[0]


def red(page) -> float:
    """The share of the canvas that shows the photo."""
    left, top, width, height = (round(value) for value in page.place("#view"))
    seen = page.screenshot()[top : top + height, left : left + width - 250].astype(int)  # less the panel
    return float((np.abs(seen - RED).max(axis=2) < 12).mean())


def test_the_mouse_turns_the_camera_and_never_rolls_it(page):
    before, picture = pose(page), page.canvas()
    page.drag((200, 240), (300, 240))
    redrawn(page, picture)
    turned = pose(page)
    assert np.arccos(turned["back"] @ before["back"] / 1.0) == pytest.approx(0.3 * np.hypot(*before["back"][:2]), abs=0.02)
    assert turned["back"][2] == pytest.approx(before["back"][2], abs=1e-6)  # to the side alone
    assert (np.cross(before["back"], turned["back"])[2] < 0) and np.allclose(turned["eye"], before["eye"])
    page.drag((200, 240), (200, 300))
    tilted = until(lambda: after if not np.allclose((after := pose(page))["back"], turned["back"]) else None)
    assert np.arccos(tilted["back"] @ turned["back"]) == pytest.approx(0.18, abs=0.01)
    assert tilted["back"][2] > turned["back"][2] and tilted["right"][2] == pytest.approx(0, abs=1e-6)
    page.ask("Input.dispatchMouseEvent", type="mouseMoved", x=400, y=400)  # no button is down
    assert np.allclose(pose(page)["back"], tilted["back"])


def distance(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """From the point to the line from a to b."""
    share = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return float(np.linalg.norm(point - a - share * (b - a)))


KEYS = [("w", "back", -1), ("s", "back", 1), ("a", "right", -1), ("d", "right", 1), ("q", "world", -1), ("e", "world", 1),
        ("ArrowUp", "back", -1), ("ArrowDown", "back", 1), ("ArrowLeft", "right", -1), ("ArrowRight", "right", 1)]  # fmt: skip


@pytest.mark.parametrize("key, axis, sign", KEYS, ids=[key for key, _, _ in KEYS])
def test_a_key_moves_the_camera_its_own_way_while_it_is_down(page, key, axis, sign):
    before, picture = pose(page), page.canvas()
    with page.held(key):
        until(lambda: np.linalg.norm(moved(page, before)) > 0.05)
    step = moved(page, before)
    assert np.allclose(step / np.linalg.norm(step), sign * (before | {"world": np.array([0, 0, 1.0])})[axis], atol=1e-6)
    redrawn(page, picture)
    assert np.array_equal(moved(page, before), step)  # it is up


def test_shift_is_four_times_as_fast(page):
    length = "Math.hypot(...lightmill.pose.eye.map((x, i) => x - before[i]))"
    step = f"(() => {{ const before = lightmill.pose.eye; lightmill.move(0.1); return {length}; }})()"
    with page.held("d"):
        slow = page.value(step)
    with page.held("Shift", "D"):
        fast = page.value(step)
    assert slow == pytest.approx(0.6) and fast == pytest.approx(4 * slow)


def test_the_drive_goes_along_the_frames_until_it_is_stopped(page):
    start, picture = pose(page), page.canvas()
    ends = [np.array(frame["camera_to_world"])[:3, 3] for frame in page.value("lightmill.scene.frames")]
    page.click("#drive")
    until(lambda: np.linalg.norm(moved(page, start)) > 0.05)
    assert page.value("document.getElementById('drive').ariaPressed") == "true"
    redrawn(page, picture)
    page.click("#drive")
    assert page.value("document.getElementById('drive').ariaPressed") == "false"
    stopped = pose(page)["eye"]
    picture = page.canvas()
    assert min(distance(stopped, *ends[number : number + 2]) for number in range(2)) < 1e-5
    page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert np.array_equal(pose(page)["eye"], stopped)


def test_a_frame_that_is_chosen_ends_the_drive(page):
    page.click("#drive")
    page.click("#next")
    page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert np.allclose(pose(page)["eye"], PLACES[1], atol=1e-5)
    assert page.value("document.getElementById('drive').ariaPressed") == "false"


@pytest.mark.parametrize("shift", [-3, -2, 2, 3])
def test_a_button_shifts_the_lane_and_zero_shifts_it_back(page, shift):
    before, picture = pose(page), page.canvas()
    page.click(f'[data-shift="{shift}"]')
    redrawn(page, picture)
    assert np.allclose(moved(page, before), shift * before["right"])
    pressed = "[...document.querySelectorAll('#shifts [aria-pressed=true]')].map((button) => button.dataset.shift)"
    assert page.value(pressed) == [str(shift)]
    page.click('[data-shift="0"]')
    until(lambda: np.array_equal(page.canvas(), picture))
    assert page.value(pressed) == ["0"]


def test_the_slider_says_how_much_of_the_photo_is_seen(page):
    assert red(page) < 0.01
    page.click("#compare")
    half = until(lambda: share if (share := red(page)) > 0.1 else None)
    left, top, width, height = page.place("#split")
    place = [(left + width * share, top + height / 2) for share in (0.2, 0.5, 0.7)]
    page.drag(place[1], place[2])
    until(lambda: red(page) > half + 0.1)
    page.drag(place[2], place[0])
    until(lambda: 0.05 < red(page) < half - 0.15)
    page.click("#compare")
    until(lambda: red(page) < 0.01)


def test_buttons_and_the_list_jump_between_frames(page):
    picture = page.canvas()
    page.click("#next")
    second = redrawn(page, picture)
    assert np.allclose(pose(page)["eye"], PLACES[1], atol=1e-5)
    page.click("#previous")
    redrawn(page, second)
    page.click("#previous")
    until(lambda: np.allclose(pose(page)["eye"], PLACES[2], atol=1e-5))
    choose(page, "frames", 1)
    until(lambda: np.allclose(pose(page)["eye"], PLACES[1], atol=1e-5))
    assert page.value("document.getElementById('photo').src").endswith("drive_1.jpg")


def choose(page, list: str, index: int) -> None:
    """An entry of a list, by the keyboard."""
    page.value(f"document.getElementById('{list}').focus()")
    for _ in range(10):
        at = page.value(f"document.getElementById('{list}').selectedIndex")
        if at == index:
            return
        with page.held("ArrowDown" if at < index else "ArrowUp"):
            pass
    raise AssertionError(f"the list {list} does not move")


def test_lists_choose_what_is_shown(page):
    pictures = [page.canvas()]
    for mode in range(1, 6):
        choose(page, "mode", mode)
        pictures.append(redrawn(page, pictures[-1]))
    choose(page, "mode", 2)  # skyboxes only
    until(lambda: np.array_equal(page.canvas(), pictures[2]))
    alone = [pictures[2]]
    for skybox in (1, 2, 3):
        choose(page, "skybox", skybox)
        alone.append(redrawn(page, alone[-1]))
    pictures += alone[1:]
    assert len({picture.tobytes() for picture in pictures}) == len(pictures) == 9


def test_smooth_edges_are_means_of_four_rays(page):
    smooth = page.canvas().astype(float)
    page.click("#smooth")
    hard = redrawn(page, smooth).astype(float)
    page.click("#smooth")
    until(lambda: np.array_equal(page.canvas(), smooth))
    apart = np.abs(smooth - hard).max(axis=2)
    assert 0.001 < (apart > 20).mean() < 0.1 and np.median(apart) <= 2  # silhouettes alone
    assert np.abs(np.diff(smooth, axis=1)).max() <= np.abs(np.diff(hard, axis=1)).max()


def test_the_wireframe_is_lines_over_what_lies_behind(page):
    picture = page.canvas()
    page.click("#wireframe")
    lines = redrawn(page, picture)
    assert 0.02 < (lines != picture).any(axis=2).mean() < 0.9
    page.click("#wireframe")
    until(lambda: np.array_equal(page.canvas(), picture))


def test_a_link_is_followed_and_the_time_of_a_frame_is_told(page):
    page.value("location.hash = '#frame=2&shift=3'")
    until(lambda: np.allclose(pose(page)["eye"] - 3 * pose(page)["right"], PLACES[2], atol=1e-5))
    page.value("location.hash = ''")
    assert page.value("document.getElementById('timing').textContent").endswith("fps")
