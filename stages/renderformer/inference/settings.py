"""What people choose about a prediction, beside the scene and the checkpoint."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import UserError
from stages.renderformer.inference.orbit import orbit
from stages.renderformer.records import SceneRecord


@dataclass(frozen=True)
class PredictSettings:
    """One object for ``lightmill predict`` and ``lightmill compare``.

    view: number of the scene's camera, from 0, or ``all``.
    frames: an orbit of so many images, which starts at camera ``view`` (``stages.renderformer.inference.orbit``). None: the
        view itself. arc_deg: how far the orbit goes. None: all around, or as far as walls allow.
    resolution: pixels of the longer side, or (height, width). None: what the network was trained with.
    composite_lights: one pass per light, summed (``Renderer.frames``).
    """

    view: int | str = 0
    frames: int | None = None
    arc_deg: float | None = None
    resolution: int | tuple[int, int] | None = None
    composite_lights: bool = False

    def __post_init__(self) -> None:
        if self.view == "all" and self.frames is not None:
            raise UserError("an orbit starts at one camera: give --view N instead of --view all")

    @property
    def one_image(self) -> bool:
        return self.view != "all" and self.frames is None

    def apply(self, scene: SceneRecord) -> tuple[SceneRecord, list[int]]:
        """The scene, with the orbit's cameras if there is one, and the numbers of its cameras to render."""
        count = len(scene.fov_deg)
        if self.view != "all" and not (isinstance(self.view, int) and 0 <= self.view < count):
            raise UserError(f"view {self.view} of {scene.id} does not exist: it has cameras 0 to {count - 1}, or say all")
        if self.frames is not None:
            scene = orbit(scene, self.frames, self.view, self.arc_deg)
        return scene, [self.view] if self.one_image else list(range(len(scene.fov_deg)))
