"""Decisions over all objects at once: record ids, duplicates, splits, and the licences that a folder's README states.

Split rule (``fill_splits``): an object's content hash gives a fraction in [0, 1), and the fraction gives the split. So the
split depends on no name, no order and no other object. All objects of a held-out family go to the family's split.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipeline.errors import UserError

SPLITS = ("train", "validation", "test")
BOUNDS = {"test": 0.1, "validation": 0.2}  # an object goes to the first split whose bound its fraction is under, else to train
LEAST = 2  # objects that every split has
SIGNATURE_TOLERANCE = 2e-3  # candidates for duplicates: every number of the signature agrees to this
POINT_TOLERANCE = 5e-4  # of the longest side: confirmed when the surfaces agree to this


def record_id(item_id: str, stem: str) -> str:
    """A readable, unique record id: slug of the stem and 8 hex digits of the item id's hash."""
    slug = re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")[:40].strip("-") or "mesh"
    return f"{slug}-{hashlib.blake2b(item_id.encode(), digest_size=4).hexdigest()}"


def hash_fraction(content_hash: str) -> float:
    """A hex digest as a number in [0, 1), from its first 52 bits."""
    return int(content_hash[:13], 16) / 16**13


def fill_splits(
    objects: list[dict[str, Any]], fixed_splits: Mapping[str, str], duplicates: Mapping[str, Iterable[str]] | None = None
) -> dict[str, str]:
    """object_id -> split. Hash fractions decide, by ``BOUNDS``, except for objects in ``fixed_splits`` (object_id -> split).

    A split with fewer than ``LEAST`` objects takes those of the next higher fractions: first test, then validation.
    ``duplicates``: object_id -> content hashes of the meshes left out for it. The highest fraction counts.

    What holds when a set grows, with the same families held out:

    - No object moves towards the test: none from train to validation or test, none from validation to test.
    - Only an object that filled a split up moves, from test to validation or train, or from validation to train.
    - Once each split has ``LEAST`` objects without filling up, no object ever moves again.

    The reason: an object's place in the order of fractions rises by the number of new objects below it, and the ends of test
    and validation in that order rise by no more than that. No rule can do better from the objects alone: objects that never
    move could not be in train in any set of six, since two of every six must be test.

    A new duplicate can only raise its object's fraction, so that object moves towards train if at all. While a split is
    filled up, that can pull another object into it.

    Raises UserError where a split stays under ``LEAST``.
    """
    number = len(objects)
    splits = {name: split for name, split in fixed_splits.items() if split != "train"}
    fractions = {
        o["object_id"]: max(hash_fraction(h) for h in (o["content_hash"], *(duplicates or {}).get(o["object_id"], ())))
        for o in objects
        if o["object_id"] not in splits
    }
    free = sorted(fractions, key=lambda name: (fractions[name], name))
    end = 0
    for split, bound in BOUNDS.items():
        missing = max(0, LEAST - list(splits.values()).count(split))
        start, end = end, max(end + missing, sum(fraction < bound for fraction in fractions.values()))
        splits.update(dict.fromkeys(free[start:end], split))
    splits.update(dict.fromkeys(free[end:], "train"))
    counts = {split: list(splits.values()).count(split) for split in SPLITS}
    if min(counts.values()) < LEAST:
        stated = ", ".join(f"{counts[split]} {split}" for split in SPLITS)
        uneven = ", and the hashes of so few are uneven" if number >= 3 * LEAST else ""
        raise UserError(
            f"{number} distinct usable meshes ({stated}): train, validation and test need at least {LEAST} each, so at least "
            f"{3 * LEAST} in all{uneven}; add meshes{' or hold out fewer families' if fixed_splits else ''}"
        )
    return splits


def spread(values: list[float]) -> dict[str, float]:
    """Percentiles for summaries: p0 is the smallest, p100 the largest."""
    if not values:
        return {}
    percents = (0, 10, 50, 90, 100)
    return {f"p{percent}": round(float(x), 5) for percent, x in zip(percents, np.percentile(values, percents), strict=True)}


def find_duplicates(
    ids: list[str], signatures: np.ndarray, mesh: Callable[[str], tuple[np.ndarray, np.ndarray]]
) -> dict[str, str]:
    """id -> the earlier id with the same geometry.

    Meshes of nearly equal ``signatures`` (N, S) are compared as surfaces. ``mesh`` reads (vertices, faces) of these few by id.
    """
    from scipy.spatial import cKDTree

    same: dict[str, str] = {}
    pairs = cKDTree(signatures).query_pairs(SIGNATURE_TOLERANCE, p=np.inf, output_type="ndarray")
    for first, second in sorted(map(tuple, np.sort(pairs, axis=1).tolist())):
        a, b = ids[first], ids[second]
        if a not in same and b not in same and same_surface(mesh(a), mesh(b)):
            same[b] = a
    return same


def same_surface(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether each mesh's vertices and face centres lie on the other's surface, within the tolerance."""
    from stages.graphics.geometry import measure

    for (vertices, faces), (other, triangles) in ((a, b), (b, a)):
        points = np.concatenate([vertices, measure.corners_of(vertices, faces).mean(axis=1)])
        points = points[:: max(1, len(points) // 20000)]
        if measure.distances(points, other, triangles).max() > POINT_TOLERANCE:
            return False
    return True


def read_notes(readme: Path) -> dict[str, str]:
    """Sub-folder -> licence and origin, from a README's Markdown table whose last column's title speaks of licences."""
    notes: dict[str, str] = {}
    inside = False
    try:
        lines = readme.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return notes
    for line in lines:
        cells = [cell.strip().strip("`") for cell in line.strip().strip("|").split("|")]
        if not line.lstrip().startswith("|") or len(cells) < 2:
            inside = False
        elif not inside:
            inside = bool(re.search(r"licen[cs]e", cells[-1], flags=re.IGNORECASE))
        elif not re.fullmatch(r":?-+:?", cells[0]):
            notes[cells[0].strip("/")] = cells[-1][:300]
    return notes


def note_for(relative: str, notes: Mapping[str, str]) -> str:
    """The note of the nearest folder above the file that has one, else ''."""
    for folder in PurePosixPath(relative).parents:
        if folder.as_posix() in notes:
            return notes[folder.as_posix()]
    return ""
