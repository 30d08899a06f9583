"""Contact sheets of a rendered dataset: what a person wants to see before training on it.

A file per template of the scenes and kind of sheet, each about 1,100 pixels wide whatever the resolution:

- ``contact-<template>.png``: `SCENES` scenes of every variant with all their views, a scene's with one exposure; below a view
  its samples per pixel and estimated error, or why it was dropped.
- ``layers-<template>.png``: one view of one scene of every variant as it is stored: image, direct light, albedo, normal, depth,
  coverage, objects, triangles, and its lights one by one, all radiance with one exposure.

Only the chosen scenes are read, view by view; the choice is by hash of the scene's id, so that it does not depend on the order
and hardly changes when the dataset grows.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipeline.keys import seed_for
from pipeline.stage import Record
from stages.graphics.arrays import unpack_json
from stages.graphics.exr import decode_lights
from stages.graphics.tonemap import exposure_for, exposure_text, to_picture
from stages.renderformer.records import ViewRecord
from stages.renderformer.views import decode_view, view_members

SCENES = 8  # of each template and variant
COLUMNS = 8  # pictures in a row; also the views of a scene, and the lights of a view, that are shown at most
TILE = 128  # pixels: smaller views are enlarged by a whole number, larger ones averaged
CELL = TILE + 2  # with its frame
GAP = 6
TEXT = 12  # height of labels, pixels
LINE = 17  # height of a line of text
HEADING = 32
DROPPED = 128  # grey of dropped views
FRAME, FAINT = "#cccccc", "#555555"

Read = Callable[[str, Collection[str]], Record]  # some members of a record
Kinds = Mapping[str, Sequence[str]]  # variant -> ids of its scenes


def write_sheets(folder: Path, scenes: Mapping[tuple[str, str], Sequence[str]], read: Read) -> None:
    """Write both sheets of every template. ``scenes``: (template, variant) -> ids of all its scenes."""
    templates: dict[str, dict[str, Sequence[str]]] = {}
    for template, variant in sorted(scenes):
        templates.setdefault(template, {})[variant] = scenes[template, variant]
    for template, kinds in templates.items():
        name = re.sub(r"[^a-z0-9_]+", "-", template.lower())
        contact_sheet(template, kinds, read).save(folder / f"contact-{name}.png", optimize=True)
        layer_sheet(template, kinds, read).save(folder / f"layers-{name}.png", optimize=True)


def choose(ids: Sequence[str]) -> list[str]:
    """`SCENES` of the scenes."""
    return heapq.nsmallest(SCENES, ids, key=lambda id: (seed_for(0, "sheet", id), id))


def contact_sheet(template: str, kinds: Kinds, read: Read) -> Image.Image:
    """Chosen scenes of every variant of one template, with all their views."""
    page = Page(
        f"{template}: one exposure per scene; spp: paths per pixel; error: estimated, of log10(1 + radiance); grey: dropped"
    )
    for variant, ids in kinds.items():
        chosen = choose(ids)
        page.heading(f"{template}_{variant}", f"{len(chosen)} of {len(ids):,} scene{'s' * (len(ids) != 1)}")
        for id in chosen:
            page.place(_scene_block(id, read))
    return page.image()


def layer_sheet(template: str, kinds: Kinds, read: Read) -> Image.Image:
    """One view of every variant of one template, layer by layer: of the chosen scenes the one with the most lights."""
    page = Page(
        f"{template}: radiance with one exposure per view; normal as (n + 1) / 2; depth bright where near; share of each light"
    )
    for variant, ids in kinds.items():
        metas = {id: _meta(id, read) for id in choose(ids)}
        id = max(metas, key=lambda id: (metas[id]["lights"] <= COLUMNS, metas[id]["lights"]))
        view = _view(id, next(meta["index"] for meta in metas[id]["views"] if meta["status"] == "ok"), read)
        exposure = exposure_for(view.image)
        meta = view.meta
        error = "" if meta["error"] is None else f", estimated error {meta['error']:.4f}"
        note = f"{id}, view {meta['index']}, {meta['spp']} samples per pixel{error}, {exposure_text(exposure)}"
        page.heading(f"{template}_{variant}", note)
        for block in _layer_blocks(view, exposure):
            page.place(block)
    return page.image()


# --- blocks: a picture with its text -----------------------------------------------------------------------------------


def _scene_block(id: str, read: Read) -> Image.Image:
    """The views of one scene side by side, the scene's name above, a line on each below."""
    noted = _meta(id, read)
    views, lights = noted["views"], noted["lights"]
    images = {meta["index"]: fit(_image(id, meta["index"], read)) for meta in views if meta["status"] == "ok"}
    exposure = exposure_for(np.concatenate([image.reshape(-1, 3) for image in images.values()]))
    tiles = []
    for meta in views[:COLUMNS]:
        if meta["index"] in images:
            error = "" if meta["error"] is None else f", error {meta['error']:.4f}"
            tiles.append(_tile(to_picture(images[meta["index"]], exposure), f"{meta['spp']} spp{error}"))
        else:
            tiles.append(_dropped(meta))
    width = sum(tile.width for tile in tiles) + GAP * (len(tiles) - 1)
    block = Image.new("RGB", (width, LINE + tiles[0].height), "white")
    more = f" ({len(views) - COLUMNS} more views)" if len(views) > COLUMNS else ""
    _write(block, (0, 0), f"{id}, {lights} light{'s' * (lights != 1)}, {exposure_text(exposure)}{more}", width)
    for index, tile in enumerate(tiles):
        block.paste(tile, (index * (CELL + GAP), LINE))
    return block


def _layer_blocks(view: ViewRecord, exposure: float) -> list[Image.Image]:
    """Two rows of tiles: what is seen, then the lights."""
    hit = view.depth > 0
    near, far = (float(f(view.depth[hit])) for f in (np.min, np.max)) if hit.any() else (0.0, 1.0)
    depth = np.where(hit, 1 - 0.85 * (view.depth - near) / max(far - near, 1e-6), 0)
    normal = 0.5 * (view.normal + view.coverage[..., None])  # black where nothing was hit
    blocks = [
        _tile(to_picture(fit(view.image), exposure), "image"),
        _tile(to_picture(fit(view.direct), exposure), "direct light"),
        _tile(to_picture(fit(view.albedo)), "albedo"),
        _tile(_grey(fit(normal)), "normal, world"),
        _tile(_grey(fit(depth)), f"depth {near:.2f} to {far:.2f}"),
        _tile(_grey(fit(view.coverage)), "coverage"),
        _tile(_colours(view.object), "object"),
        _tile(_colours(view.triangle), "triangle"),
    ]
    blocks += [Image.new("RGB", (CELL, CELL + LINE), "white") for _ in range(COLUMNS - len(blocks))]
    for index, light in enumerate(view.lights[:COLUMNS]):
        share = float(light.sum() / max(view.image.sum(), 1e-12))
        more = f" of {len(view.lights)}" if len(view.lights) > COLUMNS else ""
        blocks.append(_tile(to_picture(fit(light), exposure), f"light {index}{more}: {share:.1%}"))
    return blocks


def fit(pixels: np.ndarray) -> np.ndarray:
    """(H, W) or (H, W, 3) linear values as a square picture of at most `TILE` pixels a side.

    A small one has every pixel repeated a whole number of times, a large one is averaged.
    """
    side = len(pixels)
    if side <= TILE:
        times = TILE // side
        return pixels.repeat(times, axis=0).repeat(times, axis=1)
    planes = pixels.reshape(*pixels.shape[:2], -1).astype(np.float32)
    small = [
        np.asarray(Image.fromarray(np.ascontiguousarray(planes[..., channel])).resize((TILE, TILE), Image.Resampling.BOX))
        for channel in range(planes.shape[-1])
    ]
    return np.stack(small, axis=-1).reshape(TILE, TILE, *pixels.shape[2:])


def _colours(indices: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8: a colour for each of the (H, W) indices, black for -1; a large picture is thinned out."""
    step = -(-len(indices) // TILE)
    palette = np.random.default_rng(0).integers(64, 256, (257, 3))
    palette[0] = 0
    colours = palette[np.where(indices < 0, 0, 1 + indices % 256)][::step, ::step]
    times = TILE // len(colours)
    return colours.repeat(times, axis=0).repeat(times, axis=1).astype(np.uint8)


def _meta(id: str, read: Read) -> dict[str, Any]:
    return unpack_json(read(id, ("meta.json",)).members["meta.json"])


def _image(id: str, index: int, read: Read) -> np.ndarray:
    name, _ = view_members(index)
    return decode_lights(read(id, (name,)).members[name], f"{name} of {id}")[0].sum(axis=0)


def _view(id: str, index: int, read: Read) -> ViewRecord:
    names = view_members(index)
    return decode_view(read(id, names).members, index, f"{names[0]} of {id}")


def _grey(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] as (H, W, 3) uint8, without a transfer curve."""
    pixels = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=-1)


def _tile(picture: np.ndarray, text: str) -> Image.Image:
    """A framed picture of at most `TILE` pixels a side, a line of text below."""
    tile = Image.new("RGB", (CELL, CELL + LINE), "white")
    tile.paste(Image.fromarray(picture), ((CELL - picture.shape[1]) // 2, (CELL - picture.shape[0]) // 2))
    ImageDraw.Draw(tile).rectangle((0, 0, CELL - 1, CELL - 1), outline=FRAME)
    _write(tile, (1, CELL + 1), text, CELL - 1)
    return tile


def _dropped(meta: dict[str, Any]) -> Image.Image:
    """A view that is not stored: its status, and what it was dropped for."""
    number, value = ("mean", meta["mean"]) if meta["status"] == "dark" else ("nearest", meta["nearest"])
    tile = _tile(np.full((TILE, TILE, 3), DROPPED, np.uint8), f"{number} {value:.4f}")
    centre = (CELL / 2, CELL / 2)
    ImageDraw.Draw(tile).text(centre, meta["status"].replace("_", " "), fill="white", font=_font(TEXT + 3), anchor="mm")
    return tile


def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def _write(image: Image.Image, place: tuple[int, int], text: str, width: int, size: int = TEXT, fill: str = "black") -> None:
    """One line of text, cut where it would not fit."""
    font = _font(size)
    if font.getlength(text) > width:
        while text and font.getlength(text + "…") > width:
            text = text[:-1]
        text += "…"
    ImageDraw.Draw(image).text(place, text, fill=fill, font=font)


class Page:
    """Blocks set like words: from left to right, a new row where one does not fit."""

    WIDTH = COLUMNS * CELL + (COLUMNS + 1) * GAP

    def __init__(self, legend: str) -> None:
        self._placed: list[tuple[int, int, Image.Image]] = []
        self._x, self._y, self._row = GAP, GAP, 0  # where the next block goes, and the height of the row in the making
        line = Image.new("RGB", (self.WIDTH - 2 * GAP, LINE), "white")
        _write(line, (0, 0), legend, line.width, fill=FAINT)
        self.place(line)

    def heading(self, title: str, note: str) -> None:
        """A line across the page: starts a new row."""
        self.new_row()
        line = Image.new("RGB", (self.WIDTH - 2 * GAP, HEADING), "white")
        _write(line, (0, 6), title, line.width, size=16)
        start = int(_font(16).getlength(title)) + 14
        _write(line, (start, 10), note, line.width - start, fill=FAINT)
        self._placed.append((GAP, self._y, line))
        self._y += HEADING

    def place(self, block: Image.Image) -> None:
        if self._x > GAP and self._x + block.width > self.WIDTH - GAP:
            self.new_row()
        self._placed.append((self._x, self._y, block))
        self._x += block.width + GAP
        self._row = max(self._row, block.height)

    def new_row(self) -> None:
        self._y += self._row + (GAP if self._row else 0)
        self._x, self._row = GAP, 0

    def image(self) -> Image.Image:
        self.new_row()
        page = Image.new("RGB", (self.WIDTH, self._y), "white")
        for x, y, block in self._placed:
            page.paste(block, (x, y))
        return page
