"""`lightmill compare`: same metrics as the report's, from files or from a scene; clear words for what cannot be compared."""

from __future__ import annotations

import json
import struct
import zlib

import numpy as np
import pytest
import trimesh
from PIL import Image

from pipeline.errors import UserError
from stages.cli import main
from stages.graphics.exr import write_rgb
from stages.graphics.metrics import METRICS, measure_all
from stages.graphics.tonemap import exposure_for, srgb_encode, to_picture
from stages.renderformer.inference.compare import compare_images, compare_scene, read_image


@pytest.fixture
def images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    a = rng.gamma(1, 0.5, (24, 32, 3)).astype(np.float32)
    return a, (a * rng.uniform(0.8, 1.2, a.shape)).astype(np.float32)


def test_two_exr_files(tmp_path, images):
    for name, image in zip("ab", images, strict=True):
        write_rgb(tmp_path / f"{name}.exr", image)
    comparison = compare_images(tmp_path / "a.exr", tmp_path / "b.exr")
    result = comparison.to_json()
    assert result["metrics"] == measure_all(*images)
    assert (result["width"], result["height"], result["notes"]) == (32, 24, [])
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    text = comparison.table()
    for name, metric in METRICS.items():
        line = next(line for line in text.splitlines() if line.startswith(metric.label + " "))
        assert metric.format(result["metrics"][name]) in line


def test_a_png_is_made_linear_and_its_clipping_is_said(tmp_path, images):
    image = np.minimum(images[0], 1)
    write_rgb(tmp_path / "a.exr", image)
    Image.fromarray(to_picture(image)).save(tmp_path / "b.png")
    result = compare_images(tmp_path / "a.exr", tmp_path / "b.png")
    assert result.metrics["psnr"] > 48  # only 8-bit rounding is left
    assert "b.png is an 8-bit picture" in result.notes[0] and result.notes[0] in result.table()


def test_an_opaque_alpha_channel_and_grey_are_fine(tmp_path, images):
    picture = to_picture(images[0])
    Image.fromarray(picture).convert("RGBA").save(tmp_path / "a.png")
    assert np.array_equal(to_picture(read_image(tmp_path / "a.png")), picture)
    Image.fromarray(picture[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(to_picture(read_image(tmp_path / "grey.png"))[..., 2], picture[..., 0])


def png_of_16_bits(pixels: np.ndarray) -> bytes:
    """(H, W, 3) big-endian uint16, which Pillow reads as 8 bits and cannot write."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def test_what_cannot_be_compared_is_said_in_one_line(tmp_path, images):
    a = images[0]
    write_rgb(tmp_path / "a.exr", a)
    write_rgb(tmp_path / "wide.exr", np.concatenate([a, a], axis=1))
    write_rgb(tmp_path / "nan.exr", np.where(a > 2, np.nan, a))
    write_rgb(tmp_path / "tiny.exr", a[:4, :4])
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "text.exr").write_text("not a picture")
    (tmp_path / "a.jpg").write_text("")
    glass = np.dstack([to_picture(a), np.full(a.shape[:2], 128, np.uint8)])
    Image.fromarray(glass).save(tmp_path / "glass.png")
    Image.fromarray((a[..., 0] * 1000).astype(np.uint16)).save(tmp_path / "deep.png")
    (tmp_path / "deep_rgb.png").write_bytes(png_of_16_bits((a * 1000).astype(">u2")))
    cases = {
        "wide.exr": "24x32x3 and 24x64x3",
        "nan.exr": "NaN or infinite",
        "text.png": "not a PNG image",
        "text.exr": "not an OpenEXR image",
        "a.jpg": "EXR or PNG",
        "glass.png": "transparent",
        "deep.png": "16 bits",
        "deep_rgb.png": "16 bits",
        "missing.exr": "is not a file",
        "": "is not a file",
    }
    for name, message in cases.items():
        with pytest.raises(UserError, match=message) as caught:
            compare_images(tmp_path / "a.exr", tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="4x4 pixels"):
        compare_images(tmp_path / "tiny.exr", tmp_path / "tiny.exr")


def test_the_sample_references_agree_with_themselves_and_differ_from_each_other(shared_data):
    folder = shared_data / "cycles"
    name = "cbox-physical-128.exr"
    assert compare_images(folder / name, folder / name).metrics["flip"] == 0
    other = compare_images(folder / name, folder / "veach-mis-physical-128.exr").metrics
    assert other["psnr"] < 30 and other["log_error"] > 0.01


# --- a scene: traced and predicted ------------------------------------------------------------------------------------


@pytest.fixture
def checkpoint(tmp_path):
    from model.renderformer import checkpoint as files
    from model.renderformer.config import ModelConfig
    from model.renderformer.network import RenderFormer

    config = ModelConfig(
        latent_dim=128, num_layers=1, num_heads=1, dim_feedforward=64, texture_encode_patch_size=1,
        view_transformer_latent_dim=128, view_transformer_n_layers=1, view_transformer_n_heads=1,
        view_transformer_ffn_hidden_dim=64, use_dpt_decoder=False,
    )  # fmt: skip
    files.save(config, RenderFormer(config).state_dict(), tmp_path / "model", {"triangles": "600", "resolution": "16"})
    return tmp_path / "model"


@pytest.fixture
def cube(tmp_path):
    trimesh.creation.box((2, 3, 1)).export(tmp_path / "cube.stl")
    return tmp_path / "cube.stl"


@pytest.fixture
def scalar(monkeypatch):
    """Path tracing without the seconds that a JIT compiler takes."""
    from stages.graphics.mitsuba import backend

    monkeypatch.setattr(backend, "choose", lambda choice: {"backend": "scalar"})


def test_a_scene_is_traced_and_predicted_from_the_same_arrays(cube, checkpoint, scalar):
    from stages.renderformer.inference.renderer import Renderer
    from stages.renderformer.inference.settings import PredictSettings
    from tests.renderformer.fakes import path_traced

    result = compare_scene(Renderer(checkpoint), cube, PredictSettings(resolution=24), spp=3)
    renderer = Renderer(checkpoint)
    scene = renderer.load(cube)
    with pytest.warns(UserWarning, match="trained with 16x16"):
        assert result.test == pytest.approx(renderer.render(scene, resolution=24))
    (view,) = path_traced(scene, 24, max_spp=3, seed=0, backend={"backend": "scalar"})
    assert np.array_equal(result.reference, view.image)
    assert result.metrics == measure_all(result.reference, result.test)
    assert "resolution 24x24: the checkpoint was trained with 16x16" in result.table()  # what limits the prediction is told


@pytest.mark.parametrize("choice", [{"view": "all"}, {"frames": 2}])
def test_a_comparison_is_of_one_camera(cube, checkpoint, choice):
    from stages.renderformer.inference.renderer import Renderer
    from stages.renderformer.inference.settings import PredictSettings

    with pytest.raises(UserError, match="of one camera"):
        compare_scene(Renderer(checkpoint), cube, PredictSettings(**choice))


def test_the_command_shows_a_scene_as_a_picture_and_a_table(cube, checkpoint, scalar, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["compare", str(cube), "--checkpoint", str(checkpoint), "--spp", "1", "--device", "cpu"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "1 samples per pixel" in text and text.splitlines()[-1] == "picture: cube-compare.png"
    for metric in METRICS.values():
        assert f"\n{metric.label} " in text
    picture = np.asarray(Image.open("cube-compare.png"))
    assert picture.shape[1] > 4 * 256 and picture.shape[0] > 256  # four panels, each pixel enlarged
    panels = [picture[28 : 28 + 256, 8 + 264 * index : 264 * (index + 1)] for index in range(4)]
    assert all((panel != 255).mean() > 0.2 for panel in panels)
    assert main([*words, "--json", "-o", "other.png", "--resolution", "24"]) == 0
    assert json.loads(capsys.readouterr().out)["width"] == 24 and (tmp_path / "other.png").is_file()


def test_two_images_as_a_picture(tmp_path, images, capsys):
    for name, image in zip("ab", images, strict=True):
        write_rgb(tmp_path / f"{name}.exr", image)
    words = ["compare", str(tmp_path / "a.exr"), str(tmp_path / "b.exr"), "-o", str(tmp_path / "ab.png")]
    assert main(words) == 0 and "picture: " in capsys.readouterr().out
    picture = np.asarray(Image.open(tmp_path / "ab.png")).astype(int)
    exposure = exposure_for(images[0])
    assert (picture[28, 8] == to_picture(images[0], exposure)[0, 0]).all()  # the reference's first pixel
    first = np.abs(np.subtract(*(srgb_encode(image[0, 0] * exposure) for image in images)))
    assert picture[28, 8 + 2 * 264] == pytest.approx(np.clip(5 * first, 0, 1) * 255, abs=1)  # the difference's


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.exr"], "is an image: give the test image as well"),
        (["a.exr", "b.exr", "--checkpoint", "x"], "leave --checkpoint out"),
        (["cube.stl", "b.exr"], "'.stl': compare takes two EXR or PNG images, or one scene"),
        (["a.exr", "b.exr", "-o", "b.exr"], "must end in .png"),
        (["a.exr", "b.exr", "-o", "nowhere/c.png"], "nowhere does not exist"),
        (["a.exr", "b.png", "-o", "b.png"], "is one of the images that are compared"),
        (["a.exr", "b.exr", "--lpips", "vgg", "--lpips-folder", "nowhere"], "LPIPS needs"),
        (["cube.stl", "--spp", "0", "--checkpoint", "model"], "0 samples per pixel"),
        (["cube.stl", "--resolution", "8", "--checkpoint", "model"], "SSIM needs 11"),
        (["cube.stl", "--view", "2", "--checkpoint", "model"], "view 2 of cube does not exist"),
    ],
)
def test_what_the_command_cannot_compare(cube, checkpoint, scalar, tmp_path, images, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    for name, image in zip("ab", images, strict=True):
        write_rgb(tmp_path / f"{name}.exr", image)
    assert main(["compare", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1
