"""Panels of any artifact or record, by the names of its members and files: what a system without views gets.

Numbers (.json, .jsonl, .csv), words (.txt, .md), pictures (.png, .jpg), HDR images (.exr), meshes (an .npz of vertices and
faces), clips (.mp4) and pages (.html).
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from stages.graphics.panels import Curves, Facts, Image, Images, Lazy, Page, Pane, Pictures, Shown, Space, Surface, Video, Words

PICTURES = (".png", ".jpg", ".jpeg")
MOST_TEXT = 200_000  # characters of a file that are shown
MOST_JSON = 400_000  # bytes of JSON that are shown as facts
STEP = re.compile(r"(.*?)(\d+)\.(?:png|jpe?g)\Z")


def panels(shown: Shown, leave: Collection[str] = ()) -> Iterator[Any]:
    """Panels of a record's members, or of an artifact's files, but for those named in ``leave``."""
    if shown.record_id is None:
        yield from _files(shown, [name for name in shown.files() if name not in leave])
    else:
        yield from _members(shown, [name for name in shown.members() if name not in leave])


# --- records ----------------------------------------------------------------------------------------------------------


def _members(shown: Shown, names: list[str]) -> Iterator[Any]:
    pictures = {name.rpartition(".")[0]: name for name in names if name.endswith(PICTURES)}
    if pictures:
        yield Pictures("Pictures", pictures)
    hdr = {name.removesuffix(".exr"): lazy_hdr(shown, name) for name in names if name.endswith(".exr")}
    if hdr:
        yield Images("Images", hdr)
    for name in names:
        if name.endswith(".npz"):
            yield from _arrays(shown, name)
        elif name.endswith(".json"):
            yield Facts(name, json.loads(_bytes(shown, name)))
        elif not name.endswith((".exr", *PICTURES)):
            yield Words(name, _bytes(shown, name)[:MOST_TEXT].decode("utf-8", "replace"))


def _bytes(shown: Shown, name: str) -> bytes:
    return shown.record((name,)).members[name]


def _arrays(shown: Shown, name: str) -> Iterator[Any]:
    from stages.graphics.arrays import unpack_arrays

    arrays = unpack_arrays(_bytes(shown, name))
    if {"vertices", "faces"} <= arrays.keys() and arrays["vertices"].ndim == 2 and arrays["vertices"].shape[1] == 3:
        yield Space(name, [Pane(name, [Surface(name, arrays["vertices"], arrays["faces"])])])
    yield Facts(name, {key: f"{array.dtype} {tuple(array.shape)}" for key, array in arrays.items()})


def lazy_hdr(shown: Shown, member: str) -> Lazy:
    """The image of an EXR member, read when it is looked at."""
    return Lazy(lambda: hdr_image(member.removesuffix(".exr"), _bytes(shown, member)))


def hdr_image(title: str, data: bytes) -> Image:
    """An EXR image of any kind: a view light by light, or plain RGB."""
    from stages.graphics.exr import META, decode, decode_lights, decode_rgb
    from stages.graphics.tonemap import exposure_for

    header, _ = decode(data, title)
    lights, facts = decode_lights(data, title, None) if META in header else (decode_rgb(data, title)[None], {})
    return Image(title, lights, exposure=exposure_for(lights.sum(axis=0, dtype="float32")), facts=facts)


# --- artifacts --------------------------------------------------------------------------------------------------------


def _files(shown: Shown, names: list[str]) -> Iterator[Any]:
    for name in names:
        if name.endswith(".html") and (name.endswith("/index.html") or "/" not in name):
            yield Page(name, name)
    for name in names:
        if name.endswith((".jsonl", ".csv")) and (series := curves(_text(shown, name), name)):
            yield Curves(name, series)
    yield from _pictures(names)
    for name in names:
        in_site = any(name.startswith(other.removesuffix("index.html")) for other in names if other.endswith("/index.html"))
        if name.endswith(".mp4"):
            yield Video(name, name)
        elif name.endswith(".json") and not in_site and (shown.artifact.path / "files" / name).stat().st_size <= MOST_JSON:
            yield Facts(name, json.loads(_text(shown, name)))
        elif name.endswith((".md", ".txt")) and not in_site:
            yield Words(name, _text(shown, name))


def _pictures(names: list[str]) -> Iterator[Pictures]:
    """Pictures by folder. Those of one folder that differ by a number alone get a slider."""
    folders = defaultdict(list)
    for name in names:
        if name.endswith(PICTURES):
            folders[name.rpartition("/")[0]].append(name)
    for folder, inside in folders.items():
        if any(f"{folder}/".startswith(name.removesuffix("index.html")) for name in names if name.endswith("/index.html")):
            continue  # they belong to a page
        matches = [STEP.match(name) for name in inside]
        series = all(matches) and len({match[1] for match in matches}) == 1
        captions = {f"step {int(match[2])}" if series else name: name for match, name in zip(matches, inside, strict=True)}
        yield Pictures(folder or "Pictures", captions, slider=bool(series))


def _text(shown: Shown, name: str) -> str:
    with open(shown.artifact.file(name), encoding="utf-8", errors="replace") as file:
        return file.read(64 * MOST_TEXT)


def curves(text: str, name: str = "log.jsonl") -> dict[str, list[tuple[float, float]]]:
    """Series over ``step`` of a log: lines of JSON, or CSV with a heading. Empty where it is no log."""
    series: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in _rows(text, name):
        step = row.get("step")
        if isinstance(step, (int, float)):
            for key, value in row.items():
                if key != "step" and isinstance(value, (int, float)) and not isinstance(value, bool):
                    series[key].append((step, value))
    return dict(series)


def _rows(text: str, name: str) -> Iterator[Mapping[str, Any]]:
    if name.endswith(".csv"):
        for row in csv.DictReader(io.StringIO(text)):
            yield {key: _number(value) for key, value in row.items() if key and value}
        return
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except ValueError:  # the last line of a run that is being written
            return
        if not isinstance(row, dict) or "step" not in row:
            return
        yield row


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
