"""The shape of a guided network; `config.json` of its checkpoints. Free of torch."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, Literal

from model.errors import InputError
from model.renderformer.config import check_types

ARCHITECTURE = "guided"
# Channels that networks of any config have
TOKEN_FEATURES = 82  # what is known of a triangle, besides bounces
PIXEL_FEATURES = 88  # of a pixel, besides bounces
LIGHT_FEATURES = 13  # of a light in a pixel
PIXEL_DIM = 32  # of a pixel in its bundle
LIGHT_DIM = 32  # of a pixel's light, and of a corner's token


@dataclass(frozen=True)
class GuideConfig:
    """Which guides the network reads besides the hits of its camera rays: rungs from no prior to all."""

    light: bool = True  # the lights' own contribution in closed form; False: the network makes up all light
    mirror: bool = True  # what the mirror reflection hits, lit in closed form
    lobe: bool = True  # what reflections drawn from the surface's lobe hit, in the mirror's place in the image
    visibility: bool = True  # which lights four points of each triangle see
    shadow_rays: bool = True  # which lights each pixel's hits see
    bounces: bool = True  # what rays from both sides of every triangle hit: how triangles light one another, by radiosity

    def __post_init__(self) -> None:
        needs_light = [name for name in ("mirror", "lobe", "visibility", "shadow_rays", "bounces") if getattr(self, name)]
        if needs_light and not self.light:
            raise InputError(
                f"model.guide.{needs_light[0]}=true needs model.guide.light=true: it tells where closed forms hold"
            )


@dataclass(frozen=True)
class GuidedConfig:
    """Widths and depths, in channels and layers."""

    guide: GuideConfig = field(default_factory=GuideConfig)
    tokens: Literal["none", "lookup", "encoder"] = "encoder"  # none: pixels alone; lookup: no attention; encoder: all
    token_dim: int = 96
    token_layers: int = 2
    token_heads: int = 4
    bundle: int = 8  # pixels along the side of a ray bundle, which gathers from the tokens at once
    head_dim: int = 128
    head_layers: int = 3

    def __post_init__(self) -> None:
        for name in ("token_dim", "token_layers", "token_heads", "bundle", "head_dim", "head_layers"):
            if getattr(self, name) < 1:
                raise InputError(f"model.{name}={getattr(self, name)} must be at least 1")
        if self.tokens not in ("none", "lookup", "encoder"):
            raise InputError(f"model.tokens={self.tokens!r} is not supported: none, lookup or encoder")
        if self.token_dim % (6 * self.token_heads):
            raise InputError(
                f"model.token_dim={self.token_dim} must be a multiple of 6 model.token_heads={6 * self.token_heads}: heads "
                "turn by three coordinates, two channels an angle"
            )

    @property
    def token_features(self) -> int:
        """Channels of what is known of a triangle."""
        return TOKEN_FEATURES + 6 * self.guide.bounces

    @property
    def pixel_features(self) -> int:
        """Channels of what is known of a pixel."""
        return PIXEL_FEATURES + 3 * self.guide.bounces

    @property
    def depth(self) -> int:
        """Layers of tokens and head."""
        return self.head_layers + (self.token_layers if self.tokens == "encoder" else 0)

    @property
    def facts(self) -> dict[str, Any]:
        """What probes say of the network."""
        return {"network": self.description}

    @property
    def description(self) -> str:
        """The network's size and guides in words."""
        guides = [name.replace("_", " ") for name, on in dataclasses.asdict(self.guide).items() if on]
        tokens = {"none": "no tokens", "lookup": f"tokens of {self.token_dim}"}.get(
            self.tokens, f"{self.token_layers} layers of {self.token_dim} on tokens"
        )
        return f"guided by {', '.join(['hits', *guides])}; {tokens}, {self.head_layers} of {self.head_dim} on pixels"

    @property
    def bundle_side(self) -> int:
        """Pixels along the side of a ray bundle."""
        return self.bundle

    @property
    def registers(self) -> int:
        """Tokens besides those of triangles and rays."""
        return 0

    @property
    def resolution_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return self.bundle

    @classmethod
    def from_dict(cls, data: dict[str, Any], where: str = "config") -> GuidedConfig:
        """From a ``config.json``; every field must be there, and no other.

        But ``guide.bounces``, which came later: networks that do not know it do without.
        """
        data = {name: value for name, value in data.items() if name != "architecture"}
        guide = data.get("guide")
        guide = {"bounces": False, **guide} if isinstance(guide, dict) else guide
        for kind, given, prefix in ((cls, data, ""), (GuideConfig, guide, "guide.")):
            names = {entry.name for entry in dataclasses.fields(kind)}
            if not isinstance(given, dict):
                raise InputError(f"{where}: guide must be an object with {', '.join(sorted(names))}")
            for problem, differing in (("unknown", set(given) - names), ("missing", names - set(given))):
                if differing:
                    raise InputError(f"{where}: {problem} field {', '.join(prefix + name for name in sorted(differing))}")
            check_types(kind, given, where)
        try:
            return cls(**{**data, "guide": GuideConfig(**guide)})
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        return {"architecture": ARCHITECTURE, **dataclasses.asdict(self)}

    def dumps(self) -> str:
        return json.dumps(self.to_dict(), indent=2, sort_keys=True) + "\n"
