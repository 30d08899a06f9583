"""The setting ``lpips``: by which networks LPIPS is measured, beside the other metrics.

``none``, a network, or both as a list; on a command line ``vgg,alex``. One network is kept as a word, which is what it was
before there could be two: keys stay.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

NETWORKS = ("vgg", "alex")
NONE = "none"


def parse_lpips(value: object) -> str | tuple[str, ...]:
    """``none``, a network, or a tuple of both in the order of `NETWORKS`, from such a word, words with commas, or a list."""
    words = value.split(",") if isinstance(value, str) else list(value) if isinstance(value, (list, tuple)) else [value]
    unknown = [word for word in words if word not in NETWORKS]
    if words == [NONE]:
        return NONE
    if unknown or not words:
        raise ValueError(f"choose {', '.join(NETWORKS)}, both as {','.join(NETWORKS)}, or {NONE}")
    chosen = tuple(network for network in NETWORKS if network in words)
    return chosen if len(chosen) > 1 else chosen[0]


def lpips_networks(setting: str | tuple[str, ...]) -> tuple[str, ...]:
    """The networks that a parsed setting names."""
    return () if setting == NONE else (setting,) if isinstance(setting, str) else setting


LpipsSetting = Annotated[str | tuple[str, ...], BeforeValidator(parse_lpips)]
