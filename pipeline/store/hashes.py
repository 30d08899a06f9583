"""Content hashes of local source files, remembered between runs."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from pipeline.store.files import (
    hash_file,
    write_json,
)


class HashCache:
    """Content hashes of local files, remembered by path, size, mtime and inode; the cache itself is no part of any key."""

    def __init__(self, path: Path):
        self._path = path
        try:
            self._known: dict[str, list[Any]] = json.loads(path.read_bytes())
        except (OSError, ValueError):
            self._known = {}
        self._changed = False

    def __call__(self, path: Path | str) -> str:
        path = Path(path).absolute()
        stat = path.stat()
        stamp = [stat.st_size, stat.st_mtime_ns, stat.st_ino]
        entry = self._known.get(str(path))
        if entry is None or entry[:3] != stamp:
            entry = [*stamp, hash_file(path)]
            self._known[str(path)] = entry
            self._changed = True
        return entry[3]

    def __enter__(self) -> HashCache:
        return self

    def __exit__(self, *error: object) -> None:
        self.save()

    def save(self) -> None:
        if self._changed:
            with contextlib.suppress(OSError):  # only a cache
                write_json(self._path, self._known)
