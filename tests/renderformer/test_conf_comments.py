"""The settings files' comments: every alternative that one names (``# a | b: what for``) is accepted."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from pipeline.stage import load_system

CONF = Path(__file__).resolve().parents[2] / "conf"
SETTING = re.compile(r"(?P<indent> *)(?P<key>\w+):(?P<value>[^#]*)(?:#(?P<comment>.*))?$")
SYSTEMS = {name: load_system(name) for name in ("renderformer", "neuras")}


def alternatives(comment: str) -> list[str]:
    """The words on both sides of each bar, before what is said of them; [] where there is no bar."""
    named = re.sub(r"\([^)]*\)", "", comment).partition(":")[0]
    return [word.strip() for word in named.split("|")] if "|" in named else []


def settings(path: Path) -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """(keys from the file's root, alternatives in the comment) of every setting that has some."""
    above: list[tuple[int, str]] = []
    for line in path.read_text().splitlines():
        if match := SETTING.match(line):
            above = [entry for entry in above if entry[0] < len(match["indent"])] + [(len(match["indent"]), match["key"])]
            if words := alternatives(match["comment"] or ""):
                yield tuple(key for _, key in above), words


def models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in models(part)]


def fields(annotation: Any, keys: tuple[str, ...]) -> list[Any]:
    """The annotations of the field that the keys lead to, in every variant of a config that has it."""
    matching = [model.model_fields[keys[0]] for model in models(annotation) if keys[0] in model.model_fields]
    if len(keys) > 1:
        return [deeper for field in matching for deeper in fields(field.annotation, keys[1:])]
    return [field.annotation for field in matching]


def accepted(annotation: Any, word: str) -> bool:
    try:
        TypeAdapter(annotation).validate_python(word)
    except ValidationError:
        return False
    return True


CASES = [
    pytest.param(system, stage, keys, words, id=f"{path.relative_to(CONF)}:{'.'.join(keys)}")
    for name, system in SYSTEMS.items()
    for path in sorted((CONF / name).rglob("*.yaml"))
    for stage in [next((part for part in path.relative_to(CONF).parts if part in system.modules), None)]
    if stage is not None
    for keys, words in settings(path)
]


@pytest.mark.parametrize("system, stage, keys, words", CASES)
def test_what_a_comment_names_is_accepted(system, stage, keys, words):
    keys = keys[1:] if keys[0] == stage else keys  # a file of @package _global_
    matching = fields(system.stage(stage).Config, keys)
    assert matching, f"no field {'.'.join(keys)} in the config of {stage}"
    for word in words:
        assert any(accepted(field, word) for field in matching), f"{'.'.join(keys)}={word} is refused"


def test_comments_with_alternatives_are_found():
    assert {"variation", "backend", "split", "optimizer", "lpips"} <= {case.values[2][-1] for case in CASES}
    assert alternatives(" adamw | muon (2-D weights; AdamW for the rest)") == ["adamw", "muon"]
    assert alternatives(" none | vgg: LPIPS as well, a | b") == ["none", "vgg"] and not alternatives(" pixels")
