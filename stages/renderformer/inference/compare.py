"""``lightmill compare``: how far a test image is from a reference, as numbers and as a picture.

``compare A B`` takes two image files: EXR (linear radiance; a view's lights are summed) or 8-bit PNG (sRGB, made linear).
``compare SCENE --checkpoint C`` makes both images. The reference is path traced as the training data is, with lights hidden
from the camera. The test image is predicted from the same arrays. One design choice: both commands measure all metrics of
``stages.graphics.metrics`` by the same function, so that a number from here can be set beside a report's.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import UserError
from stages.graphics.metrics import METRICS, Metric, flip_map, measure_all
from stages.graphics.tonemap import exposure_for, exposure_text, from_picture, srgb_encode, to_picture

if TYPE_CHECKING:
    from stages.renderformer.inference.renderer import Renderer
    from stages.renderformer.inference.room import Room
    from stages.renderformer.inference.settings import PredictSettings

IMAGES = (".exr", ".png")
DIFFERENCE_GAIN = 5
PANEL = 256  # least width of a panel, pixels: smaller images have every pixel repeated
MARGIN, LINE = 8, 20


@dataclass
class Comparison:
    """Two (H, W, 3) linear images, and how they differ.

    names: of the images, such as their paths. labels: of the images in a picture.
    metrics: name -> value, of `measure_all`. definitions: what each of these names means.
    """

    reference: np.ndarray
    test: np.ndarray
    names: tuple[str, str]
    metrics: dict[str, float]
    definitions: Mapping[str, Metric] = field(default_factory=lambda: METRICS)
    notes: list[str] = field(default_factory=list)
    labels: tuple[str, str] = ("reference", "test")

    def to_json(self) -> dict[str, Any]:
        return {
            "reference": self.names[0],
            "test": self.names[1],
            "width": self.reference.shape[1],
            "height": self.reference.shape[0],
            "metrics": self.metrics,
            "notes": self.notes,
        }

    def table(self) -> str:
        """The comparison as text for a terminal."""
        lines = [
            f"{self.labels[0]:<10} {self.names[0]}",
            f"{self.labels[1]:<10} {self.names[1]}",
            f"{'size':<10} {self.reference.shape[1]}x{self.reference.shape[0]}",
            "",
        ]
        for name, value in self.metrics.items():
            metric = self.definitions[name]
            better = "higher" if metric.higher_is_better else "lower"
            lines.append(f"{metric.label:<18} {metric.format(value):>9} {metric.unit:<2}  {better} is better".rstrip())
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def picture(self) -> np.ndarray:
        """(h, w, 3) uint8: reference, test, difference and FLIP map side by side, labelled, the metrics below."""
        from PIL import Image, ImageDraw, ImageFont

        exposure = exposure_for(self.reference)
        difference, flip = error_pictures(self.reference, self.test, exposure)
        stated = "" if exposure == 1 else f", {exposure_text(exposure)}"
        panels = {
            f"{self.labels[0]}{stated}": to_picture(self.reference, exposure),
            f"{self.labels[1]}{stated}": to_picture(self.test, exposure),
            f"difference x{DIFFERENCE_GAIN}": difference,
            "HDR-FLIP error": flip,
        }
        times = max(1, -(-PANEL // self.reference.shape[1]))
        height, width = (times * side for side in self.reference.shape[:2])
        scores = [(self.definitions[name], value) for name, value in self.metrics.items()]
        metrics = [f"{metric.label} {metric.format(value)} {metric.unit}".strip() for metric, value in scores]
        footer = [f"{label}: {name}" for label, name in zip(self.labels, self.names, strict=True)] + ["    ".join(metrics)]
        size = len(panels) * (width + MARGIN) + MARGIN, height + (1 + len(footer)) * LINE + 3 * MARGIN
        page = Image.new("RGB", size, "white")
        draw, font = ImageDraw.Draw(page), ImageFont.load_default(size=14)
        for index, (caption, pixels) in enumerate(panels.items()):
            left = MARGIN + index * (width + MARGIN)
            draw.text((left, MARGIN), caption, fill="black", font=font)
            page.paste(Image.fromarray(pixels.repeat(times, axis=0).repeat(times, axis=1)), (left, MARGIN + LINE))
        for index, text in enumerate(footer):
            while font.getlength(text) > size[0] - 2 * MARGIN:
                text = "…" + text[2:]  # the end of a path says most
            draw.text((MARGIN, 2 * MARGIN + LINE + height + index * LINE), text, fill="black", font=font)
        return np.asarray(page)


def error_pictures(reference: np.ndarray, test: np.ndarray, exposure: float) -> tuple[np.ndarray, np.ndarray]:
    """Two (H, W, 3) uint8 pictures: the absolute difference, and the HDR-FLIP map in its own colours.

    The difference is of the two images as sRGB pictures at that exposure, times `DIFFERENCE_GAIN`.
    """
    import matplotlib

    difference = np.abs(srgb_encode(test * exposure) - srgb_encode(reference * exposure)) * DIFFERENCE_GAIN
    flip = matplotlib.colormaps["magma"](np.clip(flip_map(reference, test), 0, 1), bytes=True)[..., :3]
    return np.round(np.clip(difference, 0, 1) * 255).astype(np.uint8), np.ascontiguousarray(flip)


def compare_images(a: Path | str, b: Path | str, metrics: Mapping[str, Metric] = METRICS) -> Comparison:
    """A comparison of two image files; ``a`` is the reference."""
    paths = Path(a), Path(b)
    reference, test = (read_image(path) for path in paths)
    try:
        measured = measure_all(reference, test, metrics)
    except ValueError as error:
        raise UserError(f"{paths[0]} and {paths[1]} cannot be compared: {error}") from None
    png = [path.name for path in paths if path.suffix.lower() == ".png"]
    notes = [f"{name} is an 8-bit picture: radiance above 1 is not in it" for name in dict.fromkeys(png)]
    if not reference.any():
        notes.append(f"{paths[0].name} is black: HDR-FLIP uses exposure 0")
    return Comparison(reference, test, (str(a), str(b)), measured, metrics, notes)


def compare_scene(
    renderer: Renderer,
    path: Path | str,
    settings: PredictSettings,
    spp: int = 256,
    room: Room | None = None,
    metrics: Mapping[str, Metric] = METRICS,
) -> Comparison:
    """A comparison of one camera of a scene or mesh file: path traced with ``spp`` samples and denoised, and predicted."""
    from stages.graphics.mitsuba.backend import choose
    from stages.renderformer.inference.renderer import checkpoint_name
    from stages.renderformer.rendering.render import render_views
    from stages.renderformer.rendering.settings import RenderSettings

    if spp < 1:
        raise UserError(f"{spp} samples per pixel: give at least 1")
    if not settings.one_image:
        raise UserError("a comparison is of one camera: give --view N, and no orbit")
    scene, (view,) = settings.apply(renderer.load(path, room))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        predicted = renderer.render(scene, view, settings.resolution, settings.composite_lights)
    (traced,) = render_views(scene, RenderSettings(predicted.shape[:2], spp), choose("auto"), [view])
    names = (
        f"{path}, view {view}, path traced, {traced.meta['spp']} samples per pixel, denoised",
        checkpoint_name(renderer.folder),
    )
    notes = [*scene.meta.get("notes", ()), *(str(warning.message) for warning in caught)]
    try:
        measured = measure_all(traced.image, predicted, metrics)
    except ValueError as error:
        raise UserError(f"{path} cannot be compared: {error}") from None
    return Comparison(traced.image, predicted, names, measured, metrics, notes, ("target", "prediction"))


def check_picture(out: Path, inputs: Sequence[Path]) -> None:
    """UserError unless the comparison's picture can be written there. Called before anything is computed."""
    if out.suffix.lower() != ".png":
        raise UserError(f"{out}: the picture must end in .png")
    if not out.parent.is_dir():
        raise UserError(f"the folder {out.parent} does not exist: make it first")
    if out.resolve() in [path.resolve() for path in inputs]:
        raise UserError(f"{out} is one of the images that are compared: give another name")


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) float32 linear radiance of an EXR or PNG file."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise UserError(f"{path} is not a file: compare takes two images, EXR or PNG, or one scene")
    if suffix == ".exr":
        from stages.graphics.exr import read_rgb

        return read_rgb(path)
    if suffix == ".png":
        return _read_png(path)
    raise UserError(f"{path} ends in {suffix or 'nothing'!r}: compare takes two EXR or PNG images, or one scene")


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=["PNG"]) as image:  # others run programs
            image.load()
        with open(path, "rb") as file:
            bits = file.read(25)[24]  # of IHDR, the first chunk: Pillow cuts 16 bits to 8 without a word
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{path} is not a PNG image that can be read ({error})") from error
    if bits > 8:
        raise UserError(f"{path} has 16 bits per channel: give an 8-bit PNG, or an EXR for more precision")
    if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
        raise UserError(f"{path} has transparent pixels: flatten it first, there is no colour behind them to compare")
    return from_picture(np.asarray(image.convert("RGB")))
