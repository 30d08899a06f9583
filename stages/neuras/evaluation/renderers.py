"""A fitted scene, and the two renderers that draw it: torch, the reference, and the baked shader in OpenGL.

Both have ``render(camera)``, which gives (H, W, 3) float32 in [0, 1].
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.neuras.baked import Baked
from pipeline.errors import UserError
from pipeline.store import Artifact
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster, GBuffer
from stages.neuras.baking import drawing
from stages.neuras.baking.residuals import Residuals
from stages.neuras.rasterizing.footprints import footprint
from stages.neuras.records import AtlasMesh, CaptureInfo, load_atlas


class Reference:
    """The scene by torch, slow and exact: ``Baked.render``, and ``Residuals.at`` where there are some. Use as a ``Drawing``."""

    def __init__(self, baked: Baked, atlas: AtlasMesh, residuals: Residuals | None = None):
        self._baked, self._atlas, self._residuals = baked, atlas, residuals
        self.rays = baked.rays
        self.caster = Caster(atlas.vertices, atlas.faces)

    def render(self, camera: Camera) -> np.ndarray:
        return self.pictures(camera)["ours"]

    def pictures(self, camera: Camera) -> dict[str, np.ndarray]:
        """ "ours", and "textures" where there are residuals: the same without them."""
        rays = [self._parts(ray, self.caster.view(ray)) for ray in camera.subpixels(self.rays)]
        return {name: sum((parts[name] for parts in rays), np.float32(0)) / np.float32(self.rays**2) for name in rays[0]}

    def shade(self, camera: Camera, view: GBuffer) -> np.ndarray:
        """One ray a pixel, of a camera whose view of the mesh is known."""
        return self._parts(camera, view)["ours"]

    def _parts(self, camera: Camera, view: GBuffer) -> dict[str, np.ndarray]:
        """`pictures` of one ray a pixel."""
        uv = view.interpolate(self._atlas.faces, self._atlas.uvs).reshape(-1, 2)
        rays = camera.directions().reshape(-1, 3)
        covered = footprint(view, camera, self._atlas)
        looks = uv, covered.spread.reshape(-1, 2), covered.detail.ravel(), view.hit.ravel()
        colours, _ = self._baked.render(*looks, camera.position, rays)
        shape = (camera.height, camera.width, 3)
        if self._residuals is None:
            return {"ours": colours.reshape(shape)}
        eye = camera.position - self._baked.sky_centre
        added = self._residuals.at(eye, camera.forward, rays, view.depth.ravel().astype(float))
        both = np.clip(colours + added, 0, 1).astype(np.float32)
        return {"ours": both.reshape(shape), "textures": colours.reshape(shape)}

    def close(self) -> None:
        pass


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn: the fitted maps and networks, the mesh that they lie on, facts of the capture, residuals of photos, and
    the near and far plane, world units.
    """

    baked: Baked
    atlas: AtlasMesh
    info: CaptureInfo
    planes: tuple[float, float]
    residuals: Residuals | None = None

    @classmethod
    def of(cls, inputs: Mapping[str, Artifact]) -> Scene:
        """Of artifacts by role: capture, atlas, fit, bake."""
        site = inputs["bake"].file("site")
        about = json.loads((site / "scene.json").read_bytes())
        return cls(
            Baked.load(inputs["fit"].path / "files"),
            load_atlas(inputs["atlas"].file("atlas.npz")),
            CaptureInfo.of(inputs["capture"]),
            (about["near"], about["far"]),
            Residuals.load(site),
        )

    def reference(self) -> Reference:
        return Reference(self.baked, self.atlas, self.residuals)

    def drawing(self, texture_format: drawing.TextureFormat = "fp16") -> drawing.Drawing:
        """By OpenGL; UserError where the machine has none."""
        return drawing.Drawing(self.baked, self.atlas, *self.planes, texture_format, self.residuals)


def opengl() -> str | None:
    """What draws by OpenGL here; None where nothing does."""
    try:
        gl = drawing.context()
    except UserError:
        return None
    name = f"{gl.info['GL_RENDERER']}, OpenGL {gl.info['GL_VERSION']}"
    gl.release()
    return name


def as_bytes(picture: np.ndarray) -> np.ndarray:
    """A picture in [0, 1] as uint8: what a file or a screen gets."""
    result: Any = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    return result
