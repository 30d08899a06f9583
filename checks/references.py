"""Compare our path tracer with Cycles' images: ``python checks/references.py SCENE.h5... --references FOLDER``

FOLDER holds ``<scene>-physical-<resolution>.exr`` (unclamped, box filter, not denoised) and ``<scene>-compat-<resolution>.exr``
(Cycles' defaults, denoised), lights visible in both. Prints per scene

- physical: how far the means of values clamped at 4 are, by colour channel; PSNR of values clamped to [0, 1], as they are and
  after denoising both images without guides;
- compat: the same means, PSNR and log error of ``mode=cycles`` and of ``mode=physical``, denoised as stored.

With ``--cycles-python`` naming an interpreter that has ``bpy`` (Blender as a module, Python 3.11), Cycles renders the physical
image again at ``--cycles-spp``, which tells the noise of a reference from a real difference. Exits with 1 where a physical
mean is farther than ``--tolerance``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def means(image: np.ndarray) -> np.ndarray:
    """By channel, of values clamped at 4: a visible light would outweigh everything else."""
    return np.minimum(image, 4).mean(axis=(0, 1), dtype=np.float64)


def percent(a: np.ndarray, b: np.ndarray) -> str:
    return " ".join(f"{value:+.2%}" for value in means(a) / means(b) - 1)


def bare(image: np.ndarray) -> np.ndarray:
    """Denoised without guides."""
    import pyoidn

    return pyoidn.denoise(np.ascontiguousarray(image, np.float32), hdr=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--references", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--spp", type=int, default=2048, help="of our physical image, default %(default)s")
    parser.add_argument("--compat-spp", type=int, default=256, help="of the others, default %(default)s")
    parser.add_argument("--tolerance", type=float, default=0.005, help="relative, default %(default)s")
    parser.add_argument("--cycles-python", metavar="PYTHON", help="an interpreter that has bpy")
    parser.add_argument("--cycles-spp", type=int, default=16384, help="default %(default)s")
    args = parser.parse_args()

    sys.path.insert(0, str(ROOT))
    from stages.graphics.exr import read_rgb
    from stages.graphics.metrics import log_error, psnr
    from stages.graphics.mitsuba.backend import choose
    from stages.graphics.tonemap import clamp
    from stages.renderformer.rendering.render import render_views
    from stages.renderformer.rendering.settings import RenderSettings
    from stages.renderformer.scenes.released import load_scene

    backend, failed = choose(), 0

    def reference(path: Path, kind: str) -> np.ndarray | None:
        found = sorted(args.references.glob(f"{path.stem}-{kind}-*.exr"))
        return read_rgb(found[0]) if found else None

    def ours(scene, truth: np.ndarray, spp: int, **named) -> np.ndarray:
        settings = RenderSettings(len(truth), spp, lights_visible=True, **named)
        return render_views(scene, settings, backend, [0])[0].image

    def again(scene, resolution: int) -> np.ndarray:
        with tempfile.TemporaryDirectory() as folder:
            first = {"camera_to_world": scene.camera_to_world[:1], "fov_deg": scene.fov_deg[:1]}
            np.savez(f"{folder}/scene.npz", **scene.arrays() | first)
            command = [args.cycles_python, str(ROOT / "bench" / "cycles.py"), f"{folder}/scene.npz", "--out", folder]
            command += ["--spp", str(args.cycles_spp), "--resolution", str(resolution), "--lights-visible"]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            return read_rgb(Path(folder) / "scene-0.exr")

    for path in args.scenes:
        scene = load_scene(path)
        if (truth := reference(path, "physical")) is not None:
            image = ours(scene, truth, args.spp, denoise=False)
            raw, clean = psnr(clamp(image), clamp(truth)), psnr(clamp(bare(image)), clamp(bare(truth)))
            print(
                f"{path.stem:14} physical  means {percent(image, truth)}  PSNR {raw:.1f} raw, {clean:.1f} denoised", flush=True
            )
            failed += bool((np.abs(means(image) / means(truth) - 1) > args.tolerance).any())
            if args.cycles_python:
                other = again(scene, len(truth))
                print(f"{'':14} Cycles at {args.cycles_spp} samples: ours {percent(image, other)} from it,", end=" ")
                print(f"the reference {percent(truth, other)}", flush=True)
        if (truth := reference(path, "compat")) is not None:
            for mode in ("cycles", "physical"):
                image = ours(scene, truth, args.compat_spp, mode=mode)
                told = f"PSNR {psnr(clamp(image), clamp(truth)):.1f}, log error {log_error(image, truth):.5f}"
                print(f"{path.stem:14} compat, mode={mode}  means {percent(image, truth)}  {told}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
