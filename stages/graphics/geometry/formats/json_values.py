"""Typed values of a stranger's JSON tree: each is there and of its kind, or a Reject names it."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.faults import at


def parse(data: bytes) -> dict[str, Any]:
    """The table that the bytes of a JSON text hold."""
    with at("JSON"):
        tree = json.loads(data)
    if not isinstance(tree, dict):
        raise Reject("unsupported", "not glTF 2.x: its JSON is not a table")
    return tree


def data_of(uri: str) -> bytes:
    """The bytes of a data URI."""
    try:
        return base64.b64decode(uri.partition(",")[2])
    except ValueError:
        raise Reject("unreadable", "its data URI is not base64") from None


MISSING = object()


def integer(entry: dict[str, Any], key: str, default: Any = MISSING) -> int:
    """A whole number of at least 0."""
    value = entry.get(key, default)
    if value is MISSING:
        raise Reject("unreadable", f"{key} is missing")
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 53:
        raise Reject("unreadable", f"{key} is {str(value)[:40]!r}, expected a whole number of at least 0")
    return value


def integers(entry: dict[str, Any], key: str) -> list[int]:
    """A list of whole numbers; [] where there is none."""
    values = entry.get(key, [])
    if not isinstance(values, list):
        raise Reject("unreadable", f"{key} is not a list")
    return [integer({key: value}, key) for value in values]


def floats(entry: dict[str, Any], key: str, count: int, default: Any = MISSING) -> np.ndarray:
    """(count,) finite float64."""
    values = entry.get(key, default)
    if values is MISSING:
        raise Reject("unreadable", f"{key} is missing")
    ok = isinstance(values, list | tuple) and len(values) == count
    if not ok or any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        raise Reject("unreadable", f"{key} is {str(values)[:40]!r}, expected {count} numbers")
    if not all(math.isfinite(value) for value in values):
        raise Reject("not_finite", f"{key} has a number that is not finite")
    return np.array(values, np.float64)


def table(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """A table in a table."""
    value = entry.get(key)
    if not isinstance(value, dict):
        raise Reject("unreadable", f"{key} is missing" if value is None else f"{key} is not a table")
    return value


def items(entry: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """A list of tables; [] where there is none."""
    values = entry.get(key, [])
    if not isinstance(values, list):
        raise Reject("unreadable", f"{key} is not a list")
    for index, value in enumerate(values):
        if not isinstance(value, dict):
            raise Reject("unreadable", f"{key} {index}: not a table")
    return values
