"""OpenEXR files: a rendered view as two multi-layer images, and plain RGB pictures for the commands.

A view is two members of a record, so that who wants only the image neither reads nor decodes the rest: ``view<i>.exr`` with
a layer per light (``light0.R`` .. ``light0.B``, ``light1.R`` ..) and ``view<i>.aov.exr`` with what ``LAYERS`` lists
(``direct.R``, ``normal.X``, ``depth.Z``, ``triangle.id`` ..; arbitrary output variables, as renderers call them). The header
attribute ``lightmill`` of the first holds the view's meta as JSON. The same view always gives the same bytes: OpenEXR writes no
clock, and compression is lossless and done by one thread. Why this compression: docs/dataset.md.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stages.graphics.arrays import pack_json
from stages.graphics.exr import HALF_MAX, META, decode, decode_lights, encode, planes, to_half
from stages.renderformer.records import ViewRecord


class Layer(NamedTuple):
    """Channels of an AOV layer, in the order of the array's last axis. Indices are stored plus one, 0 for nothing."""

    channels: Sequence[str]
    dtype: type = np.float16


LAYERS = {
    "direct": Layer("RGB"),
    "albedo": Layer("RGB"),
    "normal": Layer("XYZ"),
    "depth": Layer("Z"),
    "coverage": Layer("A"),
    "triangle": Layer(("id",), np.uint32),
    "object": Layer(("id",), np.uint32),
}
VIEW = re.compile(r"view(\d+)\.exr\Z")  # a view's first member


def clamped_values(view: ViewRecord) -> int:
    """How many radiance values of the view a half float cannot hold."""
    return int(sum((layer > HALF_MAX).sum() for layer in (view.lights, view.direct)))


def view_members(index: int) -> tuple[str, str]:
    """Names of a view's two members: its lights, its AOVs."""
    return f"view{index}.exr", f"view{index}.aov.exr"


def encode_view(view: ViewRecord) -> dict[str, bytes]:
    """The view's two members; floats become half floats, those over 65,504 become 65,504."""
    lights = {
        f"light{i}.{letter}": to_half(light[..., j]) for i, light in enumerate(view.lights) for j, letter in enumerate("RGB")
    }
    if not lights:  # an EXR file has at least one channel
        lights = {"none.A": np.zeros(view.depth.shape, np.float16)}
    layers = {}
    for name, (letters, dtype) in LAYERS.items():
        pixels = getattr(view, name)
        pixels = (pixels + 1).astype(dtype) if dtype is np.uint32 else to_half(pixels)
        pixels = pixels.reshape(*pixels.shape[:2], len(letters))
        layers |= {f"{name}.{letter}": pixels[..., i] for i, letter in enumerate(letters)}
    image, aov = view_members(view.meta["index"])
    return {image: encode({META: pack_json(view.meta).decode()}, lights), aov: encode({}, layers)}


def decode_layers(data: bytes, where: str = "the view", dtype: type | None = np.float32) -> dict[str, np.ndarray]:
    """AOV layers by name: (H, W, 3) or (H, W), ``dtype`` None: half floats, as stored; indices (H, W) int32, -1 for nothing."""
    _, channels = decode(data, where)
    layers = {}
    for name, (letters, stored) in LAYERS.items():
        index = stored is np.uint32
        stored_planes = planes(channels, [f"{name}.{letter}" for letter in letters], where, np.int32 if index else dtype)
        channels_last = np.moveaxis(stored_planes, 0, -1) if len(letters) > 1 else stored_planes[0]
        layers[name] = stored_planes[0] - 1 if index else channels_last
    return layers


def decode_view(members: Mapping[str, bytes], index: int, where: str = "the view") -> ViewRecord:
    """View ``index`` of a record, whole."""
    image, aov = view_members(index)
    lights, meta = decode_lights(members[image], where)
    return ViewRecord(lights, **decode_layers(members[aov], where), meta=meta)
