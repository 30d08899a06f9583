"""Files that appear whole or not at all. This module knows nothing of the engine, so every room may import it."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY = ".*.tmp*"  # matches the names that a killed writer leaves behind


def sync(path: Path) -> None:
    """Make the bytes of a file, or the renames and new names in a folder, survive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def publish(temporary: Path, path: Path) -> None:
    """Flush a finished temporary file of the same folder to disk, and rename it to ``path``."""
    sync(temporary)
    os.replace(temporary, path)
    sync(path.parent)


@contextmanager
def atomic_path(path: Path, durable: bool = True) -> Iterator[Path]:
    """A hidden path beside ``path`` with the same suffix, for the body to write a file to.

    The file becomes ``path`` when the body ends, so readers see all of it or none. An exception removes it. ``durable`` flushes
    it to disk first. Without that, a power cut may lose it.
    """
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.tmp{path.suffix}")
    try:
        yield temporary
        if durable:
            publish(temporary, path)
        else:
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomic(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Write ``data``, whole or in pieces, by ``atomic_path``. Missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines([data] if isinstance(data, bytes) else data)
