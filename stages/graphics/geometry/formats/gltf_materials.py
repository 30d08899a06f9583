"""Base colours of glTF materials and vertices.

A colour that cannot be had never costs the mesh: it leaves a note. Metals are taken with their base colour as well, since
there is one colour per surface. KHR_materials_pbrSpecularGlossiness goes before the core material, as it prescribes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import IMAGE_FORMATS, Look, Material, as_colour, side_bytes
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.gltf import Gltf, Primitive
from stages.graphics.geometry.formats.json_values import data_of, floats, integer, items, table
from stages.graphics.geometry.formats.parts import Source

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
OLDER = "KHR_materials_pbrSpecularGlossiness"


def read(gltf: Gltf, source: Source) -> list[tuple[Material, int]]:
    """Of each material its base colour, and the number of the texture coordinates that its image lies by."""
    materials = []
    try:
        entries = items(gltf.tree, "materials")
    except Reject as reject:
        source.note(reject.detail)
        return []
    for number, entry in enumerate(entries):
        material = Material(), 0
        try:
            with at(f"material {number}"):
                material = _material(gltf, entry, f"material {number}", source)
        except Reject as reject:
            source.note(reject.detail)
        materials.append(material)
    return materials


def look(primitive: Primitive, triangles: np.ndarray, materials: list[tuple[Material, int]], source: Source) -> Look:
    """The colours of a primitive's triangles."""
    look = Look()
    try:
        with at(primitive.place):
            if primitive.material is not None:
                if primitive.material >= len(materials):
                    raise Reject("unreadable", f"material {primitive.material} does not exist, the file has {len(materials)}")
                look.material, coordinates = materials[primitive.material]
                if look.material.image is not None:
                    look.uv = primitive.attribute(f"TEXCOORD_{coordinates}", 2)[triangles]
    except Reject as reject:
        source.note(reject.detail)
    try:
        with at(primitive.place):
            if primitive.has("COLOR_0"):
                look.tint = vertex_colours(primitive, source)[triangles]
    except Reject as reject:
        source.note(reject.detail)
    return look


def vertex_colours(primitive: Primitive, source: Source) -> np.ndarray:
    """(V, 3) linear colours."""
    values = primitive.attribute("COLOR_0", 3, 4)[:, :3]
    if values.dtype.kind == "i":  # an exporter that forgot to say so
        values = values / (255 if values.max(initial=0) < 256 else 65535)
        source.note(f"{primitive.place}: COLOR_0 has whole numbers that are not said to be normalised, taken as if they were")
    return as_colour(values, f"{primitive.place}: COLOR_0", source.note)


def _material(gltf: Gltf, entry: dict[str, Any], place: str, source: Source) -> tuple[Material, int]:
    base, name = optional(entry, "pbrMetallicRoughness"), "baseColor"
    older = optional(entry, "extensions").get(OLDER)
    if older is not None:
        base, name = table(optional(entry, "extensions"), OLDER), "diffuse"
    factor = floats(base, f"{name}Factor", 4, [1, 1, 1, 1])[:3]
    if older is not None and not factor.any() and "specularFactor" in base:  # a metal, as this model has them
        factor = floats(base, "specularFactor", 3)
    _say_left_out(entry, place, source)
    colour = tuple(as_colour(factor, f"{place}: {name}Factor", source.note).tolist())
    if f"{name}Texture" not in base:
        return Material(colour, stated=True), 0
    try:
        with at(place):
            return textured(gltf, table(base, f"{name}Texture"), colour, source)
    except Reject as reject:
        source.note(reject.detail)
        return Material(colour), 0


def _say_left_out(entry: dict[str, Any], place: str, source: Source) -> None:
    """What of a material a base colour cannot hold."""
    if entry.get("alphaMode", "OPAQUE") != "OPAQUE":
        source.note(f"{place}: it is see-through in places: it is opaque here")
    if floats(entry, "emissiveFactor", 3, [0, 0, 0]).any():
        source.note(f"{place}: it shines, and is drawn as a surface that does not")


def textured(gltf: Gltf, texture: dict[str, Any], colour: tuple, source: Source) -> tuple[Material, int]:
    """The material of a plain colour times an image."""
    number = integer(texture, "index")
    entry = one_of(gltf, "textures", number)
    webp = optional(optional(entry, "extensions"), "EXT_texture_webp")
    if "source" not in {**entry, **webp}:
        raise Reject("unsupported", f"texture {number}: no image in a format that is read")
    image = integer({**entry, **webp}, "source")
    pixels = source.images.get(image, lambda: _image_bytes(gltf, image, source))
    sampler = one_of(gltf, "samplers", integer(entry, "sampler")) if "sampler" in entry else {}
    wrap = tuple(WRAPS.get(sampler.get(name, 10497), "repeat") for name in ("wrapS", "wrapT"))
    moved = optional(optional(texture, "extensions"), "KHR_texture_transform")
    (angle,) = floats({"rotation": [moved.get("rotation", 0)]}, "rotation", 1)
    (x, y), (u, v) = floats(moved, "scale", 2, [1, 1]), floats(moved, "offset", 2, [0, 0])
    transform = np.array([[x * np.cos(angle), y * np.sin(angle), u], [-x * np.sin(angle), y * np.cos(angle), v]], float)
    coordinates = integer(moved, "texCoord", integer(texture, "texCoord", 0))
    return Material(colour, pixels, wrap, transform), coordinates


def _image_bytes(gltf: Gltf, number: int, source: Source) -> bytes:
    image = one_of(gltf, "images", number)
    if "bufferView" in image:
        return bytes(gltf.view(image["bufferView"]))
    uri = image.get("uri")
    if not isinstance(uri, str):
        raise Reject("unreadable", "it has neither a uri nor a buffer view")
    if uri.startswith("data:"):
        return data_of(uri)
    return side_bytes(uri, source.folder, source.root, IMAGE_FORMATS, source.max_bytes)


def one_of(gltf: Gltf, kind: str, number: int) -> dict[str, Any]:
    """The table of that number in a list of the tree whose entries are not checked when a file is opened."""
    entries = items(gltf.tree, kind)
    if number >= len(entries):
        raise Reject("unreadable", f"{kind[:-1]} {number} does not exist, the file has {len(entries)}")
    return entries[number]


def optional(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """A table in a table; an empty one where there is none."""
    return table(entry, key) if key in entry else {}
