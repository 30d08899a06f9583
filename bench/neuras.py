"""What fitting, baking and drawing a scene cost, part by part.

``python bench/neuras.py --store STORE [KEY] [--only step,adam,reach,gbuffer,bake,draw,page,stream] [--three FOLDER]`` takes
a bake artifact of neuras (default: the newest); prints a table per part. Every part takes a minute or a few. ``--three``: the
unpacked npm package three (``npm pack three``), to draw the same mesh by three.js. Times mean little where others use the
machine; ratios mean more.

step      seconds per million fitted pixels, memory, and the share of each part of a step
adam      a step's update against dense Adam, and its gather against plain indexing
reach     seconds until the validation PSNR has 95 % of its final value
gbuffer   rays a second that find what each pixel sees
bake      seconds to write the site
draw      frame time by resolution and number of skyboxes, by OpenGL without a window, beside a plain textured mesh
page      the same of the page in a browser without a window
stream    memory on the device and files fetched on a drive through the scene in tiles, and through it five times in a row
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import http.server
import itertools
import json
import resource
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from bench import streaming
from model.neuras import fitting, sampling
from model.neuras.maps import Maps
from model.neuras.rays import Pixels
from model.neuras.scene import Scene as Learned
from pipeline.config import parse
from pipeline.store import Artifact, Store
from stages.graphics import browser
from stages.graphics.casting import Caster
from stages.neuras import s04_fit
from stages.neuras.baking import site
from stages.neuras.baking.browser import pictures
from stages.neuras.commands import size
from stages.neuras.evaluation import costs
from stages.neuras.evaluation.drive import scene_of
from stages.neuras.evaluation.paths import framed
from stages.neuras.evaluation.renderers import Scene
from stages.neuras.records import fitted_poses, frames, posed

SIZES = "640x360,1280x720,1920x1080"
LAYERS = (1, 3, 6)
TILE_M, REACH_M, COPIES, STOPS = 50.0, 200.0, 5, 21  # of part stream: stops are frames of the drive through one copy
CHECKS = 15  # validations on the way, of part reach
Row = Sequence[Any]


class Bench:
    """A fitted scene and what it was fitted to."""

    def __init__(self, store: Store, reference: str, steps: int, sizes: Sequence[tuple[int, int]], three: Path | None):
        self.scene, self.capture = scene_of(store, reference)
        self.steps, self.sizes, self.three = steps, sizes, three
        inputs = store.resolve(reference).manifest["preimage"]["inputs"]
        fit = store.by_key(inputs["fit"])
        assert isinstance(fit, Artifact)
        self.config = parse(s04_fit.FitStageConfig, fit.manifest["config"], "fit")
        self.views = list(posed(frames(self.capture), fitted_poses(fit)))

    @functools.cached_property
    def caster(self) -> Caster:
        return Caster(self.scene.atlas.vertices, self.scene.atlas.faces)

    def trainer(self) -> tuple[fitting.Trainer, Pixels]:
        """As stage fit begins."""
        torch.set_num_threads(1)
        torch.set_flush_denormal(True)
        scene, config = self.scene, self.config
        photos = [view for view in self.views if view.split == "train"]
        training = [s04_fit._view(view, scene.atlas, self.caster) for view in photos]
        around = s04_fit._surroundings(config, scene.info, scene.atlas, [view.camera.position for view in self.views])
        pixels = Pixels(training, around.sky_centre, config.patch, torch.device("cpu"))
        return fitting.Trainer(Learned(config.fit(scene.info.metre, s04_fit.focal_length(photos)), around, pixels)), pixels

    def batches(self, pixels: Pixels, count: int) -> Iterator[Any]:
        return pixels.patches(self.config.seed, self.config.patches, 0, count)

    def layered(self, layers: int) -> Scene:
        """The scene with its farthest skyboxes alone."""
        baked = self.scene.baked
        names = [name for name in ("sky_indices", "sky_features", "sky_half_sizes") if getattr(baked, name) is not None]
        return replace(self.scene, baked=type(baked)(**{**vars(baked), **{n: getattr(baked, n)[-layers:] for n in names}}))

    def variants(self) -> dict[str, Scene]:
        """What is drawn, by name."""
        most = self.scene.baked.sky_size[0]
        neural = {f"{layers} skyboxes": self.layered(layers) for layers in LAYERS if layers <= most}
        return {"plain textured mesh": costs.plain(self.scene), **neural}

    # --- fitting ------------------------------------------------------------------------------------------------------

    def step(self) -> tuple[Row, list[Row]]:
        trainer, pixels = self.trainer()
        spent: dict[str, float] = {}
        with contextlib.ExitStack() as timers:
            for name, owner, attribute in (
                ("draw pixels", Pixels, "batch"),
                ("find texels", Learned, "places"),
                ("gather rows", Maps, "features"),
                ("nearest codes, their loss", fitting, "straight_through"),
                ("mix samples", fitting, "gather"),
                ("networks, compositing", Learned, "shade"),
                ("backward", torch.Tensor, "backward"),
                ("Adam: networks and codes", type(trainer.optimizer), "step"),
                ("Adam: touched texels", Maps, "update"),
            ):
                timers.enter_context(_timed(owner, attribute, name, spent))
            for batch in self.batches(pixels, 3):  # not counted
                trainer.train_step(batch)
            spent.clear()
            began = time.process_time()
            for batch in self.batches(pixels, self.steps):
                trainer.train_step(batch)
            total = time.process_time() - began
        count = self.steps * self.config.patches * self.config.patch**2
        spent["all else"] = total - sum(spent.values())
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        rows: list[Row] = [
            ("CPU seconds per million pixels", f"{1e6 * total / count:.2f}", ""),
            ("milliseconds a step", f"{1000 * total / self.steps:.1f}", ""),
            ("largest memory of this process, GB", f"{memory:.2f}", ""),
        ]
        rows += [(name, f"{1000 * value / self.steps:.1f} ms", f"{100 * value / total:.0f} %") for name, value in spent.items()]
        return ("one core", "", "share"), rows

    def adam(self) -> tuple[Row, list[Row]]:
        trainer, pixels = self.trainer()
        maps, places = trainer.scene.maps["mesh"], trainer.scene.places(next(self.batches(pixels, 1)))["mesh"]
        rows, where = maps.row_of[places[0]].long().unique(return_inverse=True)
        gradient, rates = torch.randn(len(rows), maps.fine.width), torch.full((maps.fine.width,), 1e-3)
        dense = torch.nn.Parameter(maps.fine.values.clone())
        adam = torch.optim.Adam([dense], lr=1e-3, betas=(0.9, 0.99))
        dense.grad = torch.zeros_like(dense).index_add_(0, rows, gradient)
        leaf = maps.features(rows)

        def indexed(leaf: torch.Tensor, texels: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
            return (leaf[texels] * weights[..., None]).sum(dim=1)

        def gathered(mix: Callable[..., torch.Tensor], back: bool) -> float:
            def work() -> None:
                found = mix(leaf.detach().requires_grad_(back), where, places[1])
                if back:
                    found.sum().backward()

            return _median(work)

        found: list[Row] = []
        pairs = [
            (
                "Adam on touched rows",
                _median(lambda: maps.fine.update(rows, gradient, rates, 2)),
                "dense Adam",
                _median(adam.step),
            )
        ]
        for back in (False, True):
            also = ", and back" if back else ""
            ours, theirs = gathered(sampling.gather, back), gathered(indexed, back)
            pairs.append((f"gather by embedding_bag{also}", ours, f"gather by indexing{also}", theirs))
        for name, ours, other, theirs in pairs:
            found += [(name, f"{ours:.1f}", "1"), (other, f"{theirs:.1f}", f"{theirs / ours:.1f}")]
        about = f"{len(rows):,} of {maps.count:,} texels, {len(places[0]):,} pixels of {places[0].shape[1]} texels"
        return (about, "ms", "times ours"), found

    def reach(self) -> tuple[Row, list[Row]]:
        trainer, pixels = self.trainer()
        views = [s04_fit._view(view, self.scene.atlas, self.caster) for view in self.views if view.split == "validation"]
        held_out = Pixels(views, trainer.scene.surroundings.sky_centre, self.config.patch, torch.device("cpu"))
        quiet = fitting.Outputs(Path("."), lambda text: None)
        steps, spent, curve = self.config.steps, 0.0, []
        every = max(1, steps // CHECKS)
        batches = self.batches(pixels, steps)
        for number in range(steps):
            began = time.process_time()
            trainer.train_step(next(batches))
            spent += time.process_time() - began
            if (number + 1) % every == 0 or number + 1 == steps:
                curve.append((number + 1, spent, fitting.validate(trainer.scene, held_out, views, number + 1, quiet)["psnr"]))
        final = curve[-1][2]
        first = next(row for row in curve if row[2] >= 0.95 * final)
        return ("step", "CPU seconds", "validation PSNR", ""), [
            (step, f"{seconds:.1f}", f"{psnr:.2f}", "95 % of the last" if step == first[0] else "")
            for step, seconds, psnr in curve
        ]

    def gbuffer(self) -> tuple[Row, list[Row]]:
        cameras = [view.camera for view in self.views[:12]]
        began = time.process_time()
        caster = Caster(self.scene.atlas.vertices, self.scene.atlas.faces)
        built = time.process_time() - began
        began = time.process_time()
        for camera in cameras:
            caster.view(camera)
        spent = time.process_time() - began
        rays = sum(camera.width * camera.height for camera in cameras)
        return ("one core", ""), [
            (f"seconds to build, {len(caster.faces):,} faces", f"{built:.2f}"),
            ("million rays a CPU second", f"{rays / spent / 1e6:.2f}"),
        ]

    # --- drawing ------------------------------------------------------------------------------------------------------

    def bake(self) -> tuple[Row, list[Row]]:
        with tempfile.TemporaryDirectory() as folder:
            began = time.process_time()
            sizes = self.write(Path(folder), self.scene, self.views[:60])
            spent = time.process_time() - began
        return ("", ""), [
            ("CPU seconds", f"{spent:.1f}"),
            *((f"{kind}, MB", f"{size / 1e6:.2f}") for kind, size in sizes.items()),
        ]

    def write(self, folder: Path, scene: Scene, shown: Sequence[Any]) -> dict[str, int]:
        return site.write_site(folder, scene.baked, scene.atlas, scene.info, shown, scene.planes, "fp16")

    def draw(self) -> tuple[Row, list[Row]]:
        cameras = [view.camera for view in self.views if view.split == "test"][:3]
        rows = []
        for name, scene in self.variants().items():
            with scene.drawing("fp16") as drawing:
                times = [
                    statistics.median(costs.frame_times(drawing, [framed(camera, *wanted) for camera in cameras]))
                    for wanted in self.sizes
                ]
            rows.append((name, times))
        return _sized("milliseconds a frame, OpenGL", self.sizes, rows)

    def page(self) -> tuple[Row, list[Row]]:
        view = next(view for view in self.views if view.split == "test")
        shown = [replace(view, camera=framed(view.camera, *wanted)) for wanted in self.sizes]
        rows = []
        for name, scene in self.variants().items():
            with tempfile.TemporaryDirectory() as folder:
                self.write(Path(folder), scene, shown)
                times = [pictures(Path(folder), [f"frame={n}"], timing=5)[1] for n in range(len(self.sizes))]
                rows.append((name, [statistics.median(t) for t in times]))
        if self.three is not None:
            rows.insert(1, ("plain textured mesh by three.js", [self.by_three(one.camera) for one in shown]))
        return _sized("milliseconds a frame, browser", self.sizes, rows)

    def stream(self) -> tuple[Row, list[Row]]:
        drive = [view for view in self.views if view.split != "shift"]
        stops = [drive[i] for i in np.linspace(0, len(drive) - 1, min(STOPS, len(drive))).round().astype(int)]
        metre, rows = self.scene.info.metre, []
        for copies in (1, COPIES):
            scene, shown = streaming.placed(self.scene, stops, copies)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                streaming.write(folder, scene, shown, TILE_M * metre, REACH_M * metre)
                tiles = json.loads((folder / "scene.json").read_bytes())["tiles"]
                files = [path.stat().st_size for path in (folder / "tiles").rglob("*") if path.is_file()]
                places = streaming.drive(folder, len(shown))
            length = copies * np.linalg.norm(stops[-1].camera.position - stops[0].camera.position) / metre
            whole = sum(sum(tile["rows"]) for tile in tiles["each"]) / (tiles["columns"] * tiles["height"])
            most = {key: max(place[key] for place in places) for key in places[0]}
            drawn, last = max(len(place["drawn"]) for place in places), places[-1]
            rows.append(
                (
                    f"{length:.0f} m",
                    f"{whole * most['pool'] / 1e6:.1f}",
                    *(f"{most[key] / 1e6:.1f}" for key in ("pool", "buffers")),
                    f"{100 * most['used']:.0f} %",
                    most["lacking"],
                    drawn,
                    f"{last['fetches']} of {len(files)}",
                    f"{last['fetched'] / 1e6:.1f} of {sum(files) / 1e6:.1f}",
                    f"{places[0]['fetched'] / 1e6:.1f}",
                )
            )
        heads = (
            "all textures, MB",
            "pool, MB",
            "mesh, MB",
            "pool used",
            "without room",
            "tiles drawn",
            "files",
            "MB fetched",
            "at the start",
        )
        return ("road", *heads), rows

    def by_three(self, camera: Any) -> float:
        """Milliseconds of a frame by three.js: the mesh with one texture as large as ours, from this camera."""
        from PIL import Image

        assert self.three is not None
        atlas, baked = self.scene.atlas, self.scene.baked
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for file in (self.three / "build").glob("three.*.js"):
                shutil.copy(file, folder)
            centre = baked.sky_centre
            (folder / "positions.bin").write_bytes((atlas.vertices - centre).astype(np.float32).tobytes())
            (folder / "uvs.bin").write_bytes(atlas.uvs.astype(np.float32).tobytes())
            (folder / "faces.bin").write_bytes(atlas.faces.astype(np.uint32).tobytes())
            colours = (255 * np.clip(costs.plain(self.scene).baked.mesh_texture()[..., :3], 0, 1)).astype(np.uint8)
            Image.fromarray(colours).save(folder / "colours.png")
            pose = camera.camera_to_world.copy()
            pose[:3, 3] -= centre
            fov = float(np.degrees(2 * np.arctan(camera.height / (2 * camera.fy))))
            planes = self.scene.planes
            about = {"size": [camera.width, camera.height], "fov": fov, "planes": planes, "pose": pose.T.ravel().tolist()}
            (folder / "index.html").write_text(THREE.replace("ABOUT", json.dumps(about)))
            with _served(folder) as address, browser.opened(address) as page:
                page.until("document.documentElement.dataset.ready ?? ''")
                return statistics.median(page.value("window.times"))


THREE = """<!doctype html><script type="importmap">{"imports": {"three": "./three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
const about = ABOUT, load = async (name) => (await fetch(name)).arrayBuffer();
const geometry = new THREE.BufferGeometry();
geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(await load("positions.bin")), 3));
geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(await load("uvs.bin")), 2));
geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(await load("faces.bin")), 1));
const texture = await new THREE.TextureLoader().loadAsync("colours.png");
texture.flipY = false; texture.generateMipmaps = false; texture.minFilter = THREE.LinearFilter;
const scene = new THREE.Scene();
scene.add(new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide })));
const [width, height] = about.size;
const camera = new THREE.PerspectiveCamera(about.fov, width / height, ...about.planes);
camera.matrixAutoUpdate = false;
camera.matrix.fromArray(about.pose);
const renderer = new THREE.WebGLRenderer({ antialias: false });
renderer.setSize(width, height);
document.body.appendChild(renderer.domElement);
const gl = renderer.getContext(), times = [];
for (let i = 0; i < 6; i++) {
  const began = performance.now();
  renderer.render(scene, camera);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  times.push(performance.now() - began);
}
window.times = times.slice(1);
document.documentElement.dataset.ready = "yes";
</script>"""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        pass


@contextlib.contextmanager
def _served(folder: Path) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/index.html"
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def _timed(owner: Any, attribute: str, name: str, spent: dict[str, float]) -> Iterator[None]:
    """Add the CPU seconds of a function's calls to ``spent``, those within another timed call not twice."""
    plain = getattr(owner, attribute)

    @functools.wraps(plain)
    def timed(*arguments: Any, **options: Any) -> Any:
        began, before = time.process_time(), sum(spent.values())
        try:
            return plain(*arguments, **options)
        finally:
            inside = sum(spent.values()) - before
            spent[name] = spent.get(name, 0.0) + time.process_time() - began - inside

    setattr(owner, attribute, timed)
    try:
        yield
    finally:
        setattr(owner, attribute, plain)


def _median(work: Callable[[], Any], times: int = 7) -> float:
    """Milliseconds of CPU, the median after one call that is not counted."""
    work()
    spent = []
    for _ in range(times):
        began = time.process_time()
        work()
        spent.append(1000 * (time.process_time() - began))
    return statistics.median(spent)


def _sized(what: str, sizes: Sequence[tuple[int, int]], rows: Sequence[tuple[str, Sequence[float]]]) -> tuple[Row, list[Row]]:
    """Times by resolution, each also as a multiple of the first row's."""
    first = rows[0][1]
    heads = [f"{width} x {height}" for width, height in sizes]
    cells = [
        (name, *itertools.chain.from_iterable((f"{t:.1f}", f"{t / base:.1f}") for t, base in zip(times, first, strict=True)))
        for name, times in rows
    ]
    return (what, *itertools.chain.from_iterable((head, "ratio") for head in heads)), cells


PARTS = ("step", "adam", "reach", "gbuffer", "bake", "draw", "page", "stream")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("key", nargs="?", default="bake", help="a bake artifact of neuras (default: the newest)")
    parser.add_argument("--store", default="store")
    parser.add_argument("--only", default=",".join(PARTS), help=f"parts, comma-separated (default: {','.join(PARTS)})")
    parser.add_argument("--steps", type=int, default=30, help="timed steps of part step")
    parser.add_argument("--sizes", default=SIZES, help=f"of drawn pictures (default: {SIZES})")
    parser.add_argument("--three", type=Path, help="folder of the unpacked npm package three")
    arguments = parser.parse_args()
    sizes = [size(text) for text in arguments.sizes.split(",")]
    bench = Bench(Store(arguments.store), arguments.key, arguments.steps, sizes, arguments.three)
    for part in arguments.only.split(","):
        if part not in PARTS:
            parser.error(f"{part} is unknown: choose from {', '.join(PARTS)}")
        heads, rows = getattr(bench, part)()
        print(f"\n{part}\n\n| {' | '.join(map(str, heads))} |\n|{' --- |' * len(heads)}")
        for row in rows:
            print(f"| {' | '.join(map(str, row))} |", flush=True)


if __name__ == "__main__":
    main()
