"""`lightmill compare`: same metrics as the report's, from files; clear words for what cannot be compared."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UserError
from stages.compare import compare, read_image, table
from stages.exr import write_rgb
from stages.metrics import METRICS, measure_all
from stages.tonemap import to_picture


@pytest.fixture
def images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    a = rng.gamma(1, 0.5, (24, 32, 3)).astype(np.float32)
    return a, (a * rng.uniform(0.8, 1.2, a.shape)).astype(np.float32)


def test_two_exr_files(tmp_path, images):
    for name, image in zip("ab", images, strict=True):
        write_rgb(tmp_path / f"{name}.exr", image)
    result = compare(tmp_path / "a.exr", tmp_path / "b.exr")
    assert result["metrics"] == measure_all(*images)
    assert (result["width"], result["height"], result["notes"]) == (32, 24, [])
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    text = table(result)
    for name, metric in METRICS.items():
        line = next(line for line in text.splitlines() if line.startswith(metric.label + " "))
        assert metric.format(result["metrics"][name]) in line


def test_a_png_is_made_linear_and_its_clipping_is_said(tmp_path, images):
    image = np.minimum(images[0], 1)
    write_rgb(tmp_path / "a.exr", image)
    Image.fromarray(to_picture(image)).save(tmp_path / "b.png")
    result = compare(tmp_path / "a.exr", tmp_path / "b.png")
    assert result["metrics"]["psnr"] > 48  # only 8-bit rounding is left
    assert "b.png is an 8-bit picture" in result["notes"][0] and result["notes"][0] in table(result)


def test_an_opaque_alpha_channel_and_grey_are_fine(tmp_path, images):
    picture = to_picture(images[0])
    Image.fromarray(picture).convert("RGBA").save(tmp_path / "a.png")
    assert np.array_equal(to_picture(read_image(tmp_path / "a.png")), picture)
    Image.fromarray(picture[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(to_picture(read_image(tmp_path / "grey.png"))[..., 2], picture[..., 0])


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
    cases = {
        "wide.exr": "24x32x3 and 24x64x3",
        "nan.exr": "NaN or infinite",
        "text.png": "not a PNG image",
        "text.exr": "not an OpenEXR image",
        "a.jpg": "EXR and PNG",
        "glass.png": "transparent",
        "deep.png": "16 bits",
        "missing.exr": "is not a file",
        "": "is not a file",
    }
    for name, message in cases.items():
        with pytest.raises(UserError, match=message) as caught:
            compare(tmp_path / "a.exr", tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="4x4 pixels"):
        compare(tmp_path / "tiny.exr", tmp_path / "tiny.exr")


def test_the_sample_references_agree_with_themselves_and_differ_from_each_other(shared_data):
    folder = shared_data / "cycles"
    name = "cbox-physical-128.exr"
    assert compare(folder / name, folder / name)["metrics"]["flip"] == 0
    other = compare(folder / name, folder / "veach-mis-physical-128.exr")["metrics"]
    assert other["psnr"] < 30 and other["log_error"] > 0.01
