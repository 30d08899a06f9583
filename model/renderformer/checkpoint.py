"""Checkpoint folders: ``config.json`` and ``model.safetensors``, read and written strictly; RenderFormer's are released ones.

What a model was trained with travels in the safetensors header's metadata, which other readers ignore.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from model.errors import InputError
from model.renderformer.architectures import build, load_config
from model.renderformer.base import Network
from pipeline.atomic import atomic_path, write_atomic

CONFIG, WEIGHTS = "config.json", "model.safetensors"


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


def _check_shapes(config: Any, stored: Mapping[str, tuple[int, ...]], path: Path) -> None:
    """That the file holds the network which the config asks for, before a byte of either is allocated."""
    if config.depth > len(stored):
        raise InputError(f"{path} holds {len(stored)} tensors, {CONFIG} asks for {config.depth} layers")
    with torch.device("meta"):
        expected = {name: tuple(tensor.shape) for name, tensor in build(config).state_dict().items()}
    for kind, differing in (("unknown", stored.keys() - expected.keys()), ("missing", expected.keys() - stored.keys())):
        if differing:
            raise InputError(f"{path}: {kind} parameter {', '.join(sorted(differing))} for the network of {CONFIG}")
    for name, shape in stored.items():
        if shape != expected[name]:
            raise InputError(f"{path}: {name} has shape {shape}, {CONFIG} asks for {expected[name]}")


def load(folder: Path) -> tuple[Network, dict[str, str]]:
    """The model, on the CPU in float32 and in eval mode, and what it says it was trained with (may be empty)."""
    folder = Path(folder)
    config = load_config(folder / CONFIG)
    path = folder / WEIGHTS
    if not path.is_file():
        raise InputError(f"{path} is missing: a checkpoint folder holds {CONFIG} and {WEIGHTS}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            _check_shapes(config, {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}, path)  # noqa: SIM118
            state = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except SafetensorError as error:
        raise InputError(f"{path} is not a safetensors file: {error}") from None
    model = build(config)
    model.load_state_dict(state)
    return model.eval(), {name: value for name, value in metadata.items() if name != "format"}
