"""How linear a model is in light, as a path tracer is: ``python checks/linearity.py CHECKPOINT DATASET --scenes 24``

CHECKPOINT: a checkpoint's folder. DATASET: a shard artifact's folder. Of each test scene's first view: the image under doubled
light against twice the image (largest difference over the largest value), and the sum of images by one light alone against the
image by all at once (mean |log10(1 + x) - log10(1 + y)|; of scenes with more than one light). Exits with 1 where either is over
its tolerance.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.store import Artifact  # noqa: E402
from stages.graphics.metrics import log_error  # noqa: E402
from stages.renderformer.dataset import decode_sample  # noqa: E402
from stages.renderformer.inference.predict import light_passes, load_model, predict_scene  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--scenes", type=int, default=24, help="test scenes, at most (default: 24)")
    parser.add_argument("--doubled", type=float, default=1e-6, help="tolerance (default: %(default)s)")
    parser.add_argument("--composited", type=float, default=3e-3, help="tolerance of the mean (default: %(default)s)")
    arguments = parser.parse_args()
    model, shard = load_model(arguments.checkpoint), Artifact(arguments.dataset)
    doubled, composited = [], []
    for scene_id in shard.ids("test")[: arguments.scenes]:
        sample = decode_sample(shard.read(scene_id))
        view, size = next(iter(sample.views)), next(iter(sample.views.values())).image.shape[0]

        def image(scene, view=view, size=size) -> np.ndarray:
            return predict_scene(model, scene, [view], size)[0]

        scene, once = sample.scene, image(sample.scene)
        twice = image(replace(scene, emission=2 * scene.emission))
        doubled.append(float(np.abs(twice - 2 * once).max() / max(twice.max(), 1e-30)))
        if scene.n_lights > 1:
            composited.append(log_error(once, sum(share * image(alone) for alone, share in light_passes(scene))))
    print(f"doubled light: largest difference {max(doubled):.1e} of the largest value, in {len(doubled)} views")
    mean, most = np.mean(composited), max(composited)
    print(f"lights one by one: mean log error {mean:.4f}, at most {most:.4f}, in {len(composited)} views")
    return int(max(doubled) > arguments.doubled or mean > arguments.composited)


if __name__ == "__main__":
    sys.exit(main())
