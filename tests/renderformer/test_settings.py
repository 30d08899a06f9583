"""Each setting is said once: a variant repeats nothing that it inherits, and YAML and class give the same default."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from pipeline.hydra_config import compose, config_folder, system_of
from pipeline.stage import load_system

CONF = config_folder(system_of([]))
SYSTEM = load_system("renderformer")
DEFAULTS = ("remesh", "decimate", "scene", "render", "shard", "train", "evaluate")  # groups whose first variant is the class's
FILES = [path.relative_to(CONF).with_suffix("").as_posix() for path in sorted(CONF.glob("*/**/*.yaml"))]
VARIANTS = [name for name in FILES if "/common/" not in name]


def read(name: str) -> tuple[list[Any], dict[str, Any]]:
    """The defaults list of a variant without ``_self_``, and its own values."""
    own = yaml.safe_load((CONF / f"{name}.yaml").read_text()) or {}
    return [entry for entry in own.pop("defaults", []) if entry != "_self_"], own


def merge(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    both = {name: merge(under[name], over[name]) for name in over if isinstance(under.get(name), dict)}
    return under | over | both


def values_of(name: str) -> dict[str, Any]:
    parents, own = read(name)
    return merge(inherited(name, parents), own)


def inherited(name: str, parents: list[Any]) -> dict[str, Any]:
    """What a variant has from others. An experiment has it from the groups that it chooses: of the whole config."""
    if name.startswith("experiment/"):
        words = [f"experiment={entry.removeprefix('/experiment/')}" for entry in parents if isinstance(entry, str)]
        chosen = [pair for entry in parents if isinstance(entry, dict) for pair in entry.items()]
        words += [f"{key.removeprefix('override /')}={value}" for key, value in chosen]
        return compose(words)
    values: dict[str, Any] = {}
    for parent in parents:
        values = merge(values, values_of(f"{Path(name).parent.as_posix()}/{parent.removesuffix('@_here_')}"))
    return values


def repeated(own: dict[str, Any], base: dict[str, Any], path: str = "") -> list[str]:
    names = []
    for name, value in own.items():
        if name in base and isinstance(value, dict) and isinstance(base[name], dict):
            names += repeated(value, base[name], f"{path}{name}.")
        elif name in base and value == base[name]:
            names.append(f"{path}{name}")
    return names


@pytest.mark.parametrize("name", FILES)
def test_a_variant_repeats_no_value_that_it_inherits(name):
    parents, own = read(name)
    assert repeated(own, inherited(name, parents)) == []


def different(model: BaseModel, section: dict[str, Any], path: str) -> list[str]:
    names = []
    for name, value in section.items():
        default = getattr(model, name)
        if isinstance(default, BaseModel):
            names += different(default, value, f"{path}.{name}")
        elif (list(default) if isinstance(default, tuple) else default) != value:
            names.append(f"{path}.{name}")
    return names


def config_class(stage: str) -> type[BaseModel]:
    from stages.renderformer.s03_scene import SceneConfig
    from stages.renderformer.s06_train import TrainConfig

    return {"scene": SceneConfig, "train": TrainConfig}.get(stage) or SYSTEM.stage(stage).Config


@pytest.mark.parametrize("stage", DEFAULTS)
def test_default_of_the_class_is_that_of_the_command_line(stage):
    """Both are stated: Hydra knows a word only if the YAML names it, and code makes configs without any YAML."""
    section = {name: value for name, value in compose([])[stage].items() if name not in ("limits", "model")}
    assert different(config_class(stage)(), section, stage) == []


@pytest.mark.parametrize("name", [name for name in VARIANTS if name.partition("/")[0] in ("collect", "probe")])
def test_defaults_of_sources_and_probes_are_those_of_the_command_line(name):
    group, _, variant = name.partition("/")
    kinds = SYSTEM.stage(group).Config.__args__[0].__args__
    kind = next(kind for kind in kinds if kind.model_fields["name"].default == variant)
    section = {key: value for key, value in compose([f"{group}={variant}"])[group].items() if key != "limits"}
    assert different(kind(), section, group) == []


def test_default_network_of_the_class_is_the_full_model():
    from stages.renderformer.s06_train import ModelSection

    assert different(ModelSection(name="base"), compose(["model=base"])["model"], "model") == []
