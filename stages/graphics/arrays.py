"""Arrays and JSON as bytes, the same bytes every time: the encoding of every record's members."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np


def pack_arrays(arrays: dict[str, np.ndarray], compressed: bool = False) -> bytes:
    """An ``.npz`` of the arrays in sorted order (no clock in it: numpy dates members 1980)."""
    buffer = io.BytesIO()
    save = np.savez_compressed if compressed else np.savez
    save(buffer, allow_pickle=False, **{name: np.ascontiguousarray(arrays[name]) for name in sorted(arrays)})
    return buffer.getvalue()


def unpack_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz``; pickled objects and sizes that no memory holds are refused (ValueError)."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except MemoryError as error:
        raise ValueError(f"arrays of an absurd size: {error}") from None


def pack_json(value: Any) -> bytes:
    """Sorted, indented JSON; NaN is refused."""
    return (json.dumps(value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()


def unpack_json(data: bytes) -> Any:
    return json.loads(data)
