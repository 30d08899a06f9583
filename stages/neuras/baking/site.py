"""The folder of a baked scene: a complete web site, and all that another engine needs.

=================  ====================================================================================
index.html, *.js   the page; no build step, no network
scene.json         sizes, formats, skyboxes, cameras of the frames, shaders' names
geometry.glb       the mesh: POSITION relative to the skyboxes' centre, TEXCOORD_0 (v down), _CHART
mesh_codes.png     code of each texel: low byte in R, high byte in G (quantized scenes). Level 0 of the texture lies on the
                   left, coarser levels one below the other on its right
sky_codes.png      the same of the skyboxes: a row of six faces for each, the nearest on top
codebooks.bin      float32: mesh codes (K, D), then sky codes (K, D)
mesh_I.png, ...    features of scenes without quantization: bytes in RGBA, four channels each (``ranges`` in scene.json)
shaders/           GLSL ES 3.00 for WebGL 2 and GLSL 3.30 for engines
frames/            original photos, to compare with
residuals/         what single photos know beyond the textures (``stages.neuras.baking.residuals``)
tiles/N/           of a scene cut into tiles (``stages.neuras.baking.tiles``): ``geometry.glb``, with texture coordinates of the
                   whole texture and _CHART counted anew, and ``level_L.bin``, compressed by gzip: int32 (P, 8), where each of
                   the P charts lies (``Tiles.table``), then rows of texels: codes, uint16, or bytes in RGBA, one map after the
                   other. The two files of the whole mesh are stubs then: one point, one
                   texel
=================  ====================================================================================
"""

from __future__ import annotations

import gzip
import io
import json
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from model.neuras.baked import Baked
from stages.neuras.baking.drawing import lens
from stages.neuras.baking.residuals import Residuals
from stages.neuras.baking.shaders import MODES, Ranges, mesh_shaders, resolve_shaders, sky_shaders, textures
from stages.neuras.baking.tiles import Tiles
from stages.neuras.records import FRAME, AtlasMesh, CaptureInfo, FrameRecord

PAGE = Path(__file__).parent / "page"
SCAN, FILL = 0xDA, 0xFF  # of a JPEG: the marker before the picture's data, and a byte that may stand before any marker
METADATA = {*range(0xE0, 0xF0), 0xFE} - {0xE0, 0xE2, 0xEE}  # all but what a decoder needs: JFIF, the colour profile, Adobe's
STREAMING = "tiles.js"  # the script of a page whose scene is cut; it starts the viewer and keeps its textures filled


def write_site(
    folder: Path,
    baked: Baked,
    atlas: AtlasMesh,
    info: CaptureInfo,
    frames: Iterable[FrameRecord],
    depth_range: tuple[float, float],
    expand: str,
    tiles: Tiles | None = None,
    photos: Residuals | None = None,
) -> dict[str, int]:
    """Write the site; returns the bytes of its kinds of files: "geometry", "textures", "shaders", "page" and so on.

    frames: those whose photos and cameras the page offers. depth_range: near and far plane, world units. expand: what the
    page's loader makes of codes, "rgba8" or "fp16". tiles: the scene as it is cut; None: in one piece. photos: residuals that
    lie in the folder already.
    """
    (folder / "shaders").mkdir(parents=True, exist_ok=True)
    (folder / "frames").mkdir(exist_ok=True)
    bytes_wanted = expand == "rgba8" or not baked.quantized  # the page has no half-float files
    ranges = _ranges(baked) if bytes_wanted else {"mesh": None, "sky": None}
    tiled = tiles is not None
    whole = _one_texel(baked) if tiled else baked
    _geometry(folder / "geometry.glb", _one_point() if tiled else atlas, baked.sky_centre)
    if baked.quantized:
        _codes(folder / "mesh_codes.png", whole.mesh_indices)
        _codes(folder / "sky_codes.png", _in_rows(baked.sky_indices))
        books = [np.ascontiguousarray(book, np.float32) for book in (baked.mesh_codebook, baked.sky_codebook)]
        (folder / "codebooks.bin").write_bytes(b"".join(book.tobytes() for book in books))
    else:
        for name, maps in (("mesh", whole.mesh_texture()), ("sky", _in_rows(baked.sky_textures()))):
            values = ranges[name].quantized(maps)
            for index in range(textures(baked.channels)):
                part = np.ascontiguousarray(values[..., 4 * index : 4 * index + 4])
                Image.fromarray(part, "RGBA").save(folder / f"{name}_{index}.png")
    for dialect in ("web", "desktop"):
        programs = {
            "mesh": mesh_shaders(baked, dialect, ranges["mesh"], tiled, photos),
            "sky": sky_shaders(baked, dialect, ranges["sky"], photos),
            "resolve": resolve_shaders(baked, dialect),
        }
        for name, program in programs.items():
            for kind, text in zip(("vert", "frag"), program, strict=True):
                (folder / "shaders" / f"{name}.{dialect}.{kind}").write_text(text)
    views = [_view(folder, frame, baked.sky_centre) for frame in frames]
    layers, side = baked.sky_size
    scene = {
        "format": 1,
        "channels": baked.channels,
        "textures": textures(baked.channels),
        "rays": baked.rays,
        "quantized": baked.quantized,
        "expand": "rgba8" if bytes_wanted else "fp16",
        "ranges": {name: None if r is None else {"low": r.low.tolist(), "span": r.span.tolist()} for name, r in ranges.items()},
        "mesh": {"width": whole.mesh_size[1], "height": whole.mesh_size[0], "levels": baked.levels, "faces": len(atlas.faces)},
        "skyboxes": {"count": layers, "side": side, "half_sizes": baked.sky_half_sizes.tolist()},
        "codes": {name: len(book) for name, book in (("mesh", baked.mesh_codebook), ("sky", baked.sky_codebook))}
        if baked.quantized
        else None,
        "modes": list(MODES),
        "centre": [float(x) for x in baked.sky_centre],
        "up": list(info.up),
        "metre": info.metre,
        "units": info.units,
        "near": depth_range[0],
        "far": depth_range[1],
        "frames": views,
    }
    if photos is not None:
        scene["residuals"] = photos.about
    if tiled:
        scene["tiles"] = _tiles(folder / "tiles", baked, tiles, ranges["mesh"])
    (folder / "scene.json").write_text(json.dumps(scene, indent=1, allow_nan=False) + "\n")
    for path in sorted(PAGE.iterdir()):
        if path.suffix in (".html", ".js", ".css") and (tiled or path.name != STREAMING):
            shutil.copyfile(path, folder / path.name)
    if tiled:
        page = folder / "index.html"
        page.write_text(page.read_text().replace('src="viewer.js"', f'src="{STREAMING}"'))
    return sizes(folder)


def _tiles(folder: Path, baked: Baked, tiles: Tiles, ranges: Ranges | None) -> dict[str, Any]:
    """Write the tiles' files; returns what the page has to know of them. Boxes are relative to the centre, as vertices are."""
    sheet = baked.mesh_indices if baked.quantized else baked.mesh_features
    each = []
    for number, tile in enumerate(tiles.tiles):
        place = folder / str(number)
        place.mkdir(parents=True, exist_ok=True)
        _geometry(place / "geometry.glb", tile.mesh, baked.sky_centre)
        for level in range(baked.levels):
            texels = tiles.image(number, level, sheet, baked.pyramid)
            if not baked.quantized:
                maps = ranges.quantized(texels.astype(np.float32))
                texels = np.moveaxis(maps.reshape(*maps.shape[:2], -1, 4), 2, 0)
            data = tiles.table(number, level).tobytes() + np.ascontiguousarray(texels).tobytes()
            (place / f"level_{level}.bin").write_bytes(gzip.compress(data, mtime=0))
        each.append(
            {
                "low": (tile.mesh.vertices.min(axis=0) - baked.sky_centre).tolist(),
                "high": (tile.mesh.vertices.max(axis=0) - baked.sky_centre).tolist(),
                "faces": len(tile.mesh.faces),
                "charts": len(tile.charts),
                "density": tile.density,
                "rows": tiles.rows[number],
            }
        )
    return {"width": tiles.width, "columns": tiles.columns, "height": tiles.height, "reach": tiles.reach, "each": each}


def _one_texel(baked: Baked) -> Baked:
    """The scene without its mesh's texture."""
    if baked.quantized:
        return replace(baked, mesh_indices=np.zeros((1, 1), np.uint16))
    return replace(baked, mesh_features=np.zeros((1, 1, baked.channels), np.float16))


def _one_point() -> AtlasMesh:
    """A mesh of which nothing is seen; glTF allows none without faces."""
    return AtlasMesh(np.zeros((1, 3)), np.zeros((1, 2)), np.zeros((1, 3), np.int32), np.zeros(1, np.int32), 1, 1)


def _ranges(baked: Baked) -> dict[str, Ranges]:
    """Of all features that a texel has; of codes without making the maps, which may take gigabytes."""
    if not baked.quantized:
        return {"mesh": Ranges.of(baked.mesh_texture()), "sky": Ranges.of(baked.sky_textures())}
    books = {"mesh": (baked.mesh_codebook, baked.mesh_indices), "sky": (baked.sky_codebook, baked.sky_indices)}
    return {name: Ranges.of(book[np.unique(indices)]) for name, (book, indices) in books.items()}


def _in_rows(maps: np.ndarray) -> np.ndarray:
    """(L S, 6 S, ..): the faces (L, 6, S, S, ..) as one picture, a row for each skybox."""
    layers, faces, side = maps.shape[:3]
    return np.moveaxis(maps, 1, 2).reshape(layers * side, faces * side, *maps.shape[4:])


def _geometry(path: Path, atlas: AtlasMesh, centre: np.ndarray) -> None:
    """A binary glTF. Indices and attributes lie in one buffer, in the order of its accessors."""
    positions = (atlas.vertices - np.asarray(centre)).astype(np.float32)
    arrays = [
        (np.ascontiguousarray(atlas.faces, np.uint32).ravel(), 5125, "SCALAR", 34963),
        (positions, 5126, "VEC3", 34962),
        (np.ascontiguousarray(atlas.uvs, np.float32), 5126, "VEC2", 34962),
        (atlas.vertex_charts(), 5126, "SCALAR", 34962),
    ]
    accessors: list[dict[str, Any]] = []
    views, data = [], b""
    for index, (array, kind, shape, target) in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": index, "componentType": kind, "count": len(array), "type": shape})
        data += array.tobytes()  # all are multiples of four bytes
    accessors[1] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    attributes = {"POSITION": 1, "TEXCOORD_0": 2, "_CHART": 3}
    document = {
        "asset": {"version": "2.0", "generator": "lightmill"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = b"glTF" + np.array([2, 28 + len(text) + len(data), len(text)], "<u4").tobytes() + b"JSON"
    path.write_bytes(header + text + np.array([len(data)], "<u4").tobytes() + b"BIN\0" + data)


def _codes(path: Path, codes: np.ndarray) -> None:
    pixels = np.stack([codes & 255, codes >> 8, np.zeros_like(codes)], axis=-1).astype(np.uint8)
    Image.fromarray(pixels, "RGB").save(path, optimize=True)


def without_metadata(jpeg: bytes) -> bytes | None:
    """The JPEG without EXIF, XMP, comments and the like, its picture as it was; None where the bytes are no JPEG, or more
    than one: phones put a video behind a photo.

    A site is made to be shared, and a photo's metadata say where it was taken. Browsers also turn a picture as EXIF says, and
    cameras here are those of the picture as it is stored.
    """
    if not (jpeg.startswith(b"\xff\xd8") and jpeg.endswith(b"\xff\xd9")):
        return None
    kept, at = [jpeg[:2]], 2
    while jpeg[at : at + 1] == b"\xff" and len(jpeg) >= at + 4:
        marker, length = jpeg[at + 1], int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if marker == FILL:
            at += 1
            continue
        if marker == SCAN:
            return b"".join([*kept, jpeg[at:]])
        if marker not in METADATA:
            kept.append(jpeg[at : at + 2 + length])
        at += 2 + length
    return None


def view_name(frame_id: str) -> str:
    """How the page calls the frame of that record."""
    return frame_id.removeprefix(FRAME)


def _view(folder: Path, frame: FrameRecord, centre: np.ndarray) -> dict[str, Any]:
    """A frame as the page knows it; its photo is written beside. World coordinates are relative to the centre."""
    name = view_name(frame.id)
    path = folder / "frames" / f"{name}.jpg"
    if (bare := without_metadata(frame.picture)) is not None:
        path.write_bytes(bare)
    else:
        buffer = io.BytesIO()
        Image.fromarray(frame.image()).save(buffer, "JPEG", quality=92)
        path.write_bytes(buffer.getvalue())
    pose = frame.camera.camera_to_world.copy()
    pose[:3, 3] -= centre
    return {
        "name": name,
        "split": frame.split,
        "trajectory": frame.trajectory,
        "image": f"frames/{path.name}",
        "width": frame.camera.width,
        "height": frame.camera.height,
        "lens": list(lens(frame.camera)),
        "camera_to_world": pose.tolist(),
    }


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of a site's kinds of files."""
    kinds = {"geometry": 0, "textures": 0, "shaders": 0, "residuals": 0, "frames": 0, "page": 0}
    for path in folder.rglob("*"):
        if path.is_file():
            kind = path.relative_to(folder).parts[0] if path.parent != folder else "page"
            if path.suffix == ".glb":
                kind = "geometry"
            elif kind in ("page", "tiles") and path.suffix in (".png", ".bin"):
                kind = "textures"
            kinds[kind] += path.stat().st_size
    return kinds
