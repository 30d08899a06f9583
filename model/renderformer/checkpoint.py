"""Checkpoint folders: ``config.json`` and ``model.safetensors``, read and written strictly; RenderFormer's are released ones.

What a model was trained with travels in the safetensors header's metadata, which other readers ignore.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from model.errors import InputError
from model.file_kinds import wrong_kind
from model.renderformer.architectures import build, load_config
from model.renderformer.base import Network
from pipeline.atomic import atomic_path, write_atomic

CONFIG, WEIGHTS = "config.json", "model.safetensors"
NAMED = 3  # names in an error


def save(config: Any, weights: Mapping[str, Tensor], folder: Path, trained_with: Mapping[str, str] | None = None) -> None:
    """Write the folder from a network's config and state dict; each file appears whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    metadata = {"format": "pt", **(trained_with or {})}
    with atomic_path(folder / WEIGHTS) as temporary:
        save_file(state, temporary, metadata)
        _sort_metadata(temporary)
    write_atomic(folder / CONFIG, config.dumps().encode())


def _sort_metadata(path: Path) -> None:
    """Put the header's metadata in sorted order: safetensors writes it in a random one, so equal models would differ."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        data = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(size)
        if len(data) != size:
            raise AssertionError(f"header of {path} changed its length")
        file.seek(8)
        file.write(data)


def _expected_shapes(config: Any, tensors: int, path: Path) -> dict[str, tuple[int, ...]]:
    """Of the network which the config asks for, by name, with no byte of it allocated; a file has so many tensors."""
    if config.depth > tensors:
        raise InputError(f"{path} holds {tensors} tensors, {CONFIG} asks for {config.depth} layers")
    with torch.device("meta"):
        return {name: tuple(tensor.shape) for name, tensor in build(config).state_dict().items()}


def _check_shapes(expected: Mapping[str, tuple[int, ...]], stored: Mapping[str, tuple[int, ...]], path: Path) -> None:
    """That the file holds the network which the config asks for, before a byte of it is read."""
    unknown, missing = stored.keys() - expected.keys(), expected.keys() - stored.keys()
    differing = [f"{kind} parameter {_some(names)}" for kind, names in (("missing", missing), ("unknown", unknown)) if names]
    if differing:
        raise InputError(f"{path} is not of the network that {CONFIG} describes: {'; '.join(differing)}")
    wrong = [
        f"{name} has shape {shape}, not {expected[name]}" for name, shape in sorted(stored.items()) if shape != expected[name]
    ]
    if wrong:
        raise InputError(f"{path}: {CONFIG} asks for other shapes: {_some(wrong)}")


def _check_values(state: Mapping[str, Tensor], path: Path) -> None:
    """That all are numbers of floating point."""
    whole = [
        f"{name} of {str(tensor.dtype).removeprefix('torch.')}"
        for name, tensor in state.items()
        if not tensor.is_floating_point()
    ]
    if whole:
        raise InputError(f"{path} holds other numbers than weights are: {_some(whole)}; convert them to float32")


def _damage(path: Path, error: SafetensorError) -> str:
    """What is wrong with a file that has no known kind."""
    size = path.stat().st_size
    if "not fully covered" in str(error):
        return f"is not a safetensors file as it was: it is cut off or has bytes too many ({size:,}), fetch it again"
    return f"is not a safetensors file, or a damaged one ({size:,} bytes): fetch it again"


def _some(names: Collection[str]) -> str:
    """Three of the names, and how many more there are."""
    first = ", ".join(sorted(names)[:NAMED])
    return first if len(names) <= NAMED else f"{first} and {len(names) - NAMED:,} more"


def _wrapper_prefix(names: Collection[str], own: Collection[str]) -> str:
    """What a wrapper put before every name of a state dict, such as ``_orig_mod.module.``; "" for nothing.

    own: the network's names, which may have a first part in common, too: without tokens all of a guided one's are its head's.
    """
    return _common_parts(names).removesuffix(_common_parts(own))


def _common_parts(names: Collection[str]) -> str:
    """The parts with which all names begin, up to a dot."""
    common = os.path.commonprefix(list(names)) if len(names) > 1 else ""
    return common[: common.rfind(".") + 1]


def _say(note: str) -> None:
    print(f"note: {note}", file=sys.stderr)


def load(folder: Path, say: Callable[[str], None] = _say) -> tuple[Network, dict[str, str]]:
    """The model, on the CPU in float32 and in eval mode, and what it says it was trained with (may be empty).

    Names may begin as DataParallel, torch.compile or another wrapper leaves them: that is taken off, and said. InputError:
    the folder holds anything but the network that its config describes.
    """
    folder = Path(folder)
    config = load_config(folder / CONFIG)
    path = folder / WEIGHTS
    if not path.is_file():
        raise InputError(f"{path} is missing: a checkpoint folder holds {CONFIG} and {WEIGHTS}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            names = sorted(file.keys())
            expected = _expected_shapes(config, len(names), path)
            prefix = _wrapper_prefix(names, expected)
            stored = {name.removeprefix(prefix): tuple(file.get_slice(name).get_shape()) for name in names}
            _check_shapes(expected, stored, path)
            state = {name.removeprefix(prefix): file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise InputError(f"{path} {wrong_kind(path) or _damage(path, error)}") from None
    _check_values(state, path)
    if prefix:
        say(f"{path}: all names begin with {prefix!r}, as a wrapper around the network left them; it is taken off")
    model = build(config)
    model.load_state_dict(state)
    return model.eval(), {name: value for name, value in metadata.items() if name != "format"}
