"""STL, binary and text: triangles without shared vertices. Colours, which vendors hide in it, are not read."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.text import Words, plain_text, shown

HEADER, TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(data: bytes, source: Source) -> list[Part]:
    """One part of a binary file, one for each solid of a text."""
    count = struct.unpack_from("<I", data, HEADER - 4)[0] if len(data) >= HEADER else None
    if count is not None and len(data) == HEADER + TRIANGLE.itemsize * count:
        return _binary(data, count, source)
    text = plain_text(data)
    is_text = count is None or b"\0" not in text[:512] or b"facet" in text[:2048]  # some binary files begin with the word too
    if text[:512].lstrip().lower().startswith(b"solid") and is_text:
        return _text(text, source)
    if count is None:
        if not data.strip():
            raise Reject("no_faces", "an empty file")
        raise Reject("unreadable", f"byte {len(data)}: the file ends in the header of {HEADER} bytes")
    return _binary(data, count, source)


def _binary(data: bytes, count: int, source: Source) -> list[Part]:
    size = HEADER + TRIANGLE.itemsize * count
    if len(data) < size or len(data) >= size + TRIANGLE.itemsize:  # a few bytes more are some exporters' padding
        raise Reject("unreadable", f"byte {HEADER - 4}: it states {count} faces, which end at byte {size} of {len(data)}")
    if count > source.max_faces:
        raise Reject("too_large", f"states {count} faces, at most {source.max_faces} are taken")
    blob = np.frombuffer(data, TRIANGLE, count, HEADER)
    if blob["attribute"].any() or b"COLOR=" in data[:HEADER]:
        source.note("colours in attribute bytes or the header, an extension of some vendors, are not read")
    points = blob["corners"].reshape(-1, 3).astype(np.float64)
    return [_part(points, lambda vertex: f"byte {HEADER + TRIANGLE.itemsize * (vertex // 3)}: triangle {vertex // 3}")]


def _text(text: bytes, source: Source) -> list[Part]:
    parts, end = [], 0
    # the name after the word solid may hold any word
    heads = [match for match in re.finditer(rb"^[ \t]*(end)?[ \t]?solid\b[^\n]*$", text, re.MULTILINE | re.IGNORECASE)]
    for head, tail in zip(heads, [*heads[1:], None], strict=True):
        if head[1]:
            continue
        line = text.count(b"\n", 0, head.start()) + 1
        if tail is None or not tail[1]:
            last = text.rstrip().count(b"\n") + 1 if tail is None else text.count(b"\n", 0, tail.start()) + 1
            raise Reject("unreadable", f"line {last}: no endsolid for the solid of line {line}")
        end = tail.end()
        words = Words(text[head.end() : tail.start()], line)
        part = _solid(words, source)
        if part is not None:
            parts.append(part)
    if text[end:].strip() and end:
        line = text.count(b"\n", 0, end) + 2
        raise Reject("unreadable", f"line {line}: {shown(text[end:].split()[0])} after the last endsolid")
    return parts


def _solid(words: Words, source: Source) -> Part | None:
    lower = [word.lower() for word in words.words]
    starts = [index for index, word in enumerate(lower) if word == b"vertex"]
    if not starts:
        if lower:
            raise Reject("unreadable", f"{words.place(0)}: {shown(lower[0])} where a facet should begin")
        return None
    if len(starts) > 3 * source.max_faces:
        raise Reject("too_large", f"{len(starts) // 3} faces, at most {source.max_faces} are taken")
    loops = [index for index, word in enumerate(lower) if word == b"endloop"]
    before = np.searchsorted(starts, loops)
    wrong = np.flatnonzero(np.diff(before, prepend=0) != 3)
    if len(wrong):
        count = int(np.diff(before, prepend=0)[wrong[0]])
        raise Reject("unreadable", f"{words.place(loops[wrong[0]])}: a loop of {count} vertices, expected 3")
    if not loops or before[-1] != len(starts):
        raise Reject("unreadable", f"{words.place(starts[-1])}: a loop without its end")
    points = words.floats(np.add.outer(starts, [1, 2, 3]).ravel())
    return _part(points.reshape(-1, 3), lambda vertex: words.place(starts[vertex]))


def _part(points: np.ndarray, place: Callable[[int], str]) -> Part:
    triangles = np.arange(len(points)).reshape(-1, 3)
    return checked_part(points, triangles, place, lambda triangle: place(3 * triangle))
