"""How far a set of pictures looks from a set of photos: FID and KID, of features of the Inception network.

Neither needs the photo of the same place. So the paper judges lanes beside the drive by them, against the photos of the drive.
Truth beside the drive, where it exists, is judged the same way: it says what a good value is. Warping can come closer, because
it shows the photos themselves. FID is biased upwards where images are few, so compare only sets of the same size. KID is not.
Masks are not applied.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from pipeline.stage import Inputs
from stages.graphics.metrics import Metric
from stages.neuras.evaluation import paths
from stages.neuras.evaluation.renderers import Scene, as_bytes
from stages.neuras.evaluation.views import Photos, warping
from stages.neuras.records import fitted_poses, frames, posed

LEAST = 2  # images of a set: a covariance needs two
TRUTH = "photo"  # the "method" whose pictures are the photos themselves

Features = np.ndarray  # (N, D) float64, a row per image


def frechet(a: Features, b: Features) -> float:
    """FID: the Frechet distance between Gaussians of the same means and covariances as ``a`` and ``b`` (Heusel et al. 2017).

    The trace of sqrt(cov_a cov_b) is the sum of the singular values of the product of the centred features, because the
    covariances are of low rank where images are few. So no square root of a singular matrix is taken.
    """
    centred = [(x - x.mean(axis=0)) / np.sqrt(len(x) - 1) for x in (a, b)]
    spread = sum(float(np.square(x).sum()) for x in centred)
    overlap = float(np.linalg.svd(centred[0] @ centred[1].T, compute_uv=False).sum())
    return float(np.square(a.mean(axis=0) - b.mean(axis=0)).sum()) + spread - 2 * overlap


def kernel_distance(a: Features, b: Features) -> float:
    """KID: the unbiased squared maximum mean discrepancy with the kernel (x.y / D + 1)^3 (Binkowski et al. 2018).

    Over all pairs, not over random subsets. It may be negative where the sets are alike.
    """

    def kernel(x: Features, y: Features) -> np.ndarray:
        return (x @ y.T / x.shape[1] + 1) ** 3

    def within(x: Features) -> float:
        return float((kernel(x, x).sum() - np.trace(kernel(x, x))) / (len(x) * (len(x) - 1)))

    return within(a) + within(b) - 2 * float(kernel(a, b).mean())


METRICS = {
    metric.name: metric
    for metric in (
        Metric("fid", "FID", "", False, 1, None, (0, np.inf), frechet),
        Metric("kid", "KID", "", False, 4, None, (-np.inf, np.inf), kernel_distance),
    )
}


Pictures = Callable[[str], Mapping[str, np.ndarray]]  # a view's key -> its pictures by method, (H, W, 3) uint8


def extractor(folder: str | None) -> Callable[[np.ndarray], np.ndarray]:
    """A picture (H, W, 3) uint8 -> its features (D,); InputError where the network's weights are missing."""
    import torch

    from model.inception import Inception

    network = Inception.load(folder)
    torch.set_num_threads(1)  # sums in another order round differently

    def features(picture: np.ndarray) -> np.ndarray:
        image = torch.from_numpy(picture.astype(np.float32) / 255).permute(2, 0, 1)[None]
        with torch.inference_mode():
            found: np.ndarray = network(image)[0].double().numpy()
        return found

    return features


def judge(
    sets: Mapping[str, Sequence[str]], pictures: Pictures, photos: Iterable[np.ndarray], folder: str | None
) -> list[dict[str, Any]]:
    """FID and KID of every method against the photos, for every set of views, as plain JSON.

    sets: keys of views by the set's label; those of fewer than `LEAST` are left out. folder: of the network's weights.
    """
    features = extractor(folder)
    reference = np.array([features(photo) for photo in photos])
    known: dict[str, dict[str, np.ndarray]] = {}
    rows = []
    for label, keys in sets.items():
        if min(len(keys), len(reference)) < LEAST:
            continue
        for key in keys:
            if key not in known:
                known[key] = {method: features(picture) for method, picture in pictures(key).items()}
        of_method = {method: np.array([known[key][method] for key in keys]) for method in known[keys[0]]}
        scores = {
            method: {name: round(metric.measure(reference, found), 6) for name, metric in METRICS.items()}
            for method, found in of_method.items()
        }
        rows.append({"label": label, "views": len(keys), "photos": len(reference), "methods": scores})
    return rows


def photographed(
    groups: Iterable[Mapping[str, Any]], read: Callable[[str, str], bytes]
) -> tuple[dict[str, list[str]], Pictures]:
    """The sets of views beside the drive whose truth is known, and their pictures.

    groups: the summary's. read: a view's PNG of a method.
    """
    beside = [group for group in groups if group["metres"]]

    def pictures(key: str) -> dict[str, np.ndarray]:
        methods = (TRUTH, *beside[0]["methods"])
        return {method: np.array(Image.open(io.BytesIO(read(key, method))).convert("RGB")) for method in methods}

    return {group["label"]: group["ids"] for group in beside}, pictures


def imagined(
    scene: Scene, inputs: Inputs, splits: Sequence[str], shifts: Sequence[float], nearest: int
) -> tuple[dict[str, list[str]], Pictures]:
    """The same where nobody has photographed: the frames of ``splits``, moved by ``shifts`` (metres) to both sides."""
    reference = scene.reference()
    photos = Photos(inputs["capture"], inputs["fit"])
    warped = warping(photos, reference, scene.info.radius, nearest)
    cameras, sets = {}, {}
    for metres in shifts:
        sides: dict[str, list[str]] = {}
        for shift, side in ((-metres, "left"), (metres, "right")):
            sides[side] = []
            for frame in posed(frames(inputs["capture"], *splits), fitted_poses(inputs["fit"])):
                (cameras[key := f"{frame.id} {shift:+g}"],) = paths.beside([frame.camera], shift * scene.info.metre)
                sides[side].append(key)
        sets |= {f"{metres:g} m to the {side}": keys for side, keys in sides.items()}
        sets[f"{metres:g} m, both sides"] = [key for keys in sides.values() for key in keys]

    def pictures(key: str) -> dict[str, np.ndarray]:
        return {
            "ours": as_bytes(reference.render(cameras[key])),
            "warping": as_bytes(warped.render(cameras[key])[0]),
        }

    return sets, pictures
