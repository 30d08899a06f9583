"""How good are the stored images, and does their error estimate tell the truth?

    python bench/error.py [--scenes PATH...] [--views 20] [--resolution 128] [--truth-spp 4096] [-o scatter.png]

Renders views at 16, 64 and 256 samples per pixel as the render stage stores them and compares them with long renders; scenes,
truths and their cache are those of ``bench/render.py``. Prints by samples per pixel the mean error (absolute difference of
log10(1 + x)) of the raw image, of the sum of the lights denoised as one, and of the stored image, whose lights are denoised
one by one; how far denoising moves the mean of values clamped at 4; and how the estimated error of the stored image relates
to the true one. With ``-o`` the estimates are drawn against the true errors. The weights in
``stages/renderformer/rendering/error.py`` come from such runs. Some 20 minutes on 2 quiet cores, nearly all of it for the
truths.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from render import ROOT, Bench, View, choose_views, made_scenes, read_scenes

from stages.graphics.denoising import denoise
from stages.graphics.mitsuba import backend as backends

SAMPLES = (16, 64, 256)
FACTOR = 1.5  # within which an estimate counts as right


def measure(bench: Bench, view: View) -> list[dict]:
    """A row per number of samples."""
    truth = bench.truth(view)
    mean = np.minimum(truth.halves.mean(axis=0), 4).mean()
    rows = []
    for spp in SAMPLES:
        # a target out of reach: all samples are taken, in halves, and the error is estimated
        raw, stored = (bench.render(view, f"error/{spp}", spp, target_error=1e-12, denoise=flag)[1] for flag in (False, True))
        one = denoise(raw.image, raw.albedo, raw.normal, raw.coverage)
        row = {"view": view.name, "lights": len(stored.lights), "spp": spp, "estimate": stored.meta["error"]}
        row |= {"raw": truth.bound(raw.image), "sum": truth.error(one), "stored": truth.error(stored.image)}
        rows.append(row | {"mean": float(np.minimum(stored.image, 4).mean() / mean - 1), "noise": truth.noise})
    return rows


def table(rows: list[dict]) -> str:
    lines = [
        f"{'spp':>5} {'raw':>8} {'sum':>8} {'stored':>8} {'stored/sum':>11} {'mean':>7}"
        f" {'estimate/true p10':>18} {'p50':>5} {'p90':>5} {'within 1.5x':>12}"
    ]
    for spp in SAMPLES:
        mine = [row for row in rows if row["spp"] == spp]
        raw, one, stored = (np.array([row[name] for row in mine]) for name in ("raw", "sum", "stored"))
        ratio = np.array([row["estimate"] for row in mine]) / stored
        right = np.abs(np.log(ratio)) <= np.log(FACTOR)
        low, middle, high = np.percentile(ratio, (10, 50, 90))
        lines.append(
            f"{spp:5d} {raw.mean():8.5f} {one.mean():8.5f} {stored.mean():8.5f} {stored.mean() / one.mean():11.3f}"
            f" {np.mean([row['mean'] for row in mine]):+7.2%} {low:18.2f} {middle:5.2f} {high:5.2f}"
            f" {right.sum():6d} of {len(right)}"
        )
    noise = np.mean([row["noise"] for row in rows])
    return "\n".join([*lines, f"noise of the truths {noise:.5f} on the mean"])


def plot(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 5), layout="constrained")
    for spp, marker in zip(SAMPLES, "os^", strict=True):
        mine = [row for row in rows if row["spp"] == spp]
        true, told = ([row[name] for row in mine] for name in ("stored", "estimate"))
        axes.loglog(true, told, marker, label=f"{spp} samples per pixel", alpha=0.8, markersize=5)
    ends = np.array(axes.get_xlim() + axes.get_ylim())
    line = np.array([ends.min(), ends.max()])
    axes.plot(line, line, color="black", linewidth=1)
    axes.fill_between(line, line / FACTOR, line * FACTOR, color="black", alpha=0.08, label=f"within a factor of {FACTOR}")
    axes.set(xlabel="error against a long render", ylabel="estimated error", xlim=line, ylim=line, aspect="equal")
    axes.set_title("mean absolute difference of log10(1 + radiance)", fontsize=10)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", type=Path, metavar="PATH", help="as of bench/render.py")
    parser.add_argument("--views", type=int, default=20, help="default %(default)s")
    parser.add_argument("--resolution", type=int, default=128, help="default %(default)s")
    parser.add_argument("--truth-spp", type=int, default=4096, help="default %(default)s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="default: all cores")
    parser.add_argument("--backend", default="auto", choices=backends.CHOICES)
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "bench", help="scenes and truths are kept here")
    parser.add_argument("-o", "--out", type=Path, metavar="PNG", help="scatter plot")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    backend = backends.choose(arguments.backend)
    scenes = read_scenes(arguments.scenes) if arguments.scenes else made_scenes(arguments.work)
    views = choose_views(scenes, arguments.views, arguments.work, backend, arguments.threads)
    bench, rows = Bench(arguments, backend), []
    for view in views:
        rows += measure(bench, view)
        for row in rows[-len(SAMPLES) :]:
            told = " ".join(f"{name} {row[name]:.5f}" for name in ("raw", "sum", "stored", "estimate"))
            print(f"{row['view']:24} {row['lights']:2} lights {row['spp']:4} spp  {told}", flush=True)
    print(f"\n{len(views)} views, {arguments.resolution} px, {backend['backend']}\n{table(rows)}")
    if arguments.out:
        plot(rows, arguments.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
