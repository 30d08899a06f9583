"""Pictures of a capture: read with care, undistorted, made smaller.

A picture that needs none of this keeps the bytes of its file; all others become PNG.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from pipeline.errors import Reject
from stages.neuras.captures.lenses import Lens, bilinear, sources, undistorted

MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr")  # 8 bits a channel


@dataclass(frozen=True)
class Picture:
    """image: bytes of a PNG or JPEG. mask: of a PNG of one channel, or None. size: (width, height)."""

    image: bytes
    mask: bytes | None
    size: tuple[int, int]


@dataclass(frozen=True)
class Original:
    """A picture as a set has it.

    image, mask: files. outlines: polygons [[x, y], ..] of pixels that do not count, of things that move. backdrop: the
    colour (0 to 255) behind an alpha channel; None: the channel is dropped.
    """

    image: Path
    lens: Lens
    mask: Path | None = None
    outlines: Sequence[Sequence[Sequence[float]]] = ()
    backdrop: tuple[int, int, int] | None = None


def made(original: Original, max_side: int | None, max_pixels: int) -> Picture:
    """The picture as a pinhole of at most ``max_side`` pixels sees it; raises Reject."""
    lens = original.lens
    image = opened(original.image, max_pixels, "image")
    if image.size != (lens.width, lens.height):
        raise Reject("size", _other_size(image.size, lens))
    if original.backdrop is not None and image.has_transparency_data:
        image = _over(image, original.backdrop)
    mask = _mask(original, image.size, max_pixels)
    size = _fitting(image.size, max_side)
    if lens.straight and size == image.size and image.format in ("JPEG", "PNG") and image.mode == "RGB":
        return Picture(original.image.read_bytes(), None if mask is None else _png(_drawn(mask)), size)
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


def _mask(original: Original, size: tuple[int, int], max_pixels: int) -> np.ndarray | None:
    """(H, W) bool: the pixels that count; None where all do."""
    if original.mask is None and not original.outlines:
        return None
    width, height = size
    mask = np.ones((height, width), bool)
    if original.mask is not None:
        mask = np.array(opened(original.mask, max_pixels, "mask").convert("L")) > 0
        if mask.shape != (height, width):
            raise Reject("mask_size", f"the mask has {_times(mask.shape[::-1])} pixels, the image {_times(size)}")
    drawn = _drawn(mask)
    for outline in original.outlines:
        ImageDraw.Draw(drawn).polygon([tuple(point) for point in outline], fill=0)
    return np.array(drawn) > 0


def _over(image: Image.Image, backdrop: tuple[int, int, int]) -> Image.Image:
    """The image in front of one colour, mixed as the values stand, as the data sets that have such images do it."""
    ground = Image.new("RGBA", image.size, (*backdrop, 255))
    return Image.alpha_composite(ground, image.convert("RGBA")).convert("RGB")


def _other_size(size: tuple[int, int], lens: Lens) -> str:
    said = f"the image has {_times(size)} pixels, its intrinsics are for {lens.width} x {lens.height}"
    across, down = size[0] / lens.width, size[1] / lens.height
    if abs(across / down - 1) > 0.01:
        return f"{said}: another camera's, or the image was cut or turned"
    return f"{said}: multiply the focal lengths, the principal point and the size in the set's file by {across:.4g}"


def size_of(path: Path, max_pixels: int | None = None) -> tuple[int, int]:
    """(width, height) that the image file states; raises Reject, also where that is over ``max_pixels``."""
    try:
        with Image.open(path) as image:
            size = image.size
    except Exception as error:  # decoders of strangers' files fail in every way
        raise Reject("unreadable", f"the image {path.name}: {type(error).__name__}: {str(error)[:150]}") from None
    if max_pixels is not None:
        _check_size(size, "image", max_pixels)
    return size


def _check_size(size: tuple[int, int], what: str, max_pixels: int) -> None:
    if size[0] * size[1] > max_pixels:
        raise Reject("too_large", f"the {what} has {_times(size)} pixels, over capture.max_pixels={max_pixels}")


def _fitting(size: tuple[int, int], max_side: int | None) -> tuple[int, int]:
    if max_side is None or max(size) <= max_side:
        return size
    return tuple(max(round(side * max_side / max(size)), 1) for side in size)


def opened(path: Path, max_pixels: int, what: str) -> Image.Image:
    """The decoded file, of 8 bits a channel; its stated size is checked before anything is decoded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(path)
            _check_size(image.size, what, max_pixels)
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
