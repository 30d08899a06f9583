"""The noise floor of a dataset: how far its images are from noiseless ones, told from pairs of independent renders.

The difference of two independent renders of a view has twice the variance of the noise in one, so everything here is divided
to state the error of *one* render against a noiseless truth: squared errors by 2, which is exact (PSNR + 3.01 dB), and mean
absolute ones by the square root of 2, which is exact where the noise is Gaussian and, whatever its law, wrong by that factor at
most. Not in it is what both renders have in common: the denoiser's bias, clamping, the renderer's own approximations.

Training reweights a view's lights (``stages.renderformer.dataset``). The noise of the layers then adds up in another way than
in the stored image, so that the floor is stated for the sum of all lights and for random reweightings of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stages.graphics.metrics import PSNR_MAX, log_error, psnr
from stages.graphics.tonemap import clamp
from stages.renderformer.dataset.augment import Relight, draw_light_factors, lit_by
from stages.renderformer.records import ViewRecord

REWEIGHTINGS = 4  # of the lights of each pair
LIGHTING = Relight(share=1.0, keep=0.5, scale=(0.5, 2.0), saturation=1.0)  # half of the lights off, the others in any colour
DIGITS = {"log_error": 5, "psnr": 2}  # in the summary
PERCENTS = (10, 50, 90)


def add_pairs(views: Sequence[ViewRecord], again: Callable[[list[int]], list[ViewRecord]], seed: int, share: float) -> None:
    """Render each kept view of a scene a second time with probability ``share``, and note `pair_error` in its meta.

    ``again(indices)`` renders these cameras independently of ``views``. The lot depends on ``seed`` and camera index alone.
    """
    lots = {view.meta["index"]: np.random.default_rng([seed, view.meta["index"]]) for view in views}
    drawn = [view for view in views if view.meta["status"] == "ok" and lots[view.meta["index"]].random() < share]
    for view, other in zip(drawn, again([view.meta["index"] for view in drawn]) if drawn else (), strict=True):
        view.meta["noise"] = pair_error(view, other, lots[view.meta["index"]])


def error_of_one(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Error of either image, (H, W, 3) linear radiance, against the noiseless truth of which both are independent estimates.

    ``log_error`` is the mean absolute difference of log10(1 + x), ``psnr`` is in dB on values clamped to [0, 1].
    """
    decibels = min(psnr(clamp(a), clamp(b)) + 10 * np.log10(2), PSNR_MAX)
    return {"log_error": round(log_error(a, b) / np.sqrt(2), 6), "psnr": round(float(decibels), 3)}


def relit(view: ViewRecord, factors: np.ndarray) -> np.ndarray:
    """(H, W, 3) radiance with the lights' radiance multiplied by ``factors`` (L, 3)."""
    return lit_by(view.lights, factors.astype(np.float32))


def pair_error(a: ViewRecord, b: ViewRecord, rng: np.random.Generator) -> dict[str, Any]:
    """`error_of_one` of two independent renders of one view: of the ``sum`` of its lights, and a list of `REWEIGHTINGS`."""
    factors = [draw_light_factors(LIGHTING, rng, len(a.lights)) for _ in range(REWEIGHTINGS)]
    return {
        "sum": error_of_one(a.image, b.image),
        "reweighted": [error_of_one(relit(a, weights), relit(b, weights)) for weights in factors],
    }


def noise_floor(pairs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Number of views, and the distributions of both errors over them, from what `pair_error` said of each."""
    errors = {"sum": [pair["sum"] for pair in pairs], "reweighted": [error for pair in pairs for error in pair["reweighted"]]}
    distributions = {
        name: {measure: _distribution([error[measure] for error in measured], digits) for measure, digits in DIGITS.items()}
        for name, measured in errors.items()
    }
    return {"views": len(pairs), **distributions}


def _distribution(values: Sequence[float], digits: int) -> dict[str, float]:
    summary = {"mean": np.mean(values)} | {f"p{percent}": np.percentile(values, percent) for percent in PERCENTS}
    return {name: round(float(value), digits) for name, value in summary.items()}
