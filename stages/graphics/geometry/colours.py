"""Base colours of a stranger's mesh file: its materials, their images, and what can be wrong with them.

Reads what glTF materials and OBJ's MTL libraries say of base colour, and the images that they name, inside the given root
only. Nothing here can cost a mesh: an image that is missing, too large, malformed or outside the folder leaves its material
with its plain colour, and a note. Design choice: Pillow opens five formats and looks at the size before it decodes; what
is kept is at most ``MAX_SIDE`` pixels wide, averaged in linear light.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import json
import re
import struct
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.records import TextureRecord
from stages.graphics.tonemap import srgb_decode, to_picture

IMAGE_FORMATS = {".bmp": "BMP", ".jpeg": "JPEG", ".jpg": "JPEG", ".png": "PNG", ".tga": "TGA", ".webp": "WEBP"}
LIBRARY_SUFFIX = ".mtl"
MAX_PIXELS = 1 << 26  # of an image as stored; a larger one is not decoded
MAX_SIDE = 1024  # pixels of an image as kept; a larger one is averaged down
MAX_IMAGES = 32  # of an object; the materials of further ones keep their plain colours
GLTF_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
INTEGER_UV = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}  # what stands for 1, by component type


@dataclass
class Material:
    """Base colour of a part: linear ``colour``, times the image where there is one."""

    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    image: np.ndarray | None = None  # (H, W, 3) uint8 sRGB
    wrap: tuple[str, str] = ("repeat", "repeat")
    transform: np.ndarray = field(default_factory=lambda: np.eye(3)[:2])  # (2, 3) of (u, v, 1) as the file has them

    @cached_property
    def picture(self) -> str:
        """What tells the image from others; "" where there is none."""
        if self.image is None:
            return ""
        return hashlib.blake2b(self.image.tobytes(), digest_size=16).hexdigest() + str(self.image.shape)


# -- images


def decode_image(data: bytes) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of an image file, at most MAX_SIDE pixels wide; alpha is dropped. ValueError says what is wrong."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=sorted(set(IMAGE_FORMATS.values()))) as image:
            width, height = image.size
            if not 0 < width * height <= MAX_PIXELS:
                raise ValueError(f"{width} x {height} pixels, at most {MAX_PIXELS} are decoded")
            image.draft("RGB", (MAX_SIDE, MAX_SIDE))  # a JPEG is decoded at half or quarter size where that suffices
            if image.mode.startswith("I"):  # 16 bits of grey, which convert() would clip
                pixels = np.repeat(
                    (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2
                )
            else:
                pixels = np.asarray(image.convert("RGB"))
    except MemoryError:
        raise
    except Exception as error:  # decoders of strangers' files fail in every way
        raise ValueError(f"{type(error).__name__}: {str(error)[:120]}") from None
    return reduced(pixels)


def reduced(pixels: np.ndarray) -> np.ndarray:
    """The (H, W, 3) uint8 picture with no side over MAX_SIDE, averaged in linear light."""
    from PIL import Image

    height, width = pixels.shape[:2]
    scale = MAX_SIDE / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(pixels)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    linear = srgb_decode(np.arange(256) / 255).astype(np.float32)
    channels = [Image.fromarray(linear[pixels[..., c]]).resize(size, Image.Resampling.BOX) for c in range(3)]
    return to_picture(np.stack([np.asarray(channel) for channel in channels], axis=-1))


class Images:
    """The images of one file, each decoded once; what could not be had is in ``notes``."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._known: dict[Any, np.ndarray | None] = {}

    def get(self, name: Any, read: Any) -> np.ndarray | None:
        """The image ``name``, from the bytes that ``read()`` gives; None and a note where that fails."""
        if name not in self._known:
            self._known[name] = None
            if len(self._known) > MAX_IMAGES:
                self.notes.append(f"image {name}: over {MAX_IMAGES} images")
            else:
                try:
                    self._known[name] = decode_image(read())
                except (ValueError, KeyError, IndexError, TypeError, AttributeError, OSError, Reject) as error:
                    detail = error.detail if isinstance(error, Reject) else str(error)
                    self.notes.append(f"image {str(name)[:80]}: {detail[:160]}")
        return self._known[name]


def side_file(uri: str, folder: Path, root: Path, suffixes: Any) -> Path:
    """The file beside a mesh that a reference means; Reject or ValueError where it may not or cannot be read."""
    from stages.graphics.geometry.paths import check_path

    path = check_path(uri, folder, root)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{uri[:80]!r} is not one of {', '.join(suffixes)}")
    if not path.is_file():
        raise ValueError(f"{uri[:80]!r} is missing")
    return path


def _read(path: Path, max_bytes: int) -> bytes:
    if path.stat().st_size > max_bytes:
        raise ValueError(f"over {max_bytes} bytes")
    return path.read_bytes()


def side_files(path: Path, root: Path) -> list[Path]:
    """The material libraries and images beside a mesh file that decide its colours; what is unsafe or missing is left out."""
    files: set[Path] = set()

    def add(uri: str, suffixes: Any) -> Path | None:
        try:
            target = side_file(uri, path.parent, root, suffixes)
        except (Reject, ValueError, OSError):
            return None
        files.add(target)
        return target

    try:
        if path.suffix.lower() == ".obj":
            for name in library_names(path.read_bytes()):
                library = add(name, (LIBRARY_SUFFIX,))
                for material in parse_library(library.read_bytes()).values() if library else ():
                    if "map" in material:
                        add(material["map"], IMAGE_FORMATS)
        elif path.suffix.lower() in (".gltf", ".glb"):
            with open(path, "rb") as file:  # of a GLB only its first chunk, the JSON
                head = file.read(20) if path.suffix.lower() == ".glb" else b""
                tree = json.loads(file.read(struct.unpack_from("<I", head, 12)[0] if head else -1))
            for image in tree.get("images", []):
                if not image.get("uri", "data:").startswith("data:"):
                    add(image["uri"], IMAGE_FORMATS)
    except (Reject, ValueError, OSError, AttributeError, TypeError, KeyError, IndexError, struct.error):
        pass  # the file itself is rejected when it is read
    return sorted(files)


# -- OBJ


def library_names(data: bytes) -> list[str]:
    """What the ``mtllib`` lines of an OBJ name."""
    lines = re.findall(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", data, flags=re.MULTILINE)
    return [line.decode("utf-8", "replace") for line in lines]


def parse_library(data: bytes) -> dict[str, dict[str, Any]]:
    """Material name -> ``colour`` (Kd) and ``map`` (file of map_Kd), where an MTL states them."""
    materials: dict[str, dict[str, Any]] = {}
    current: dict[str, Any] = {}
    for line in data.decode("utf-8", "replace").splitlines():
        words = line.strip().split(None, 1)
        if len(words) < 2:
            continue
        key, value = words[0].lower(), words[1].strip()
        if key == "newmtl":
            current = materials.setdefault(" ".join(value.split()), {})
        elif key == "kd":
            with contextlib.suppress(ValueError):  # it may also name a spectrum
                r, g, b = (float(np.nan_to_num(np.clip(float(word), 0, 1))) for word in value.split()[:3])
                current["colour"] = r, g, b
        elif key == "map_kd":
            current["map"] = value.split()[-1] if value.startswith("-") else value  # options come before the name
            if re.search(r"-clamp\s+on", value):
                current["wrap"] = "clamp"
    return materials


def obj_materials(data: bytes, folder: Path, root: Path, max_bytes: int, images: Images) -> dict[str, Material]:
    """Material name -> base colour, as the libraries of an OBJ say. Kd counts only where there is no image, as exporters
    leave anything in it beside one."""
    material_by_name: dict[str, Material] = {}
    for name in library_names(data):
        try:
            library = parse_library(_read(side_file(name, folder, root, (LIBRARY_SUFFIX,)), max_bytes))
        except (Reject, ValueError, OSError) as error:
            images.notes.append(f"library {name[:80]}: {str(error)[:160]}")
            continue
        for key, stated in library.items():
            image = None
            if "map" in stated:
                uri = stated["map"]
                image = images.get(uri, lambda uri=uri: _read(side_file(uri, folder, root, IMAGE_FORMATS), max_bytes))
            colour = (1.0, 1.0, 1.0) if image is not None else stated.get("colour", (1.0, 1.0, 1.0))
            wrap = stated.get("wrap", "repeat")
            material_by_name.setdefault(key, Material(colour, image, (wrap, wrap), np.array([[1.0, 0, 0], [0, -1, 1]])))
    return material_by_name


def library_without_images(names: Any) -> bytes:
    """An MTL that only says that these materials exist: what trimesh gets to see."""
    return "".join(f"newmtl {name}\nKd 1 1 1\n" for name in names).encode()


# -- glTF


def gltf_materials(
    tree: dict[str, Any], joined: bytes | bytearray, folder: Path, root: Path, max_bytes: int, images: Images
) -> tuple[list[Material], list[int]]:
    """(base colours, texture coordinate set of each) of a glTF whose buffer views lie in ``joined``."""
    materials, sets = [], []
    for stated in tree.get("materials", []):
        material, coordinates = Material(), 0
        try:
            material, coordinates = _gltf_material(tree, stated, joined, folder, root, max_bytes, images)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            images.notes.append(f"material {len(materials)}: {type(error).__name__}: {str(error)[:120]}")
        materials.append(material)
        sets.append(coordinates)
    return materials, sets


def _gltf_material(
    tree: dict[str, Any],
    stated: dict[str, Any],
    joined: bytes | bytearray,
    folder: Path,
    root: Path,
    max_bytes: int,
    images: Images,
) -> tuple[Material, int]:
    base = stated.get("pbrMetallicRoughness", {})
    texture, factor = base.get("baseColorTexture"), base.get("baseColorFactor", [1, 1, 1, 1])
    older = stated.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if texture is None and older:  # what Sketchfab wrote for years
        texture, factor = older.get("diffuseTexture"), older.get("diffuseFactor", factor)
    colour = tuple(float(x) for x in np.nan_to_num(np.clip(np.array(factor[:3], float), 0, 1)))
    if len(colour) != 3:
        raise ValueError(f"a base colour of {len(colour)} numbers")
    if texture is None:
        return Material(colour), 0
    entry = tree["textures"][int(texture["index"])]
    source = entry.get("extensions", {}).get("EXT_texture_webp", {}).get("source", entry.get("source"))
    if source is None:
        images.notes.append(f"texture {texture['index']}: no image in a format that is read")
        return Material(colour), 0

    def read() -> bytes:
        image = tree["images"][int(source)]
        if "bufferView" in image:
            view = tree["bufferViews"][int(image["bufferView"])]
            return bytes(joined[view.get("byteOffset", 0) :][: view["byteLength"]])
        if image["uri"].startswith("data:"):
            return base64.b64decode(image["uri"].partition(",")[2])
        return _read(side_file(image["uri"], folder, root, IMAGE_FORMATS), max_bytes)

    sampler = tree["samplers"][int(entry["sampler"])] if "sampler" in entry else {}
    wrap = tuple(GLTF_WRAPS.get(sampler.get(name, 10497), "repeat") for name in ("wrapS", "wrapT"))
    moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
    angle = float(moved.get("rotation", 0))
    (x, y), (u, v) = moved.get("scale", (1, 1)), moved.get("offset", (0, 0))
    transform = np.array([[x * np.cos(angle), y * np.sin(angle), u], [-x * np.sin(angle), y * np.cos(angle), v]], float)
    coordinates = int(moved.get("texCoord", texture.get("texCoord", 0)))
    return Material(colour, images.get(int(source), read), wrap, transform), coordinates


# -- all together


def texture_record(id: str, parts: list[tuple[Material, np.ndarray | None, int]], kept: np.ndarray) -> TextureRecord | None:
    """The record of a mesh's parts, each (material, (f, 3, 2) corner coordinates or None, f), of the faces ``kept``.

    ``kept``: rising indices into the faces of all parts together. Equal images and equal materials become one. None where
    there is neither an image nor a second colour.
    """
    coordinates = np.concatenate([np.zeros((count, 3, 2)) if uv is None else uv for _, uv, count in parts])[kept]
    ends = np.searchsorted(kept, np.cumsum([0, *(count for _, _, count in parts)]))
    rows: dict[tuple, int] = {}
    images: dict[str, int] = {}
    pictures: list[np.ndarray] = []
    material = np.zeros(len(kept), np.int32)
    for (look, uv, _), start, end in zip(parts, ends, ends[1:], strict=False):
        if start == end:
            continue
        part_faces = slice(start, end)
        image, wrap = -1, (0, 0)
        if uv is not None and look.image is not None:
            image = images.setdefault(look.picture, len(pictures))
            if image == len(pictures):
                pictures.append(look.image)
            wrap = tuple(TextureRecord.WRAPS.index(name) for name in look.wrap)
            coordinates[part_faces] = coordinates[part_faces] @ look.transform[:, :2].T + look.transform[:, 2]
        else:
            coordinates[part_faces] = 0
        material[part_faces] = rows.setdefault((look.colour, image, wrap), len(rows))
    if not pictures and len(rows) < 2:
        return None
    colour, image, wrap = zip(*rows, strict=True)
    coordinates = np.nan_to_num(coordinates, posinf=0, neginf=0)
    return TextureRecord(
        id, coordinates.astype(np.float32), material, np.float32(colour), np.int16(image), np.uint8(wrap), pictures
    )
