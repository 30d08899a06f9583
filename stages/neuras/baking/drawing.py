"""A baked scene drawn by OpenGL without a window (moderngl over EGL; software drivers do)."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Literal

import numpy as np

from model.neuras.baked import Baked
from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.neuras.baking.residuals import Residuals
from stages.neuras.baking.shaders import MODES, Ranges, mesh_shaders, resolve_shaders, sky_shaders, textures
from stages.neuras.records import AtlasMesh

TextureFormat = Literal["fp16", "rgba8"]
INSTALL = "install EGL and a driver, such as the packages libegl1 and libgl1-mesa-dri"


def context() -> Any:
    """An OpenGL 3.3 context without a window; UserError where the machine has none."""
    try:
        import moderngl

        return moderngl.create_standalone_context(backend="egl", require=330)
    except Exception as error:  # moderngl raises bare Exceptions
        raise UserError(f"OpenGL does not start here ({error}): {INSTALL}") from None


def projection(camera: Camera, near: float, far: float) -> np.ndarray:
    """(4, 4) from the camera's frame to clip space."""
    x, y, z, w = lens(camera)
    depth = (far + near) / (near - far), 2 * far * near / (near - far)
    return np.array([[x, 0, -z, 0], [0, y, -w, 0], [0, 0, *depth], [0, 0, -1, 0]])


def depth_range(vertices: np.ndarray, metre: float, eyes: Sequence[np.ndarray]) -> tuple[float, float]:
    """Near and far plane in world units: a tenth of a metre, and beyond the mesh, from anywhere within it and from half as far
    again as the ``eyes`` (3,).
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    away = max((float(np.linalg.norm(np.maximum(eye - low, high - eye))) for eye in eyes), default=0.0)
    return 0.1 * metre, max(float(2 * np.linalg.norm(high - low) + metre), 1.5 * away + metre)


def lens(camera: Camera) -> tuple[float, float, float, float]:
    """Focal lengths and principal point in halves of the image, y up: ndc = lens[:2] * (x, y) / -z + lens[2:]."""
    return (
        2 * camera.fx / camera.width,
        2 * camera.fy / camera.height,
        2 * camera.cx / camera.width - 1,
        1 - 2 * camera.cy / camera.height,
    )


class Drawing:
    """A scene on the GPU. Use as a context manager, or ``close`` it.

    texture_format: "fp16" holds features as half floats, "rgba8" as bytes with a range per channel. ``near`` and ``far``: of
    the depth buffer, world units. residuals: those that are added.
    """

    def __init__(
        self,
        baked: Baked,
        atlas: AtlasMesh,
        near: float,
        far: float,
        texture_format: TextureFormat = "fp16",
        residuals: Residuals | None = None,
    ):
        self._gl = context()
        self._near, self._far = near, far
        self._centre = np.asarray(baked.sky_centre, float)
        self._skyboxes, self._rays = baked.sky_size[0], baked.rays
        mesh, sky = baked.mesh_texture(), baked.sky_textures()
        largest = self._gl.info["GL_MAX_TEXTURE_SIZE"]
        if max(mesh.shape[:2]) > largest:
            raise UserError(f"the texture is {mesh.shape[1]} x {mesh.shape[0]}, OpenGL here takes {largest}: lower atlas.size")
        exact = texture_format == "fp16"
        mesh_ranges, sky_ranges = (None, None) if exact else (Ranges.of(mesh), Ranges.of(sky))
        self._mesh = self._gl.program(*mesh_shaders(baked, "desktop", mesh_ranges, photos=residuals))
        self._sky = self._gl.program(*sky_shaders(baked, "desktop", sky_ranges, residuals))
        self._resolve = self._gl.program(*resolve_shaders(baked, "desktop"))
        self._textures = [
            *self._upload(self._mesh, "mesh", mesh[None], mesh_ranges, array=False),
            *self._upload(self._sky, "sky", sky.reshape(-1, *sky.shape[2:]), sky_ranges, array=True),
        ]
        if "codes" in self._mesh:
            codes = baked.mesh_indices if baked.quantized else np.zeros((1, 1), np.uint16)
            texture = self._gl.texture(codes.shape[::-1], 1, np.ascontiguousarray(codes).tobytes(), alignment=1, dtype="u2")
            texture.filter = (self._gl.NEAREST, self._gl.NEAREST)
            self._textures.append((self._mesh, "codes", texture))
        self._photos = None if residuals is None else _Photos(self._gl, residuals)
        vertices = np.concatenate([atlas.vertices - self._centre, atlas.uvs, atlas.vertex_charts()[:, None]], axis=1).astype(
            np.float32
        )
        parts = (self._gl.buffer(vertices.tobytes()), "3f 2f 1f", "position", "uv", "chart")
        kept = [name for name in parts[2:] if name in self._mesh]
        layout = " ".join(
            code if name in kept else f"{int(code[0]) * 4}x" for code, name in zip(parts[1].split(), parts[2:], strict=True)
        )
        indices = self._gl.buffer(np.ascontiguousarray(atlas.faces, np.int32).tobytes())
        self._triangles = self._gl.vertex_array(self._mesh, [(parts[0], layout, *kept)], indices)
        self._screen = self._gl.vertex_array(self._sky, [])
        self._mean = self._gl.vertex_array(self._resolve, [])
        self._target: Any = None  # the picture, and where its rays are drawn
        self._fine: Any = None

    def _upload(
        self, program: Any, name: str, maps: np.ndarray, ranges: Ranges | None, array: bool
    ) -> list[tuple[Any, str, Any]]:
        """Textures of (N, H, W, D) features, four channels each."""
        count, height, width, channels = maps.shape
        made = []
        for index in range(textures(channels)):
            if ranges is None:
                part = np.zeros((count, height, width, 4), np.float16)
                values = maps[..., 4 * index : 4 * index + 4]
                part[..., : values.shape[-1]] = values
            else:
                part = ranges.part(4 * index).quantized(maps[..., 4 * index : 4 * index + 4])
            data, kind = np.ascontiguousarray(part).tobytes(), "f2" if ranges is None else "f1"
            texture = (
                self._gl.texture_array((width, height, count), 4, data, alignment=1, dtype=kind)
                if array
                else self._gl.texture((width, height), 4, data, alignment=1, dtype=kind)
            )
            texture.filter = (self._gl.LINEAR, self._gl.LINEAR)
            texture.repeat_x = texture.repeat_y = False
            made.append((program, f"{name}{index}", texture))
        return made

    def render(self, camera: Camera, mode: str = "full", skybox: int = -1) -> np.ndarray:
        """(H, W, 3) float32 in [0, 1]. ``mode``: one of ``shaders.MODES``; ``skybox``: show this one alone."""
        self.draw(camera, mode, skybox)
        with self._gl:
            data = np.frombuffer(self._target.read(components=4, dtype="f4"), np.float32)
        return data.reshape(camera.height, camera.width, 4)[::-1, :, :3].copy()

    def draw(self, camera: Camera, mode: str = "full", skybox: int = -1) -> None:
        """Draw without reading the picture back; ``finish`` waits for it."""
        with self._gl:  # another scene's context may be current
            self._draw(camera, mode, skybox)

    def _draw(self, camera: Camera, mode: str, skybox: int) -> None:
        size = (camera.width, camera.height)
        if self._target is None or self._target.size != size:
            for old in (self._target, self._fine):
                if old is not None:  # OpenGL's objects outlive Python's
                    for part in (old, *old.color_attachments, old.depth_attachment):
                        part.release()
            self._target = self._fine = None
            self._target, self._fine = (self._framebuffer(camera, rays) for rays in (1, self._rays))
        pose = camera.camera_to_world
        eye = pose[:3, 3] - self._centre
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ eye
        matrix = projection(camera, self._near, self._far) @ view
        steps = {"pixel_right": pose[:3, 0] / camera.fx, "pixel_down": -pose[:3, 1] / camera.fy}
        for program, values in (
            (self._mesh, {"clip_from_scene": matrix.T, "eye": eye, "mode": MODES.index(mode), **steps}),
            (self._sky, {"world_from_camera": pose[:3, :3].T, "lens": lens(camera), "eye": eye, "mode": MODES.index(mode)}),
        ):
            for name, value in values.items():
                if name in program:
                    program[name] = tuple(np.ravel(value).tolist()) if np.ndim(value) else value
        if "only" in self._sky:
            self._sky["only"] = skybox
        for unit, (program, name, texture) in enumerate(self._textures):
            if name in program:
                texture.use(unit)
                program[name] = unit
        if self._photos is not None:
            self._photos.choose(eye, camera.forward)
            for program in (self._mesh, self._sky):
                self._photos.use(program, len(self._textures))
        self._fine.use()
        self._fine.clear(0.0, 0.0, 0.0, 1.0, depth=1.0)
        self._gl.enable(self._gl.DEPTH_TEST)
        self._gl.depth_func = "<="
        self._triangles.render()
        self._screen.render(vertices=3)
        self._gl.disable(self._gl.DEPTH_TEST)
        self._target.use()
        self._fine.color_attachments[0].use(0)
        self._resolve["rays"] = 0
        self._mean.render(vertices=3)

    def _framebuffer(self, camera: Camera, rays: int) -> Any:
        size = (camera.width * rays, camera.height * rays)
        largest = self._gl.info["GL_MAX_TEXTURE_SIZE"]
        if max(size) > largest:
            raise UserError(
                f"a picture of {camera.width} x {camera.height} with {rays} rays along a pixel's side is larger than the "
                f"{largest} pixels that OpenGL here takes: make it smaller, or fit.rays"
            )
        colour = self._gl.texture(size, 4, dtype="f4")
        colour.filter = (self._gl.NEAREST, self._gl.NEAREST)
        return self._gl.framebuffer([colour], self._gl.depth_texture(size))

    def finish(self) -> None:
        """Wait until all is drawn."""
        with self._gl:
            self._gl.finish()

    def close(self) -> None:
        self._gl.release()

    def __enter__(self) -> Drawing:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class _Photos:
    """Residuals on the device: two texture arrays, a layer for each photo that was wanted last."""

    def __init__(self, gl: Any, residuals: Residuals):
        self._residuals = residuals
        self._layers: dict[int, int] = {}  # of photos, the one that was wanted longest ago first
        count = residuals.layers
        self._free = list(range(count))
        self._values = gl.texture_array((*residuals.size, count), 3, dtype="f1", alignment=1)
        self._values.filter = (gl.LINEAR, gl.LINEAR)
        self._values.repeat_x = self._values.repeat_y = False
        self._depths = gl.texture_array((*residuals.size, count), 2, dtype="f1", alignment=1)
        self._depths.filter = (gl.NEAREST, gl.NEAREST)
        self._uniforms: dict[str, bytes] = {}

    def choose(self, eye: np.ndarray, look: np.ndarray) -> None:
        """The photos of a view from ``eye`` (3,), relative to the skyboxes' centre, along ``look`` (3,)."""
        chosen, weights = self._residuals.chosen(eye, look)
        matrices, eyes, about = np.zeros((len(chosen), 4, 4)), np.zeros((len(chosen), 3)), np.zeros((len(chosen), 4))
        for index, (number, weight) in enumerate(zip(chosen, weights, strict=True)):
            source, layer = self._residuals.source(number), self._layer(number)
            matrices[index, :, :3], eyes[index] = source.matrix.T, source.eye  # column after column
            about[index] = (weight, *source.depths.shape[::-1], layer)
        self._uniforms = {
            name: value.astype(np.float32).tobytes()
            for name, value in (("photo_matrix", matrices), ("photo_eye", eyes), ("photo_about", about))
        }

    def _layer(self, number: int) -> int:
        """Where the photo lies, written there if it does not yet."""
        layer = self._layers.pop(number, None)
        if layer is None:
            layer = self._free.pop() if self._free else self._layers.pop(next(iter(self._layers)))
            source = self._residuals.source(number)
            height, width = source.depths.shape
            place = (0, 0, layer, width, height, 1)
            self._values.write(np.ascontiguousarray(source.values).tobytes(), place, alignment=1)
            self._depths.write(source.depths.astype("<u2").tobytes(), place, alignment=1)  # low byte, high byte
        self._layers[number] = layer
        return layer

    def use(self, program: Any, unit: int) -> None:
        """Bind both textures from ``unit`` on, and set the program's uniforms."""
        for offset, (name, texture) in enumerate((("residuals", self._values), ("depths", self._depths))):
            if name in program:
                texture.use(unit + offset)
                program[name] = unit + offset
        for name, data in self._uniforms.items():
            if name in program:
                program[name].write(data)
