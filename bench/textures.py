"""What it costs to texture objects: seconds of one core to find the outer faces and to colour a rung's texels.

``python bench/textures.py --store STORE [--objects N]`` after ``python -m pipeline stage=decimate store=STORE collect=folder
collect.path=DIR collect.textures=true``; prints a table for objects spread evenly over those with base colours. The scene
stage pays this once per object, rung and worker.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.errors import UserError
from pipeline.store import Store
from stages.graphics.geometry import one_thread
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.renderformer.objects.rungs import load_rungs


def timed(function, *arguments):
    """(result, CPU seconds)."""
    start = time.process_time()
    return function(*arguments), time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", default="store")
    parser.add_argument("--objects", type=int, default=8)
    arguments = parser.parse_args()
    one_thread()
    from stages.renderformer.scenes import textures

    store = Store(arguments.store)
    decimate = store.resolve("decimate")
    key = decimate.manifest["preimage"]["inputs"]["collect"]
    collect = store.find("collect", key)
    told = json.loads(collect.file("textures.json").read_text())
    ids = [id for id in decimate.ids() if told[id]["textured"]]
    print("| object | faces | images | seen faces % | seconds to find them | rung | seconds | points per texel |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for id in ids[:: max(1, len(ids) // arguments.objects)][: arguments.objects]:
        mesh = MeshRecord.from_record(collect.read(id))
        texture = TextureRecord.from_record(collect.read(id + TextureRecord.SUFFIX))
        seen, looking = timed(textures.seen_faces, mesh.vertices, mesh.faces)
        head = f"| {id} | {len(mesh.faces):,} | {len(texture.images)} | {100 * seen.mean():.0f} | {looking:.2f} "
        for vertices, faces in load_rungs(decimate.read(id)).values():
            if len(faces) < 200:
                continue
            _, seconds = timed(textures.transfer, texture, mesh.vertices, mesh.faces, vertices[faces], seen)
            grid = textures.points_per_side(texture, len(faces)) ** 2
            print(f"{head}| {len(faces):,} | {seconds:.2f} | {grid} |")
            head = "| | | | | "


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"error: {error}")
