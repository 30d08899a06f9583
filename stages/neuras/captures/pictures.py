"""Pictures of a capture: read with care, undistorted, made smaller.

A picture that needs none of this keeps the bytes of its file; all others become PNG.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.errors import Reject
from stages.neuras.captures.lenses import Lens, bilinear, sources, undistorted

MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr")  # 8 bits a channel


@dataclass(frozen=True)
class Picture:
    """image: bytes of a PNG or JPEG. mask: of a PNG of one channel, or None. size: (width, height)."""

    image: bytes
    mask: bytes | None
    size: tuple[int, int]


def made(image_file: Path, mask_file: Path | None, lens: Lens, max_side: int | None, max_pixels: int) -> Picture:
    """The picture as a pinhole of at most ``max_side`` pixels sees it; raises Reject."""
    image = _opened(image_file, max_pixels, "image")
    if image.size != (lens.width, lens.height):
        raise Reject("size", f"the image has {_times(image.size)} pixels, its intrinsics are for {lens.width} x {lens.height}")
    mask = None
    if mask_file is not None:
        mask = np.array(_opened(mask_file, max_pixels, "mask").convert("L")) > 0
        if mask.shape != (lens.height, lens.width):
            raise Reject("mask_size", f"the mask has {_times(mask.shape[::-1])} pixels, the image {_times(image.size)}")
    size = _fitting(image.size, max_side)
    if lens.straight and size == image.size and image.format in ("JPEG", "PNG") and image.mode == "RGB":
        return Picture(image_file.read_bytes(), None if mask is None else _png(_drawn(mask)), size)
    pixels = np.array(image.convert("RGB"))
    if not lens.straight:
        pixels, inside = undistorted(pixels, lens)
        if mask is not None:
            inside &= bilinear(mask[..., None], sources(lens)[0])[..., 0] > 0.999
        mask = None if inside.all() else inside
    picture = Image.fromarray(pixels)
    drawn = None if mask is None else _drawn(mask)
    if size != image.size:
        picture = picture.resize(size, Image.Resampling.BOX)
        # a pixel counts where all that it covers counts
        drawn = drawn and drawn.resize(size, Image.Resampling.BOX).point(lambda value: 255 if value == 255 else 0)
    return Picture(_png(picture), drawn and _png(drawn), size)


def size_of(path: Path) -> tuple[int, int]:
    """(width, height) that the image file states; raises Reject."""
    try:
        with Image.open(path) as image:
            return image.size
    except Exception as error:  # decoders of strangers' files fail in every way
        raise Reject("unreadable", f"the image {path.name}: {type(error).__name__}: {str(error)[:150]}") from None


def _fitting(size: tuple[int, int], max_side: int | None) -> tuple[int, int]:
    if max_side is None or max(size) <= max_side:
        return size
    return tuple(max(round(side * max_side / max(size)), 1) for side in size)


def _opened(path: Path, max_pixels: int, what: str) -> Image.Image:
    """The decoded file, of 8 bits a channel; its stated size is checked before anything is decoded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(path)
            if image.width * image.height > max_pixels:
                raise Reject("too_large", f"the {what} has {_times(image.size)} pixels, over capture.max_pixels={max_pixels}")
            image.load()
    except Reject:
        raise
    except Image.DecompressionBombError as error:
        raise Reject("too_large", str(error)) from None
    except Exception as error:  # decoders of strangers' files fail in every way
        raise Reject("unreadable", f"the {what} {path.name}: {type(error).__name__}: {str(error)[:150]}") from None
    if image.mode not in MODES:
        raise Reject("unreadable", f"the {what} {path.name} has pixels of the kind {image.mode}: 8 bits a channel are read")
    return image


def _drawn(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=6)
    return buffer.getvalue()


def _times(size: tuple[int, ...]) -> str:
    return f"{size[0]} x {size[1]}"
