"""How fitted scenes of the made-up street look at other sizes than that of the photos they were fitted to.

``python checks/levels.py STORE levels=KEY one_level=KEY [--views 6]``, with keys of bake artifacts of one capture. Held-out
views are path traced anew at half the photos' size, at their size and at twice it, and drawn by torch from every scene. Prints
the mean PSNR by scene and size, and the difference of each scene from the first with its 95 % interval, paired by view. A
texture without levels shimmers where a pixel covers many of its texels: PSNR at half size shows that. Some minutes of a core.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.config import parse  # noqa: E402
from pipeline.store import Store  # noqa: E402
from stages.graphics.metrics import psnr  # noqa: E402
from stages.graphics.mitsuba import backend  # noqa: E402
from stages.graphics.statistics import bootstrap, with_interval  # noqa: E402
from stages.neuras.evaluation.drive import scene_of  # noqa: E402
from stages.neuras.evaluation.renderers import as_bytes  # noqa: E402
from stages.neuras.s00_capture import Capture  # noqa: E402
from stages.neuras.street.source import StreetSource, prepare  # noqa: E402

SIZES = {"half": 0.5, "as fitted": 1.0, "double": 2.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("scenes", nargs="+", metavar="NAME=KEY", help="of bake artifacts; others are compared with the first")
    parser.add_argument("--views", type=int, default=6, help="held-out views between frames, evenly spread")
    arguments = parser.parse_args()
    store = Store(arguments.store)
    found = {name: scene_of(store, key) for name, _, key in (word.partition("=") for word in arguments.scenes)}
    captures = {capture.path: capture for _, capture in found.values()}
    if len(captures) > 1:
        parser.error("the scenes are of several captures: give those of one")
    config = parse(Capture.Config, next(iter(captures.values())).manifest["config"], "capture")
    if config.name != "street":
        parser.error("the truth at other sizes is known of the made-up street alone")
    scenes = {name: scene.reference() for name, (scene, _) in found.items()}
    backend.activate(backend.choose(), threads=1)
    print(f"| size | {' | '.join(scenes)} | difference from {next(iter(scenes))} |\n|{' --- |' * (2 + len(scenes))}")
    with tempfile.TemporaryDirectory() as folder:
        prepare(config, Path(folder))
        for size, scale in SIZES.items():
            sized = config.model_copy(update={"width": round(scale * config.width), "height": round(scale * config.height)})
            source = StreetSource(sized, Path(folder))
            test = [id for id, group in source.items() if group == "test"]
            chosen = [test[i] for i in np.unique(np.linspace(0, len(test) - 1, arguments.views).round().astype(int))]
            scores: dict[str, list[float]] = {name: [] for name in scenes}
            for id in chosen:
                frame = source.frame(id)
                for name, scene in scenes.items():
                    scores[name].append(psnr(frame.image() / 255, as_bytes(scene.render(frame.camera)) / 255))
            first, *others = scores.values()
            gains = [bootstrap([[b - a] for a, b in zip(first, other, strict=True)]) for other in others]
            means = " | ".join(f"{np.mean(values):.2f}" for values in scores.values())
            told = ", ".join(with_interval(gain, "{:+.2f}".format) for gain in gains)
            print(f"| {size}: {sized.width} x {sized.height} | {means} | {told} |", flush=True)


if __name__ == "__main__":
    main()
