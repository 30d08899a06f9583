"""Base colours of a mesh file: materials, their images, and the record that *collect* keeps of them.

The formats' readers (``stages.graphics.geometry.formats``) fill them in. Nothing here can cost a mesh: an image that is
missing, too large, malformed or outside the folder leaves a note. Design choice: Pillow opens five formats and looks at the
size before it decodes; what is kept is at most ``MAX_SIDE`` pixels wide, averaged in linear light.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.paths import check_path
from stages.graphics.geometry.records import TextureRecord
from stages.graphics.tonemap import srgb_decode, to_picture

IMAGE_FORMATS = {".bmp": "BMP", ".jpeg": "JPEG", ".jpg": "JPEG", ".png": "PNG", ".tga": "TGA", ".webp": "WEBP"}
MAX_PIXELS = 1 << 26  # of an image as stored; a larger one is not decoded
MAX_SIDE = 1024  # pixels of an image as kept; a larger one is averaged down
MAX_IMAGES = 32  # of an object; the materials of further ones keep their plain colours


@dataclass
class Material:
    """Base colour of a part: linear ``colour``, times the image where there is one.

    stated: whether the file says what colour it is; without, it has a colour only beside parts that have one.
    """

    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    image: np.ndarray | None = None  # (H, W, 3) uint8 sRGB
    wrap: tuple[str, str] = ("repeat", "repeat")
    transform: np.ndarray = field(default_factory=lambda: np.eye(3)[:2])  # (2, 3) of (u, v, 1) as the file has them
    stated: bool = False

    @cached_property
    def picture(self) -> str:
        """What tells the image from others; "" where there is none."""
        if self.image is None:
            return ""
        return hashlib.blake2b(self.image.tobytes(), digest_size=16).hexdigest() + str(self.image.shape)


@dataclass
class Look:
    """What a part of F triangles says of its colours.

    material: plain white where the part has none. uv: (F, 3, 2) coordinates in the material's image. tint: (F, 3, 3) linear
    colours of the corners, which multiply the material's.
    """

    material: Material = field(default_factory=Material)
    uv: np.ndarray | None = None
    tint: np.ndarray | None = None

    @property
    def textured(self) -> bool:
        return self.uv is not None and self.material.image is not None

    @property
    def stated(self) -> bool:
        """Whether the file says what colour the part is."""
        return self.textured or self.tint is not None or self.material.stated

    def content(self) -> tuple:
        """What parts of the same triangles are put in order by."""
        arrays = (b"" if array is None else array.tobytes() for array in (self.uv, self.tint))
        return *arrays, self.material.colour, self.material.picture


def as_colour(values: np.ndarray, what: str, note: Callable[[str], None]) -> np.ndarray:
    """Linear colours in [0, 1]. What is beyond is clamped, with a note that says of ``what`` and how far."""
    values = np.asarray(values, np.float64)
    if not np.isfinite(values).all():
        note(f"{what}: a colour is not finite, taken as 0")
        values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    if values.size and (values.min() < 0 or values.max() > 1):
        beyond = values.max() if values.max() > 1 else values.min()
        note(f"{what}: colours reach {beyond:.4g}, no surface reflects that: clamped to 0 .. 1")
    return values.clip(0, 1)


def srgb_colours(values: np.ndarray, what: str, note: Callable[[str], None]) -> np.ndarray:
    """Linear colours of sRGB ones in 0 .. 1, or in 0 .. 255 where any is over 1: how formats without a rule keep them."""
    return srgb_decode(as_colour(values / 255 if values.max(initial=0) > 1 else values, what, note))


# -- images


def decode_image(data: bytes) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of an image file, at most MAX_SIDE pixels wide; alpha is dropped. A Reject says what is wrong."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=sorted(set(IMAGE_FORMATS.values()))) as image:
            width, height = image.size
            if not 0 < width * height <= MAX_PIXELS:
                raise Reject("too_large", f"{width} x {height} pixels, at most {MAX_PIXELS} are decoded")
            image.draft("RGB", (MAX_SIDE, MAX_SIDE))  # a JPEG is decoded at half or quarter size where that suffices
            if image.mode.startswith("I"):  # 16 bits of grey, which convert() would clip
                pixels = np.repeat(
                    (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2
                )
            else:
                pixels = np.asarray(image.convert("RGB"))
    except Reject:
        raise
    except MemoryError:
        raise
    except Image.UnidentifiedImageError:
        raise Reject("unreadable", f"no image in a format that is read ({', '.join(IMAGE_FORMATS)})") from None
    except Image.DecompressionBombError:
        raise Reject("too_large", f"over {MAX_PIXELS} pixels") from None
    except Exception:  # decoders of strangers' files fail in every way
        raise Reject("unreadable", "a damaged image") from None
    return reduced(pixels)


def reduced(pixels: np.ndarray) -> np.ndarray:
    """The (H, W, 3) uint8 picture with no side over MAX_SIDE, averaged in linear light."""
    from PIL import Image

    height, width = pixels.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(pixels)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    linear = srgb_decode(np.arange(256) / 255).astype(np.float32)
    channels = [Image.fromarray(linear[pixels[..., c]]).resize(size, Image.Resampling.BOX) for c in range(3)]
    return to_picture(np.stack([np.asarray(channel) for channel in channels], axis=-1))


class Images:
    """The images of one file, each decoded once; what could not be had is in ``notes``."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._known: dict[Any, np.ndarray | None] = {}

    def get(self, name: Any, read: Callable[[], bytes]) -> np.ndarray | None:
        """The image ``name``, from the bytes that ``read()`` gives; None and a note where that is a Reject."""
        if name not in self._known:
            self._known[name] = None
            if len(self._known) > MAX_IMAGES:
                self.notes.append(f"image {name}: over {MAX_IMAGES} images")
            else:
                try:
                    self._known[name] = decode_image(read())
                except Reject as reject:
                    self.notes.append(f"image {str(name)[:80]}: {reject.detail[:160]}")
        return self._known[name]


def side_file(uri: str, folder: Path, root: Path, suffixes: Any) -> Path:
    """The file beside a mesh that a reference means; a Reject where it may not or cannot be read."""
    path = check_path(uri, folder, root)
    if path.suffix.lower() not in suffixes:
        raise Reject("unsupported", f"{uri[:80]!r} is not one of {', '.join(suffixes)}")
    if not path.is_file():
        raise Reject("unreadable", f"{uri[:80]!r} is missing")
    return path


def side_bytes(uri: str, folder: Path, root: Path, suffixes: Any, max_bytes: int) -> bytes:
    """What such a file holds."""
    path = side_file(uri, folder, root, suffixes)
    if path.stat().st_size > max_bytes:
        raise Reject("too_large", f"{uri[:80]!r} has over {max_bytes} bytes")
    return path.read_bytes()


# -- all together


def texture_record(looks: list[tuple[Look, int]], kept: np.ndarray) -> TextureRecord | None:
    """The record, without an id, of a mesh's parts: each one's look and its number of faces; of the faces ``kept``.

    ``kept``: rising indices into the faces of all parts together. Equal images and equal materials become one. None where no
    part's colour is stated.
    """
    ends = np.searchsorted(kept, np.cumsum([0, *(count for _, count in looks)]))
    coordinates = np.concatenate([np.zeros((n, 3, 2)) if look.uv is None else look.uv for look, n in looks])[kept]
    tint = None
    if any(look.tint is not None for look, _ in looks):
        tint = np.concatenate([np.ones((n, 3, 3)) if look.tint is None else look.tint for look, n in looks])[kept]
    rows: dict[tuple, int] = {}
    images: dict[str, int] = {}
    pictures: list[np.ndarray] = []
    material = np.zeros(len(kept), np.int32)
    stated = False
    for (look, _), start, end in zip(looks, ends, ends[1:], strict=False):
        if start == end:
            continue
        stated |= look.stated
        part_faces = slice(start, end)
        image, wrap = -1, (0, 0)
        if look.textured:
            image = images.setdefault(look.material.picture, len(pictures))
            if image == len(pictures):
                pictures.append(look.material.image)
            wrap = tuple(TextureRecord.WRAPS.index(name) for name in look.material.wrap)
            transform = look.material.transform
            coordinates[part_faces] = coordinates[part_faces] @ transform[:, :2].T + transform[:, 2]
        else:
            coordinates[part_faces] = 0
        material[part_faces] = rows.setdefault((look.material.colour, image, wrap), len(rows))
    if not stated:
        return None
    colour, image, wrap = zip(*rows, strict=True)
    coordinates = np.nan_to_num(coordinates, posinf=0, neginf=0)
    return TextureRecord(
        "",
        coordinates.astype(np.float32),
        material,
        np.float32(colour),
        np.int16(image),
        np.uint8(wrap),
        pictures,
        None if tint is None else tint.astype(np.float32),
    )
