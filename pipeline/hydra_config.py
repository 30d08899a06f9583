"""Hydra at the boundary: compose YAML and overrides into plain containers, and explain a bad override.

The word ``system=NAME`` is read before Hydra composes: it chooses the folder whose ``config.yaml`` is composed. Groups that all
systems share (``executor``, ``hydra/launcher``) and ``engine.yaml`` are found beside the systems' folders, in ``CONF``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ValueType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from pipeline.config import nearest
from pipeline.errors import UserError
from pipeline.stage import System, load_system

HERE = Path(__file__).resolve().parent
CONF = HERE / "conf" if (HERE / "conf").is_dir() else HERE.parent / "conf"  # of an installed package, of a checkout
DEFAULT_SYSTEM = "renderformer"
SYSTEM_WORD = "system="


def system_of(overrides: Sequence[str]) -> System:
    """The system that the last ``system=NAME`` of the overrides names, or the default one."""
    names = [word.removeprefix(SYSTEM_WORD) for word in overrides if word.startswith(SYSTEM_WORD)]
    return load_system(names[-1] if names else DEFAULT_SYSTEM)


def config_folder(system: System) -> Path:
    """The folder of the system's ``config.yaml``: ``conf/NAME``, or the folder ``conf`` beside its module."""
    for folder in (CONF / system.name, system.folder / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UserError(
        f"system={system.name} has no config.yaml: put one in conf/{system.name}, or in the folder conf beside its module"
    )


@contextmanager
def initialized(system: System) -> Iterator[list[str]]:
    """Hydra, set to the system's folder; gives the words that a composition needs besides its own overrides."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(config_folder(system)), version_base="1.3"):
        yield [f"hydra.searchpath=[file://{CONF}]"]


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


def parse_overrides(words: Sequence[str]) -> list[Any]:
    """The words as Hydra's overrides. A UserError names the word with a mistake, and the place in it."""
    parser = OverridesParser.create()
    overrides = []
    for word in words:
        try:
            overrides.append(parser.parse_override(word))
        except HydraException as error:
            raise UserError(_syntax_error(word, error)) from None
    return overrides


def _as_list(override: Any) -> str:
    """The override's word, with values between commas in brackets. A group has no list: Hydra refuses those."""
    name, equals, value = override.input_line.partition("=")
    several = override.is_choice_sweep() and override.value_type is ValueType.SIMPLE_CHOICE_SWEEP and "." in name
    return f"{name}{equals}[{value}]" if several else override.input_line


def _syntax_error(word: str, error: HydraException) -> str:
    name, equals, _ = word.partition("=")
    if not equals and not name.startswith("~"):
        return f"{word!r} is not an override: write name=value"
    reason = str(error).splitlines()[0]
    for opening, closing in ("[]", "{}", "()"):
        if word.count(opening) != word.count(closing):
            return f"{word!r} is not an override: {opening!r} and {closing!r} do not pair ({reason})"
    if word.rstrip().endswith(","):
        return f"{word!r} is not an override: nothing follows the comma at its end"
    return f"{word!r} is not an override: {reason}"


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """The config for ``overrides``; a UserError names what does not fit and the nearest right key or choice.

    Several values (``name=a,b``) are a list here. In a sweep they have become jobs of one value each before.
    """
    overrides = [_as_list(override) for override in parse_overrides(overrides)]
    system = system_of(overrides)
    with initialized(system) as more:
        try:
            return to_plain(hydra_compose("config", overrides=[*overrides, *more]))
        except HydraException as error:
            raise UserError(_explain(str(error), overrides, system, more)) from None


def _leaves(value: Any, path: str) -> list[str]:
    if isinstance(value, dict):
        return [leaf for key, item in value.items() for leaf in [f"{path}{key}", *_leaves(item, f"{path}{key}.")]]
    return []


def _explain(message: str, overrides: Sequence[str], system: System, more: Sequence[str]) -> str:
    """What is wrong with the first override that does not fit; ``message`` is Hydra's own."""
    first = message.splitlines()[0]
    if first.startswith("Ambiguous value"):
        return f"{first}: several values are for a sweep, add -m"
    folders = [config_folder(system), CONF]
    try:
        groups = [word for word in overrides if "=" in word and "." not in word.partition("=")[0]]
        good: list[str] = []
        for word in groups:  # groups that exist decide which keys are known (collect=folder has a path)
            try:
                hydra_compose("config", overrides=[*good, word, *more])
                good.append(word)
            except HydraException:
                pass
        settings = OmegaConf.to_container(hydra_compose("config", overrides=[*good, *more]), resolve=False)
    except HydraException:
        return first
    names = _leaves(settings, "")
    for word in overrides:
        name, equals, value = word.partition("=")
        bare = name.lstrip("+~")
        if bare.startswith(("hydra.", "hydra/")):
            continue
        if not equals and not name.startswith("~"):
            return f"{word!r} is not an override: write name=value"
        group = next((folder / bare for folder in folders if (folder / bare).is_dir()), None)
        if name == bare and bare not in names and group is None:
            return (
                f"{bare} is unknown{nearest(bare, names) if '.' in bare else nearest(bare, [n for n in names if '.' not in n])}"
            )
        if group is not None:
            choices = sorted(path.relative_to(group).with_suffix("").as_posix() for path in group.rglob("*.yaml"))
            if value not in choices and "," not in value:
                return f"{bare}={value} is unknown{nearest(value, choices)}"
    return first
