"""What each numbered stage does, the records they exchange, and the ``lightmill`` command."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from pipeline.stage import System


def systems() -> Iterator[System]:
    """The project's systems: the packages of ``stages`` that supply one."""
    for module in pkgutil.iter_modules(__path__):
        if module.ispkg:
            system = getattr(importlib.import_module(f"stages.{module.name}"), "SYSTEM", None)
            if isinstance(system, System):
                yield system
