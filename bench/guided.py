"""What a picture of a guided model costs by part: ``python bench/guided.py CHECKPOINT DATASET --resolutions 64,128,256``

CHECKPOINT: a checkpoint's folder. DATASET: a shard artifact's folder, of whose test scenes the first view is drawn.
Milliseconds of processor time on one thread, the least of ``--repeats``, the mean over the scenes, so that it may run beside
other programs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model.renderformer.guided.pixels import Pixels  # noqa: E402
from pipeline.store import Artifact  # noqa: E402
from stages.renderformer.dataset import decode_sample  # noqa: E402
from stages.renderformer.guides import GuideCaster  # noqa: E402
from stages.renderformer.inference.predict import load_model, network_arrays, predict_scene  # noqa: E402

PARTS = ("visibility of lights", "tokens", "rays", "pixels", "first picture")


def milliseconds(work: Callable[[], Any], repeats: int) -> float:
    times = []
    for _ in range(repeats + 1):  # the first one, which also allocates, is never the least
        began = time.thread_time()
        work()
        times.append(time.thread_time() - began)
    return 1000 * min(times[1:])


def parts(model: Any, scene: Any, view: int, side: int, repeats: int) -> list[float]:
    """Milliseconds of `PARTS`; the first two are taken once per scene."""
    batch, seen_by = network_arrays(model, scene, (side, side))
    caster, seen = GuideCaster(scene), seen_by(view)
    with torch.inference_mode():
        scenes = model.read_scenes(batch, "cpu")
        encoded = model.encode(scenes)
        pixels = Pixels.read(seen, scenes, model.config.bundle)
        works = (
            lambda: GuideCaster(scene).scene_guides(model.reads_bounces),
            lambda: model.encode(scenes),
            lambda: caster.view_guides(view, side, side),
            lambda: model.decode_view(encoded, pixels),
            lambda: predict_scene(model, scene, [view], side),
        )
        return [milliseconds(work, repeats) for work in works]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--resolutions", default="64,128,256", help="pixels per side (default: %(default)s)")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    model, shard = load_model(arguments.checkpoint), Artifact(arguments.dataset)
    samples = [decode_sample(shard.read(id)) for id in shard.ids("test")[: arguments.scenes]]
    print("pixels" + "".join(f"{part:>22}" for part in PARTS))
    for side in map(int, arguments.resolutions.split(",")):
        rows = [parts(model, sample.scene, next(iter(sample.views)), side, arguments.repeats) for sample in samples]
        print(f"{side:>6}" + "".join(f"{value:>22.0f}" for value in np.mean(rows, axis=0)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
