"""Compare our path tracer with Cycles' images: ``python tests/references.py SCENE.json... --references FOLDER``

FOLDER holds ``<scene>-physical-128.exr``, lights visible, box filter, no clamping. Prints how far the mean of values clamped
at 4 is, averaged over ``--runs`` renders. With ``--cycles-python`` naming an interpreter that has ``bpy`` (Blender as a module,
Python 3.11), Cycles renders the same arrays again at ``--cycles-spp``, which tells the noise of a reference from a real
difference (the last figure carries noise as well). Exits with 1 if a mean is farther than ``--tolerance`` from the reference.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESOLUTION = 128


def clamped_mean(path: Path) -> float:
    """Of an EXR's values clamped at 4: a visible light would outweigh everything else."""
    from stages.exr import read_rgb

    return float(np.minimum(read_rgb(path), 4).mean())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--references", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--spp", type=int, default=1024, help="of each of our renders, default %(default)s")
    parser.add_argument("--runs", type=int, default=4, help="our renders per scene, default %(default)s")
    parser.add_argument("--tolerance", type=float, default=0.01, help="relative, default %(default)s")
    parser.add_argument("--cycles-python", metavar="PYTHON", help="an interpreter that has bpy")
    parser.add_argument("--cycles-spp", type=int, default=16384, help="default %(default)s")
    args = parser.parse_args()

    sys.path.insert(0, str(ROOT))
    from stages.released import load_scene
    from stages.trace import trace

    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        out, arrays = Path(folder) / "out.exr", Path(folder) / "scene.npz"
        for path in args.scenes:
            ours = []
            for seed in range(args.runs):
                trace(path, out, RESOLUTION, args.spp, denoise=False, seed=seed)
                ours.append(clamped_mean(out))
            mean, error = np.mean(ours), np.std(ours) / max(1, len(ours) - 1) ** 0.5
            truth = clamped_mean(args.references / f"{path.stem}-physical-{RESOLUTION}.exr")
            line = f"{path.stem:16s} reference {mean / truth - 1:+.2%} +- {error / truth:.2%}"
            if args.cycles_python:
                scene = load_scene(path)
                first = {"camera_to_world": scene.camera_to_world[:1], "fov_deg": scene.fov_deg[:1]}
                np.savez(arrays, **scene.arrays() | first)
                command = [args.cycles_python, str(ROOT / "bench" / "cycles.py"), str(arrays), "--out", folder]
                command += ["--spp", str(args.cycles_spp), "--resolution", str(RESOLUTION), "--lights-visible"]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                again = clamped_mean(arrays.with_name("scene-0.exr"))
                line += f"; Cycles at {args.cycles_spp} samples: {mean / again - 1:+.2%}, "
                line += f"itself {again / truth - 1:+.2%} from the reference"
            failed += not abs(mean / truth - 1) <= args.tolerance
            print(line, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
