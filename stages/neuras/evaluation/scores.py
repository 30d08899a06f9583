"""How far a picture is from the photo, where its error sits, and how far two renderers of one scene are apart.

Scores are of 8-bit sRGB, as values in [0, 1]: what a person sees and what the paper's tables hold. Pixels that a mask leaves
out count nowhere. Windows and networks see the photo there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.graphics.metrics import Metric, named, psnr, ssim

Scorer = Callable[[np.ndarray, np.ndarray, np.ndarray], float]  # photo and picture (H, W, 3) in [0, 1], (H, W) bool that counts
PLACES = {
    "right_depth": "right depth",
    "wrong_depth": "wrong depth",
    "background": "background",
}  # of a pixel: the mesh and the truth agree within a tolerance, they do not, both see nothing
STEP = 255  # differences of renderers are in steps of 8 bits
SEEN = 4  # steps from which a difference of renderers counts as seen


def told(names: Iterable[str]) -> dict[str, Metric]:
    """The metrics of these names with their headings and formats, in order."""
    mse = Metric("mse", "MSE", "", False, 4, None, (0, 1), lambda photo, picture: float(np.mean((photo - picture) ** 2)))
    wanted = set(names)
    return {name: metric for name, metric in {"mse": mse, **named(wanted)}.items() if name in wanted}


def scorers(lpips: Iterable[str], folder: str | None) -> dict[str, Scorer]:
    """MSE, PSNR and SSIM, and LPIPS by each of the networks ``lpips``.

    Raises UserError where the weights of one are missing.
    """
    known: dict[str, Scorer] = {
        "mse": lambda photo, picture, counts: float(np.mean((photo[counts] - picture[counts]) ** 2)),
        "psnr": lambda photo, picture, counts: psnr(photo[counts], picture[counts]),
        "ssim": ssim,
    }
    return known | {f"lpips_{network}": _lpips(network, folder) for network in lpips}


def _lpips(network: str, folder: str | None) -> Scorer:
    import torch

    from model.lpips import LPIPS

    try:
        distance = LPIPS.load(None if folder is None else Path(folder), network)
    except ValueError as error:
        raise UserError(str(error)) from None

    def score(photo: np.ndarray, picture: np.ndarray, counts: np.ndarray) -> float:
        images = [torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] for image in (photo, picture)]
        with torch.no_grad():
            return float(distance(*images, None if counts.all() else torch.from_numpy(counts)))

    return score


def score(photo: np.ndarray, picture: np.ndarray, counts: np.ndarray, scorers: Mapping[str, Scorer]) -> dict[str, float]:
    """Every score of a picture, (H, W, 3) uint8 as the photo is, rounded to 1e-6; ``counts``: (H, W) bool."""
    reference = photo / 255.0
    test = np.where(counts[..., None], picture / 255.0, reference)
    return {name: round(scorer(reference, test, counts), 6) for name, scorer in scorers.items()}


def error_places(
    photo: np.ndarray, picture: np.ndarray, counts: np.ndarray, depth: np.ndarray, true_depth: np.ndarray, tolerance: float
) -> dict[str, dict[str, float]]:
    """Of each of ``PLACES`` the share of pixels, and of the squared error.

    depth: (H, W) of the mesh, true_depth: (H, W), both along the ray, 0 for nothing. tolerance: relative to the true depth.
    """
    same = (depth > 0) & (true_depth > 0) & (np.abs(depth - true_depth) <= tolerance * true_depth)
    nothing = (depth == 0) & (true_depth == 0)
    squared = ((photo.astype(float) - picture) ** 2).sum(axis=-1)
    total = max(float(squared[counts].sum()), 1e-12)
    return {
        place: {
            "pixels": round(float(where[counts].mean()), 6),
            "squared_error": round(float(squared[counts & where].sum()) / total, 6),
        }
        for place, where in zip(PLACES, (same, ~same & ~nothing, nothing), strict=True)
    }


def agreement(one: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """How far two pictures (H, W, 3) in [0, 1] are apart: the largest difference of a pixel's channels, in steps of 8 bits.

    ``seen``: the share of pixels that are more than ``SEEN`` steps apart.
    """
    steps = STEP * np.abs(one.astype(float) - other).max(axis=-1)
    values = {"median": np.median(steps), "p99": np.quantile(steps, 0.99), "seen": (steps > SEEN).mean(), "mean": steps.mean()}
    return {name: round(float(value), 6) for name, value in values.items()}


def worst(views: Iterable[Mapping[str, Any]], kind: str) -> Mapping[str, Any]:
    """The view whose renderers are farthest apart in ``kind`` of their "agreement"."""
    return max(views, key=lambda view: (view["agreement"][kind]["seen"], view["agreement"][kind]["median"]))
