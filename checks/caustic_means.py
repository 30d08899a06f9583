"""Whether light paths leave every mean as it is: ``python checks/caustic_means.py [--spp 65536] [--cycles-python PYTHON]``

The six views of bench/caustics.py are rendered by camera paths alone, which need nothing more, and by both kinds of paths, each
in parts of 1,024 samples that share no path; with ``--adaptive`` the second way is that of ``render.adaptive``, guided and
taken to the last sample. Prints per view the means over all pixels of radiance as it is, and clamped at 4,
how far the second is from the first, and the standard error of that, told from the parts. With ``--cycles-python`` naming an
interpreter that has ``bpy``, Cycles renders the same (``--cycles-spp``). Exits with 1 where a difference is over
``--tolerance`` and over three standard errors. Some 20 minutes of one core.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from bench.caustics import NAMES  # noqa: E402
from bench.caustics import scene as caustic_scene  # noqa: E402
from stages.graphics.exr import read_rgb  # noqa: E402
from stages.graphics.mitsuba.backend import choose  # noqa: E402
from stages.renderformer.records import SceneRecord  # noqa: E402
from stages.renderformer.rendering import caustics  # noqa: E402
from stages.renderformer.rendering.render import render_views  # noqa: E402
from stages.renderformer.rendering.settings import RenderSettings  # noqa: E402

CLAMP = 4.0
PART = 1024  # samples per pixel
NEVER = 1e-9  # an error that no view meets


class Means:
    """Of one view by one way: ``plain`` and ``clamped``, each (mean, standard error)."""

    def __init__(self, parts: list[np.ndarray]):
        whole = np.mean(parts, axis=0, dtype=np.float64)
        # The mean of clamped values is not that of clamped parts: a part changes it where nothing is cut.
        free = whole < CLAMP
        error = len(parts) ** -0.5
        self.plain = whole.mean(), np.std([part.mean(dtype=np.float64) for part in parts], ddof=1) * error
        self.clamped = np.minimum(whole, CLAMP).mean(), np.std([(part * free).mean() for part in parts], ddof=1) * error


def ours(scene: SceneRecord, side: int, spp: int, light_paths: bool, backend: dict, threads: int, **way) -> list[np.ndarray]:
    served = caustics.NARROW_ALPHA
    try:
        caustics.NARROW_ALPHA = served if light_paths else 0.0  # no part of a surface is narrow: nothing is left to light paths
        every = (RenderSettings(side, PART, seed, denoise=False, **way) for seed in range(spp // PART))
        return [render_views(scene, settings, backend, threads=threads)[0].image for settings in every]
    finally:
        caustics.NARROW_ALPHA = served


def by_cycles(scene: SceneRecord, side: int, spp: int, python: str, threads: int) -> list[np.ndarray]:
    """Four parts."""
    parts = []
    with tempfile.TemporaryDirectory() as folder:
        np.savez(f"{folder}/scene.npz", **scene.arrays())
        for seed in range(4):
            command = [python, str(ROOT / "bench" / "cycles.py"), f"{folder}/scene.npz", "--out", folder, "--seed", str(seed)]
            command += ["--spp", str(spp // 4), "--resolution", str(side), "--threads", str(threads)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            parts.append(read_rgb(Path(folder) / "scene-0.exr"))
    return parts


def difference(name: str, one: Means, other: Means) -> tuple[float, float]:
    """Relative, of the second to the first, and its standard error."""
    (a, of_a), (b, of_b) = getattr(one, name), getattr(other, name)
    return b / a - 1, float(np.hypot(of_a, of_b) / a)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spp", type=int, default=65536, help="samples per pixel, default %(default)s")
    parser.add_argument("--resolution", type=int, default=32, help="default %(default)s")
    parser.add_argument("--views", nargs="+", default=NAMES, choices=NAMES, metavar="NAME", help="default: all six")
    parser.add_argument("--adaptive", action="store_true", help="guided, as render.adaptive has it")
    parser.add_argument("--threads", type=int, default=1, help="default %(default)s")
    parser.add_argument("--tolerance", type=float, default=0.005, help="relative, default %(default)s")
    parser.add_argument("--cycles-python", metavar="PYTHON", help="an interpreter that has bpy")
    parser.add_argument("--cycles-spp", type=int, default=65536, help="default %(default)s")
    arguments = parser.parse_args()
    backend, failed = choose(), 0
    way = {"adaptive": True, "target_error": NEVER} if arguments.adaptive else {}
    print("| view | plain: camera paths | light paths too | Cycles | clamped: camera paths | light paths too | Cycles |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for view in arguments.views:
        scene, side = caustic_scene(view), arguments.resolution
        camera = Means(ours(scene, side, arguments.spp, False, backend, arguments.threads))
        both = Means(ours(scene, side, arguments.spp, True, backend, arguments.threads, **way))
        cycles = None
        if arguments.cycles_python:
            cycles = Means(by_cycles(scene, side, arguments.cycles_spp, arguments.cycles_python, arguments.threads))
        cells = []
        for name in ("plain", "clamped"):
            off, error = difference(name, camera, both)
            failed += abs(off) > max(arguments.tolerance, 3 * error)
            cells += [f"{getattr(camera, name)[0]:.5f}", f"{off:+.2%} ± {error:.2%}"]
            cells.append("{:+.2%} ± {:.2%}".format(*difference(name, camera, cycles)) if cycles else "–")
        print(f"| {view} | " + " | ".join(cells) + " |", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
