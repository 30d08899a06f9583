"""OFF: a stream of words, with colours of vertices and faces. Binary files and four dimensions are not read."""

from __future__ import annotations

import re

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import Look, srgb_colours
from stages.graphics.geometry.formats.parts import Part, Source, checked_part
from stages.graphics.geometry.formats.polygons import points_at, triangulate
from stages.graphics.geometry.formats.text import Words, plain_text, shown

KEYWORD = re.compile(rb"\s*(?P<kind>(?P<uv>ST)?(?P<colour>C)?(?P<normal>N)?4?n?)OFF(?![A-Za-z])(?P<binary>[ \t]*BINARY)?")


def read(data: bytes, source: Source) -> list[Part]:
    """One part."""
    return [_Off(data, source).part()]


class _Off:
    """The words of a file, and where its vertices and faces begin.

    Line breaks do not count, but for one thing: what stands in a line after a face is its colour. Nothing says how many
    numbers that are, nor whether a vertex has more than its kind demands. So the lines are looked at before the stream.
    """

    def __init__(self, data: bytes, source: Source):
        text = re.sub(rb"#[^\n]*", b"", plain_text(data))
        keyword = KEYWORD.match(text)
        kind = keyword["kind"] if keyword else b""
        if keyword and (keyword["binary"] or b"4" in kind or b"n" in kind):
            raise Reject("unsupported", f"line 1: {shown(keyword[0].strip())}, only text with three coordinates is read")
        start = keyword.end() if keyword else 0
        self.source = source
        self.words = words = Words(text[start:], 1 + text.count(b"\n", 0, start))
        if keyword is None and not (words.words and words.words[0].isdigit()):
            raise Reject("unreadable", f"{words.place(0)}: no OFF header")
        self.coloured, self.with_normals, self.with_uv = (keyword and keyword[name] for name in ("colour", "normal", "uv"))
        self.vertices, self.faces, self.first = self._counts(len(data))
        # the words that begin a line, and that after the last word
        self.line_starts = np.unique(np.cumsum([0, *(len(line.split()) for line in words.text.split(b"\n"))]))

    def _counts(self, size: int) -> tuple[int, int, int]:
        """(vertices, faces, word after the counts). The number of edges, which nothing needs, may be left out."""
        words = self.words
        if len(words) < 2:
            raise Reject("unreadable", f"{words.place(0)}: no numbers of vertices and faces")
        vertices, faces = (int(value) for value in words.integers(slice(0, 2)))
        for name, count, least in (("vertices", vertices, 6), ("faces", faces, 4)):
            if not 0 <= count * least <= size:
                raise Reject("unreadable", f"{words.place(0)}: it states {count} {name} in {size} bytes")
        if faces > self.source.max_faces:
            raise Reject("too_large", f"{words.place(0)}: states {faces} faces, at most {self.source.max_faces} are taken")
        alone = words.line(0) != words.line(1)  # each word in its own line
        return vertices, faces, 3 if alone or words.line(min(2, len(words) - 1)) == words.line(1) else 2

    def part(self) -> Part:
        faults = []
        for width in self._widths():
            for tails in (True, False) if self._one_face_per_line(width) else (False, True):
                try:
                    return self._part(width, tails)
                except Reject as reject:
                    faults.append(reject)
        self._reject_odd_line()
        raise faults[0]

    def _widths(self) -> list[int]:
        """How many numbers a vertex may have, the likeliest first: as many as stand in each line, else as the kind says."""
        fixed = 3 + (3 if self.with_normals else 0) + (2 if self.with_uv else 0)
        stated = [fixed + 4, fixed + 3] if self.coloured else [fixed]
        lengths = self._lengths(self.first, self.vertices)
        in_lines = len(lengths) == self.vertices > 0 and (lengths == lengths[0]).all() and lengths[0] >= 3
        return list(dict.fromkeys([int(lengths[0]), *stated])) if in_lines else stated

    def _lengths(self, start: int, count: int) -> np.ndarray:
        """Words of the lines from the word ``start`` on, at most ``count`` lines; none where no line begins there."""
        line = np.searchsorted(self.line_starts, start)
        lengths = np.diff(self.line_starts[line : line + count + 1])
        return lengths if len(lengths) and self.line_starts[line] == start else lengths[:0]

    def _one_face_per_line(self, width: int) -> bool:
        start = self.first + self.vertices * width
        lengths = self._lengths(start, self.faces)
        heads = self.line_starts[np.searchsorted(self.line_starts, start) :][: len(lengths)]
        sizes = [self.words.words[head] for head in heads]
        return len(lengths) == self.faces and all(s.isdigit() and int(s) < n for s, n in zip(sizes, lengths, strict=True))

    def _reject_odd_line(self) -> None:
        """A Reject for the first line of a vertex or face that has too few words, where most others have enough."""
        lengths = self._lengths(self.first, self.vertices)
        usual = int(np.bincount(lengths).argmax()) if len(lengths) else 0
        odd = np.flatnonzero(lengths != usual)
        if len(odd) and len(odd) * 2 < len(lengths):
            place = self.words.place(int(self.first + lengths[: odd[0]].sum()))
            raise Reject("unreadable", f"{place}: {lengths[odd[0]]} numbers, other vertices have {usual}")
        start = self.first + int(lengths.sum())
        lengths = self._lengths(start, self.faces)
        heads = start + np.cumsum([0, *lengths[:-1]]) if len(lengths) else []
        sizes = [self.words.words[head] for head in heads]
        odd = [i for i, size in enumerate(sizes) if not size.isdigit() or int(size) >= lengths[i]]
        if odd and len(odd) * 2 < len(sizes):
            place, size = self.words.place(int(heads[odd[0]])), sizes[odd[0]]
            raise Reject("unreadable", f"{place}: a face of {shown(size)} corners in a line of {lengths[odd[0]]} words")

    def _part(self, width: int, tails: bool) -> Part:
        """The mesh, if vertices have ``width`` numbers, and faces have ``tails``: their colours, up to the end of the line."""
        words, end = self.words, self.first + self.vertices * width
        if end > len(words):
            vertex = (len(words) - self.first) // width
            raise Reject("unreadable", f"{words.place(len(words))}: the file ends in vertex {vertex} of {self.vertices}")
        rows = words.floats(slice(self.first, end)).reshape(self.vertices, width)
        starts = self._face_starts(end, tails)
        sizes = words.integers(starts)
        places = np.repeat(starts + 1 - np.cumsum([0, *sizes[:-1]])[: len(sizes)], sizes) + np.arange(sizes.sum())
        corners = words.integers(places)
        triangles, owner = triangulate(sizes, points_at(rows[:, :3], corners))
        part = checked_part(
            rows[:, :3], corners[triangles],
            lambda vertex: words.place(self.first + vertex * width),
            lambda triangle: words.place(int(starts[owner[triangle]])),
        )  # fmt: skip
        if self.source.images is not None:
            part.look = self._look(rows, part.triangles, self._tails(starts + 1 + sizes) if tails else None, owner)
        return part

    def _face_starts(self, start: int, tails: bool) -> np.ndarray:
        """(faces,) the word that each face begins with."""
        words, faces = self.words, self.faces
        starts = np.zeros(faces, np.int64)
        for face in range(faces):
            if start >= len(words):
                raise Reject("unreadable", f"{words.place(len(words))}: the file ends before face {face} of {faces}")
            size = words.words[start]
            if not size.isdigit():
                raise Reject("unreadable", f"{words.place(start)}: {shown(size)} where a face's number of corners should stand")
            starts[face] = start
            start += int(size) + 1
            if start > len(words):
                raise Reject("unreadable", f"{words.place(len(words))}: the file ends in face {face} of {faces}")
            if tails:
                start = int(self.line_starts[np.searchsorted(self.line_starts, start)])
        if not tails and start != len(words):
            raise Reject("unreadable", f"{words.place(start)}: {shown(words.words[start])} after the last face")
        return starts

    def _tails(self, ends: np.ndarray) -> np.ndarray | None:
        """(faces, 3) colours that stand after the faces; None where not all have one."""
        lengths = self.line_starts[np.searchsorted(self.line_starts, ends)] - ends
        if len(lengths) and (lengths >= 3).all():
            return self.words.floats(np.add.outer(ends, [0, 1, 2]).ravel()).reshape(-1, 3)
        if lengths.any():
            self.source.note("face colours that are not three numbers for each face are not read")
        return None

    def _look(self, rows: np.ndarray, triangles: np.ndarray, face_colours: np.ndarray | None, owner: np.ndarray) -> Look:
        """Colours of faces where they have some, else those of vertices."""
        if face_colours is not None:
            colours = srgb_colours(face_colours, "face colours", self.source.note)
            return Look(tint=np.repeat(colours[owner][:, None], 3, axis=1))
        start = 6 if self.with_normals else 3
        if self.coloured and rows.shape[1] >= start + 3:
            return Look(tint=srgb_colours(rows[:, start : start + 3], "vertex colours", self.source.note)[triangles])
        return Look()
