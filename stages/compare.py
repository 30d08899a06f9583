"""``lightmill compare A B``: the metrics between two images, A the reference.

An image is an EXR file (linear radiance; a view's lights are summed) or an 8-bit PNG (sRGB, made linear). The metrics
are all those of ``stages.metrics``, so that a figure typed here can be set beside a report's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.metrics import METRICS, measure_all
from stages.tonemap import from_picture


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) float32 linear radiance of an EXR or PNG file."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise UserError(f"{path} is not a file: compare takes two images, EXR or PNG")
    if suffix == ".exr":
        from stages.exr import read_rgb

        return read_rgb(path)
    if suffix == ".png":
        return _read_png(path)
    raise UserError(f"{path} ends in {suffix or 'nothing'!r}: compare takes EXR and PNG images")


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=["PNG"]) as image:  # others run programs
            image.load()
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{path} is not a PNG image that can be read ({error})") from error
    if image.mode.startswith(("I", "F")):
        raise UserError(f"{path} has 16 bits per channel: give an 8-bit PNG, or an EXR for more precision")
    if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
        raise UserError(f"{path} has transparent pixels: flatten it first, there is no colour behind them to compare")
    return from_picture(np.asarray(image.convert("RGB")))


def compare(a: Path | str, b: Path | str) -> dict[str, Any]:
    """``{"reference", "test", "width", "height", "metrics": {name: value}, "notes": [...]}`` of two image files."""
    paths = Path(a), Path(b)
    reference, test = (read_image(path) for path in paths)
    try:
        metrics = measure_all(reference, test)
    except ValueError as error:
        raise UserError(f"{paths[0]} and {paths[1]} cannot be compared: {error}") from None
    png = [path.name for path in paths if path.suffix.lower() == ".png"]
    notes = [f"{name} is an 8-bit picture: radiance above 1 is not in it" for name in dict.fromkeys(png)]
    if not reference.any():
        notes.append(f"{paths[0].name} is black: HDR-FLIP uses exposure 0")
    return {
        "reference": str(a),
        "test": str(b),
        "width": reference.shape[1],
        "height": reference.shape[0],
        "metrics": metrics,
        "notes": notes,
    }


def table(result: dict[str, Any]) -> str:
    """The result of `compare` as text for a terminal."""
    lines = [
        f"reference  {result['reference']}",
        f"test       {result['test']}",
        f"size       {result['width']}x{result['height']}",
        "",
    ]
    for name, value in result["metrics"].items():
        metric = METRICS[name]
        better = "higher" if metric.higher_is_better else "lower"
        lines.append(f"{metric.label:<18} {metric.format(value):>9} {metric.unit:<2}  {better} is better".rstrip())
    return "\n".join([*lines, *(f"note: {note}" for note in result["notes"])])
