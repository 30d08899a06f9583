"""The baked page beside torch: what a browser draws of held-out frames, and how long it takes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.graphics.cameras import Camera
from stages.neuras.baking.browser import pictures
from stages.neuras.baking.site import view_name
from stages.neuras.evaluation.renderers import Reference
from stages.neuras.evaluation.scores import agreement

TIMED = 5  # frames


def compare_page(site: Path, reference: Reference, cameras: Mapping[str, Camera], limit: int) -> dict[str, Any]:
    """How far the page's pictures of these frames are from torch's: one row per frame, and times in ms.

    cameras: by frame id; at most ``limit`` of those that the page offers, evenly spaced. Raises RuntimeError where no
    browser draws it.
    """
    offered = {view["name"]: number for number, view in enumerate(json.loads((site / "scene.json").read_bytes())["frames"])}
    known = [frame for frame in cameras if view_name(frame) in offered]
    if not known:
        raise RuntimeError("the page offers no held-out frame: raise bake.frames")
    chosen = [known[i] for i in np.unique(np.linspace(0, len(known) - 1, min(limit, len(known))).round().astype(int))]
    images, times = pictures(site, [f"frame={offered[view_name(frame)]}" for frame in chosen], timing=TIMED)
    rows = [
        {"id": frame, **agreement(image / 255, reference.render(cameras[frame]))}
        for frame, image in zip(chosen, images, strict=True)
    ]
    last = cameras[chosen[-1]]
    return {"views": rows, "size": [last.width, last.height], "ms": [round(value, 3) for value in times]}
