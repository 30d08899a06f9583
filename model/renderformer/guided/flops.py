"""Floating-point operations of a guided network, as ``model.renderformer.flops`` counts them."""

from __future__ import annotations

from collections.abc import Sequence

from model.renderformer.guided.config import (
    LIGHT_DIM,
    LIGHT_FEATURES,
    PIXEL_DIM,
    GuidedConfig,
)

LIGHTS = 4.5  # of a scene, where nobody says: the mean of the training data


def forward_flops(
    config: GuidedConfig, triangles: Sequence[int], views: int, height: int, width: int, textured: int = 0,
    lights: float = LIGHTS,
) -> dict[str, float]:  # fmt: skip
    """FLOPs of a forward pass by part, for scenes of so many triangles, each seen by ``views`` cameras."""
    dim, head, hidden = config.token_dim, config.head_dim, 4 * config.token_dim
    pixels = len(triangles) * views * height * width
    bundles, tokens = pixels / config.bundle**2, sum(triangles)
    inputs = config.pixel_features
    parts = {}
    if config.tokens != "none":
        parts["embedding"] = tokens * (2 * dim * (config.token_features + dim) + 3 * LIGHT_DIM * dim)
        inputs += 2 * dim + LIGHT_DIM
    if config.tokens == "encoder":
        inputs += dim
        parts["encoder layers"] = config.token_layers * tokens * (4 * dim**2 + 3 * dim * hidden)
        parts["encoder attention"] = config.token_layers * 2 * dim * sum(n * n for n in triangles)
        parts["rays"] = pixels * config.pixel_features * PIXEL_DIM + bundles * PIXEL_DIM * config.bundle**2 * dim
        parts["decoder layers"] = bundles * (2 * dim**2 + 3 * dim * hidden) + tokens * 2 * dim**2
        parts["cross-attention"] = 2 * dim * bundles / max(1, len(triangles)) * tokens
    parts["head"] = pixels * (inputs * head + config.head_layers * 6 * head**2 + head * (7 + LIGHT_DIM))
    parts["lights"] = pixels * lights * LIGHT_DIM * (LIGHT_FEATURES + LIGHT_DIM + 2)
    return {name: 2.0 * count for name, count in parts.items()}
