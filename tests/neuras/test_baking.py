"""The shaders, drawn by OpenGL, equal the reference in torch."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from model.neuras.baked import Baked
from pipeline.errors import UserError
from stages.graphics.browser import find_browser
from stages.graphics.cameras import Camera
from stages.neuras.baking import browser, drawing, shaders, site
from stages.neuras.baking.site import PAGE, write_site
from stages.neuras.evaluation.renderers import Reference
from stages.neuras.records import AtlasMesh, CaptureInfo, FrameRecord
from tests.neuras import scenes


@pytest.fixture(scope="module", autouse=True)
def needs_opengl():
    try:
        drawing.context().release()
    except UserError as error:
        pytest.skip(str(error))


def reference(baked: Baked, atlas: AtlasMesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) colours and (H, W) hits as torch computes them."""
    by_torch = Reference(baked, atlas)
    view = by_torch.caster.view(camera)
    return by_torch.shade(camera, view), view.hit


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"quantized": False},
        {"view_dependent": False},
        {"networks": False},
        {"channels": 6},
        {"levels": 1},
        {"centre": (5e5, -4e6, 30.0)},
    ],
    ids=lambda settings: "-".join(settings) or "default",
)
def test_opengl_draws_what_torch_computes(settings):
    centre = settings.get("centre", (0.0, 0.0, 0.0))
    flat = scenes.atlas(centre=centre)
    baked = scenes.baked(flat, **settings)
    camera = scenes.looking_at(tuple(np.add(centre, (4.0, 3.0, 2.0))), centre)
    truth, hit = reference(baked, flat, camera)
    with drawing.Drawing(baked, flat, 0.1, 100.0) as scene:
        drawn = scene.render(camera)
    assert 0.2 < hit.mean() < 0.8 and truth[hit].std() > 0.05 and truth[~hit].std() > 0.05
    difference = np.abs(drawn - truth).max(axis=2) * 255
    assert np.median(difference[hit]) < 0.5 and np.median(difference[~hit]) < 0.5
    assert (difference > 4).mean() < 0.004  # a pixel on the silhouette may go either way


def test_a_pixel_is_the_mean_of_its_rays():
    """OpenGL and torch draw the same; it is what a picture of four times the size shows, with the whole pixel's texture."""
    flat = scenes.atlas()
    baked, camera = scenes.baked(flat, networks=False), scenes.looking_at((4.0, 3.0, 2.0), size=(60, 40))
    one, smooth = (Reference(replace(baked, rays=rays), flat).render(camera) for rays in (1, 4))
    with drawing.Drawing(replace(baked, rays=4), flat, 0.1, 100.0) as scene:
        drawn = scene.render(camera)
    difference = np.abs(drawn - smooth).max(axis=2) * 255
    assert np.median(difference) < 0.5 and (difference > 8).mean() < 0.004
    fine = Reference(baked, flat)
    hit = fine.caster.view(camera.resized(240, 160)).hit.reshape(40, 4, 60, 4).mean(axis=(1, 3))
    centre = fine.caster.view(camera).hit
    edges = (hit > 0) & (hit < 1)
    assert edges.mean() > 0.03
    for covered in (hit == 0, hit == 1):  # the mean of what each ray sees lies near what the centre sees, but for the edges
        assert np.abs(smooth - one)[covered & (centre == hit)].mean() < np.abs(smooth - one)[edges].mean()


def test_a_mesh_is_drawn_however_far_the_cameras_are():
    flat = scenes.atlas()
    baked = scenes.baked(flat)
    far = scenes.looking_at((60.0, 0.0, 20.0), size=(64, 48))
    far = replace(far, fx=20 * far.fx, fy=20 * far.fy)
    wanted, _ = reference(baked, flat, far)
    for eyes, least, most in (([far.position], 0, 0.01), ([], 0.05, 1)):  # without them it is beyond the far plane
        with drawing.Drawing(baked, flat, *drawing.depth_range(flat.vertices, 1.0, eyes)) as scene:
            assert least <= np.abs(scene.render(far) - wanted).mean() < most


def test_a_picture_that_opengl_cannot_hold_is_refused():
    flat = scenes.atlas()
    camera, told = scenes.looking_at((4.0, 3.0, 2.0), size=(10000, 4)), "8 rays along a pixel's side is larger than .* fit.rays"
    with (
        drawing.Drawing(replace(scenes.baked(flat), rays=8), flat, 0.1, 100.0) as scene,
        pytest.raises(UserError, match=told),
    ):
        scene.render(camera)


def test_eight_bits_come_near():
    flat = scenes.atlas()
    baked, camera = scenes.baked(flat), scenes.looking_at((4.0, 3.0, 2.0))
    with drawing.Drawing(baked, flat, 0.1, 100.0) as exact, drawing.Drawing(baked, flat, 0.1, 100.0, "rgba8") as coarse:
        difference = np.abs(exact.render(camera) - coarse.render(camera)).max(axis=2) * 255
    assert 0 < np.median(difference) < 2.5


def test_a_shifted_camera_sees_another_picture_and_flips_nothing():
    flat = scenes.atlas()
    baked, camera = scenes.baked(flat), scenes.looking_at((4.0, 3.0, 2.0))
    with drawing.Drawing(baked, flat, 0.1, 100.0) as scene:
        pictures = [scene.render(camera.moved(np.array(offset))) for offset in ((0, 0, 0), (0.5, 0, 0), (0, 0.5, 0))]
    truth, _ = reference(baked, flat, camera.moved(np.array((0.5, 0, 0))))
    assert np.abs(pictures[1] - truth).mean() < 0.2 * np.abs(pictures[0] - truth).mean()
    assert np.abs(pictures[2] - pictures[0]).mean() > 0.02


def test_modes_show_different_things():
    flat = scenes.atlas()
    baked, camera = scenes.baked(flat), scenes.looking_at((4.0, 3.0, 2.0))
    _, hit = reference(baked, flat, camera)
    with drawing.Drawing(baked, flat, 0.1, 100.0) as scene:
        pictures = {mode: scene.render(camera, mode) for mode in shaders.MODES}
        alone = [scene.render(camera, skybox=layer) for layer in range(3)]
    assert np.array_equal(pictures["mesh"][hit], pictures["full"][hit]) and not pictures["mesh"][~hit].any()
    assert (pictures["skyboxes"][hit] > 0).any() and np.allclose(pictures["skyboxes"][~hit], pictures["full"][~hit])
    assert (pictures["opacity"][hit] == 1).all() and 0 < pictures["opacity"][~hit].mean() < 1
    assert len(np.unique(pictures["charts"][hit], axis=0)) > 2
    assert len(np.unique(pictures["codes"][hit], axis=0)) > 30
    assert not np.allclose(alone[0], alone[2])


def test_numbers_read_back_as_they_were():
    values = np.random.default_rng(0).normal(0, 10, 1000).astype(np.float32)
    assert np.array_equal(np.array([float(text) for text in shaders._list(values).split(",")], np.float32), values)
    assert shaders._number(1.0) == "1.0" and shaders._number(1e-9) == "9.99999972e-10"


def test_bytes_hold_the_range_of_every_channel():
    features = np.random.default_rng(0).normal(size=(50, 6)) * np.arange(6)
    ranges = shaders.Ranges.of(features)
    read = ranges.low[:6] + ranges.span[:6] * ranges.quantized(features)[:, :6] / 255
    assert np.abs(read - features).max() <= ranges.span.max() / 255 * 0.51


# -- the site


def photographed(flat: AtlasMesh, baked: Baked) -> list[FrameRecord]:
    """Frames whose photos are the scene's own pictures."""
    frames = []
    with drawing.Drawing(baked, flat, 0.1, 100.0) as scene:
        for number, position in enumerate([(4.0, 3.0, 2.0), (4.5, 2.0, 2.0), (5.0, 1.0, 2.0)]):
            camera = scenes.looking_at(position, size=(160, 120))
            buffer = io.BytesIO()
            Image.fromarray((scene.render(camera) * 255).round().astype(np.uint8)).save(buffer, "PNG")
            frames.append(FrameRecord(f"frame-drive_{number}", camera, buffer.getvalue(), "train"))
    return frames


INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "none", "every other")


@pytest.mark.parametrize(
    "settings, expand", [({}, "fp16"), ({}, "rgba8"), ({"quantized": False}, "rgba8"), ({"networks": False}, "fp16")]
)
def test_the_page_draws_what_torch_computes(tmp_path, settings, expand):
    if find_browser() is None:
        pytest.skip("no Chromium: install chromium")
    flat = scenes.atlas()
    baked = scenes.baked(flat, **settings)
    frames = photographed(flat, baked)
    write_site(tmp_path, baked, flat, INFO, frames, (0.1, 100.0), expand)
    links = ["frame=0", "frame=2", "frame=0&shift=1", "frame=0&mode=1", "frame=0&mode=2", "frame=0&mode=3", "frame=0&mode=4",
             "frame=0&mode=5", "frame=0&skybox=1", "frame=0&wireframe=1"]  # fmt: skip
    images, times = browser.pictures(tmp_path, links, timing=3)
    assert len(times) == 3 and min(times) > 0
    shown = dict(zip(links, images, strict=True))
    for link, camera in [
        ("frame=0", frames[0].camera),
        ("frame=2", frames[2].camera),
        ("frame=0&shift=1", frames[0].camera.moved(np.array([1.0, 0, 0]))),
    ]:
        difference = np.abs(shown[link] - 255 * reference(baked, flat, camera)[0]).max(axis=2)
        assert np.median(difference) < (1.0 if expand == "fp16" else 3.0) and (difference > 8).mean() < 0.03
    different = [link for link in links if "mode=5" not in link or baked.quantized]
    assert len({shown[link].tobytes() for link in different}) == len(different)


def test_a_site_says_what_it_holds(tmp_path):
    flat = scenes.atlas()
    baked = scenes.baked(flat)
    sizes = write_site(tmp_path, baked, flat, INFO, photographed(flat, baked), (0.1, 100.0), "fp16")
    assert [kind for kind, size in sizes.items() if not size] == ["residuals"]  # without photos there are none
    mesh = trimesh.load(tmp_path / "geometry.glb", force="mesh", process=False)
    assert np.allclose(mesh.vertices, flat.vertices, atol=1e-6) and len(mesh.faces) == len(flat.faces)
    codes = np.array(Image.open(tmp_path / "mesh_codes.png"), np.uint16)
    assert np.array_equal(codes[..., 0] + 256 * codes[..., 1], baked.mesh_indices)
    scene = json.loads((tmp_path / "scene.json").read_bytes())
    assert [frame["name"] for frame in scene["frames"]] == ["drive_0", "drive_1", "drive_2"]
    assert {path.name for path in (tmp_path / "shaders").iterdir()} == {
        f"{name}.{dialect}.{kind}"
        for name in ("mesh", "sky", "resolve")
        for dialect in ("web", "desktop")
        for kind in ("vert", "frag")
    }


def test_opened_as_a_file_the_page_says_why_it_shows_nothing():
    page = (PAGE / "index.html").read_text()
    assert 'location.protocol === "file:"' in page and "http.server --bind 127.0.0.1" in page


def test_photos_on_the_page_say_nothing_of_where_they_were_taken_and_are_not_turned():
    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 255, (24, 40, 3), np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6  # turned by 90 degrees
    exif[0x010E] = "at home"
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", exif=exif, comment=b"my garden", icc_profile=b"a profile")
    told = buffer.getvalue()
    bare = site.without_metadata(told)
    assert b"at home" in told and b"my garden" in told
    assert b"at home" not in bare and b"my garden" not in bare and b"a profile" in bare
    again = Image.open(io.BytesIO(bare))
    assert not again.getexif() and np.array_equal(np.array(again), np.array(Image.open(io.BytesIO(told))))
    assert site.without_metadata(bare) == bare
    assert site.without_metadata(told[:2] + b"\xff" + told[2:]) == bare  # a byte that may stand before any marker
    signed = told[:2] + b"\xff\xeb\x00\x0aat home!" + told[2:]  # APP11
    assert site.without_metadata(signed) == bare
    for other in (b"\x89PNG", told[:40], told + b"a video", told[:40] + b"\xff\xd9"):
        assert site.without_metadata(other) is None
