"""Where in its pictures a model errs: every pixel belongs to one region, told from what the path tracer noted of it.

Reads views as stored; gives numbers. A region's error is the paper's, mean |log10(1 + x) - log10(1 + y)|, over its pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stages.renderformer.records import SceneRecord, ViewRecord

SMOOTH = 0.3  # roughness under which a surface counts as smooth
SPECULAR = 0.5  # share of the reflectance from which a surface counts as specular
SHADOWED = 0.25  # share of direct light in the radiance under which a diffuse surface counts as shadowed
REGIONS: Mapping[str, str] = {
    "silhouette": "the pixel or a neighbour sees another object, or past all of them",
    "smooth specular": f"most of the reflectance is specular, roughness under {SMOOTH}",
    "rough specular": "most of the reflectance is specular, rougher than that",
    "lit diffuse": "the others, where direct light is at least a quarter of the radiance",
    "shadowed diffuse": "the others, where it is less",
    "nothing": "no ray of the pixel hits anything",
}


def region_map(scene: SceneRecord, view: ViewRecord) -> np.ndarray:
    """(H, W) int8, the place of each pixel's region in ``REGIONS``."""
    names = list(REGIONS)
    hit = view.triangle >= 0
    faces = np.maximum(view.triangle, 0)
    specular, diffuse = scene.specular[faces].mean(axis=-1), scene.diffuse[faces].mean(axis=-1)
    shiny = specular > SPECULAR * (specular + diffuse)
    lit = view.direct.mean(axis=-1) >= SHADOWED * view.image.mean(axis=-1)
    out = np.where(lit, names.index("lit diffuse"), names.index("shadowed diffuse"))
    out[shiny] = names.index("rough specular")
    out[shiny & (scene.roughness[faces] < SMOOTH)] = names.index("smooth specular")
    out[view.coverage == 0] = names.index("nothing")
    edge = (view.coverage > 0) & ((view.coverage < 1) | ~hit | _differs(view.object))
    out[edge] = names.index("silhouette")
    return out.astype(np.int8)


def _differs(objects: np.ndarray) -> np.ndarray:
    """(H, W) bool: whether one of a pixel's eight neighbours has another value."""
    padded = np.pad(objects, 1, mode="edge")
    height, width = objects.shape
    shifts = [padded[1 + i : 1 + i + height, 1 + j : 1 + j + width] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    return np.any([shift != objects for shift in shifts], axis=0)


def region_errors(regions: np.ndarray, target: np.ndarray, images: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """By region that the view shows: ``pixels``, and the mean log error of each image, by method."""
    errors = {
        method: np.abs(np.log10(1 + np.maximum(image, 0)) - np.log10(1 + target)).mean(axis=-1)
        for method, image in images.items()
    }
    return {
        name: {
            "pixels": int((regions == number).sum()),
            **{method: round(float(error[regions == number].mean(dtype=np.float64)), 7) for method, error in errors.items()},
        }
        for number, name in enumerate(REGIONS)
        if (regions == number).any()
    }


def summarise_regions(scenes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each region: its ``share`` of all pixels, and by method its mean ``error`` and its ``part`` of the whole."""
    views = [view["regions"] for scene in scenes for view in scene["views"]]
    methods = [name for name in next(iter(views[0].values())) if name != "pixels"]
    pixels = sum(region["pixels"] for view in views for region in view.values())

    def total(name: str, method: str) -> float:
        return sum(view[name]["pixels"] * view[name][method] for view in views if name in view)

    whole = {method: sum(total(name, method) for name in REGIONS) for method in methods}
    rows = []
    for name in REGIONS:
        count = sum(view[name]["pixels"] for view in views if name in view)
        if count:
            sums = {method: total(name, method) for method in methods}
            error = {method: value / count for method, value in sums.items()}
            part = {method: value / whole[method] if whole[method] else 0.0 for method, value in sums.items()}
            rows.append({"region": name, "share": count / pixels, "error": error, "part": part})
    return rows
