"""OpenEXR files: a rendered view as two multi-layer images, and plain RGB pictures for the commands.

A view is two members of a record, so that who wants only the image neither reads nor decodes the rest: ``view<i>.exr`` with
a layer per light (``light0.R`` .. ``light0.B``, ``light1.R`` ..) and ``view<i>.aov.exr`` with what ``LAYERS`` lists
(``direct.R``, ``normal.X``, ``depth.Z``, ``triangle.id`` ..; arbitrary output variables, as renderers call them). The header
attribute ``lightmill`` of the first holds the view's meta as JSON. The same view always gives the same bytes: OpenEXR writes no
clock, and compression is lossless and done by one thread. Why this compression: docs/dataset.md.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError
from stages.graphics.arrays import unpack_json

HALF_MAX = 65504.0  # largest finite half float
FLOATS = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)  # the float32 of every half float, by its bits
MAX_SIDE = 16384  # pixels; what a header may claim
MAX_BYTES = 2**32  # of all channels together, uncompressed
META = "lightmill"  # header attribute


def encode(header: dict, channels: dict[str, np.ndarray]) -> bytes:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    buffer = io.BytesIO()
    OpenEXR.File(header, {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}, 0).write(buffer)
    return buffer.getvalue()


def decode(data: bytes, where: str) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and channels of an EXR file, one (H, W) array per channel."""
    import OpenEXR

    OpenEXR.setMaxImageSize(MAX_SIDE, MAX_SIDE)
    claimed = claimed_bytes(data)
    if claimed > MAX_BYTES:
        raise UserError(f"{where} claims to hold up to {claimed:,} bytes of pixels, more than {MAX_BYTES:,}")
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
            return dict(file.header()), {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, OSError, MemoryError) as error:
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{where} is not an OpenEXR image that can be read ({detail})") from error


WINDOW, CHANNELS = (
    re.compile(rb"dataWindow\0box2i\0.{4}(.{16})", re.DOTALL),
    re.compile(rb"channels\0chlist\0(.{4})", re.DOTALL),
)
CHANNEL_BYTES = 18  # of the shortest entry in a list of channels


def claimed_bytes(data: bytes) -> int:
    """An upper bound of what the headers make the library allocate: it does so before it looks for the pixels.

    All that looks like a size or a list of channels counts, so that nothing can hide one.
    """
    sizes = [struct.unpack("<4i", match[1]) for match in WINDOW.finditer(data)]
    pixels = max((max(right - left + 1, 0) * max(low - top + 1, 0) for left, top, right, low in sizes), default=0)
    return 4 * pixels * sum(struct.unpack("<I", match[1])[0] // CHANNEL_BYTES for match in CHANNELS.finditer(data))


def to_half(pixels: np.ndarray) -> np.ndarray:
    return np.clip(pixels, -HALF_MAX, HALF_MAX).astype(np.float16)


def size_of(data: bytes, where: str = "the view") -> tuple[int, int]:
    """Height and width of an EXR image, from its header."""
    import OpenEXR

    try:
        with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
            low, high = file.header()["dataWindow"]
    except (RuntimeError, ValueError, TypeError, OSError, KeyError) as error:
        raise UserError(f"{where} is not an OpenEXR image that can be read ({error})") from error
    return int(high[1] - low[1] + 1), int(high[0] - low[0] + 1)


def decode_lights(data: bytes, where: str = "the view", dtype: type | None = np.float32) -> tuple[np.ndarray, dict]:
    """(L, H, W, 3) radiance by light, and the view's meta; ``dtype`` None: half floats, as stored. In memory colours are
    planes, as they are in the file."""
    header, channels = decode(data, where)
    if META not in header:
        raise UserError(f"{where} has no header attribute {META!r}: it is not a view that lightmill rendered")
    meta = unpack_json(header[META])
    count = sum(name.startswith("light") and name.endswith(".R") for name in channels)
    names = [f"light{i}.{letter}" for i in range(count) for letter in "RGB"]
    lights = planes(channels, names, where, dtype).reshape(count, 3, *next(iter(channels.values())).shape)
    return np.moveaxis(lights, 1, -1), meta


def planes(channels: Mapping[str, np.ndarray], names: list[str], where: str, dtype: type | None) -> np.ndarray:
    """(len(names), H, W): the file's own order, which costs no shuffling of pixels."""
    first = next(iter(channels.values()))
    planes = np.empty((len(names), *first.shape), dtype or first.dtype)
    for plane, name in zip(planes, names, strict=True):
        if name not in channels:
            raise UserError(f"{where} has no channel {name}: it is not a view that lightmill rendered")
        copy_pixels(channels[name], plane)
    return planes


def copy_pixels(pixels: np.ndarray, out: np.ndarray) -> None:
    """``out[...] = pixels``, of (H, W) or (H, W, 3); half floats become float32 in half the time of numpy's cast."""
    if pixels.dtype != np.float16 or out.dtype != np.float32:
        out[...] = pixels
    elif pixels.ndim > 2:
        for channel in range(pixels.shape[-1]):
            copy_pixels(pixels[..., channel], out[..., channel])
    else:
        FLOATS.take(pixels.view(np.uint16), out=out, mode="wrap")  # every index is in range; "raise" would buffer ``out``


def encode_rgb(image: np.ndarray, dtype: type = np.float16) -> bytes:
    """``image`` (H, W, 3), linear RGB, as EXR bytes; half floats unless told otherwise, then clamped at 65,504."""
    pixels = np.clip(image, -HALF_MAX, HALF_MAX) if dtype is np.float16 else image
    return encode({}, {letter: pixels[..., index].astype(dtype) for index, letter in enumerate("RGB")})


def decode_rgb(data: bytes, where: str = "the image") -> np.ndarray:
    """(H, W, 3) float32 linear RGB from any EXR image: R, G and B, one grey channel, or a view's lights summed."""
    header, channels = decode(data, where)
    if META in header:
        return decode_lights(data, where)[0].sum(axis=0)
    if set("RGB") <= channels.keys():
        return np.stack([channels[letter] for letter in "RGB"], axis=-1).astype(np.float32)
    if len(channels) == 1:
        return np.repeat(next(iter(channels.values()))[..., None], 3, axis=-1).astype(np.float32)
    raise UserError(f"{where} has the channels {', '.join(sorted(channels))}: expected R, G and B")


def write_rgb(path: Path, image: np.ndarray) -> None:
    """``image`` (H, W, 3), linear RGB, as a float32 EXR file; the file appears whole or not at all."""
    data = encode_rgb(image, np.float32)
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}): give a file in an existing folder") from error


def read_rgb(path: Path) -> np.ndarray:
    """``decode_rgb`` of a file."""
    try:
        return decode_rgb(path.read_bytes(), str(path))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): give an OpenEXR image") from error
