"""Hydra at the boundary: compose YAML and overrides into plain containers, and explain a bad override."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from pipeline.config import nearest
from pipeline.errors import UserError

CONF = Path(__file__).resolve().parents[1] / "conf"


def to_plain(config: DictConfig) -> dict[str, Any]:
    """The composed config as plain, resolved containers."""
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise UserError(f"{error.full_key} is needed: give {error.full_key}=VALUE") from None
    except OmegaConfBaseException as error:
        raise UserError(str(error).splitlines()[0]) from None
    assert isinstance(plain, dict)
    plain.pop("hydra", None)
    return plain


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """The config for ``overrides``; a UserError names what does not fit and the nearest right key or choice."""
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = hydra_compose("config", overrides=list(overrides))
            return to_plain(config)
    except HydraException as error:
        raise UserError(_explain(str(error), overrides)) from None


def _leaves(value: Any, path: str) -> list[str]:
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in [f"{path}{key}", *_leaves(item, f"{path}{key}.")]]
    return []


def _explain(message: str, overrides: Sequence[str]) -> str:
    first = message.splitlines()[0]
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            groups = [word for word in overrides if "=" in word and "." not in word.partition("=")[0]]
            good = []
            for word in groups:  # groups that exist decide which keys are known (collect=folder has a path)
                try:
                    hydra_compose("config", overrides=[*good, word])
                    good.append(word)
                except HydraException:
                    pass
            known = OmegaConf.to_container(hydra_compose("config", overrides=good), resolve=False)
    except HydraException:
        return first
    names = _leaves(known, "")
    for word in overrides:
        name, equals, _ = word.partition("=")
        bare = name.lstrip("+~")
        if not equals and not name.startswith("~"):
            return f"{word!r} is not an override: write name=value"
        if name == bare and bare not in names and not (CONF / bare).is_dir():
            return (
                f"{bare} is unknown{nearest(bare, names) if '.' in bare else nearest(bare, [n for n in names if '.' not in n])}"
            )
        if (CONF / bare).is_dir():
            choices = sorted(path.relative_to(CONF / bare).with_suffix("").as_posix() for path in (CONF / bare).rglob("*.yaml"))
            value = word.partition("=")[2]
            if value not in choices and "," not in value:
                return f"{bare}={value} is unknown{nearest(value, choices)}"
    return first
