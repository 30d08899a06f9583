"""From Hydra's composed YAML to frozen, typed configs: one conversion, at the boundary.

Every stage has a ``StageConfig`` right above the code that it configures. Unknown keys are errors that name the nearest
right one; ``runtime`` fields (workers, devices, logging) stay out of keys.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from pipeline.errors import UserError


def runtime(default: Any = ..., **kwargs: Any) -> Any:
    """A field that changes how a stage runs, not what it makes; left out of the key."""
    return Field(default, json_schema_extra={"runtime": True}, **kwargs)


def added(default: Any, legacy: Any, **kwargs: Any) -> Any:
    """A field that came later: left out of the key while it equals ``legacy``, the value that older artifacts imply."""
    return Field(default, json_schema_extra={"legacy": legacy}, **kwargs)


def count(default: Any = ..., **kwargs: Any) -> Any:
    """A field that says only *how many* items there are: part of the artifact's key, not of an item's."""
    return Field(default, json_schema_extra={"count": True}, **kwargs)


def report(default: Any = ..., **kwargs: Any) -> Any:
    """A field that decides only files which ``finish`` makes: a change makes those anew, and takes every item over.

    ``legacy``, where given, is that of `added`.
    """
    extra = {"report": True, **({"legacy": kwargs.pop("legacy")} if "legacy" in kwargs else {})}
    return Field(default, json_schema_extra=extra, **kwargs)


class Section(BaseModel):
    """Base of every config model: frozen, no unknown fields, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, protected_namespaces=())


class Limits(Section):
    """What one item may use before its worker is killed and the item, after one retry alone, rejected."""

    cpu_s: float = 600.0  # CPU seconds
    wall_s: float = 1800.0  # seconds on the clock, for what hangs without computing
    memory_gb: float = 8.0  # resident memory of the worker

    def exceed(self, reject: Mapping[str, Any]) -> bool:
        """Whether one of these is higher than the limit that the rejected item ran into, if it did."""
        return any(getattr(self, name) > limit for name, limit in reject.get("limit", {}).items())


class StageLimits(Section):
    """``Limits`` as a config gives them; None: the stage's own."""

    cpu_s: float | None = Field(None, gt=0)
    wall_s: float | None = Field(None, gt=0)
    memory_gb: float | None = Field(None, gt=0)


class StageConfig(Section):
    """Base of every stage's config."""

    workers: int | None = runtime(None, ge=1)  # worker processes of this stage; None: the run's
    limits: StageLimits = runtime(StageLimits())  # of one item
    max_reject_share: float = runtime(0.5, ge=0, le=1)  # above this share of rejected items the stage fails


def nearest(word: str, choices: Any) -> str:
    """', did you mean X?' for the nearest known word, else the list of known ones."""
    choices = sorted(choices)
    close = difflib.get_close_matches(word, choices, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known are {', '.join(choices)}" if choices else ""


def _fields(kind: Any, data: Any) -> set[str]:
    """Field names of the model class that ``data`` selects from ``kind`` (a model or an annotated union)."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return set(kind.model_fields)
    names: set[str] = set()
    for argument in getattr(kind, "__args__", ()):
        if isinstance(argument, type) and issubclass(argument, BaseModel):
            chosen = argument.model_fields.get("name")
            if not isinstance(data, dict) or chosen is None or chosen.default == data.get("name"):
                names |= set(argument.model_fields)
        else:
            names |= _fields(argument, data)
    return names


def _as_written(problem: Mapping[str, Any], data: Any) -> list[str]:
    """Where in ``data`` the problem is, without the names of unions' branches, which pydantic puts in between."""
    location = []
    for place, part in enumerate(problem["loc"], 1):
        lacking = problem["type"] == "missing" and place == len(problem["loc"])
        if isinstance(data, Mapping) and part not in data and not lacking:
            continue
        location.append(str(part))
        data = data[part] if isinstance(data, (Mapping, list, tuple)) and not lacking else None
    return location


def parse(kind: Any, data: Any, where: str) -> Any:
    """``data`` (plain containers) as a frozen ``kind``; a UserError names what is wrong and the nearest right key."""
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        lines = []
        for problem in error.errors():
            location = _as_written(problem, data)
            path = ".".join([where, *location])
            if problem["type"] == "extra_forbidden":
                lines.append(f"{path} is unknown{nearest(location[-1], _fields(kind, data))}")
            elif problem["type"] == "missing":
                lines.append(f"{path} is needed")
            else:
                value = "" if isinstance(problem.get("input"), dict) else f"={problem.get('input')!r}"  # what names itself
                reason = problem["msg"].removeprefix("Value error, ")
                jobs = "; for a job of each value add -m" if isinstance(problem.get("input"), list) else ""
                lines.append(f"{path}{value}: {reason}{jobs}")
        raise UserError("; ".join(lines)) from None


def existing_folder(setting: str, path: str | None, needed: str) -> Path:
    """The folder that the setting names; ``needed`` says what needs it, for the error where there is none."""
    if path is None:
        raise UserError(f"{needed}: {setting}=DIR")
    root = Path(path).expanduser()
    if not root.is_dir():
        raise UserError(f"{setting}={path!r} is not a folder")
    return root
