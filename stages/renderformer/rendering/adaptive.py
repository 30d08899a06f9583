"""Where in a view more samples pay: in cells of pixels whose estimated error is large for the samples that they had.

A cell's noise falls about as one over the root of its samples. The mean of all cells' errors is then least, at equal cost,
where samples are in proportion to the noise of one sample to the power 2/3. Counts follow cells and their neighbours, never the
pixel alone: one whose samples happened to miss what is bright would be left as it is, and the image would be too dark.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

CELL = 8  # pixels along a side
GROWTH = 2.0  # of a view's samples, at most, before the next estimate
CELL_GROWTH = 4.0  # of a cell's
LEAST = 1 / 8  # of the samples of the cell that has most
AIM = 0.97  # of the target
MULTIPLE = 8  # counts are multiples of it: what a lane of the integrator takes at least


def next_counts(counts: np.ndarray, error: np.ndarray, target: float, most: int) -> np.ndarray:
    """(H, W) samples that each pixel should have had before the next estimate, at least ``counts``, at most ``most``.

    counts: (H, W), the same all over each cell. error: (H, W), of which the mean is the view's estimated error. target: for it.
    """
    rows, columns = (np.arange(side) // CELL for side in counts.shape)
    cell = rows[:, None] * (columns[-1] + 1) + columns
    area = np.bincount(cell.ravel())
    shape = (rows[-1] + 1, columns[-1] + 1)
    mean = (np.bincount(cell.ravel(), error.ravel()) / area).reshape(shape)
    now = counts[::CELL, ::CELL].ravel().astype(float)
    around = np.maximum(uniform_filter(mean, 3, mode="nearest"), 0).ravel()  # its running sums leave rounding below nothing
    noise = around * np.sqrt(now)  # of one sample
    growing = (noise > 0) & (now < most)
    if not growing.any():
        return counts

    def wanted(scale: float) -> np.ndarray:
        optimal = np.minimum((scale * noise) ** (2 / 3), most)
        return np.maximum(np.maximum(optimal, LEAST * optimal.max()), now)

    def enough(scale: float) -> bool:
        after = wanted(scale)
        return area @ after >= GROWTH * (area @ now) or area @ (noise / np.sqrt(after)) <= AIM * target * area.sum()

    low = 0.0
    high = float(((CELL_GROWTH * now[growing]) ** 1.5 / noise[growing]).min())  # there the first cell has grown enough
    if enough(high):
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (low, middle) if enough(middle) else (middle, high)
    after = np.minimum(np.ceil(wanted(high) / MULTIPLE - 1e-6) * MULTIPLE, most)
    return after.astype(np.int64)[cell]
