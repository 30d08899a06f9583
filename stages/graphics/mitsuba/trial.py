"""The trial of a backend: a process of its own renders a tiny scene (see ``backend``), as ``python -m`` does.

A compiler that does not fit the machine ends this process, not the run.
"""

from __future__ import annotations

import json
import sys
import traceback
from typing import Any

from stages.graphics.mitsuba.backend import OUR_FAULT, activate

BOUNCES = 4


def trial(backend: dict[str, Any]) -> None:
    """Path trace a floor under a lamp, both triangle meshes; an exception or an image not finite and bright is a failure."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an aborting compiler leaves no core file behind
    activate(backend)

    import mitsuba as mi
    import numpy as np

    at = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": BOUNCES},
            "camera": {
                "type": "perspective",
                "fov": 60.0,
                "to_world": at().look_at(origin=[0, -2, 1], target=[0, 0, 0], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8},
            },
            "floor": {
                "type": "cube",
                "to_world": at().translate([0, 0, -0.1]).scale([1, 1, 0.1]),
                "bsdf": {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.5}},
            },
            "lamp": {
                "type": "cube",
                "to_world": at().translate([0, 0, 2]).scale(0.2),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 50.0}},
            },
        }
    )
    mean = float(np.array(mi.render(scene, spp=4)).mean())
    assert np.isfinite(mean) and mean > 0, mean


if __name__ == "__main__":
    try:
        trial(json.loads(sys.argv[1]))
    except (TypeError, NameError, AttributeError):
        traceback.print_exc()
        sys.exit(OUR_FAULT)
