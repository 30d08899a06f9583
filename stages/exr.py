"""OpenEXR files: a rendered view as one multi-layer half-float image, and plain RGB pictures for the commands.

A view's layers are named as EXR viewers expect: ``light0.R`` .. ``light0.B``, ``light1.R`` .., ``direct.R``,
``albedo.R``, ``normal.X`` .. ``normal.Z``, ``depth.Z``, ``coverage.A``, and ``triangle.id`` and ``object.id`` as 32-bit
integers plus one, 0 for nothing; the header attribute ``lightmill`` holds the view's meta as JSON. The same view always
gives the same bytes: OpenEXR writes no clock, and compression is lossless and done by one thread.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from stages.arrays import pack_json, unpack_json
from stages.records import ViewRecord

HALF_MAX = 65504.0  # largest finite half float
META = "lightmill"  # header attribute
# Single layers of a view: name, channels (in the order of the array's last axis).
LAYERS = {"direct": "RGB", "albedo": "RGB", "normal": "XYZ", "depth": "Z", "coverage": "A"}
INDICES = ("triangle", "object")


def _encode(header: dict, channels: dict[str, np.ndarray]) -> bytes:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    buffer = io.BytesIO()
    OpenEXR.File(header, {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}, 0).write(buffer)
    return buffer.getvalue()


def _decode(data: bytes, where: str) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and channels of an EXR file, one (H, W) array per channel."""
    import OpenEXR

    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
            return dict(file.header()), {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{where} is not an OpenEXR image that can be read ({detail})") from error


def clamped_values(view: ViewRecord) -> int:
    """How many radiance values of the view a half float cannot hold."""
    return int(sum((layer > HALF_MAX).sum() for layer in (view.lights, view.direct)))


def encode_view(view: ViewRecord) -> bytes:
    """The view as half-float EXR bytes; values over 65,504 become 65,504."""
    channels = {}
    layers = {f"light{index}": (light, "RGB") for index, light in enumerate(view.lights)}
    layers |= {name: (getattr(view, name), letters) for name, letters in LAYERS.items()}
    for name, (pixels, letters) in layers.items():
        half = np.clip(pixels, -HALF_MAX, HALF_MAX).astype(np.float16).reshape(*pixels.shape[:2], len(letters))
        channels |= {f"{name}.{letter}": half[..., index] for index, letter in enumerate(letters)}
    channels |= {f"{name}.id": (getattr(view, name) + 1).astype(np.uint32) for name in INDICES}
    return _encode({META: pack_json(view.meta).decode()}, channels)


def decode_view(data: bytes, where: str = "the view") -> ViewRecord:
    """A view from the bytes of ``encode_view``, as float32."""
    header, channels = _decode(data, where)
    if META not in header:
        raise UserError(f"{where} has no header attribute {META!r}: it is not a view that lightmill rendered")

    def layer(name: str, letters: str) -> np.ndarray:
        pixels = np.stack([channels[f"{name}.{letter}"] for letter in letters], axis=-1).astype(np.float32)
        return pixels if len(letters) > 1 else pixels[..., 0]

    single = {name: layer(name, letters) for name, letters in LAYERS.items()}
    single |= {name: channels[f"{name}.id"].astype(np.int32) - 1 for name in INDICES}
    count = sum(name.startswith("light") and name.endswith(".R") for name in channels)
    lights = [layer(f"light{index}", "RGB") for index in range(count)]
    shape = (0, *single["direct"].shape)
    return ViewRecord(np.stack(lights) if lights else np.zeros(shape, np.float32), **single, meta=unpack_json(header[META]))


def encode_rgb(image: np.ndarray, dtype: type = np.float16) -> bytes:
    """``image`` (H, W, 3), linear RGB, as EXR bytes; half floats unless told otherwise, then clamped at 65,504."""
    pixels = np.clip(image, -HALF_MAX, HALF_MAX) if dtype is np.float16 else image
    return _encode({}, {letter: pixels[..., index].astype(dtype) for index, letter in enumerate("RGB")})


def decode_rgb(data: bytes, where: str = "the image") -> np.ndarray:
    """(H, W, 3) float32 linear RGB from any EXR image: R, G and B, one grey channel, or a view's lights summed."""
    header, channels = _decode(data, where)
    if META in header:
        return decode_view(data, where).image
    if set("RGB") <= channels.keys():
        return np.stack([channels[letter] for letter in "RGB"], axis=-1).astype(np.float32)
    if len(channels) == 1:
        return np.repeat(next(iter(channels.values()))[..., None], 3, axis=-1).astype(np.float32)
    raise UserError(f"{where} has the channels {', '.join(sorted(channels))}: expected R, G and B")


def write_rgb(path: Path, image: np.ndarray) -> None:
    """``image`` (H, W, 3), linear RGB, as a float32 EXR file; the file appears whole or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(encode_rgb(image, np.float32))
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}): give a file in an existing folder") from error


def read_rgb(path: Path) -> np.ndarray:
    """``decode_rgb`` of a file."""
    try:
        return decode_rgb(path.read_bytes(), str(path))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): give an OpenEXR image") from error
