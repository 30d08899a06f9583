"""The architectures, by the ``config.json`` of checkpoints: one that names none is RenderFormer's released format."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model.errors import InputError
from model.file_kinds import wrong_kind
from model.renderformer.base import Network
from model.renderformer.config import ModelConfig
from model.renderformer.flops import forward_flops
from model.renderformer.guided.config import ARCHITECTURE, GuidedConfig
from model.renderformer.guided.flops import forward_flops as guided_flops
from model.renderformer.guided.network import GuidedNetwork
from model.renderformer.network import RenderFormer


@dataclass(frozen=True)
class Architecture:
    """config: of its networks. network: built from one. flops: of a forward pass by part, from (config, triangles of each
    scene, views, height, width)."""

    config: type
    network: Callable[[Any], Network]
    flops: Callable[..., dict[str, float]]


ARCHITECTURES: Mapping[str, Architecture] = {
    "renderformer": Architecture(ModelConfig, RenderFormer, forward_flops),
    ARCHITECTURE: Architecture(GuidedConfig, GuidedNetwork, guided_flops),
}


def architecture_of(config: Any) -> Architecture:
    """Of a network's config."""
    return next(architecture for architecture in ARCHITECTURES.values() if isinstance(config, architecture.config))


def build(config: Any) -> Network:
    """The network of that config, with random weights."""
    return architecture_of(config).network(config)


def load_config(path: Path) -> Any:
    """The config in a ``config.json``."""
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))  # some editors begin a file with a byte order mark
    except FileNotFoundError:
        raise InputError(f"{path} is missing: a checkpoint folder holds config.json and model.safetensors") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} {wrong_kind(path) or 'is not JSON: it is no text in UTF-8'}") from None
    except ValueError as error:
        raise InputError(f"{path} {wrong_kind(path) or f'is not JSON: {error}'}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold one JSON object")
    name = data.get("architecture", "renderformer")
    if "architecture" in data and name != ARCHITECTURE:
        raise InputError(
            f"{path}: architecture {name!r} is unknown: {ARCHITECTURE}, or none for RenderFormer's released format"
        )
    return ARCHITECTURES[name].config.from_dict(data, str(path))
