"""MTL: the material libraries of OBJ files, as far as they say what colour a surface is.

``Kd`` is taken as linear. It counts only where there is no image, as exporters leave anything in it beside one.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.colours import IMAGE_FORMATS, Material, as_colour, side_bytes
from stages.graphics.geometry.formats.parts import Source
from stages.graphics.geometry.formats.text import floats, plain_text, shown

SUFFIX = ".mtl"
# Options of map_Kd and how many words follow each at most; -o, -s and -t take one to three numbers.
OPTIONS = {
    b"-blendu": 1, b"-blendv": 1, b"-bm": 1, b"-boost": 1, b"-cc": 1, b"-clamp": 1, b"-imfchan": 1, b"-mm": 2, b"-o": 3,
    b"-s": 3, b"-t": 3, b"-texres": 1, b"-type": 1,
}  # fmt: skip


@dataclass
class Entry:
    """What a library states of a material: ``Kd`` as written, the file of ``map_Kd`` and how it lies."""

    colour: list[bytes] | None = None
    image: str = ""
    wrap: str = "repeat"
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def parse(data: bytes) -> dict[str, Entry]:
    """The materials of a library by name."""
    materials: dict[str, Entry] = {}
    current = Entry()
    for line in plain_text(data).split(b"\n"):
        key, _, value = line.strip().partition(b" ") if b"\t" not in line else line.strip().replace(b"\t", b" ").partition(b" ")
        key, value = key.lower(), value.strip()
        if key == b"newmtl":
            current = materials.setdefault(material_name(value), Entry())
        elif key == b"kd":
            current.colour = value.split(b"#")[0].split()
        elif key == b"map_kd":
            _read_map(current, value)
    return materials


def material_name(value: bytes) -> str:
    """A name as ``newmtl`` and ``usemtl`` have it; it may hold spaces."""
    return " ".join(value.decode("utf-8", "replace").split())


def _read_map(entry: Entry, value: bytes) -> None:
    """Options, then the name of a file, which may hold spaces."""
    while (head := value.split(None, 1)) and len(head) == 2 and head[0].lower() in OPTIONS:
        option, value = head[0].lower(), head[1]
        taken: list[bytes] = []
        while len(taken) < OPTIONS[option] and len(word := value.split(None, 1)) == 2:
            if option in (b"-o", b"-s", b"-t") and floats(word[:1])[0] is not None:
                break
            taken.append(word[0])
            value = word[1]
        if option == b"-clamp":
            entry.wrap = "clamp" if taken == [b"on"] else "repeat"
        elif option in (b"-o", b"-s") and taken:
            default = 0.0 if option == b"-o" else 1.0
            u, v = [*map(float, floats(taken)[1]), default][:2]
            if option == b"-o":
                entry.offset = u, v
            else:
                entry.scale = u, v
    entry.image = value.decode("utf-8", "replace").strip().strip('"')


def library_files(names: list[str], source: Source) -> list[str]:
    """The files that ``mtllib`` lines name: each line is one name with spaces, or several names."""
    files = []
    for name in names:
        one = name if (source.folder / name.replace("\\", "/")).is_file() or " " not in name else None
        several = re.findall(rf"\S+?{re.escape(SUFFIX)}(?=\s|\Z)", name, re.IGNORECASE)
        files += [one] if one or len(several) < 2 else several
    return [name or "" for name in files]


def read(names: list[str], source: Source) -> dict[str, Material]:
    """Base colours by material name, of the libraries that an OBJ names; what cannot be had leaves a note."""
    materials: dict[str, Material] = {}
    for name in library_files(names, source):
        try:
            library = parse(side_bytes(name, source.folder, source.root, (SUFFIX,), source.max_bytes))
        except Reject as reject:
            source.note(f"library {name[:80]}: {reject.detail[:160]}")
            continue
        except UnicodeDecodeError:
            source.note(f"library {name[:80]}: it is not text")
            continue
        for key, entry in library.items():
            materials.setdefault(key, _material(key, entry, source))
    return materials


def _material(name: str, entry: Entry, source: Source) -> Material:
    (x, y), (u, v) = entry.scale, entry.offset
    # rows of (u, v, 1), whose v runs up, to coordinates whose v runs down
    transform = np.array([[x, 0, u], [0, -y, 1 - v]])
    if entry.image:
        pixels = source.images.get(
            entry.image,
            lambda: side_bytes(entry.image, source.folder, source.root, IMAGE_FORMATS, source.max_bytes),
        )
        if pixels is not None:
            return Material((1.0, 1.0, 1.0), pixels, (entry.wrap, entry.wrap), transform)
    colour = _colour(name, entry, source)
    return Material(colour or (1.0, 1.0, 1.0), transform=transform, stated=colour is not None and not entry.image)


def _colour(name: str, entry: Entry, source: Source) -> tuple[float, float, float] | None:
    if entry.colour is None:
        return None
    fault, values = floats(entry.colour[:3])
    if fault is not None or not len(values) or any(math.isnan(value) for value in values):
        source.note(f"material {name[:80]}: Kd {shown(b' '.join(entry.colour))} is not three numbers")
        return None
    values = np.resize(values, 3) if len(values) == 1 else values  # one number stands for all three
    if len(values) != 3:
        source.note(f"material {name[:80]}: Kd {shown(b' '.join(entry.colour))} is not three numbers")
        return None
    return tuple(as_colour(values, f"material {name[:80]}: Kd", source.note).tolist())
