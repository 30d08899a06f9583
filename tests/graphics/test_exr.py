"""EXR files: what goes in comes out, in the same bytes each time."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.graphics.exr import HALF_MAX, decode_lights, decode_rgb, encode_rgb, read_rgb, size_of, write_rgb
from stages.renderformer.records import ViewRecord
from stages.renderformer.views import LAYERS, clamped_values, decode_layers, decode_view, encode_view


def a_view(lights: int = 10, size: int = 6) -> ViewRecord:
    rng = np.random.default_rng(1)
    image = (size, size)
    return ViewRecord(
        rng.uniform(0, 9, (lights, *image, 3)).astype(np.float32),
        rng.uniform(0, 9, (*image, 3)).astype(np.float32),
        rng.uniform(0, 1, (*image, 3)).astype(np.float32),
        rng.uniform(-1, 1, (*image, 3)).astype(np.float32),
        rng.uniform(0, 3, image).astype(np.float32),
        rng.uniform(0, 1, image).astype(np.float32),
        rng.integers(-1, 100_000, image).astype(np.int32),
        rng.integers(-1, 9, image).astype(np.int32),
        {"index": 2, "status": "ok"},
    )


@pytest.mark.parametrize("lights", [0, 1, 10])
def test_view_survives_as_half_floats(lights):
    view = a_view(lights)
    back = decode_view(encode_view(view), 2)
    for name in ("lights", "direct", "albedo", "normal", "depth", "coverage"):
        expected = getattr(view, name).astype(np.float16).astype(np.float32)
        assert getattr(back, name).dtype == np.float32
        assert np.array_equal(getattr(back, name), expected), name
    for name in ("triangle", "object"):
        assert getattr(back, name).dtype == np.int32 and np.array_equal(getattr(back, name), getattr(view, name)), name
    assert back.meta == view.meta and size_of(encode_view(view)["view2.exr"]) == (6, 6)


def test_the_image_is_read_without_its_aovs_and_indices_survive():
    view = a_view(2)
    view.triangle = np.array([[-1, 70000], [0, 5]], np.int32).repeat(3, axis=0).repeat(3, axis=1)
    members = encode_view(view)
    assert sorted(members) == ["view2.aov.exr", "view2.exr"]
    lights, meta = decode_lights(members["view2.exr"])
    assert lights.shape == (2, 6, 6, 3) and meta == view.meta
    layers = decode_layers(members["view2.aov.exr"])
    assert layers.keys() == LAYERS.keys() and layers["normal"].shape == (6, 6, 3) and layers["depth"].shape == (6, 6)
    assert layers["triangle"].dtype == np.int32 and np.array_equal(layers["triangle"], view.triangle)
    for name, other in ((b"normal.Z", b"normal.Q"), (b"object.id", b"object.ix")):
        with pytest.raises(UserError, match=f"has no channel {name.decode()}"):
            decode_layers(members["view2.aov.exr"].replace(name, other))


def test_same_view_gives_the_same_bytes():
    assert encode_view(a_view()) == encode_view(a_view())


def test_values_beyond_half_floats_are_clamped_and_counted():
    view = a_view(2)
    view.lights[0, 0, 0] = 1e6
    assert clamped_values(view) == 3
    assert decode_view(encode_view(view), 2).lights.max() == HALF_MAX


def test_rgb_image_is_exact(tmp_path):
    image = np.random.default_rng(0).uniform(0, 1e5, (5, 7, 3)).astype(np.float32)
    write_rgb(tmp_path / "a.exr", image)
    assert np.array_equal(read_rgb(tmp_path / "a.exr"), image)
    assert np.array_equal(decode_rgb(encode_rgb(image, np.float32)), image)
    half = np.minimum(image, HALF_MAX).astype(np.float16).astype(np.float32)
    assert np.array_equal(decode_rgb(encode_rgb(image)), half)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_a_view_reads_as_the_sum_of_its_lights():
    view = a_view()
    assert np.allclose(decode_rgb(encode_view(view)["view2.exr"]), view.image, rtol=2e-3)


def test_what_is_no_image_is_refused_by_name(tmp_path):
    (tmp_path / "bad.exr").write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match="bad.exr is not an OpenEXR image"):
        read_rgb(tmp_path / "bad.exr")
    with pytest.raises(UserError, match="missing.exr cannot be read"):
        read_rgb(tmp_path / "missing.exr")
    with pytest.raises(UserError, match="not a view"):
        decode_lights(encode_rgb(np.zeros((2, 2, 3))), "that")
    with pytest.raises(UserError, match="existing folder"):
        write_rgb(tmp_path / "no" / "a.exr", np.zeros((2, 2, 3)))
