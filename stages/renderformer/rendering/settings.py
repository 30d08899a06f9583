"""What decides the pixels of a path-traced view, beside the scene and the backend."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import UserError

MODES = ("physical", "cycles")


@dataclass(frozen=True)
class RenderSettings:
    """One object for the render stage, the probes, ``lightmill trace`` and ``lightmill compare``.

    resolution: pixels per side, or (height, width). seed: of all random numbers.
    max_spp: camera paths per pixel for the image with all lights on, at most. The JIT integrator shares each path among all
        lights; the scalar one gives each light its share of the paths.
    target_error: bound on the estimated error of a view (``stages.renderformer.rendering.error``). A view gets 16 samples, then
        32, 48, 64, 96, 128, 192 .. until it is met or out of reach. Light paths bring caustics
        (``stages.renderformer.rendering.caustics``); in scenes without narrow surfaces, paths are guided by what the first
        found (``stages.renderformer.rendering.guiding``). 0: ``max_spp`` at once, no guiding and no estimate.
    mode: ``physical`` or ``cycles`` (``stages.renderformer.rendering.render``).
    max_depth: longest path in segments; 2 is direct light only.
    denoise: Open Image Denoise, every light on its own.
    adaptive: samples behind the first go where they pay (``stages.renderformer.rendering.adaptive``), no longer to all pixels
        alike; where there are light paths, first directions are guided (``stages.renderformer.rendering.primary``). The scalar
        backend knows no such thing.
    lights_visible: whether camera rays see lights; reflections always do.
    """

    resolution: int | tuple[int, int]
    max_spp: int
    seed: int = 0
    target_error: float = 0.0
    mode: str = "physical"
    max_depth: int = 34
    denoise: bool = True
    lights_visible: bool = False
    adaptive: bool = False

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UserError(f"mode={self.mode!r} is unknown: choose from {', '.join(MODES)}")
        for name, value, least in (("resolution", min(self.size), 1), ("max_spp", self.max_spp, 1), ("seed", self.seed, 0)):
            if value < least:
                raise UserError(f"{name}={value}: expected at least {least}")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the picture in pixels; a camera's field of view is across the height."""
        return (self.resolution, self.resolution) if isinstance(self.resolution, int) else self.resolution
