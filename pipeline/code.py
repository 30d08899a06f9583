"""What code made an artifact: a digest of the stage's syntax tree and of the project modules it imports, and the commit.

Code is not in a key: a stage's ``version`` is. The digest catches the author who changed the output and forgot the version
(tests/renderformer/versions.json holds the pairs). Comments, docstrings and formatting change nothing.
"""

from __future__ import annotations

import ast
import subprocess
from functools import cache
from pathlib import Path

from pipeline.keys import blake
from pipeline.stage import System

ROOT = Path(__file__).resolve().parents[1]
ENGINE = "pipeline"  # the engine decides where and when a stage runs, never what comes out


def _module_file(name: str) -> Path | None:
    base = ROOT.joinpath(*name.split("."))
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


@cache
def _tree(path: Path) -> ast.Module:
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list) or not body:
            continue
        first = body[0]
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
            body.pop(0)
    return tree


def imported_modules(name: str) -> set[str]:
    """Project modules (not the engine's) that ``name`` imports anywhere in it, functions included, and theirs in turn."""
    found: set[str] = set()
    todo = [name]
    while todo:
        module = todo.pop()
        path = _module_file(module)
        if path is None or module in found or module.split(".")[0] == ENGINE:
            continue
        found.add(module)
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.Import):
                todo += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
                    package = package[: len(package) - node.level + 1]
                    base = ".".join([*package, base]) if base else ".".join(package)
                todo += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return found


def code_digest(system: System, stage: str) -> str:
    """Hex digest of the syntax trees behind a stage."""
    parts = []
    for imported in sorted(imported_modules(system.modules[stage].partition(":")[0])):
        path = _module_file(imported)
        assert path is not None
        parts.append(imported + "\n" + ast.dump(_tree(path)))
    return blake("\n".join(parts).encode())


@cache
def commit() -> dict[str, str | bool | None]:
    """The checkout's commit and whether it has changes; None where this is no checkout."""

    def git(*arguments: str) -> str | None:
        try:
            result = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, timeout=20)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return result.stdout.strip() if result.returncode == 0 else None

    status = git("status", "--porcelain")
    return {"commit": git("rev-parse", "HEAD"), "dirty": None if status is None else bool(status)}
