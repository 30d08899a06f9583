"""A longer road of the same stretch, and what a page of tiles holds and fetches while one drives along it.

``bench/neuras.py --only stream`` measures it, tests/neuras/test_tiles.py holds it to that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.neuras.baking import browser, site
from stages.neuras.baking.drawing import depth_range
from stages.neuras.baking.tiles import Tiling, cut
from stages.neuras.evaluation.renderers import Scene
from stages.neuras.records import AtlasMesh, FrameRecord

LARGEST = 8192  # texels along a side
NUMBERS = """(({ tiles }) => ({
  ...tiles.memory(), lacking: tiles.lacking, fetches: tiles.fetches, fetched: tiles.fetched,
  drawn: tiles.drawn.map((tile) => tile.number),
  used: tiles.spans.reduce((sum, piece) => sum + piece.rows, 0) / tiles.rows,
  fine: tiles.drawn.filter((tile) => tile.pieces[0].state === "here").map((tile) => tile.number),
}))(lightmill)"""


def placed(scene: Scene, frames: Sequence[FrameRecord], times: int) -> tuple[Scene, list[FrameRecord]]:
    """What stands beside the path from the first frame to the last, ``times`` times one after the other, and frames all along.

    The path must be about straight. Skyboxes grow with the road, or it would lead out of them.
    """
    atlas, baked = scene.atlas, scene.baked
    start, way = frames[0].camera.position, frames[-1].camera.position - frames[0].camera.position
    along = (atlas.vertices[atlas.faces].mean(axis=1) - start) @ way / (way @ way)
    rows = (along >= 0) & (along < 1)
    faces, charts, copies = atlas.faces[rows], atlas.charts[rows], np.arange(times)
    road = AtlasMesh(
        vertices=np.concatenate([atlas.vertices + (n * way).astype(np.float32) for n in copies]),
        uvs=np.tile(atlas.uvs, (times, 1)),
        faces=np.concatenate([faces + n * len(atlas.vertices) for n in copies]).astype(np.int32),
        charts=np.concatenate([charts + n * (charts.max() + 1) for n in copies]).astype(np.int32),
        width=atlas.width,
        height=atlas.height,
    )
    longer = replace(baked, sky_half_sizes=baked.sky_half_sizes + times * np.abs(way))
    planes = depth_range(road.vertices, scene.info.metre, [])
    return Scene(longer, road, scene.info, planes), [_moved(frame, n, n * way) for n in copies for frame in frames[:-1]]


def _moved(frame: FrameRecord, copy: int, by: np.ndarray) -> FrameRecord:
    pose = frame.camera.camera_to_world.copy()
    pose[:3, 3] += by
    return replace(frame, id=f"{frame.id}_{copy}", camera=replace(frame.camera, camera_to_world=pose))


def write(folder: Path, scene: Scene, frames: Sequence[FrameRecord], side: float | None, reach: float) -> None:
    """Its site, in tiles of ``side``, or in one piece. World units."""
    tiles = None
    if side is not None:
        cameras = [frame.camera for frame in frames]
        tiles = cut(scene.atlas, scene.baked.pyramid, scene.info.up, cameras, Tiling(side, reach, LARGEST))
    site.write_site(folder, scene.baked, scene.atlas, scene.info, frames, scene.planes, "fp16", tiles)


def drive(folder: Path, count: int) -> list[dict[str, Any]]:
    """At each of the site's frames, in order, once all is there.

    pool, skyboxes, buffers: bytes on the device. used: share of the pool's rows. lacking: levels of tiles without room.
    fetches, fetched: files so far, and their bytes. drawn: numbers of the tiles that are drawn. fine: of those with their
    finest level.
    """
    found = []
    with browser.opened(folder, "still=1") as page:
        page.value("lightmill.draw = lightmill.resize")  # pictures take long where no GPU draws them, and change no number
        for frame in range(count):
            page.value(f"lightmill.follow('#still=1&frame={frame}')")
            page.until(browser.SETTLED)
            found.append(page.value(NUMBERS))
    return found
