"""The proof of a renderer's backend: a process of its own renders a tiny scene (see ``backend``), as ``python -m`` does.

A compiler that does not fit the machine ends this process, not the run.
"""

from __future__ import annotations

import json
import sys
import traceback
from typing import Any

from stages.renderformer.rendering.backend import OUR_FAULT


def trial(backend: dict[str, Any]) -> None:
    """Render a lit quad; an exception, or an image that is not finite and bright, is a failure."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an aborting compiler leaves no core file behind

    import numpy as np

    from stages.renderformer.records import SceneRecord
    from stages.renderformer.rendering.render import render_views

    floor = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], np.float32)
    light = np.array([[[-0.2, -0.2, 1.5], [0.2, -0.2, 1.5], [0, 0.2, 1.5]]], np.float32)
    triangles = np.concatenate([floor, light])
    camera = np.eye(4, dtype=np.float32)
    camera[2, 3] = 1.0
    scene = SceneRecord(
        "probe",
        triangles,
        np.broadcast_to(np.float32([0, 0, 1]), (3, 3, 3)),
        np.full((3, 3), 0.5, np.float32),
        np.full((3, 3), 0.2, np.float32),
        np.full(3, 0.5, np.float32),
        np.float32([[0] * 3, [0] * 3, [50] * 3]),
        np.int16([-1, -1, 0]),
        np.int16([0, 0, 1]),
        camera[None],
        np.float32([60]),
    )
    mean = float(render_views(scene, 8, max_spp=4, seed=0, backend=backend, denoise=False)[0].image.mean())
    assert np.isfinite(mean) and mean > 0, mean


if __name__ == "__main__":
    try:
        trial(json.loads(sys.argv[1]))
    except (TypeError, NameError, AttributeError):
        traceback.print_exc()
        sys.exit(OUR_FAULT)
