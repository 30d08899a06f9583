"""Captures that are images and nothing else: a folder of photos, or a video, registered by pycolmap.

``prepare`` cuts the video and makes a model of COLMAP of the images, in a process of its own. Seeds are fixed and the mapper
has one thread, so a second run finds the same poses, in eight runs of nine to the last digit. A photo that could not be placed
is rejected.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.Image import Transpose

from pipeline.atomic import atomic_path
from pipeline.errors import Reject, UserError
from stages.graphics.geometry.paths import inside
from stages.graphics.video import frame_count, read_video
from stages.neuras.captures import colmap, registration
from stages.neuras.captures.pictures import opened, size_of
from stages.neuras.captures.sources import FEWEST, MASKS, Inventory, PointSet, Shot, file_in, mask_of, notes_on_masks, shot_of
from stages.neuras.records import natural

PHOTOS = (".jpg", ".jpeg", ".png")
OTHERS = (".heic", ".heif", ".avif", ".webp", ".tif", ".tiff", ".bmp", ".dng")  # photos too, but not read
VIDEOS = (".mp4", ".mov", ".m4v")
CUT, MODEL, JOB = "images", "sparse/0", "job.json"  # below the prepared folder
UPRIGHT, HIDDEN = "upright", "hidden"  # as well: what pycolmap reads where photos lie on their side, and masks as it names them
ORIENTATION = 0x0112  # EXIF: how a photo is stored; 1 is upright
TURNS = dict(
    zip(range(2, 9), (
        Transpose.FLIP_LEFT_RIGHT, Transpose.ROTATE_180, Transpose.FLIP_TOP_BOTTOM, Transpose.TRANSPOSE, Transpose.ROTATE_270,
        Transpose.TRANSVERSE, Transpose.ROTATE_90,
    ), strict=True)
)  # fmt: skip
QUALITY = 95  # of the JPEGs that are made here
LONGEST_S = 24 * 3600  # of registration


def root_of(path: str | None) -> Path:
    """The folder of photos, or the video, that ``capture.path`` names."""
    root = Path(path).expanduser() if path else None
    if root is None or not (root.is_dir() or (root.is_file() and root.suffix.lower() in VIDEOS)):
        raise UserError(f"capture.path={path!r}: capture=images needs a folder of photos or a video ({', '.join(VIDEOS)})")
    return root


def read(config: Any, root: Path, prepared: Path | None = None) -> Inventory:
    """The inventory of the images, with their poses if ``prepared`` is the folder that ``prepare`` wrote to."""
    names = _names(config, root)
    folder = None if prepared is None else prepared / MODEL
    placed = {} if folder is None else {image.name: image for image in colmap.images(folder)}
    lenses = {} if folder is None else colmap.cameras(folder)

    def fill(shot: Shot) -> None:
        if root.is_file():
            shot.image = None if prepared is None else file_in(prepared, shot.name, "image")
        else:
            shot.image, shot.mask = file_in(root, shot.name, "image"), mask_of(root, shot.name)
            if (orientation := _orientation(shot.image)) != 1:
                shot.meta["orientation"] = orientation
                if prepared is not None:
                    if not (prepared / UPRIGHT / shot.name).is_file():
                        opened(shot.image, config.max_pixels, "image")  # says why there is no turned copy
                    shot.image = file_in(prepared / UPRIGHT, shot.name, "image")
        if folder is not None:
            if shot.name not in placed:
                size_of(shot.image, config.max_pixels)  # why pycolmap was not asked, if it was not
                raise Reject("no_pose", "pycolmap could not place it among the others: blurred, or without overlap")
            image = placed[shot.name]
            shot.lens, shot.camera_to_world = lenses[image.camera], colmap.camera_to_world(image)

    shots = [shot_of(name, fill) for name in names]
    for shot in shots:
        shot.moment = shot.name
    points = PointSet("sfm", None, lambda: (colmap.points(folder, config.max_bytes)[1], None))
    files = [root] if root.is_file() else [root / name for name in names]
    files += [shot.mask for shot in shots if shot.mask is not None]
    facts = {
        "masked": [shot.name for shot in shots if shot.mask is not None],
        "turned": [[shot.name, shot.meta["orientation"]] for shot in shots if shot.meta],
    }
    facts = {name: value for name, value in facts.items() if value}  # none where photos are all that there is
    notes = [] if root.is_file() else [*_left_out(root), *notes_on_masks(root, shots)]
    return Inventory(shots, [points], "sfm", units_from="images alone have no unit", decided_by=files, facts=facts, notes=notes)


def prepare(config: Any, root: Path, folder: Path) -> None:
    """Write the model of COLMAP, and a video's frames, below ``folder``; what is there already stays."""
    if (folder / MODEL / "points3D.bin").is_file():
        return
    if not can_register():
        raise UserError(
            "capture=images needs pycolmap: pip install 'lightmill[images]'; "
            "or register the images with any program that writes a model of COLMAP, and use capture=colmap"
        )
    names = _names(config, root)
    if root.is_file():
        _cut(root, folder, names)
    images = folder if root.is_file() else _upright(root, folder, names, config.max_pixels)
    sizes = {}
    for name in names:
        with contextlib.suppress(Reject):  # told when the frame is asked for
            sizes[name] = size_of(images / name, config.max_pixels)
    if len(sizes) < FEWEST:
        raise UserError(
            f"of {len(names)} images {len(sizes)} can be read and have at most capture.max_pixels={config.max_pixels} pixels; "
            f"{FEWEST} are needed"
        )
    job = {
        "images": str(images.resolve()),
        "names": list(sizes),
        "one_camera": len(set(sizes.values())) == 1,
        "sequential": root.is_file(),
        "side": config.sfm_side,
        "folder": str(folder.resolve()),
        "masks": None if root.is_file() else _masks(root, folder, sizes),
    }
    (folder / JOB).write_text(json.dumps(job))
    command = [sys.executable, "-P", registration.__file__, str(folder / JOB)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        raise UserError(
            f"pycolmap did not end within {LONGEST_S // 3600} hours: take fewer images, or register them on a faster machine "
            "and use capture=colmap"
        ) from None
    if done.returncode:
        last = (done.stderr.strip() or "no word").splitlines()[-1][:200]
        raise UserError(f"pycolmap ended with status {done.returncode}: {last}; capture=colmap takes a model made elsewhere")
    placed = len(colmap.images(folder / MODEL)) if (folder / MODEL / "images.bin").is_file() else 0
    if placed < max(FEWEST, len(names) // 4):
        raise UserError(
            f"pycolmap could place {placed} of {len(names)} images: take more of them, sharp, from positions that differ, "
            "each place in at least three; bare walls, water and moving crowds give nothing to hold on to"
        )


def can_register() -> bool:
    return importlib.util.find_spec("pycolmap") is not None


def _names(config: Any, root: Path) -> list[str]:
    """The images' names, relative to the folder; of a video, those that its frames will have."""
    if root.is_file():
        return [f"{CUT}/frame_{number:04d}.jpg" for number in range(min(config.video_frames, frame_count(root)))]
    found = [path for path in root.rglob("*") if path.suffix.lower() in PHOTOS and path.is_file()]
    names = [path.relative_to(root).as_posix() for path in found if inside(path, root)]
    names = [name for name in names if not any(part.startswith(".") for part in name.split("/"))]  # such as macOS's ._IMG.jpg
    names = sorted((name for name in names if not name.startswith(f"{MASKS}/")), key=natural)
    if len(names) < FEWEST:
        told = "".join(f"; {note}" for note in _left_out(root))
        raise UserError(
            f"capture.path={str(root)!r} holds {len(names)} photos ({', '.join(PHOTOS)}), at least {FEWEST} are needed{told}"
        )
    return names


def _left_out(root: Path) -> list[str]:
    """A sentence about photos of kinds that are not read, if there are any."""
    kinds = Counter(path.suffix.lower() for path in root.rglob("*") if path.suffix.lower() in OTHERS)
    if not kinds:
        return []
    counted = ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items()))
    return [f"photos of other kinds were left out ({counted}): save them as JPEG or PNG"]


def _orientation(path: Path) -> int:
    """As EXIF states it: 1 for a photo that is stored upright, or says nothing."""
    try:
        with Image.open(path) as image:
            found = image.getexif().get(ORIENTATION, 1)
    except Exception:  # decoders of strangers' files fail in every way; the frame's fault is told when it is asked for
        return 1
    return found if found in TURNS else 1


def _upright(root: Path, folder: Path, names: list[str], max_pixels: int) -> Path:
    """The folder with the photos as they were held. Phones store upright ones on their side, as pycolmap would take them."""
    turned = {name: orientation for name in names if (orientation := _orientation(root / name)) != 1}
    if not turned:
        return root
    for name in names:
        path = _vacated(folder / UPRIGHT / name)
        if name not in turned:
            path.symlink_to((root / name).resolve())
            continue
        with contextlib.suppress(Reject):  # told when the frame is asked for
            _save_turned(opened(root / name, max_pixels, "image"), turned[name], path)
    return folder / UPRIGHT


def _save_turned(photo: Image.Image, orientation: int, path: Path) -> None:
    """The photo with its pixels as it was held, and its EXIF, which knows the focal length."""
    picture = photo.transpose(TURNS[orientation])
    kind, options = ("PNG", {}) if photo.format == "PNG" else ("JPEG", {"quality": QUALITY, "subsampling": 0})
    if kind == "JPEG" and picture.mode not in ("L", "RGB", "CMYK"):
        picture = picture.convert("RGB")
    try:
        exif = photo.getexif()
        exif[ORIENTATION] = 1
        known = exif.tobytes()
    except Exception:  # encoders of strangers' EXIF fail in every way
        known = b""
    with atomic_path(path) as temporary:
        picture.save(temporary, kind, exif=known, **options)


def _masks(root: Path, folder: Path, sizes: Mapping[str, tuple[int, int]]) -> str | None:
    """The folder of the photos' masks as pycolmap wants them: one for every photo. None where there are none. sizes: of the
    photos, (width, height).
    """
    found: dict[str, Path] = {}
    for name in sizes:
        with contextlib.suppress(Reject):  # told when the frame is asked for
            if (mask := mask_of(root, name)) is not None:
                found[name] = mask
    for name, size in sizes.items() if found else ():
        path = _vacated(folder / HIDDEN / f"{name}.png")
        if name in found:
            path.symlink_to(found[name].resolve())
        else:
            Image.new("L", size, 255).save(path)
    return str((folder / HIDDEN).resolve()) if found else None


def _vacated(path: Path) -> Path:
    """The path, its folder made, and without what an earlier try left there: a link may point at a photo."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    return path


def _cut(video: Path, folder: Path, names: list[str]) -> None:
    """Of as many equal stretches of the video as there are names, the sharpest frame."""
    (folder / CUT).mkdir(exist_ok=True)
    total = frame_count(video)
    best: tuple[float, np.ndarray] | None = None
    index = 0
    for number, frame in enumerate(read_video(video)):
        stretch = min(number * len(names) // total, len(names) - 1)
        if stretch != index:
            _save(best, folder / names[index])
            best, index = None, stretch
        sharpness = _sharpness(frame)
        if best is None or sharpness > best[0]:
            best = sharpness, frame
    _save(best, folder / names[index])


def _save(best: tuple[float, np.ndarray] | None, path: Path) -> None:
    if best is not None:
        with atomic_path(path) as temporary:
            Image.fromarray(best[1]).save(temporary, "JPEG", quality=QUALITY, subsampling=0)


def _sharpness(frame: np.ndarray) -> float:
    """The mean square of differences between neighbours: the least blurred of like frames has most."""
    green = frame[::2, ::2, 1].astype(np.float32)
    return float(np.square(np.diff(green, axis=0)).mean() + np.square(np.diff(green, axis=1)).mean())
