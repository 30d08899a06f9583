"""Paths that a stranger's file names: nothing outside its folder is ever read."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from pipeline.errors import Reject


def inside(path: Path, root: Path) -> bool:
    """Whether ``path``, with every link followed, lies in ``root``."""
    return path.resolve().is_relative_to(root.resolve())


def check_path(uri: str, folder: Path, root: Path) -> Path:
    """The file inside ``root`` that a reference means, or a Reject."""
    name = unquote(uri).replace("\\", "/")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name) or PurePosixPath(name).is_absolute() or "\0" in name:
        raise Reject("unsafe_path", f"refers to {uri[:80]!r}")
    target = folder / name
    if not inside(target, root):
        raise Reject("unsafe_path", f"refers to {uri[:80]!r}")
    return target
