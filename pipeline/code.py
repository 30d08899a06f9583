"""What code made an artifact: a digest of the stage's syntax tree and of the project modules it imports, and the commit.

Code is not in a key: a stage's ``version`` is. The digest catches the author who changed the output and forgot the version
(tests/versions.json holds the pairs). Comments, docstrings and formatting change nothing.
"""

from __future__ import annotations

import ast
import importlib.util
import subprocess
from functools import cache
from pathlib import Path

from pipeline.keys import blake
from pipeline.stage import System

ROOT = Path(__file__).resolve().parents[1]
ENGINE = "pipeline"  # the engine decides where and when a stage runs, never what comes out; but for one function:
SEEDS = "pipeline.keys.seed_for"


def _module_file(name: str, roots: tuple[Path, ...] = (ROOT,)) -> Path | None:
    """The file of a module below one of the folders; None for modules of libraries."""
    for root in roots:
        base = root.joinpath(*name.split("."))
        for path in (base.with_suffix(".py"), base / "__init__.py"):
            if path.is_file():
                return path
    return None


def _roots(module: str) -> tuple[Path, ...]:
    """The project, and the folder that the module is imported from, which may lie elsewhere."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return (ROOT,)
    depth = module.count(".") + (Path(spec.origin).name == "__init__.py")
    return (ROOT, Path(spec.origin).resolve().parents[depth])


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


def imported_modules(name: str, roots: tuple[Path, ...] = (ROOT,)) -> set[str]:
    """Project modules (not the engine's) that ``name`` imports anywhere in it, functions included, and theirs in turn."""
    modules: set[str] = set()
    todo = [name]
    while todo:
        module = todo.pop()
        path = _module_file(module, roots)
        if path is None or module in modules or module.split(".")[0] == ENGINE:
            continue
        modules.add(module)
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
    return modules


def code_digest(system: System, stage: str) -> str:
    """Hex digest of the syntax trees behind a stage: its project modules, and what seeds every random number."""
    module = system.modules[stage].partition(":")[0]
    roots = _roots(module)
    parts = [SEEDS + "\n" + ast.dump(_function(ROOT.joinpath(*SEEDS.split(".")[:-1]).with_suffix(".py"), SEEDS.split(".")[-1]))]
    for imported in sorted(imported_modules(module, roots)):
        path = _module_file(imported, roots)
        assert path is not None
        parts.append(imported + "\n" + ast.dump(_tree(path)))
    return blake("\n".join(parts).encode())


def _function(path: Path, name: str) -> ast.AST:
    """The function's syntax tree."""
    return next(node for node in _tree(path).body if isinstance(node, ast.FunctionDef) and node.name == name)


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
