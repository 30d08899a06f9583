"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def replace(temporary: Path, final: Path) -> None:
    """Flush a finished temporary file to disk and give it its name."""
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    os.replace(temporary, final)
