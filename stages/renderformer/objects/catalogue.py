"""What is decided over all objects at once: record ids, duplicates, splits, and what a folder says about its files'
licences.

Split rule: validation and test hold at least max(2, 10 %) of the objects each, and so does train. Families that are
held out go whole to their split; the rest of the need is met in order of content hash, so that the choice does not
depend on names or order.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from pipeline.errors import UserError

SPLITS = ("train", "validation", "test")
SIGNATURE_TOLERANCE = 2e-3  # candidates for duplicates: every number of the signature agrees to this
POINT_TOLERANCE = 5e-4  # of the longest side: confirmed when the surfaces agree to this


def record_id(item_id: str, stem: str) -> str:
    """A readable, unique record id: slug of the stem and 8 hex digits of the item id's hash."""
    slug = re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")[:40].strip("-") or "mesh"
    return f"{slug}-{hashlib.blake2b(item_id.encode(), digest_size=4).hexdigest()}"


def fill_splits(objects: list[dict[str, Any]], held: Mapping[str, str]) -> dict[str, str]:
    """object_id -> split. ``held`` places some objects already; the others fill test, then validation, by rank of hash.

    Raises UserError where the objects do not suffice.
    """
    number = len(objects)
    least = max(2, math.ceil(0.1 * number))
    splits = {name: split for name, split in held.items() if split != "train"}
    free = [o["object_id"] for o in sorted(objects, key=lambda o: o["content_hash"]) if o["object_id"] not in splits]
    for split in ("test", "validation"):
        while list(splits.values()).count(split) < least and free:
            splits[free.pop(0)] = split
    splits.update(dict.fromkeys(free, "train"))
    counts = {split: list(splits.values()).count(split) for split in SPLITS}
    if min(counts.values()) < least:
        stated = ", ".join(f"{counts[split]} {split}" for split in SPLITS)
        raise UserError(
            f"{number} distinct usable meshes ({stated}): train, validation and test need at least {least} each, "
            f"so at least {max(3 * least, 6)} in all{' and fewer held out' if number >= 3 * least else ''}; add meshes"
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
    """id -> the earlier id with the same geometry. ``signatures`` (N, S); ``mesh`` reads the few that need
    confirming."""
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
    """The note of the nearest folder that has one."""
    for folder in PurePosixPath(relative).parents:
        if folder.as_posix() in notes:
            return notes[folder.as_posix()]
    return ""
