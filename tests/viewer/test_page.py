"""The viewer's page in a real browser, led as a person leads it."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from pipeline.status import RunState
from pipeline.store import Store
from stages import systems
from stages.graphics import browser
from stages.graphics.exr import decode_lights
from stages.graphics.tonemap import TONE_MAPPERS, srgb_decode, to_picture
from stages.renderformer.dataset import decode_sample
from stages.renderformer.inference.renderer import Renderer
from stages.renderformer.records import SceneRecord
from stages.viewer.command import viewer_of
from stages.viewer.server import Server
from tests.viewer import stores

pytestmark = pytest.mark.filterwarnings("ignore::stages.renderformer.inference.renderer.LimitWarning")
SPACE, MODEL = "lightmill.spaces[0]", "lightmill.spaces[0].model"
SETTLED = "lightmill.settled()"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    if browser.find_browser() is None:
        pytest.skip("no Chromium: install chromium")
    root = tmp_path_factory.mktemp("viewer") / "store"
    return root, stores.renderformer(root), stores.neuras(root)


@pytest.fixture(scope="module")
def opened(store):
    viewer = viewer_of(str(store[0]), systems=list(systems()))
    with Server(viewer) as server:
        server.serve_in_background()
        with browser.opened(server.address, (1280, 720), 60) as page:
            page.until("!!globalThis.lightmill")
            yield page
        server.shutdown()


@pytest.fixture
def page(opened):
    """The page; in the end nothing may stand in the console."""
    yield opened
    problems = opened.problems()
    assert not problems, problems


def go(page, address: str) -> None:
    page.value(f"lightmill.go({address!r})")
    page.until(SETTLED)


def press(page, selector: str) -> None:
    """Scroll there, and click."""
    page.until(f"!!document.querySelector({selector!r})")
    page.value(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
    page.click(selector)


def slide(page, selector: str, share: float) -> str:
    """Drag a slider's thumb to that share of its way; what it says then."""
    page.value(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
    left, top, width, height = page.place(selector)
    now = page.value(f"(({{min, max, value}}) => (value - min) / (max - min))(document.querySelector({selector!r}))")
    along = [left + 8 + (width - 16) * at for at in (now, share)]
    page.drag((along[0], top + height / 2), (along[1], top + height / 2))
    page.until(SETTLED)
    return page.value(f"document.querySelector({selector!r}).parentElement.querySelector('output').textContent")


def choose(page, selector: str, value: str) -> None:
    """An entry of a list."""
    fire = "list.dispatchEvent(new Event('change'))"
    page.value(f"((list) => {{ list.value = {value!r}; {fire}; }})(document.querySelector({selector!r}))")
    page.until(SETTLED)


def colour(page, selector: str, value: str) -> None:
    """A colour of a colour field, as if it was chosen in the browser's own window."""
    fire = "input.dispatchEvent(new Event(kind, {bubbles: true}))"
    page.value(
        f"((input) => {{ input.value = {value!r}; for (const kind of ['input', 'change']) {fire}; }})"
        f"(document.querySelector({selector!r}))"
    )
    page.until(SETTLED)


def levels_apart(page, canvas: str, radiance: np.ndarray, exposure: float, mapper: str = "none") -> int:
    """Largest difference between a canvas and a linear image, in steps of 1/255."""
    return int(np.abs(page.canvas(canvas).astype(int) - to_picture(radiance, exposure, mapper)).max())


# -- clicking through


def test_every_stage_of_both_systems_is_a_few_clicks_away(page, store):
    _, rf, neuras = store
    for artifact in [*rf.values(), *neuras.values()]:
        go(page, "#/")
        press(page, f'a.card[href="#/artifact/{artifact.name}"]')
        page.until(f"document.querySelector('h1')?.textContent.startsWith('{artifact.stage}: ')")
        page.until(SETTLED)
        if artifact.ids():
            id = artifact.ids()[0]
            press(page, f'.ids a[href="#/record/{artifact.name}/{id}"]')
            page.until(f"document.querySelector('h1')?.textContent === {id!r}")
            page.until(SETTLED)
        page.until("document.querySelectorAll('.panel').length > 1")
        assert page.value("document.querySelectorAll('.failure').length") == 0, artifact.name


def test_the_graph_leads_from_an_artifact_to_what_it_was_made_from(page, store):
    go(page, f"#/artifact/{store[1]['render'].name}")
    press(page, f'.graph a[href="#/artifact/{store[1]["scene"].name}"]')
    page.until("document.querySelector('h1')?.textContent.startsWith('scene: ')")


def test_a_reject_is_shown_with_the_mesh_that_it_was_made_from(page, store):
    go(page, f"#/artifact/{store[1]['decimate'].name}")
    press(page, f'a[href="#/reject/{store[1]["decimate"].name}/ball-1"]')
    page.until(f"document.querySelector('h1')?.textContent === 'ball-1' && {SPACE}?.panes?.length === 2")
    page.until(SETTLED)
    assert "kept 1 % of it" in page.value("document.querySelector('main').textContent")


def test_a_running_stage_is_followed(page, store):
    made = Store(store[0])
    key = "ab" * 32
    draft = made.draft("render", key, {"stage": "render", "version": 1, "params": {}, "inputs": {}})
    claim = made.claim("render", key)
    assert claim.take()
    try:
        state = RunState(draft.path, total=20, done=5, reused=0, parts=5)
        state.add_rejects({"dark": 2})
        state.update(now=True)
        go(page, "#/")
        page.until("document.querySelector('#runs')?.textContent.includes('5 of 20 items')")
        assert "2 dark" in page.value("document.querySelector('#runs').textContent")
        state.update(now=True, done=6)
        page.until("document.querySelector('#runs').textContent.includes('6 of 20 items')")
        assert page.value("document.querySelector('#runs progress').value") == 6
    finally:
        claim.release()
        shutil.rmtree(draft.path)
    page.until("document.querySelector('#runs').childElementCount === 0")  # the page follows that, too


def test_what_does_not_exist_is_told_on_the_page(page, store):
    go(page, f"#/record/{store[1]['shard'].name}/nobody")
    page.until("document.querySelector('.failure')?.textContent.includes('there is no record')")
    refused = [problem for problem in page.problems() if "400 (Bad Request)" in problem]
    assert len(refused) == 1  # the browser's own line; the page has none
    page.forget(refused)


def test_curves_pages_and_the_baked_site_are_shown(page, store):
    go(page, f"#/artifact/{store[1]['train'].name}")
    assert page.value("document.querySelectorAll('svg polyline').length") == 2
    go(page, "#/runs")
    page.until("document.querySelectorAll('svg polyline').length >= 2")
    go(page, f"#/artifact/{store[2]['bake'].name}")
    site = page.value("document.querySelector('iframe').src")
    back = page.value("location.href")
    page.ask("Page.navigate", url=site)  # a page without an origin: it cannot be looked into from outside
    page.until("document.documentElement?.dataset.ready === 'true'")
    page.ask("Page.navigate", url=back)
    page.until("!!globalThis.lightmill?.go")


# -- pictures


def test_lights_relight_the_stored_image_exactly(page, store):
    artifact = store[1]["render"]
    lights, _ = decode_lights(artifact.read("test-000000").members["view0.exr"])
    go(page, f"#/record/{artifact.name}/test-000000")
    exposure, canvas = page.value(f"{SPACE}.view.exposure"), f"{SPACE}.view.canvas"
    assert page.value(f"{SPACE}.over.firstChild === {canvas} && !{SPACE}.over.hidden")  # it lies over its camera
    assert levels_apart(page, canvas, lights.sum(axis=0), exposure) <= 1
    before = page.canvas(canvas)
    amount = float(slide(page, "#light-0", 0.6).removeprefix("×"))
    assert 2 < amount < 3 and not np.array_equal(page.canvas(canvas), before)
    colour(page, "#colour-0", "#ff8040")
    gains = np.ones((len(lights), 3))
    gains[0] = amount * srgb_decode(np.array([255, 128, 64]) / 255)
    relit = np.einsum("lhwc,lc->hwc", lights, gains)
    for number, mapper in enumerate(TONE_MAPPERS):
        choose(page, "#mapper", mapper)
        assert page.value(f"{SPACE}.view.mapper") == number
        assert levels_apart(page, canvas, relit, exposure, mapper) <= 1
    stops = slide(page, "#exposure", 0.4)
    assert levels_apart(page, canvas, relit, 2.0 ** float(stops.removesuffix(" EV")), mapper) <= 1


def test_other_outputs_of_the_renderer_are_shown(page, store):
    artifact = store[1]["shard"]
    sample = decode_sample(artifact.read("test-000000"))
    go(page, f"#/record/{artifact.name}/test-000000")
    canvas, view = f"{SPACE}.view.canvas", sample.views[0]
    choose(page, "#layer", "albedo")
    assert levels_apart(page, canvas, view.albedo, 1) <= 1
    choose(page, "#layer", "normal")
    shown = np.clip(np.round((0.5 + 0.5 * view.normal) * 255), 0, 255).astype(int)
    assert np.abs(page.canvas(canvas) - shown).max() <= 1
    choose(page, "#layer", "object")
    picture = page.canvas(canvas).reshape(-1, 3)
    colours = {number: {tuple(pixel) for pixel in picture[view.object.ravel() == number]} for number in np.unique(view.object)}
    assert all(len(seen) == 1 for seen in colours.values()) and len(set.union(*colours.values())) == len(colours)


def test_cameras_are_stepped_through_by_key_and_outside_nothing_is_stored(page, store):
    go(page, f"#/record/{store[1]['render'].name}/test-000000")
    page.value(f"{SPACE}.panes[0].viewport.canvas.focus()")
    for key, camera in (("]", 1), ("]", 2), ("[", 1), ("[", 0)):
        with page.held(key):
            pass
        page.until(f"{SPACE}.eye === {camera}")
    page.until(SETTLED)
    with page.held("0"):
        pass
    page.until(f"{SPACE}.eye === null && {SPACE}.over.hidden")


# -- meshes


def drawn(page, pane: int = 0) -> np.ndarray:
    """What a pane shows, once it was drawn."""
    page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.canvas(f"{SPACE}.panes[{pane}].viewport.canvas")


def test_panes_turn_together_and_colours_rungs_and_wires_change_them(page, store):
    go(page, f"#/record/{store[1]['decimate'].name}/ball-0")
    assert page.value(f"{SPACE}.panes.length") == 3
    before = [drawn(page, pane) for pane in range(3)]
    left, top, width, height = page.place("canvas.space")
    page.drag((left + width / 2, top + height / 2), (left + width / 2 + 60, top + height / 2 + 20))
    turned = [drawn(page, pane) for pane in range(3)]
    assert all(not np.array_equal(a, b) for a, b in zip(before, turned, strict=True))
    pictures = [turned[2]]
    slide(page, "#rung", 1.0)
    pictures.append(drawn(page, 2))
    assert "192" in page.value(f"{SPACE}.panes[2].name.textContent")
    for mode in ("normals", "area", "smallest angle", "hidden (1) or seen (0)", "crossing another face (1)"):
        choose(page, "#mode", mode)
        page.until(f"{SPACE}.told.textContent.trim() === ''")
        pictures.append(drawn(page, 2))
    page.click("#wire")
    pictures.append(drawn(page, 2))
    different = {picture.tobytes() for picture in pictures}
    assert len(different) >= len(pictures) - 1  # nothing may cross and nothing be hidden: both one colour
    page.click("#turntable")
    spinning = drawn(page, 0)
    page.until(f"{SPACE}.turning !== null")
    page.value("new Promise((done) => setTimeout(done, 150))")
    assert not np.array_equal(drawn(page, 0), spinning)
    page.click("#turntable")


def test_a_capture_shows_the_photo_over_the_surface_by_a_slider(page, store):
    go(page, f"#/record/{store[2]['capture'].name}/frame-drive_1")
    page.until(f"{SPACE}.photo.complete && !{SPACE}.over.hidden")
    assert page.value(f"{SPACE}.photo.naturalWidth") == 32
    page.until(f"{SPACE}.panes[0].viewport.counts.points === 50")
    page.until(f"{SPACE}.panes[0].viewport.counts.surface === {3 * len(stores.scenes.atlas().faces)}")
    assert slide(page, "#opacity", 0.5) != "100 %"
    assert 0.3 < float(page.value(f"{SPACE}.over.style.opacity")) < 0.7


# -- models


@pytest.fixture(scope="module")
def renderer(store):
    return Renderer(store[1]["train"].name, "cpu", store[0])


def scene_of(store, id: str) -> SceneRecord:
    return decode_sample(store[1]["shard"].read(id)).scene


def test_the_model_renders_the_edited_scene_from_the_dragged_camera(page, store, renderer):
    scene = scene_of(store, "test-000000")
    go(page, f"#/record/{store[1]['shard'].name}/test-000000")
    page.until(f"{MODEL}.known")
    choose(page, "#size", "64")
    press(page, '[data-show="model"]')
    page.until(f"!{SPACE}.over.hidden && {SPACE}.over.firstChild === {MODEL}.predicted.canvas")
    page.until(SETTLED)
    exposure, canvas = page.value(f"{MODEL}.exposure"), f"{MODEL}.predicted.canvas"
    first = page.canvas(canvas)
    assert first.shape == (64, 64, 3)
    assert levels_apart(page, canvas, renderer.render(scene, 0, 64), exposure) <= 1

    amount = float(slide(page, "#light-0", 0.5).removeprefix("×"))  # a light is dimmed or brightened
    emission = scene.emission.copy()
    emission[scene.light_index == 0] *= np.float32(amount)
    brighter = replace(scene, emission=emission)
    assert levels_apart(page, canvas, renderer.render(brighter, 0, 64), exposure) <= 1

    solid = [n for n, entry in enumerate(scene.meta["objects"]) if entry["kind"] == "object"][0]
    choose(page, "#object", str(solid))  # an object is turned, by keys
    page.value("document.querySelector('#turn-z').focus()")
    for _ in range(25):
        with page.held("ArrowRight"):
            pass
    page.until(SETTLED)
    degrees = float(page.value("document.querySelector('#turn-z').value"))
    assert degrees == 25
    faces = scene.object_index == solid
    corners = scene.triangles[faces].astype(float)
    centre = (corners.reshape(-1, 3).min(axis=0) + corners.reshape(-1, 3).max(axis=0)) / 2
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    triangles, normals = scene.triangles.copy(), scene.vertex_normals.copy()
    triangles[faces] = (corners - centre) @ rotation.T + centre
    normals[faces] = normals[faces] @ rotation.T
    turned = replace(brighter, triangles=triangles, vertex_normals=normals)
    assert levels_apart(page, canvas, renderer.render(turned, 0, 64), exposure) <= 1

    light = next(n for n, entry in enumerate(scene.meta["objects"]) if entry["kind"] == "light")
    choose(page, "#object", str(light))  # a light is moved
    shift = float(slide(page, "#move-x", 0.6))
    moved = turned.triangles.copy()
    moved[scene.object_index == light, :, 0] += np.float32(shift)
    moved = replace(turned, triangles=moved)
    assert shift != 0 and levels_apart(page, canvas, renderer.render(moved, 0, 64), exposure) <= 1

    page.value("scrollTo(0, 0)")  # the camera is dragged
    left, top, width, height = page.place("canvas.space")
    page.drag((left + width / 2, top + height / 2), (left + width / 2 + 30, top + height / 2 + 12))
    page.until(f"{SETTLED}.then((still) => still && !{SPACE}.over.hidden)")
    pose = page.value(f"{SPACE}.sight.pose")
    matrix = np.eye(4)
    matrix[:3] = np.array([pose[name] for name in ("right", "up", "back", "eye")]).T
    assert not np.allclose(matrix, scene.camera_to_world[0], atol=1e-3)
    assert np.allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-6)
    dragged = replace(moved, camera_to_world=matrix[None].astype(np.float32), fov_deg=scene.fov_deg[:1])
    assert levels_apart(page, canvas, renderer.render(dragged, 0, 64), exposure) <= 1
    assert not np.array_equal(page.canvas(canvas), first)


def test_a_material_is_changed_and_a_pixels_attention_is_drawn(page, store, renderer):
    scene = scene_of(store, "test-000001")
    go(page, f"#/record/{store[1]['shard'].name}/test-000001")
    page.until(f"{MODEL}.known")
    choose(page, "#size", "64")
    press(page, '[data-show="model"]')
    page.until(SETTLED)
    left, top, width, height = page.place("canvas.space")
    page.drag(*[(left + width / 2, top + height / 2)] * 2)  # a click chooses what is there
    page.until(f"{MODEL}.chosenObject !== null")
    object = page.value(f"{MODEL}.chosenObject")
    colour(page, "#diffuse", "#20c040")
    diffuse, patches = scene.diffuse.copy(), scene.patch_index
    diffuse[scene.object_index == object] = srgb_decode(np.array([0x20, 0xC0, 0x40]) / 255)
    if patches is not None:
        patches = np.where(scene.object_index == object, -1, patches)
    expected = renderer.render(replace(scene, diffuse=diffuse, patch_index=patches), 0, 64)
    assert levels_apart(page, f"{MODEL}.predicted.canvas", expected, page.value(f"{MODEL}.exposure")) <= 1
    page.value(f"{MODEL}.look(0.5, 0.5)")
    page.until(f"{SPACE}.attention?.length === {len(scene.triangles)}")
    layers = page.value("Number(document.querySelector('#attention-layer').max)")
    assert layers == renderer.model.config.view_transformer_n_layers
    assert page.value(f"Math.max(...{SPACE}.attention) > 0")


# -- sizes and colours


@pytest.mark.parametrize("size", [(1280, 720), (390, 844)])
def test_no_page_is_wider_than_the_window(page, store, size):
    page.resize(size)
    try:
        for address in ("#/", f"#/artifact/{store[1]['decimate'].name}", f"#/record/{store[1]['shard'].name}/test-000000"):
            go(page, address)
            assert page.value("document.documentElement.scrollWidth - innerWidth") <= 0, address
    finally:
        page.resize((1280, 720))


def test_light_and_dark_are_chosen(page):
    go(page, "#/")
    papers = set()
    for _ in range(3):
        papers.add(page.value("getComputedStyle(document.body).backgroundColor"))
        page.click("#theme")
    assert len(papers) == 2
