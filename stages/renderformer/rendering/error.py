"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, half their difference is the noise that got through the denoiser; its bias is the same in both, but
shrinks with more samples, and shows in how far the image of all samples has moved away from the mean of the halves' images.
The weights of the two were fitted to long references (docs/rendering.md has the scatter plot).

The denoiser has a small network (``fast``) and a large one (``high``), which takes four times the time and leaves about four
fifths of the error. The small one serves where it meets the target.
"""

from __future__ import annotations

import numpy as np

from stages.graphics.denoising import denoise
from stages.graphics.tonemap import log_encode
from stages.renderformer.records import ViewRecord

NOISE_WEIGHT = 0.5  # of the mean difference between the denoised halves
DRIFT_WEIGHT = 1.6  # of the mean difference between their mean and the denoised whole
QUALITIES = {"fast": 1.13, "high": 1.0}  # the denoiser's networks: what the estimate is to be multiplied by
HIGH = 0.8  # error of the large network over that of the small one, in the median
STALL_FROM = 32  # samples: estimates of fewer tell little
STALL_SLOPE = 0.2  # error ~ samples^-slope; 0.5 is noise that is independent from sample to sample, denoised a little less
HOPE = 0.6  # least error of the large network over that of the small one
SLOPE, SLOPES = 0.4, (0.2, 0.5)  # error ~ samples^-slope, denoised: before it is seen; least and most that is believed
LARGE = 3.0  # samples of a pixel in the time that the large network takes more than the small one, for one image
ESTIMATED = 3  # images of an estimate


class Judge:
    """Tells the error of one view again and again, with more and more samples."""

    def __init__(self, target: float, denoised: bool):
        self.target, self.network = target, "fast" if denoised else None
        self.told: list[tuple[float, float]] = []  # samples and errors, by one and the same network
        self.shares: np.ndarray | None = None  # (H, W), what the last error is the mean of

    def error(self, samples: float, a: ViewRecord, b: ViewRecord, all_samples: ViewRecord) -> tuple[str | None, float]:
        """(network, error) of the image with all lights on, from the views of both halves and of all samples, not denoised:
        the small network where it meets the target, the large one otherwise, None where nothing is to be denoised."""
        if self.network is None:
            first, second = (log_encode(view.image.astype(np.float64)) for view in (a, b))
            difference = 0.5 * np.abs(first - second)
            error, self.shares = float(difference.mean()), difference.mean(axis=-1)
        elif self.network == "fast":
            error, self.shares = denoised_error(a, b, all_samples, "fast")
            if error <= self.target:
                return "fast", error
            if HOPE * error > self.target:
                self.told.append((samples, error * HIGH))
                return "high", error * HIGH
            self.told = []
            self.network = "high"  # if this does not do, the small one will not do with a few samples more
        if self.network == "high":
            error, self.shares = denoised_error(a, b, all_samples, "high")
        self.told.append((samples, error))
        return self.network, error

    def stalled(self, samples: float, most: int) -> bool:
        """Whether the error falls so slowly that the target is out of reach of ``most`` samples, told from the last estimate
        and one of a quarter of its samples or less."""
        history = self._history()
        last, error = history[-1] if history else (0, 0.0)
        before = [told for told in history if STALL_FROM <= told[0] <= last / 4]
        if last != samples or not before:
            return False
        slope = -np.log(error / before[-1][1]) / np.log(last / before[-1][0])
        return bool(slope < STALL_SLOPE and error * (last / most) ** max(slope, 0) > self.target)

    def _history(self) -> list[tuple[float, float]]:
        """Samples and errors of the image as it would be stored."""
        return self.told


class ThriftyJudge(Judge):
    """Estimates by the small network, and takes the large one in the end where it is cheaper than more samples.

    How much better the large one is in this view is tried once, where that is cheaper than the samples that depend on it.
    images: those that the view denoises in the end. most: samples that it may have.
    """

    def __init__(self, target: float, denoised: bool, images: int, most: int):
        super().__init__(target, denoised)
        self.images, self.most = images, most
        self.ratio, self.tried = HIGH, False  # error of the large network over that of the small one

    def error(self, samples: float, a: ViewRecord, b: ViewRecord, all_samples: ViewRecord) -> tuple[str | None, float]:
        if self.network is None:
            return super().error(samples, a, b, all_samples)
        small, shares = denoised_error(a, b, all_samples, "fast")
        self.told.append((samples, small))
        if small > self.target >= HOPE * small and not self.tried and self._needed(small * self.ratio) > LARGE * ESTIMATED:
            self.ratio, self.tried = denoised_error(a, b, all_samples, "high")[0] / small, True
        fits = samples + self._needed(small) <= self.most and self._needed(small) <= LARGE * self.images
        if small <= self.target or (fits and small * self.ratio <= self.target):
            self.shares = shares
            return "fast", small
        self.shares = shares * self.ratio
        return "high", small * self.ratio

    def _needed(self, error: float) -> float:
        """More samples until an error of now is the target."""
        (first, before), (last, now) = self.told[0], self.told[-1]
        slope = float(np.clip(np.log(before / now) / np.log(last / first), *SLOPES)) if last > first else SLOPE
        return last * (max(error / self.target, 1) ** (1 / slope) - 1)

    def _history(self) -> list[tuple[float, float]]:
        return [(samples, error * self.ratio) for samples, error in self.told]


def denoised_error(a: ViewRecord, b: ViewRecord, all_samples: ViewRecord, quality: str) -> tuple[float, np.ndarray]:
    """Of the image with all lights on as that network makes it, from the views of both halves and of all samples; and (H, W)
    what it is the mean of."""
    first, second, now = (
        log_encode(denoise(v.image, v.albedo, v.normal, v.coverage, quality).astype(np.float64)) for v in (a, b, all_samples)
    )
    noise, drift = np.abs(first - second), np.abs((first + second) / 2 - now)
    shares = QUALITIES[quality] * (NOISE_WEIGHT * noise + DRIFT_WEIGHT * drift).mean(axis=-1)
    return float(QUALITIES[quality] * (NOISE_WEIGHT * noise.mean() + DRIFT_WEIGHT * drift.mean())), shares
