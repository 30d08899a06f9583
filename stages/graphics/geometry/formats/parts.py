"""What a reader of a mesh format gets and gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import Images, Look


@dataclass
class Source:
    """A mesh file, what may be read beside it, and what there is to say about it.

    path: the file. root: nothing outside it is read. max_bytes: of a file beside it, and of arrays that the file only states.
    max_faces: that the file may state. images: collects base-colour images; None where colours are not asked for.
    about: origin and licence where the file states them. references: files that it names, though no triangle needs them.
    notes: what of the colours could not be had, and why.
    """

    path: Path
    root: Path
    max_bytes: int
    max_faces: int
    images: Images | None = None
    about: dict[str, str] = field(default_factory=dict)
    references: list[str] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        return self.path.parent

    @property
    def notes(self) -> list[str]:
        return self.images.notes if self.images is not None else []

    def note(self, text: str) -> None:
        """Say something about the colours once, where they are asked for."""
        if self.images is not None and text not in self.images.notes:
            self.images.notes.append(text)


@dataclass
class Part:
    """One piece of a mesh file in its place.

    points: (V, 3) float64. triangles: (F, 3) int64. look: its colours; nothing stated where they were not asked for.
    """

    points: np.ndarray
    triangles: np.ndarray
    look: Look = field(default_factory=Look)

    def content(self) -> tuple:
        """What parts are put in order by, so that neither names nor the order in a file decide."""
        return self.points.tobytes(), self.triangles.tobytes(), *self.look.content()


def checked_part(points: np.ndarray, triangles: np.ndarray, vertex: Callable[[int], str], face: Callable[[int], str]) -> Part:
    """The part, or a Reject where a triangle refers to no vertex or to one that is not finite.

    ``vertex`` and ``face`` say where in the file a vertex or a triangle of that number stands.
    """
    bad = np.flatnonzero(((triangles < 0) | (triangles >= len(points))).any(axis=1))
    if len(bad):
        index = next(int(i) for i in triangles[bad[0]] if not 0 <= i < len(points))
        raise Reject("bad_indices", f"{face(int(bad[0]))}: vertex {index} of {len(points)} (counted from 0)")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = np.flatnonzero(~finite[triangles].all(axis=1))
        if len(bad):
            index = int(triangles[bad[0]][~finite[triangles[bad[0]]]][0])
            raise Reject("not_finite", f"{vertex(index)}: a coordinate is infinite or not a number")
    return Part(points + 0.0, triangles)  # no negative zeros, which differ in bytes alone
