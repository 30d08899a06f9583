"""Keys: what an artifact *is*, as a hash known before anything runs.

key = blake2b-256 of canonical JSON {scheme, system, stage, version, params, inputs: {role: key}}; the legacy system is left
out. Inputs enter by key, not by content. So plans and sweeps know every key up front, and nothing relies on bit-reproducible
GPUs.
"""

from __future__ import annotations

import enum
import hashlib
import json
import math
from typing import Any

from pydantic import BaseModel

LEGACY_SYSTEM = "renderformer"  # of artifacts whose preimage names no system: its keys are older than systems
SCHEME = 1  # bump when the meaning of a key's preimage changes
_encode = json.JSONEncoder(sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode


def blake(data: bytes) -> str:
    """Hex blake2b-256 of ``data``."""
    return hashlib.blake2b(data, digest_size=32).hexdigest()


def canonical(value: Any, where: str = "value") -> Any:
    """``value`` as plain JSON types in one unambiguous form; an unknown type is a TypeError, never a repr.

    Pydantic models lose their runtime fields (see ``pipeline.config.runtime``) and every field that still equals its
    stated legacy default, so that a new option does not invalidate weeks of data.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise TypeError(f"{where} is {value}: only finite numbers can be part of a key")
        return value
    if isinstance(value, (list, tuple)):
        return [canonical(item, f"{where}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, dict):
        if not all(isinstance(key, str) for key in value):
            raise TypeError(f"{where} has a key that is not a string")
        return {key: canonical(item, f"{where}.{key}") for key, item in sorted(value.items())}
    if isinstance(value, BaseModel):
        out = {}
        for name, field in type(value).model_fields.items():
            extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            item = getattr(value, name)
            if extra.get("runtime") or ("legacy" in extra and item == extra["legacy"]):
                continue
            out[name] = canonical(item, f"{where}.{name}")
        return out
    raise TypeError(f"{where} is a {type(value).__name__}, which cannot be part of a key")


def canonical_json(value: Any) -> bytes:
    """Canonical JSON bytes of ``value``: sorted keys, no spaces, UTF-8."""
    return _encode(canonical(value)).encode()


def digest_of(value: Any) -> str:
    """Hex blake2b-256 of the canonical JSON of ``value``."""
    return blake(canonical_json(value))


def digest_of_plain(value: Any) -> str:
    """``digest_of`` for what is canonical already (texts, None and containers of them): there are millions of items."""
    return blake(_encode(value).encode())


def seed_for(seed: int, stage: str, item_id: str) -> int:
    """The 63-bit seed of one item.

    It depends on the configured seed, the stage's name and the item's id, not on the key: more items, another worker
    count or a resume leave old items as they were, and ablations are paired.
    """
    return int.from_bytes(hashlib.blake2b(f"{seed}/{stage}/{item_id}".encode(), digest_size=8).digest(), "big") >> 1
