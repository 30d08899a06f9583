"""Tables of numbers and words in strangers' pandas pickles, without running anything that the pickle asks for.

Every name that such a pickle may use becomes an inert ``_Stub``; any other name is refused. What the stubs hold is then
read as a table: neither pandas nor numpy's own unpickling takes part.
"""

from __future__ import annotations

import gzip
import io
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject

MAX_FILE, MAX_BYTES = 256 << 20, 1 << 30  # as it lies there, and unpacked
BLOCK = 1 << 20  # bytes unpacked at a time

_MODULES = {
    "DataFrame": ("pandas", "pandas.core.frame"),
    "BlockManager": ("pandas.core.internals.managers", "pandas.core.internals"),
    "_unpickle_block": ("pandas._libs.internals",),
    "_new_Index": ("pandas.core.indexes.base",),
    "Index": ("pandas", "pandas.core.indexes.base"),
    "RangeIndex": ("pandas", "pandas.core.indexes.range"),
    "Int64Index": ("pandas", "pandas.core.indexes.numeric"),
    "_reconstruct": ("numpy.core.multiarray", "numpy._core.multiarray"),
    "_frombuffer": ("numpy.core.numeric", "numpy._core.numeric"),
    "ndarray": ("numpy",),
    "dtype": ("numpy",),
    "slice": ("builtins", "__builtin__"),
    "encode": ("_codecs",),
}
KNOWN = {(module, name) for name, modules in _MODULES.items() for module in modules}


class _Stub:
    """What a pickle would have made: its name, what it was called with, and the state that it was given."""

    name = ""

    def __new__(cls, *args: Any) -> _Stub:
        stub = object.__new__(cls)
        stub.args, stub.state = args, None
        return stub

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in KNOWN:
            raise Reject("unreadable", f"the pickle asks for {module}.{name}: only plain tables are read")
        return type(name, (_Stub,), {"name": name})


def table(path: Path) -> dict[str, np.ndarray]:
    """The columns, by name, of a pickled data frame (``.pkl`` or ``.pkl.gz``); raises Reject.

    Columns of words are arrays of objects: strings, and None for anything else.
    """
    if path.stat().st_size > MAX_FILE:
        raise Reject("too_large", f"{path.name} has {path.stat().st_size} bytes, at most {MAX_FILE} are read")
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            data = bytearray()
            while block := file.read(BLOCK):
                data += block
                if len(data) > MAX_BYTES:
                    raise Reject("too_large", f"{path.name} unpacks to over {MAX_BYTES} bytes")
        _check_claims(data)
        return _columns(_Unpickler(io.BytesIO(data)).load())
    except Reject:
        raise
    except MemoryError:
        raise
    except Exception as error:  # a stranger's pickle fails in every way
        raise Reject("unreadable", f"{path.name}: {type(error).__name__}: {str(error)[:150]}") from None


def _check_claims(data: bytearray) -> None:
    """Raises ValueError where a length or a number of the memo is more than the bytes can hold: loading would reserve it."""
    for code, value, _ in pickletools.genops(data):  # itself takes what is there, never what is claimed
        if "PUT" in code.name and value > len(data):
            raise ValueError(f"it numbers {value} values in {len(data)} bytes")


def _columns(frame: Any) -> dict[str, np.ndarray]:
    if getattr(frame, "name", "") != "DataFrame":
        raise ValueError("not a data frame")
    manager = frame.state.get("_mgr") or frame.state["_data"]
    if manager.args:  # since pandas 1.3
        blocks, axes = manager.args
        parts = [(block.args[0], block.args[1]) for block in blocks]
    else:
        told = manager.state[3]["0.14.1"]
        axes, parts = told["axes"], [(block["values"], block["mgr_locs"]) for block in told["blocks"]]
    names = _index(axes[0])
    columns = {}
    for values, places in parts:
        if not (_is_numbers(values) or _is_objects(values)):
            continue
        rows, numbers = _array(values) if _is_numbers(values) else _words(values), _places(places)
        if rows.ndim != 2 or len(rows) != len(numbers):
            raise ValueError(f"a block of shape {rows.shape} for {len(numbers)} columns")
        columns |= {str(names[number]): row for number, row in zip(numbers, rows, strict=True)}
    return columns


def _index(stub: _Stub) -> list[Any]:
    """The labels of an axis that holds them as objects."""
    data = stub.args[1]["data"]
    return list(data.state[-1])


def _places(places: Any) -> list[int]:
    if isinstance(places, _Stub) and places.name == "slice":
        start, stop, step = places.args
        found = range(start, stop, step)
        if len(found) > 10_000:
            raise ValueError(f"{len(found)} columns")
        return list(found)
    return _array(places).tolist()


def _is_numbers(stub: Any) -> bool:
    return isinstance(stub, _Stub) and (
        stub.name == "_frombuffer" or (stub.name == "_reconstruct" and isinstance(stub.state[-1], (bytes, bytearray, _Stub)))
    )


def _is_objects(stub: Any) -> bool:
    return isinstance(stub, _Stub) and stub.name == "_reconstruct" and isinstance(stub.state[-1], list)


def _words(stub: _Stub) -> np.ndarray:
    """Of an array of objects, the strings."""
    shape, _, fortran, values = stub.state[-4:]
    words = np.empty(len(values), object)
    words[:] = [value if isinstance(value, str) else None for value in values]
    return words.reshape(shape, order="F" if fortran else "C")


def _array(stub: _Stub) -> np.ndarray:
    if stub.name == "_frombuffer":
        data, kind, shape, order, *_ = stub.args
        if order not in ("C", "F"):
            raise ValueError(f"an array in the order {order!r}")
    else:
        shape, kind, fortran, data = stub.state[-4:]
        order = "F" if fortran else "C"
    if isinstance(data, _Stub):  # bytes as protocols before 3 write them
        data = data.args[0].encode("latin1")
    return np.frombuffer(data, _dtype(kind)).reshape(shape, order=order)


def _dtype(stub: _Stub) -> np.dtype:
    kind, sign = stub.args[0], stub.state[1]
    if not re.fullmatch(r"[biuf][1248]", kind) or sign not in ("<", ">", "|", "="):
        raise ValueError(f"an array of {kind!r}")
    return np.dtype(("<" if sign == "=" else sign) + kind)
