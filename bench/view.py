"""How soon the viewer opens a large dataset, in how much memory, and how long a prediction takes:

    python bench/view.py [--scenes 2000] [--resolution 256] [--predictions 5]

Writes a made-up shard artifact to a temporary folder (one random scene with one image, under as many names), starts
``lightmill view`` on it as a process of its own, and asks as the page does: the store, the artifact, its records, the last
record's scene and image. Then it predicts with the model that ships, from a camera that moves. By the clock of a busy
machine times are upper bounds; ``cpu`` is the server's own time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from pipeline.keys import digest_of
from pipeline.stage import Record
from pipeline.store import Artifact, Store
from stages.graphics.arrays import pack_json
from stages.graphics.panels import unpack
from stages.renderformer.dataset.encoding import encode_scene
from stages.renderformer.records import SceneRecord, ViewRecord
from stages.renderformer.views import encode_view

SIDE = 64  # pixels of the stored image
LIGHTS, TRIANGLES = 4, 1024
PER_PART = 250
ORIGIN: dict[str, Any] = {
    "command": "bench/view.py", "machine": {"host": "here", "gpu": None}, "environment": {}, "summary": {},
    "code": {"digest": "0" * 64, "commit": "0" * 40, "dirty": False}, "started": 0.0, "finished": 1.0, "seconds": 1.0,
    "system": "renderformer",
}  # fmt: skip


def made_up_scene() -> SceneRecord:
    """Random triangles in the unit box under a few lights, and one camera."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.4, 0.4, (TRIANGLES, 1, 3))
    triangles = (places + rng.normal(0, 0.03, (TRIANGLES, 3, 3))).astype(np.float32)
    light = np.full(TRIANGLES, -1)
    light[:LIGHTS] = np.arange(LIGHTS)
    triangles[:LIGHTS, :, 2] += 2.5
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals = np.repeat((cross / np.linalg.norm(cross, axis=1, keepdims=True))[:, None], 3, axis=1)
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 1.8
    grey = np.full((TRIANGLES, 3), 0.5, np.float32)
    objects = [{"name": f"light_{n}", "kind": "light"} for n in range(LIGHTS)] + [{"name": "dust", "kind": "object"}]
    return SceneRecord(
        "scene", triangles, normals.astype(np.float32), grey, grey * 0.2, np.full(TRIANGLES, 0.5, np.float32),
        np.where(light[:, None] >= 0, 800.0, 0.0) * np.ones(3), light, np.where(light >= 0, light, LIGHTS),
        pose[None], np.array([45.0], np.float32), {"objects": objects, "split": "test"},
    )  # fmt: skip


def write(root: Path, scenes: int) -> Artifact:
    """A shard artifact of so many scenes, as the engine commits one."""
    scene, rng = made_up_scene(), np.random.default_rng(1)
    smooth = np.add.outer(np.arange(SIDE), np.arange(SIDE))[..., None] / SIDE * rng.uniform(0.2, 1, 3)
    flat = np.ones((SIDE, SIDE), np.float32)
    planes = {name: smooth.astype(np.float32) for name in ("direct", "albedo", "normal")}
    index = rng.integers(-1, TRIANGLES, (SIDE, SIDE), np.int32)
    lights = np.stack([smooth * rng.uniform(0, 1) for _ in range(LIGHTS)]).astype(np.float32)
    view = ViewRecord(
        lights, **planes, depth=flat, coverage=flat, triangle=index, object=index % 3, meta={"index": 0, "spp": 1}
    )
    members = {"scene.npz": encode_scene(scene), **encode_view(view)}
    crc = {name: zlib.crc32(data) for name, data in members.items()}
    preimage = {"stage": "shard", "version": 1, "params": {}, "inputs": {}}
    store = Store(root)
    draft, markers = store.draft("shard", digest_of(preimage), preimage), []
    for first in range(0, scenes, PER_PART):
        part, ids = draft.open_part(), [f"test-{n:06}" for n in range(first, min(first + PER_PART, scenes))]
        for id in ids:
            meta = {**scene.meta, "views": [0], "crc32": crc, "id": id}
            part.add(Record(id, {"meta.json": pack_json(meta), **members}), id, "test", "")
        markers.append({"part_key": str(len(markers)), "group": "test", "items": ids, "rejects": [], **part.close()})
    draft.use_parts(markers)
    manifest = {**ORIGIN, "key": draft.key, "preimage": preimage, "outputs": draft.outputs()}
    return store.commit(draft, "made-up", manifest)


class Browser:
    """Asks a viewer as the page does."""

    def __init__(self, address: str):
        self.address = address

    def ask(self, name: str, **query: Any) -> Any:
        with urllib.request.urlopen(f"{self.address}api/{name}?{urllib.parse.urlencode(query)}") as answer:
            data = answer.read()
            return unpack(data) if answer.headers["Content-Type"] == "application/octet-stream" else json.loads(data)

    def act(self, name: str, **values: Any) -> Any:
        request = urllib.request.Request(
            f"{self.address}api/act/renderformer/{name}", json.dumps(values).encode(), {"Content-Type": "application/json"}
        )
        with urllib.request.urlopen(request) as answer:
            return unpack(answer.read())


def row(label: str, value: str) -> None:
    print(f"  {label:62s} {value:>12s}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--predictions", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        artifact = write(Path(folder) / "store", arguments.scenes)
        print(f"{arguments.scenes:,} scenes, {artifact.manifest['outputs']['bytes'] / 1e6:,.0f} MB")
        began = time.perf_counter()
        words = [sys.executable, "-m", "stages.cli", "view", f"{folder}/store", "--port", "0", "--no-browser"]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        try:
            measure(process, artifact, began, arguments)
        finally:
            process.terminate()
            process.wait()


def measure(process: subprocess.Popen, artifact: Artifact, began: float, arguments: argparse.Namespace) -> None:
    address = process.stdout.readline().split()[0]
    server, browser, name = psutil.Process(process.pid), Browser(address), artifact.name
    row("the address is printed after", f"{time.perf_counter() - began:.2f} s")
    for question in (
        ("store", {}),
        ("artifact", {"artifact": name}),
        ("records", {"artifact": name}),
        ("panels", {"artifact": name}),
    ):
        browser.ask(question[0], **question[1])
    row("the store, the artifact and its records are shown after", f"{time.perf_counter() - began:.2f} s")
    id = f"test-{arguments.scenes - 1:06}"
    once = time.perf_counter()
    space, *_ = browser.ask("panels", artifact=name, record=id)
    browser.ask("record", artifact=name, record=id)
    browser.ask("lazy", artifact=name, record=id, path=space["panes"][0]["eyes"][0]["image"]["lazy"])
    row("the last record's scene and image, from the click", f"{time.perf_counter() - once:.2f} s")
    row("  all of it since the start", f"{time.perf_counter() - began:.2f} s")
    times = server.cpu_times()
    row("  cpu", f"{times.user + times.system:.2f} s")
    row("memory of the server", f"{server.memory_info().rss / 1e6:.0f} MB")
    checkpoint = browser.act("checkpoints")[-1]["id"]  # the one that ships
    pose = np.eye(4)
    for number in range(arguments.predictions + 1):
        pose[:3, 3] = (0.1 * number, 0, 1.8)
        camera = {"camera_to_world": pose.tolist(), "fov_deg": 45}
        once, cpu = time.perf_counter(), sum(server.cpu_times()[:2])
        answer = browser.act("predict", scene={"artifact": name, "record": id}, checkpoint=checkpoint, camera=camera,
                             edits={}, resolution=arguments.resolution)  # fmt: skip
        what = "first prediction, the network is loaded" if number == 0 else f"prediction {number}"
        whole, own = time.perf_counter() - once, sum(server.cpu_times()[:2]) - cpu
        row(f"{what}, {arguments.resolution} px, {TRIANGLES:,} triangles (cpu {own:.2f} s)", f"{whole:.2f} s")
    row("  of which the network, in the last", f"{answer['seconds']:.2f} s")


if __name__ == "__main__":
    main()
