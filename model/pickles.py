"""Arrays and tensors out of pickles, without running what a pickle can name: other classes are refused or left empty.

Reads pickles of plain numpy arrays, and the tensors of a TorchScript archive, whose program is never looked at.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from typing import Any

import numpy as np

STORAGES = {"FloatStorage": np.float32, "DoubleStorage": np.float64, "HalfStorage": np.float16, "LongStorage": np.int64}
MAX_NUMBERS = 1 << 28  # of an array


class _Arrays(pickle.Unpickler):
    """Knows numpy arrays and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            from numpy._core.multiarray import _reconstruct

            return _reconstruct
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise ValueError(f"it names {module}.{name}, which is no array")


def arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of numbers in a pickle of nested tables, by their path, such as ``VGG16_0/Conv_3/kernel``. ValueError else."""
    found: dict[str, np.ndarray] = {}

    def walk(value: Any, path: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{path}/{key}" if path else str(key))
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            found[path] = value
        else:
            raise ValueError(f"{path} is no array of numbers")

    try:
        walk(_Arrays(io.BytesIO(data)).load(), "")
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"it is no pickle of arrays ({error})") from None
    return found


class _Module:
    """What stands for any class of a TorchScript program: it keeps the state that it is given, and does nothing."""

    def __init__(self, *given: Any):
        self.state: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Tensors(pickle.Unpickler):
    """Knows tensors of a TorchScript archive. Its own classes become `_Module`."""

    def __init__(self, archive: zipfile.ZipFile, root: str):
        super().__init__(io.BytesIO(archive.read(f"{root}/data.pkl")))
        self.archive, self.root = archive, root

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "__torch__":
            return _Module
        known = {
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("collections", "OrderedDict"): dict,
            ("torch.jit._pickle", "build_intlist"): list,
        }
        if (module, name) in known:
            return known[module, name]
        if module == "torch" and name in STORAGES:
            return STORAGES[name]
        raise ValueError(f"it names {module}.{name}, which is no tensor")

    def persistent_load(self, identity: Any) -> np.ndarray:
        _, dtype, key, *_ = identity
        if not str(key).isdigit():
            raise ValueError("a storage without a number")
        return np.frombuffer(self.archive.read(f"{self.root}/data/{key}"), dtype)


def _tensor(storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *rest: Any) -> np.ndarray:
    """The array that a tensor's description means; ValueError where it would leave its storage."""
    last = offset + sum((side - 1) * step for side, step in zip(size, stride, strict=True))
    if min((offset, *size, *stride)) < 0 or last >= len(storage) or np.prod(size, dtype=object) > MAX_NUMBERS:
        raise ValueError("a tensor beyond its storage")
    strides = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[offset:], size, strides, writeable=False)


def torchscript_tensors(data: bytes) -> dict[str, np.ndarray]:
    """The tensors of a TorchScript archive by their path, such as ``model.layer.weight``, in order. ValueError else."""
    found: dict[str, np.ndarray] = {}

    def walk(value: Any, path: str) -> None:
        if isinstance(value, _Module):
            value = value.state
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{path}.{key}" if path else str(key))
        elif isinstance(value, np.ndarray):
            found[path] = value

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            root = next(name.removesuffix("/data.pkl") for name in archive.namelist() if name.endswith("/data.pkl"))
            walk(_Tensors(archive, root).load(), "")
    except (zipfile.BadZipFile, pickle.UnpicklingError, StopIteration, EOFError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"it is no TorchScript archive ({error})") from None
    return found
