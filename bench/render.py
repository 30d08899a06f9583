"""Speed of path tracing at equal error: ours, Mitsuba's built-in ``path`` integrator, and Blender Cycles on the same arrays:

    python bench/render.py [--cycles-python PYTHON] [--views 6] [--resolution 256] [--scenes PATH...]

PYTHON has ``bpy`` (``python3.11 -m venv B && B/bin/pip install bpy==5.0.1``). Without ``--scenes`` (scene files, folders of
them, or a scene artifact of a store) it makes a small scene artifact by the released law from procedural objects. Lights are
hidden from cameras, as in the released data. Some 25 minutes on 2 quiet cores; ``--views 2``, ``--resolution 128``,
``--truth-spp 512`` and ``--patience 5`` cut that. Artifacts and truths are kept in ``--work`` for the next run.

It prints, with the spread over views:
1. samples per second of ours and of ``path``: the same scene, backend, depth, samples and box filter, lights hidden for both;
2. time and samples to a target error, with and without denoising: where ``render_views(target_error=...)`` stops and which
   error the view then really has; and which fixed number of samples, doubling from 16 and interpolated, first has it;
3. fixed 64 and 4,096 samples (4,096 where it was not rendered: the time from the rate, the error without denoising from the
   truth's noise by 1/sqrt(samples));
4. views per hour, everything included (process start, imports, choosing a backend, compiling kernels with an empty cache,
   reading the arrays, building the scene, denoising, writing the EXR), ours at ``--target`` against Cycles
   (a) at the released settings: 4,096 samples, adaptive threshold 0.01, denoised, Blender's default light paths;
   (b) tuned: unclamped and as deep as ours, denoised with guides, every view at the fewest samples, doubling from 16, that
   have the error that ours really has; (b') the same interpolated to exactly that error. Nobody knows these numbers before
   rendering: (b) is the best that Cycles could do, not what a data run would get.

Error is the mean absolute difference of log10(1 + x) to the truth: a long render by our own tracer in two halves that share no
path, denoised together. Denoised, because views with caustics have raw noise above the smallest target even at 4,096 samples;
the price is a bias that it shares with the denoised images that it judges, ours and Cycles' alike. Beside it stands "at most":
the error against the raw truth, whose noise adds by its variance, to first order, and is taken out by extrapolation (twice the
error against the mean of the halves, less the mean error against each half; with fireflies not wholly). The smaller of
the two counts as the error; where they agree the figure is sure. The noise of a truth is half the difference of its halves.
Cycles is judged by a truth of its own, made the same way with as many samples and the guides of ours, or by ours, whichever is
kinder to it: the renderers agree to a few tenths of a per cent (a table says how well), but that is not far below the
smallest targets, and its own truth has more noise where ours was made with path guiding. The column "mean" (of values
clamped at 4, over the raw truth's) shows how far an image is on the whole.

``--costs N`` does something else: it renders all views of N of the scenes to ``--target``, with camera paths alone, with light
paths, and with samples where they pay besides (``--ways`` chooses), and prints the CPU seconds a scene takes by roughness and
template; with ``--caustics`` of the six views of ``bench/caustics.py``.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # before this folder, whose files have the names of packages

import numpy as np  # noqa: E402

from pipeline.atomic import atomic_path  # noqa: E402
from pipeline.keys import seed_for  # noqa: E402
from pipeline.store import Artifact  # noqa: E402
from stages.graphics import denoising  # noqa: E402
from stages.graphics.exr import read_rgb  # noqa: E402
from stages.graphics.metrics import log_error  # noqa: E402
from stages.graphics.mitsuba import backend as backends  # noqa: E402
from stages.renderformer.records import SceneRecord  # noqa: E402
from stages.renderformer.rendering.render import render_views  # noqa: E402
from stages.renderformer.rendering.settings import MODES, RenderSettings  # noqa: E402
from stages.renderformer.s04_render import Render  # noqa: E402
from stages.renderformer.scenes.released import load_scene  # noqa: E402
from stages.renderformer.views import encode_view, view_members  # noqa: E402

MAX_DEPTH = 34  # segments; Cycles: 32 bounces
CHUNK = 256  # samples per pixel in one call for a truth
GUIDED = 1e-9  # target error out of reach: a truth is made with path guiding
RATE_SPP = 64  # samples per pixel of the renders that measure samples per second
FIXED = (64, 4096)
MADE = [  # overrides of the default scenes
    "collect.per_family=1",
    "decimate.budgets=[256,512,1024]",
    "scene.count.train=24",
    "scene.count.validation=0",
    "scene.count.test=0",
    "scene.max_triangles=1572",
]


# --- errors -----------------------------------------------------------------------------------------------------------


@dataclass
class Truth:
    """A long render of a view, and its two halves that share no path."""

    spp: int  # of both halves together
    halves: np.ndarray  # (2, H, W, 3), raw
    denoised_halves: np.ndarray  # (2, H, W, 3)
    image: np.ndarray  # (H, W, 3), the mean of the raw halves, denoised

    @classmethod
    def of(cls, spp: int, halves: np.ndarray, *guides: np.ndarray) -> Truth:
        """``guides``: albedo (H, W, 3), normal (H, W, 3) and coverage (H, W)."""
        clean = [denoising.denoise(image.astype(np.float32), *guides) for image in (*halves, halves.mean(axis=0))]
        return cls(spp, halves, np.stack(clean[:2]), clean[2])

    @property
    def noise(self) -> float:
        """What is left of it after denoising: error of the mean of the denoised halves, in expectation."""
        return log_error(*self.denoised_halves) / 2

    @property
    def raw_noise(self) -> float:
        return log_error(*self.halves) / 2

    def error(self, image: np.ndarray) -> float:
        """Against the denoised truth, where the raw one does not say that it is less."""
        return min(log_error(self.image, image), self.bound(image))

    def bound(self, image: np.ndarray) -> float:
        """Error of an independent image against a raw truth without noise, extrapolated linearly in its variance."""
        whole = log_error(self.halves.mean(axis=0), image)
        return max(0.0, 2 * whole - np.mean([log_error(half, image) for half in self.halves]))


@dataclass
class Point:
    """A render of a fixed number of samples."""

    spp: int
    seconds: float
    error: float


def crossing(points: Sequence[Point], error: float) -> Point | None:
    """Where renders of more and more samples first have ``error``: between two by straight lines in logarithms, else the
    first; None where the last does not have it."""
    before = None
    for point in points:
        if point.error <= error:
            if before is None or point.error <= 0:
                return point
            t = np.log(before.error / error) / np.log(before.error / point.error)

            def between(a: float, b: float, t: float = t) -> float:
                return float(a ** (1 - t) * b**t)

            return Point(round(between(before.spp, point.spp)), between(before.seconds, point.seconds), error)
        before = point
    return None


# --- scenes -----------------------------------------------------------------------------------------------------------


@dataclass
class View:
    """A scene with one camera."""

    name: str
    scene: SceneRecord
    arrays: Path  # its npz, which both renderers read


def made_scenes(work: Path) -> list[SceneRecord]:
    """A small scene artifact of the released law, by the project's own pipeline."""
    command = [sys.executable, "-m", "pipeline", "stage=scene", f"store={work / 'store'}", *MADE]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"error: making the scenes failed: {done.stdout[-1000:]}{done.stderr[-1000:]}")
    return artifact_scenes(work / "store" / re.findall(r"\bscene/\S+", done.stdout)[-1])


def artifact_scenes(path: Path) -> list[SceneRecord]:
    artifact = Artifact(path)
    return [SceneRecord.from_record(artifact.read(row.id)) for row in artifact.rows()]


def read_scenes(paths: list[Path]) -> list[SceneRecord]:
    """From scene artifacts, scene files, and folders of scene files."""
    scenes = []
    for path in paths:
        if (path / "manifest.json").is_file():
            scenes += artifact_scenes(path)
        elif path.is_dir():
            scenes += [load_scene(file) for file in sorted(path.iterdir()) if file.suffix.lower() in (".h5", ".hdf5", ".json")]
        else:
            scenes.append(load_scene(path))
    return scenes


def choose_views(scenes: list[SceneRecord], count: int, folder: Path, backend: dict, threads: int) -> list[View]:
    """``count`` views that the render stage would keep, of as many different scenes as there are."""
    stride = max(1, len(scenes) // count)
    order = [scene for first in range(stride) for scene in scenes[first::stride]]
    views: list[View] = []
    for camera in range(max((len(scene.fov_deg) for scene in order), default=0)):
        for scene in order:
            if len(views) == count or camera >= len(scene.fov_deg):
                continue
            one = replace(scene, camera_to_world=scene.camera_to_world[[camera]], fov_deg=scene.fov_deg[[camera]])
            probe = render_views(one, RenderSettings(64, 16, denoise=False), backend, threads=threads)[0]
            if probe.meta["status"] == "ok":
                name = f"{len(views)}-{scene.id}-{camera}"
                np.savez(folder / f"{name}.npz", **one.arrays())
                views.append(View(name, one, folder / f"{name}.npz"))
    if not views:
        sys.exit("error: no view left to render: give --scenes whose cameras see something")
    return views


def read_arrays(path: Path) -> SceneRecord:
    with np.load(path) as file:
        return SceneRecord(path.stem, **{name: file[name] for name in file.files})


# --- what is measured in this process ---------------------------------------------------------------------------------


class Bench:
    """Renders views and keeps the time. Nothing here includes start-up."""

    def __init__(self, arguments: argparse.Namespace, backend: dict[str, Any]):
        self.arguments, self.backend = arguments, backend
        self.pixels = arguments.resolution**2

    def render(self, view: View, what: str, spp: int, **named: Any) -> tuple[float, Any]:
        """(seconds, view record); ``what`` decides the random numbers."""
        began = time.perf_counter()
        seed = seed_for(self.arguments.seed, f"bench/{what}", view.name)
        settings = RenderSettings(self.arguments.resolution, spp, seed, max_depth=MAX_DEPTH, **named)
        record = render_views(view.scene, settings, self.backend, threads=self.arguments.threads)[0]
        return time.perf_counter() - began, record

    def truth(self, view: View, cycles: Cycles | None = None) -> Truth:
        """By our tracer, or by Cycles with the guides of ours."""
        half = max(1, self.arguments.truth_spp // 2)
        long = self.cached(view, [Render.version, MAX_DEPTH, half], lambda: self._long_render(view, half))
        guides = [long[name] for name in ("albedo", "normal", "coverage")]
        if cycles:
            long = self.cached(view, ["Cycles", cycles.version, half], lambda: {"halves": cycles.halves(view, half)})
        return Truth.of(2 * half, long["halves"], *guides)

    def cached(self, view: View, what: list, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Kept between runs under the hash of all that decides it."""
        digest = hashlib.sha256(json.dumps([*what, view.name, self.arguments.resolution, self.arguments.seed]).encode())
        for name, values in view.scene.arrays().items():
            digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
        path = self.arguments.work / "truth" / f"{digest.hexdigest()[:24]}.npz"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary:
                np.savez(temporary, **make())
        with np.load(path) as file:
            return dict(file)

    def _long_render(self, view: View, half: int) -> dict[str, np.ndarray]:
        """Two raw images of ``half`` samples per pixel each, and the denoiser's guides."""
        layers = ("image", "albedo", "normal", "coverage")
        sums: list[list[np.ndarray]] = []
        for name in ("a", "b"):
            total = [np.zeros(1)] * len(layers)
            for first in range(0, half, CHUNK):
                share = min(CHUNK, half - first)
                record = self.render(view, f"truth/{name}/{first}", share, denoise=False, target_error=GUIDED)[1]
                weighted = [getattr(record, layer).astype(np.float64) * (share / half) for layer in layers]
                total = [a + b for a, b in zip(total, weighted, strict=True)]
            sums.append(total)
        means = [((a + b) / 2).astype(np.float32) for a, b in zip(*sums, strict=True)]
        raw = np.stack([layers[0] for layers in sums]).astype(np.float32)
        return {"halves": raw} | dict(zip(layers[1:], means[1:], strict=True))

    def rates(self, view: View, repeats: int = 2) -> dict[str, float]:
        """Samples per second, the best of ``repeats``, of our integrator and of the built-in one, both with the building of
        the scene; the ratio of their means, noise included."""

        def built_in(seed: int) -> tuple[float, np.ndarray]:
            began = time.perf_counter()
            image = BuiltIn(view.scene, self.arguments.resolution).render(RATE_SPP, seed)
            return time.perf_counter() - began, image

        ours, image = min((self.render(view, "rate", RATE_SPP, denoise=False) for _ in range(repeats)), key=lambda r: r[0])
        theirs, image_of_path = min((built_in(seed) for seed in range(repeats + 1)), key=lambda r: r[0])
        samples = self.pixels * RATE_SPP
        mean = float(np.minimum(image.image, 4).mean() / np.minimum(image_of_path, 4).mean())
        return {"ours": samples / ours, "path": samples / theirs, "mean": mean}

    def doubling(self, view: View, truth: Truth, denoise: bool) -> list[Point]:
        """Fixed sample counts from 16 on, to 64 at least, until the smallest target or the patience is reached.

        Without denoising, images of independent samples are averaged, so that only the last count is paid for.
        """
        points: list[Point] = []
        spp, total, seconds = 16, None, 0.0
        while True:
            if denoise:
                took, record = self.render(view, f"fixed/{spp}", spp, denoise=True)
                image = record.image
            else:
                share = spp if total is None else spp // 2
                took, record = self.render(view, f"raw/{spp}", share, denoise=False)
                total = record.image if total is None else (total + record.image) / 2
                seconds += took
                took, image = seconds, total
            points.append(Point(spp, took, truth.error(image)))
            enough = points[-1].error <= min(self.arguments.targets) or 2 * took > self.arguments.patience
            if spp >= max(RATE_SPP, self.arguments.max_spp) or (enough and spp >= RATE_SPP):
                return points
            spp *= 2

    def stops(self, view: View, truth: Truth, denoise: bool, rate: float) -> dict[float, dict]:
        """target -> where ``render_views`` stops on its own, at the latest when the patience (at ``rate`` samples per second)
        is over; smaller targets that would take longer are left out."""
        found: dict[float, dict] = {}
        took, patient = 0.0, self.arguments.patience * rate / self.pixels
        most = min(self.arguments.max_spp, 16 * 2 ** max(0, int(np.log2(patient / 16))))
        last = None
        for target in sorted(self.arguments.targets, reverse=True):
            if last and (last["estimate"] <= target or last["spp"] >= most):  # the same render again
                found[target] = last
                continue
            if 4 * took > self.arguments.patience:  # half the error takes four times the samples
                break
            took, record = self.render(
                view, "stop", most, denoise=denoise, target_error=target, adaptive=self.arguments.adaptive
            )
            last = found[target] = {
                "spp": record.meta["spp"],
                "seconds": took,
                "estimate": record.meta["error"],
                "error": truth.error(record.image),
                "bound": truth.bound(record.image),
            }
        return found


class BuiltIn:
    """Mitsuba's ``path`` integrator in the variant that ours runs in, on the same meshes and materials.

    Its area emitters shine from one side, so light of one radiance is two meshes wound against each other, a little apart. A
    side that no surface can see is never sampled: half of the shadow rays would be saved for nothing in return.
    """

    def __init__(self, scene: SceneRecord, resolution: int):
        import mitsuba as mi

        from stages.graphics.geometry.measure import normal_vectors
        from stages.renderformer.rendering.scalar import perspective
        from stages.renderformer.rendering.surfaces import mesh_of, surface_mesh

        surfaces, lights = np.nonzero(scene.light_index < 0)[0], scene.light_index >= 0
        shapes = {"surface": surface_mesh(scene, surfaces)}
        for radiance in np.unique(scene.emission[lights], axis=0):
            front = scene.triangles[lights & (scene.emission == radiance).all(axis=1)]
            for side in (front, front[:, ::-1]):
                normal = normal_vectors(side.astype(np.float64))
                normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
                ahead = scene.triangles[surfaces].reshape(-1, 3) @ normal.T > (normal * side[:, 0]).sum(axis=1)
                shine = {"type": "rgb", "value": radiance.tolist()}
                emitter = mi.load_dict({"type": "area", "radiance": shine, "sampling_weight": float(ahead.any())})
                shapes[f"light{len(shapes)}"] = mesh_of(side + 1e-5 * normal[:, None], None, emitter=emitter)
        self.scene = mi.load_dict({"type": "scene", **shapes})
        self.sensor = perspective(scene, 0, (resolution, resolution))
        self.integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "hide_emitters": True})

    def render(self, spp: int, seed: int) -> np.ndarray:
        """(H, W, 3) image"""
        import mitsuba as mi

        return np.array(mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=spp, seed=seed))[..., :3]


def warm_up(scene: SceneRecord, backend: dict[str, Any], threads: int, adaptive: bool = False) -> None:
    """Compile the kernels, which counts as start-up."""
    settings = RenderSettings(8, 32, target_error=1e-9, max_depth=MAX_DEPTH, adaptive=adaptive)
    render_views(scene, settings, backend, threads=threads)


# --- whole processes --------------------------------------------------------------------------------------------------


def environment(**more: str) -> dict[str, str]:
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, **more}


def produce(job: dict[str, Any]) -> dict[str, Any]:
    """In a process of its own: every view to the target error, as the render stage makes it. Seconds from choosing a
    backend on."""
    began = time.perf_counter()
    backend = backends.choose(job["backend"])
    warm_up(read_arrays(Path(job["arrays"][0])), backend, job["threads"], job["adaptive"])
    rows = []
    for path in map(Path, job["arrays"]):
        start = time.perf_counter()
        seed = seed_for(job["seed"], "bench/produce", path.stem)
        settings = RenderSettings(
            job["resolution"], job["max_spp"], seed, job["target"], max_depth=MAX_DEPTH, adaptive=job["adaptive"]
        )
        record = render_views(read_arrays(path), settings, backend, threads=job["threads"])[0]
        (Path(job["out"]) / f"{path.stem}.exr").write_bytes(encode_view(record)[view_members(record.meta["index"])[0]])
        rows.append({"seconds": time.perf_counter() - start, "spp": record.meta["spp"], "estimate": record.meta["error"]})
    return {"seconds": time.perf_counter() - began, "views": rows}


def run(command: list[str], **more: str) -> tuple[float, dict[str, Any]]:
    """(seconds from start to exit, the JSON on the last line that holds some)."""
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=environment(**more))
    seconds = time.perf_counter() - began
    answers = [line for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not answers:
        sys.exit(f"error: {' '.join(command[:3])} .. failed ({done.returncode}): {done.stdout[-1000:]}{done.stderr[-2000:]}")
    return seconds, json.loads(answers[-1])


@dataclass
class Image:
    """A view as a process rendered it; start-up excluded."""

    samples: str
    seconds: float
    error: float
    bound: float
    mean: float  # over the truth's, of values clamped at 4


@dataclass
class Production:
    """All views by one process."""

    start_up: float  # seconds that belong to no view
    images: list[Image]

    @property
    def seconds(self) -> float:
        return self.start_up + sum(image.seconds for image in self.images)

    @property
    def per_hour(self) -> float:
        return 3600 * len(self.images) / self.seconds


def judged(image: np.ndarray, truths: Sequence[Truth], seconds: float, samples: str) -> Image:
    """Errors against the truth that is kinder to the image."""
    mean = float(np.minimum(image, 4).mean() / np.minimum(truths[0].halves, 4).mean())
    error, bound = (min(getattr(truth, name)(image) for truth in truths) for name in ("error", "bound"))
    return Image(samples, seconds, error, bound, mean)


def ours(arguments: argparse.Namespace, backend: dict, views: list[View], truths: list[Truth]) -> Production:
    with tempfile.TemporaryDirectory() as folder:
        names = ("resolution", "max_spp", "seed", "target", "threads", "adaptive")
        job = {name: getattr(arguments, name) for name in names} | {"backend": backend["backend"], "out": folder}
        job["arrays"] = [str(view.arrays) for view in views]
        cache = Path(folder) / "kernels"
        cache.mkdir()
        # an empty kernel cache: a fresh machine compiles
        seconds, told = run(
            [sys.executable, str(Path(__file__).resolve()), "--produce", json.dumps(job)], DRJIT_CACHE_DIR=str(cache)
        )
        images = [read_rgb(Path(folder) / f"{view.name}.exr") for view in views]
    rows = zip(images, truths, told["views"], strict=True)
    found = [judged(image, [truth], row["seconds"], f"{row['spp']:,}") for image, truth, row in rows]
    return Production(seconds - sum(image.seconds for image in found), found)


class Cycles:
    """``bench/cycles.py`` in an interpreter that has Blender."""

    def __init__(self, arguments: argparse.Namespace, gpu: bool):
        self.arguments, self.gpu, self.version = arguments, gpu, ""

    def render(self, views: list[View], spp: int, seed: int, *options: str) -> tuple[float, list[float], list[np.ndarray]]:
        """(seconds of the process, seconds of export and render per view, images)."""
        with tempfile.TemporaryDirectory() as folder:
            command = [self.arguments.cycles_python, str(ROOT / "bench" / "cycles.py"), *(str(view.arrays) for view in views)]
            command += ["--out", folder, "--resolution", str(self.arguments.resolution), "--spp", str(spp), "--seed", str(seed)]
            command += ["--threads", str(self.arguments.threads), *(["--gpu"] if self.gpu else []), *options]
            seconds, told = run(command)
            images = [read_rgb(Path(folder) / f"{view.name}-0.exr") for view in views]
        return seconds, [row["export"] + sum(row["renders"]) for row in told["scenes"]], images

    def halves(self, view: View, spp: int) -> np.ndarray:
        """(2, H, W, 3) raw images that share no random number."""
        return np.stack([self.render([view], spp, 1000 + half)[2][0] for half in range(2)])

    def production(self, views: list[View], truths: list[list[Truth]], spp: int, *options: str) -> Production:
        """The views by one process, denoised."""
        seconds, each, images = self.render(views, spp, self.arguments.seed + 1, "--denoise", *options)
        rows = zip(images, truths, each, strict=True)
        return Production(seconds - sum(each), [judged(image, truth, took, f"{spp:,}") for image, truth, took in rows])

    def check(self) -> None:
        """Fails now rather than at the end: an interpreter without Blender, a GPU that Cycles cannot use."""
        told = run([self.arguments.cycles_python, str(ROOT / "bench" / "cycles.py"), *(["--gpu"] if self.gpu else [])])[1]
        self.version = told["blender"]

    def tuned(self, views: list[View], truths: list[list[Truth]], mine: Production) -> tuple[Production, Production]:
        """Every view at the fewest samples, doubling from 16, that have the error of ours; and interpolated to that error.

        A view that would take longer than the patience is left with what it has.
        """
        points: list[list[Point]] = [[] for _ in views]
        last: list[Image] = [None] * len(views)
        start_up, left, spp = 0.0, list(range(len(views))), 16
        while left and spp <= self.arguments.cycles_spp:
            progress(f"Cycles, {spp} samples, {len(left)} views")
            done = self.production([views[i] for i in left], [truths[i] for i in left], spp)
            start_up = start_up or done.start_up
            for i, image in zip(left, done.images, strict=True):
                points[i].append(Point(spp, image.seconds, image.error))
                last[i] = image
            missed = [i for i in left if last[i].error > mine.images[i].error]
            left = [i for i in missed if 2 * last[i].seconds <= self.arguments.cycles_patience]
            spp *= 2
        even = []
        for i, (image, ours) in enumerate(zip(last, mine.images, strict=True)):
            at = crossing(points[i], ours.error)
            if at is None:
                last[i] = replace(image, samples=f"over {image.samples}")
            even.append(replace(image, samples=f"{at.spp:,}", seconds=at.seconds, error=at.error) if at else last[i])
        return Production(start_up, last), Production(start_up, even)


def progress(text: str) -> None:
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


# --- tables -----------------------------------------------------------------------------------------------------------


def table(titles: list[str], rows: list[list[str]]) -> None:
    """A Markdown table, numbers to the right."""
    print("\n| " + " | ".join(titles) + " |")
    print("| --- | " + " | ".join("---:" for _ in titles[1:]) + " |")
    for row in rows:
        print("| " + " | ".join(row) + " |")
    sys.stdout.flush()


def spread(values: Sequence[float], form: str) -> str:
    """Median (least to most)."""
    return f"{format(float(np.median(values)), form)} ({format(min(values), form)} to {format(max(values), form)})"


def print_views(views: list[View], truths: list[Truth]) -> None:
    rows = []
    for view, truth in zip(views, truths, strict=True):
        meta = view.scene.meta
        kind = f"{meta.get('template', '')} {meta.get('variant', '')}".strip()
        row = [view.name, kind, f"{len(view.scene.triangles):,}", str(view.scene.n_lights)]
        rows.append([*row, f"{truth.image.mean():.3f}", f"{truth.raw_noise:.5f}", f"{truth.noise:.5f}"])
    table(["view", "kind", "triangles", "lights", "mean radiance", "noise of the raw truth", "of the truth"], rows)
    print(f"Truth: {truths[0].spp:,} samples per pixel, denoised.")


def print_rates(views: list[View], rates: list[dict[str, float]]) -> None:
    rows = []
    for view, rate in zip(views, rates, strict=True):
        row = [view.name, *(f"{rate[name] / 1e6:.2f}" for name in ("ours", "path"))]
        rows.append([*row, f"{rate['path'] / rate['ours']:.2f}", f"{rate['mean'] - 1:+.2%}"])
    total = {name: len(rates) / sum(1 / rate[name] for rate in rates) for name in ("ours", "path")}  # same samples each
    rows.append(["ALL", *(f"{total[name] / 1e6:.2f}" for name in total), f"{total['path'] / total['ours']:.2f}", ""])
    table(["view", "ours, M samples/s", "`path`, M samples/s", "`path` over ours", "mean, ours over `path`"], rows)


def print_targets(views: list[View], denoise: bool, sweeps: list[list[Point]], stops: list[dict], targets: list[float]) -> None:
    rows = []
    for target in targets:
        reached = []
        for view, points, stop in zip(views, sweeps, stops, strict=True):
            row = [f"{target:g}", view.name]
            if target in stop:
                spp, seconds, *errors = (stop[target][name] for name in ("spp", "seconds", "estimate", "error", "bound"))
                done = errors[0] <= target
                row += [f"{'' if done else 'over '}{spp:,}", f"{seconds:.2f}", *(f"{error:.5f}" for error in errors)]
                reached += [(spp, seconds, *errors)] if done else []
            else:
                row += ["-"] * 5
            point = crossing(points, target)
            rows.append([*row, *([f"{point.spp:,}", f"{point.seconds:.2f}"] if point else [f"over {points[-1].spp:,}", "-"])])
        if reached:
            spp, seconds, *errors = np.mean(reached, axis=0)
            row = [f"{target:g}", f"MEAN OF {len(reached)}", f"{spp:,.0f}", f"{seconds:.2f}"]
            rows.append([*row, *(f"{error:.5f}" for error in errors), "", ""])
    print(f"\nTo a target error, {'denoised' if denoise else 'not denoised'}:")
    table(["target", "view", "stops at samples", "s", "estimate", "error", "at most", "has it at samples", "s"], rows)


def print_fixed(
    views: list[View], truths: list[Truth], rates: list[dict], sweeps: dict[bool, list[list[Point]]], pixels: int
) -> None:
    rows = []
    for index, view in enumerate(views):
        row = [view.name]
        for spp in FIXED:
            for denoise in (False, True):
                points = {point.spp: point for point in sweeps[denoise][index]}
                if spp in points:
                    row += [f"{points[spp].seconds:.2f}", f"{points[spp].error:.5f}"]
                    continue
                seconds = spp * pixels / rates[index]["ours"]
                if denoise:  # what denoising costs does not depend on the samples
                    first = sweeps[True][index][0]
                    seconds += max(0.0, first.seconds - first.spp * pixels / rates[index]["ours"])
                error = f"~{truths[index].raw_noise * np.sqrt(truths[index].spp / spp):.5f}" if not denoise else "-"
                row += [f"~{seconds:.1f}", error]
        rows.append(row)
    print("\nFixed samples (~: not rendered; from the rate, and from the truth's noise):")
    table(["view", *(f"{spp:,}{kind}: {what}" for spp in FIXED for kind in ("", " denoised") for what in ("s", "error"))], rows)


def print_truths_apart(views: list[View], ours: list[Truth], theirs: list[Truth]) -> None:
    """How far the renderers differ: the distance of the raw truths over what the noise of both explains."""
    rows = []
    for view, a, b in zip(views, ours, theirs, strict=True):
        mean = np.minimum(b.halves, 4).mean() / np.minimum(a.halves, 4).mean() - 1
        across = np.mean([log_error(x, y) for x in a.halves for y in b.halves])
        within = a.raw_noise + b.raw_noise  # the mean of the distances of either's halves
        row = [view.name, f"{mean:+.2%}", f"{across:.5f}", f"{within:.5f}", f"{log_error(a.image, b.image):.5f}"]
        rows.append([*row, f"{b.raw_noise:.5f}", f"{b.noise:.5f}"])
    print("\nCycles' truths beside ours (unclamped, as deep, the same filter):")
    titles = [
        "view",
        "mean",
        "raw halves, ours to Cycles'",
        "of one renderer",
        "denoised",
        "noise of its raw truth",
        "of its truth",
    ]
    table(titles, rows)


def print_productions(views: list[View], productions: dict[str, Production]) -> None:
    """The first one is ours; every other is compared with it."""
    first = next(iter(productions.values()))
    rows = []
    for index, view in enumerate(views):
        for name, production in productions.items():
            image = production.images[index]
            row = [view.name, name, image.samples, f"{image.seconds:.2f}", f"{image.seconds / first.images[index].seconds:.2f}"]
            rows.append([*row, f"{image.error:.5f}", f"{image.bound:.5f}", f"{image.mean - 1:+.2%}"])
    table(["view", "by", "samples", "s", "over ours", "error", "at most", "mean"], rows)
    rows = []
    for name, production in productions.items():
        each = [image.seconds for image in production.images]
        ratios = [seconds / image.seconds for seconds, image in zip(each, first.images, strict=True)]
        row = [name, f"{production.seconds:.1f}", f"{production.start_up:.1f}", f"{production.per_hour:,.0f}"]
        row += [
            f"{first.per_hour / production.per_hour:.2f}",
            f"{sum(each) / sum(image.seconds for image in first.images):.2f}",
        ]
        row += [spread(each, ".2f"), spread(ratios, ".2f")]
        rows.append([*row, spread([image.error for image in production.images], ".5f")])
    titles = ["all views in one process", "s", "of them start-up", "views per hour", "ours over it", "without start-up"]
    table([*titles, "s per view: median (range)", "over ours: median (range)", "error: median (range)"], rows)


def print_costs(arguments: argparse.Namespace, backend: dict[str, Any], scenes: list[SceneRecord]) -> None:
    """CPU seconds to render all views of each scene to the target error, by each of the ways, scene by scene."""
    from stages.renderformer.rendering import caustics

    served = caustics.NARROW_ALPHA  # of the narrow parts: nothing, or what light paths serve
    ways = {"camera": (0.0, False), "light": (served, False), "adaptive": (served, True)}
    ways = {name: ways[name] for name in arguments.ways}
    rows: list[tuple[list[str], dict[str, tuple[float, list[dict]]]]] = []
    for scene in scenes:
        spent = {}
        for name, (caustics.NARROW_ALPHA, adaptive) in ways.items():
            if not rows:
                warm_up(scene, backend, arguments.threads, adaptive)
            settings = RenderSettings(
                arguments.resolution,
                arguments.max_spp,
                seed_for(arguments.seed, "bench/costs", scene.id),
                arguments.target,
                max_depth=MAX_DEPTH,
                mode=arguments.mode,
                adaptive=adaptive,
            )
            began = time.process_time()
            views = render_views(scene, settings, backend, threads=arguments.threads)
            spent[name] = time.process_time() - began, [view.meta for view in views]
        # the roughness of what is most like a mirror, of all that reflects as much by GGX as the mean surface does
        bright = (scene.specular.max(axis=1) >= 0.3) & (scene.light_index < 0)
        least = float(scene.roughness[bright].min(initial=1))
        kind = "under 0.15" if least < 0.15 else "0.15 to 0.32" if least < 0.32 else "over 0.32"
        rows.append((["all", f"roughness {kind}", scene.meta.get("template", "-"), *([scene.id] * arguments.caustics)], spent))
        told = ", ".join(f"{name} {seconds:.1f} s" for name, (seconds, _) in spent.items())
        progress(f"{scene.id} ({', '.join(rows[-1][0][1:3])}): {told}")
    titles = ["scenes", "number", *(f"{name}: {what}" for name in ways for what in ("mean s", "p50", "p90", "over target"))]
    printed = []
    for group in sorted({group for groups, _ in rows for group in groups}):
        of_group = [spent for groups, spent in rows if group in groups]
        row = [group, str(len(of_group))]
        for name in ways:
            seconds = [spent[name][0] for spent in of_group]
            over = [meta["error"] > arguments.target for spent in of_group for meta in spent[name][1]]
            row += [
                *(f"{value:.2f}" for value in (np.mean(seconds), *np.percentile(seconds, (50, 90)))),
                f"{np.mean(over):.0%}",
            ]
        printed.append(row)
    last = 2 + 4 * (len(ways) - 1)
    over = f"{list(ways)[-1]} over {list(ways)[0]}"
    table([*titles, over], [[*row, f"{float(row[last]) / max(float(row[2]), 0.01):.2f}"] for row in printed])


def print_machine(arguments: argparse.Namespace, backend: dict[str, Any]) -> None:
    info = Path("/proc/cpuinfo")
    models = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    model = models[0].split(":")[1].strip() if models else platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("mitsuba", "drjit", "pyoidn", "numpy"))
    print(f"{model}, {cores} cores, {arguments.threads} threads for each renderer; load when it began {os.getloadavg()[0]:.2f}")
    print(f"backend {backend}; Python {platform.python_version()}, {versions}")
    print(f"{arguments.resolution} x {arguments.resolution} pixels, seed {arguments.seed}", flush=True)


def compare_with_cycles(
    arguments: argparse.Namespace, bench: Bench, cycles: Cycles, views: list[View], truths: list[Truth], mine: Production
) -> None:
    theirs = []
    for view in views:
        progress(f"{view.name}: truth by Cycles")
        theirs.append(bench.truth(view, cycles))
    print_truths_apart(views, truths, theirs)
    theirs = [list(pair) for pair in zip(theirs, truths, strict=True)]
    progress("Cycles at the released settings")
    released = cycles.production(views, theirs, arguments.cycles_spp, "--mode", "released", "--adaptive", "0.01")
    for image in released.images:
        image.samples = "adaptive"
    tuned, even = cycles.tuned(views, theirs, mine)
    print(f"\nAt target error {arguments.target:g}, start-up included, beside Blender {cycles.version}:")
    print_productions(views, {"ours": mine, "(a) released": released, "(b) tuned": tuned, "(b') equal error": even})
    print("The error of (a) holds what its clamps, its glossy lobe and its wider pixel filter change on purpose.")
    missed = sum(image.samples.startswith("over") for image in tuned.images)
    if missed:
        print(f"(b) did not get to our error in {missed} views: there it counts at its last samples, which favours it.")


def positive(kind: type) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        value = kind(text)
        if not value > 0:
            raise ValueError(text)
        return value

    parse.__name__ = f"positive {kind.__name__}"
    return parse


def parsed(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    whole, number = positive(int), positive(float)
    parser.add_argument("--cycles-python", metavar="PYTHON", help="an interpreter that has bpy; default: no Cycles")
    parser.add_argument("--scenes", nargs="+", type=Path, metavar="PATH", help="default: made by the released law")
    parser.add_argument("--views", type=whole, default=6, help="default %(default)s")
    parser.add_argument("--resolution", type=whole, default=256, help="default %(default)s")
    parser.add_argument("--target", type=number, default=0.002, help="of the views per hour, default %(default)s")
    parser.add_argument("--targets", default="0.004,0.002,0.001", help="of the table, default %(default)s")
    parser.add_argument("--max-spp", type=whole, default=4096, help="of our renders, default %(default)s")
    parser.add_argument("--truth-spp", type=whole, default=1024, help="default %(default)s")
    parser.add_argument("--cycles-spp", type=whole, default=4096, help="of Cycles, at most, default %(default)s")
    parser.add_argument(
        "--patience", type=number, default=10.0, metavar="S", help="a longer render is left out; default %(default)s"
    )
    parser.add_argument(
        "--cycles-patience", type=number, default=90.0, metavar="S", help="with tuned Cycles, default %(default)s"
    )
    parser.add_argument("--adaptive", action="store_true", help="to the target errors, ours as render.adaptive has it")
    parser.add_argument("--costs", type=whole, metavar="N", help="only CPU seconds, of so many scenes")
    parser.add_argument("--caustics", action="store_true", help="with --costs: of the six views of bench/caustics.py")
    parser.add_argument(
        "--ways",
        type=lambda text: text.split(","),
        default=["camera", "light", "adaptive"],
        help="with --costs; default all three",
    )
    parser.add_argument("--mode", choices=MODES, default="physical", help="with --costs; default %(default)s")
    parser.add_argument("--backend", choices=backends.CHOICES, default="auto")
    parser.add_argument("--threads", type=whole, default=os.cpu_count(), help="for each renderer, default all (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "bench", help="kept between runs, default runs/bench")
    arguments = parser.parse_args(words)
    try:
        arguments.targets = [number(text) for text in arguments.targets.split(",")]
    except ValueError:
        parser.error(f"--targets {arguments.targets}: expected errors with commas between")
    if arguments.cycles_python and not shutil.which(arguments.cycles_python):
        parser.error(f"--cycles-python {arguments.cycles_python} cannot be run")
    arguments.work = arguments.work.resolve()
    return arguments


def main() -> None:
    arguments = parsed()
    arguments.work.mkdir(parents=True, exist_ok=True)
    backend = backends.choose(arguments.backend)
    print_machine(arguments, backend)
    if arguments.costs:
        if arguments.caustics:
            import caustics

            scenes = list(caustics.scenes().values())
        else:
            scenes = read_scenes(arguments.scenes) if arguments.scenes else made_scenes(arguments.work)
        stride = max(1, len(scenes) // arguments.costs)
        return print_costs(arguments, backend, scenes[::stride][: arguments.costs])
    bench = Bench(arguments, backend)
    cycles = Cycles(arguments, backend["backend"] == "cuda") if arguments.cycles_python else None
    if cycles:
        cycles.check()
    with tempfile.TemporaryDirectory() as folder:
        progress("scenes")
        scenes = read_scenes(arguments.scenes) if arguments.scenes else made_scenes(arguments.work)
        views = choose_views(scenes, arguments.views, Path(folder), backend, arguments.threads)
        truths, rates = [], []
        sweeps: dict[bool, list[list[Point]]] = {False: [], True: []}
        stops: dict[bool, list[dict]] = {False: [], True: []}
        for view in views:
            progress(f"{view.name}: truth")
            truths.append(bench.truth(view))
            progress(f"{view.name}: samples per second")
            rates.append(bench.rates(view))
            for denoise in (True, False):
                progress(f"{view.name}: {'denoised' if denoise else 'not denoised'}")
                sweeps[denoise].append(bench.doubling(view, truths[-1], denoise))
                stops[denoise].append(bench.stops(view, truths[-1], denoise, rates[-1]["ours"]))
        print_views(views, truths)
        print_rates(views, rates)
        for denoise in (True, False):
            print_targets(views, denoise, sweeps[denoise], stops[denoise], arguments.targets)
        print_fixed(views, truths, rates, sweeps, bench.pixels)
        progress("ours in a process of its own")
        mine = ours(arguments, backend, views, truths)
        if cycles:
            compare_with_cycles(arguments, bench, cycles, views, truths, mine)
        else:
            print(f"\nAt target error {arguments.target:g}, start-up included (give --cycles-python to compare with Cycles):")
            print_productions(views, {"ours": mine})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--produce"]:
        print("\n" + json.dumps(produce(json.loads(sys.argv[2]))), flush=True)
    else:
        main()
