"""The fragment shaders of a fitted scene, its two networks written out as constants.

One text serves two dialects: GLSL 3.30 for engines and GLSL ES 3.00 for WebGL 2. Features lie four to a texture in RGBA; a
network's layer is a sum of 4 x 4 matrices times four features each. ``model.neuras.baked.Baked.render`` says what is computed.
Coordinates are relative to the skyboxes' centre: single precision is too coarse for map coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.neuras.baked import Baked, Layer
from model.neuras.sampling import Pyramid
from stages.neuras.baking import residuals
from stages.neuras.baking.residuals import Residuals

DIALECTS = {
    "desktop": "#version 330\n",
    "web": "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2DArray;\n"
    "precision highp usampler2D;\n",
}  # fmt: skip
MODES = ("full", "mesh", "skyboxes", "opacity", "charts", "codes")  # what a shader can show: uniform int mode

MESH_VERTEX = """
in vec3 position;   // relative to the skyboxes' centre
in vec2 uv;         // v runs down, so row 0 of the texture is v = 0
in float chart;
uniform mat4 clip_from_scene;
uniform vec3 eye;
out vec2 place;
out vec3 ray;
flat out float chart_number;
void main() {
    gl_Position = clip_from_scene * vec4(position, 1.0);
    place = uv;
    ray = position - eye;
    chart_number = chart;
}
"""

SKY_VERTEX = """
uniform mat3 world_from_camera;
uniform vec4 lens;  // focal lengths and principal point in halves of the image: ndc = lens.xy * (x, y) / -z + lens.zw
out vec3 ray;
void main() {       // one triangle over the whole image, at the far plane
    vec2 ndc = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    ray = world_from_camera * vec3((ndc - lens.zw) / lens.xy, -1.0);
    gl_Position = vec4(ndc, 1.0, 1.0);
}
"""

RESOLVE_VERTEX = """
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }
"""

COLOURS = """
vec3 number_colour(float number) {  // neighbours in number differ in colour
    vec3 turn = fract(number * vec3(0.61803399, 0.75487767, 0.56984029) + vec3(0.1, 0.4, 0.7));
    return 0.25 + 0.75 * turn;
}
"""


@dataclass(frozen=True, eq=False)
class Ranges:
    """How 8-bit texels become features: feature = low + span * texel, per channel. (4 n,) float32 each."""

    low: np.ndarray
    span: np.ndarray

    @classmethod
    def of(cls, features: np.ndarray) -> Ranges:
        """Of (.., D) features; channels beyond D, which fill the last texture, are 0."""
        flat = features.reshape(-1, features.shape[-1])
        low = _padded(flat.min(axis=0).astype(np.float32))
        return cls(low, _padded(flat.max(axis=0).astype(np.float32)) - low)

    def part(self, first: int) -> Ranges:
        """Of the four channels from ``first`` on."""
        return Ranges(self.low[first : first + 4], self.span[first : first + 4])

    def quantized(self, features: np.ndarray) -> np.ndarray:
        """(.., 4 n) uint8 of (.., D) features."""
        channels = features.shape[-1]
        span = np.where(self.span > 0, self.span, 1)[:channels]
        values = np.clip((features - self.low[:channels]) / span, 0, 1)
        return _padded(np.rint(values * 255).astype(np.uint8))


def _padded(values: np.ndarray) -> np.ndarray:
    """With zeros after the last axis, to a multiple of four."""
    missing = -values.shape[-1] % 4
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)])


def textures(channels: int) -> int:
    """RGBA textures that so many channels need."""
    return -(-channels // 4)


def mesh_shaders(
    baked: Baked, dialect: str, ranges: Ranges | None, tiled: bool = False, photos: Residuals | None = None
) -> tuple[str, str]:
    """Vertex and fragment shader of the mesh. ``ranges``: None where textures hold features themselves (half floats).
    ``tiled``: textures are a pool of tiles' images, and a table says where in it a chart's levels lie (``_in_pool``).
    ``photos``: whose residuals are added."""
    count, pyramid = textures(baked.channels), baked.pyramid
    samplers = "".join(f"uniform sampler2D mesh{i};\n" for i in range(count))
    features = "".join(f"    vec4 f{i} = {_texel(_levels(pyramid, f'mesh{i}', tiled), ranges, i)};\n" for i in range(count))
    chart, texel = "chart_number", "place * texture_size"
    if tiled:
        chart, texel = "float(where(0, 0).w)", "in_sheet(place, where(0, 0).z) * vec2(textureSize(codes, 0))"
    body = f"""
in vec2 place;
in vec3 ray;
flat in float chart_number;
out vec4 colour;
uniform int mode;
uniform vec3 eye;
uniform vec3 pixel_right;  // from one pixel to the next at distance 1: the camera's right over its focal length in pixels
uniform vec3 pixel_down;
uniform usampler2D codes;
{samplers}{COLOURS}{_pyramid(pyramid, tiled)}{residual_lookup(photos)}
{_network("mesh_colour", baked.mesh_mlp, count, baked.channels, baked.view_dependent)}
void main() {{
    if (mode == 2) discard;
    if (mode == 3) {{ colour = vec4(1.0); return; }}
    if (mode == 4) {{ colour = vec4(number_colour({chart}), 1.0); return; }}
    if (mode == 5) {{
        colour = vec4(number_colour(float(texelFetch(codes, ivec2({texel}), 0).r)), 1.0);
        return;
    }}
{_footprint(pyramid, tiled)}{features}    vec3 way = normalize(ray);
    vec3 light = clamp(mesh_colour({_features(count)}, way), 0.0, 1.0);
{_added(photos, "eye + ray, 1.0")}    colour = vec4(light, 1.0);
}}
"""
    return DIALECTS[dialect] + MESH_VERTEX, DIALECTS[dialect] + body


def resolve_shaders(baked: Baked, dialect: str) -> tuple[str, str]:
    """Vertex and fragment shader that draw each pixel as the mean of its rays: of a picture so many times as wide and high."""
    body = f"""
uniform highp sampler2D rays;
out vec4 colour;
void main() {{
    ivec2 corner = ivec2(gl_FragCoord.xy) * {baked.rays};
    vec4 sum = vec4(0.0);
    for (int i = 0; i < {baked.rays**2}; i++) sum += texelFetch(rays, corner + ivec2(i % {baked.rays}, i / {baked.rays}), 0);
    colour = sum / {baked.rays**2}.0;
}}
"""
    return DIALECTS[dialect] + RESOLVE_VERTEX, DIALECTS[dialect] + body


def sky_shaders(baked: Baked, dialect: str, ranges: Ranges | None, photos: Residuals | None = None) -> tuple[str, str]:
    """Vertex and fragment shader of the skyboxes, composited near to far in one pass (eq. 4)."""
    count, (layers, _) = textures(baked.channels), baked.sky_size
    samplers = "".join(f"uniform sampler2DArray sky{i};\n" for i in range(count))
    features = "".join(
        f"        vec4 f{i} = {_texel(f'texture(sky{i}, vec3(st, float(6 * layer + face)))', ranges, i)};\n"
        for i in range(count)
    )
    halves = ", ".join(f"vec3({_list(half)})" for half in baked.sky_half_sizes)
    hidden_count = -(-len(baked.sky_mlp[0][1]) // 4) if baked.sky_mlp else count
    hidden = _layer("h", [f"f{i}" for i in range(count)], [baked.channels], *baked.sky_mlp[0], True) if baked.sky_mlp else ""
    seen = [f"h{i}" for i in range(hidden_count)] if baked.sky_mlp else [f"f{i}" for i in range(count)]
    width = len(baked.sky_mlp[0][1]) if baked.sky_mlp else baked.channels
    body = f"""
in vec3 ray;
out vec4 colour;
uniform int mode;
uniform int only;  // show this skybox alone; -1: all
uniform vec3 eye;
{samplers}{residual_lookup(photos)}
const vec3 half_sizes[{layers}] = vec3[{layers}]({halves});
{_network("sky_colour", baked.sky_mlp[1:], len(seen), width, baked.view_dependent)}
void leave(vec3 start, vec3 way, vec3 size, out int face, out vec2 st) {{  // where a ray from inside leaves the cuboid
    vec3 side = vec3(way.x < 0.0 ? -1.0 : 1.0, way.y < 0.0 ? -1.0 : 1.0, way.z < 0.0 ? -1.0 : 1.0);
    vec3 safe = mix(way, side * 1e-12, lessThan(abs(way), vec3(1e-12)));
    vec3 steps = (side * size - start) / safe;
    float nearest = min(steps.x, min(steps.y, steps.z));
    vec3 point = (start + nearest * way) / size;
    int axis = steps.x == nearest ? 0 : (steps.y == nearest ? 1 : 2);
    st = ((axis == 0 ? point.yz : (axis == 1 ? point.xz : point.xy)) + 1.0) / 2.0;
    face = 2 * axis + ((axis == 0 ? way.x : (axis == 1 ? way.y : way.z)) < 0.0 ? 1 : 0);
}}
void main() {{
    if (mode == 1 || mode == 4 || mode == 5) {{ colour = vec4(0.0, 0.0, 0.0, 1.0); return; }}
    vec3 way = normalize(ray);
    vec3 light = vec3(0.0);
    float passed = 1.0;
    for (int layer = 0; layer < {layers}; layer++) {{
        if (only >= 0 && layer != only) continue;
        int face;
        vec2 st;
        leave(eye, way, half_sizes[layer], face, st);
{features}{hidden}        float opacity = 1.0 / (1.0 + exp(-({_dot(baked.sky_opacity, seen)})));
        light += passed * opacity * sky_colour({", ".join(seen)}, way);
        passed *= 1.0 - opacity;
        if (passed < 0.0005) break;  // an eighth of an 8-bit step
    }}
    if (mode == 3) {{ colour = vec4(vec3(1.0 - passed), 1.0); return; }}
    light = clamp(light, 0.0, 1.0);
{_added(photos, "way, 0.0", "if (only < 0) ")}    colour = vec4(light, 1.0);
}}
"""
    return DIALECTS[dialect] + SKY_VERTEX, DIALECTS[dialect] + body


def residual_lookup(photos: Residuals | None) -> str:
    """The function that sums up residuals: ``Residuals.at``. The photos that a view takes are uniforms."""
    if photos is None:
        return ""
    count, steps = photos.nearest, np.log2(photos.far / photos.near) / (residuals.MASKED - 2)
    return f"""
precision highp sampler2DArray;
uniform sampler2DArray residuals;
uniform sampler2DArray depths;       // codes of the distance that a photo's pixel sees: low byte, high byte
uniform mat4 photo_matrix[{count}];    // from the scene to column * ahead, row * ahead, ahead
uniform vec3 photo_eye[{count}];
uniform vec4 photo_about[{count}];     // weight, width, height, layer
vec3 residual(vec3 point, float on_mesh, vec3 way) {{  // off the mesh the point is the way, and lies infinitely far
    vec3 total = vec3(0.0);
    float weights = 0.0;
    for (int k = 0; k < {count}; k++) {{
        vec4 about = photo_about[k];
        vec3 at = (photo_matrix[k] * vec4(point, on_mesh)).xyz;
        if (about.x <= 0.0 || at.z <= 0.0) continue;
        vec2 place = at.xy / at.z;
        vec2 inner = min(place - 0.5, about.yz - 0.5 - place);
        float border = clamp(min(inner.x, inner.y) / ({_number(residuals.BORDER)} * max(about.y, about.z)), 0.0, 1.0);
        if (border <= 0.0) continue;
        float code = dot(floor(255.0 * texelFetch(depths, ivec3(ivec2(place), int(about.w)), 0).rg + 0.5), vec2(1.0, 256.0));
        vec3 away = (on_mesh > 0.0 ? point : eye + {_number(photos.off_mesh)} * way) - photo_eye[k];
        float apart = max(length(away), 1e-12);
        float seen = {_number(photos.near)} * exp2((code - 1.0) * {_number(steps)});
        float same = clamp(1.5 - abs(seen - apart) / ({_number(residuals.TOLERANCE)} * apart), 0.0, 1.0);
        bool hit = code != {residuals.OPEN}.0 && code != {residuals.MASKED}.0;
        float agrees = on_mesh > 0.0 ? (hit ? same : 0.0) : (code == {residuals.OPEN}.0 ? 1.0 : 0.0);
        float cosine = dot(away, way) / apart;
        float share = about.x * border * agrees;
        vec3 value = texture(residuals, vec3(place / vec2(textureSize(residuals, 0).xy), about.w)).rgb;
        float fade = exp((cosine - 1.0) / {_number(1 - np.cos(photos.angle))});
        total += share * fade * (value - {_number(residuals.NEUTRAL / 255)});
        weights += share;
    }}
    return total / max(weights, {_number(residuals.LEAST)});
}}
"""


def _added(photos: Residuals | None, where: str, condition: str = "") -> str:
    """The statement that adds residuals to ``light``; ``where``: the point, and whether it lies on the mesh."""
    return "" if photos is None else f"    {condition}light = clamp(light + residual({where}, way), 0.0, 1.0);\n"


def _pyramid(pyramid: Pyramid, tiled: bool) -> str:
    """Constants and functions that look up the mesh's levels; ``footprints.footprint`` and ``Pyramid.sample`` in GLSL.

    ``dFdx`` and ``dFdy`` are differences from pixel to pixel, but all of them lie on the plane of one face. There texture
    coordinates are linear, so any step on the plane has its texture coordinates from two such differences, exactly.
    """
    text = f"const vec2 texture_size = vec2({pyramid.width}.0, {pyramid.height}.0);\n"
    if pyramid.levels == 1:
        return text + (_in_pool(pyramid) if tiled else "")
    lookup = _in_pool(pyramid) if tiled else _in_sheet(pyramid)
    return f"""{text}{lookup}vec2 side(vec3 pixel) {{  // texels from one pixel to the next; pixel: that step at distance 1
    vec3 x = dFdx(ray);
    vec3 y = dFdy(ray);
    vec3 normal = cross(x, y);
    vec3 moved = (pixel - ray * (dot(normal, pixel) / dot(normal, ray))) / gl_FragCoord.w;
    vec2 shares = vec2(dot(cross(moved, y), normal), dot(cross(x, moved), normal)) / dot(normal, normal);
    return (shares.x * dFdx(place) + shares.y * dFdy(place)) * texture_size;
}}
"""


def _in_sheet(pyramid: Pyramid) -> str:
    """The function that finds a place in the sheet of all levels."""
    height, width = pyramid.sheet
    corners = ", ".join(f"vec2({column}.0, {row}.0)" for row, column in map(pyramid.corner, range(pyramid.levels)))
    return f"""const vec2 sheet_size = vec2({width}.0, {height}.0);
const vec2 corners[{pyramid.levels}] = vec2[{pyramid.levels}]({corners});
vec2 in_sheet(vec2 at, int level) {{  // where a level has this place, half a texel from the level's border at least
    vec2 size = texture_size / exp2(float(level));
    return (corners[level] + clamp(at * size, vec2(0.5), size - 0.5)) / sheet_size;
}}
"""


def _in_pool(pyramid: Pyramid) -> str:
    """The same of a pool of tiles' images, where each chart's part of a level lies by itself (``stages.neuras.baking.tiles``).

    A place in the whole level is moved by whole texels, so filters weigh texels as they do in the sheet. The two samples of a
    very long footprint may reach beyond the texels that a tile has; they take the outermost then, not what lies beside them.
    """
    return f"""uniform highp isampler2D places;  // two texels for each level of each chart of a tile
ivec4 where(int level, int row) {{  // 0: steps in x and y, the finest level there, the chart; 1: the corners of its texels
    int number = 2 * (int(chart_number) * {pyramid.levels} + level) + row;
    int wide = textureSize(places, 0).x;
    return texelFetch(places, ivec2(number % wide, number / wide), 0);
}}
vec2 in_sheet(vec2 at, int level) {{
    vec2 size = texture_size / exp2(float(level));
    vec4 corners = vec4(where(level, 1));
    return clamp(at * size + vec2(where(level, 0).xy), corners.xy + 0.5, corners.zw - 0.5) / vec2(textureSize(mesh0, 0));
}}
"""


def _footprint(pyramid: Pyramid, tiled: bool) -> str:
    """Statements: where the two samples look in each of two levels, and the coarser level's share."""
    if pyramid.levels == 1:
        return ""
    finest = "float(where(0, 0).z)" if tiled else "0.0"
    return f"""    vec2 across = side(pixel_right);
    vec2 down = side(pixel_down);
    vec2 longer = length(across) >= length(down) ? across : down;
    float long_side = max(length(longer), 1e-12);
    float wide = abs(across.x * down.y - across.y * down.x) / long_side;
    vec2 spread = 0.25 * (1.0 - wide / long_side) * longer / texture_size;
    float detail = clamp(log2(max(max(0.5 * long_side, wide), 1e-12)), {finest}, {pyramid.levels - 1}.0);
    int finer = min(int(detail), {pyramid.levels - 2});
    float share = detail - float(finer);
    vec2 a = in_sheet(place + spread, finer);
    vec2 b = in_sheet(place - spread, finer);
    vec2 c = in_sheet(place + spread, finer + 1);
    vec2 d = in_sheet(place - spread, finer + 1);
"""


def _levels(pyramid: Pyramid, map: str, tiled: bool) -> str:
    """The features of the mesh."""
    if pyramid.levels == 1:
        return f"texture({map}, {'in_sheet(place, 0)' if tiled else 'place'})"
    fine, coarse = (f"texture({map}, {one}) + texture({map}, {other})" for one, other in ("ab", "cd"))
    return f"0.5 * mix({fine}, {coarse}, share)"


def _texel(sample: str, ranges: Ranges | None, index: int) -> str:
    if ranges is None:
        return sample
    part = slice(4 * index, 4 * index + 4)
    return f"vec4({_list(ranges.low[part])}) + vec4({_list(ranges.span[part])}) * {sample}"


def _features(count: int) -> str:
    return ", ".join(f"f{i}" for i in range(count))


def _network(name: str, layers: list[Layer], count: int, channels: int, view_dependent: bool) -> str:
    """A function from ``count`` vec4 of features (``channels`` numbers) and the view direction to a colour."""
    arguments = ", ".join(f"vec4 f{i}" for i in range(count))
    text = f"vec3 {name}({arguments}, vec3 way) {{\n"
    names, blocks = [f"f{i}" for i in range(count)], [channels]
    if view_dependent and layers:
        names, blocks = [*names, "vec4(way, 0.0)"], [channels, 3]
    for number, (weight, bias) in enumerate(layers):
        last = number == len(layers) - 1
        text += _layer(f"x{number}_", names, blocks, weight, bias, not last)
        names, blocks = [f"x{number}_{i}" for i in range(-(-len(bias) // 4))], [len(bias)]
    return f"{text}    return {names[0]}.rgb;\n}}\n"


def _layer(name: str, inputs: list[str], blocks: list[int], weight: np.ndarray, bias: np.ndarray, relu: bool) -> str:
    """Statements ``vec4 name0 = ..`` for each four outputs. ``blocks``: how many columns of ``weight`` (out, in) belong to the
    inputs that are filled up to a multiple of four each."""
    columns, start = [], 0
    for width in blocks:
        columns.append(_padded(weight[:, start : start + width]))
        start += width
    assert start == weight.shape[1], "the network's inputs are not those of the shader"
    matrix = np.concatenate(columns, axis=1)
    rows = -len(bias) % 4
    matrix, bias = np.pad(matrix, ((0, rows), (0, 0))), np.pad(bias, (0, rows))
    text = ""
    for out in range(len(bias) // 4):
        part = slice(4 * out, 4 * out + 4)
        terms = [f"mat4({_list(matrix[part, 4 * i : 4 * i + 4].T.ravel())}) * {value}" for i, value in enumerate(inputs)]
        total = "\n        + ".join([f"vec4({_list(bias[part])})", *terms])
        text += f"    vec4 {name}{out} = {f'max({total}, 0.0)' if relu else total};\n"
    return text


def _dot(layer: Layer, inputs: list[str]) -> str:
    """The one output of a layer."""
    weight, bias = _padded(layer[0][0]), float(layer[1][0])
    terms = [f"dot(vec4({_list(weight[4 * i : 4 * i + 4])}), {value})" for i, value in enumerate(inputs)]
    return " + ".join([_number(bias), *terms])


def _list(values: np.ndarray) -> str:
    return ", ".join(_number(value) for value in np.asarray(values).ravel())


def _number(value: float) -> str:
    """A literal that reads back as the same single-precision number."""
    text = f"{np.float32(value):.9g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"
