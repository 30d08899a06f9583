"""The YAML and the typed configs agree, and a wrong word on the command line is answered with the right one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from model.errors import InputError
from pipeline.__main__ import main
from pipeline.config import parse
from pipeline.errors import MachineError, UserError
from pipeline.hydra_config import CONF, compose
from pipeline.keys import canonical
from pipeline.stage import MapStage, load_system
from stages import cli

ROOT = Path(__file__).resolve().parents[2]
SYSTEM = load_system("renderformer")
ENGINE_FIELDS = {"workers", "limits", "max_reject_share"}  # every stage has them; config.yaml names them for map stages
VARIANTS = [(stage, path.stem) for stage in SYSTEM.modules for path in sorted((CONF / "renderformer" / stage).glob("*.yaml"))]
NEEDED = {("collect", "folder"): ["collect.path=/tmp"], ("collect", "objaverse"): ["collect.ids=[a]"]}


def missing(model: BaseModel, section: dict, path: str) -> list[str]:
    names = []
    for name in type(model).model_fields:
        if name in ENGINE_FIELDS:
            continue
        if name not in section:
            names.append(f"{path}.{name}")
        elif isinstance(getattr(model, name), BaseModel) and isinstance(section[name], dict):
            names += missing(getattr(model, name), section[name], f"{path}.{name}")
    return names


@pytest.mark.parametrize(("stage", "variant"), VARIANTS)
def test_yaml_names_every_field_of_its_config(stage, variant):
    root = compose([f"{stage}={variant}", *NEEDED.get((stage, variant), [])])
    config = parse(load_system(root["system"]).stage(stage).Config, root[stage], stage)
    assert missing(config, root[stage], stage) == []


@pytest.mark.parametrize(
    ("stage", "variant"), [(stage, variant) for stage, variant in VARIANTS if isinstance(SYSTEM.stage(stage), MapStage)]
)
def test_what_remedies_machine_rejects_can_be_set_for_every_map_stage_and_enters_no_key(stage, variant):
    """As docs/faults.md gives it, without a ``+``."""
    plain = [f"{stage}={variant}", *NEEDED.get((stage, variant), [])]
    root = compose([*plain, f"{stage}.limits.wall_s=5", f"{stage}.limits.memory_gb=4", f"{stage}.max_reject_share=0.9"])
    before, after = (
        parse(load_system(root["system"]).stage(stage).Config, data[stage], stage) for data in (compose(plain), root)
    )
    assert (after.limits.wall_s, after.limits.memory_gb, after.max_reject_share) == (5, 4, 0.9)
    assert after.limits.cpu_s == before.limits.cpu_s  # what a variant gives stays
    assert canonical(after) == canonical(before)


def test_limits_of_the_paper_s_scenes():
    for overrides in (["render=paper"], ["experiment=paper_256", "collect.ids=[a]"]):
        config = parse(SYSTEM.stage("render").Config, compose(overrides)["render"], "render")
        assert config.limits.model_dump(exclude_none=True) == {"cpu_s": 7200, "wall_s": 14400}


@pytest.mark.parametrize("model", sorted(path.stem for path in (CONF / "renderformer" / "model").glob("*.yaml")))
def test_every_model_is_a_valid_config(model):
    parse(SYSTEM.stage("train").Config, compose([f"model={model}", "train.informed_start=false"])["train"], "train")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["render.max_sp=4"], "did you mean 'render.max_spp'"),
        (["render=defalt"], "did you mean 'default'"),
        (["model=tny"], "did you mean 'tiny'"),
        (["stge=train"], "did you mean 'stage'"),
        (["collect=folder", "collect.pth=x"], "did you mean 'collect.path'"),
        (["nonsense"], "name=value"),
        (["render.limits.walls=4"], "did you mean 'render.limits.wall_s'"),
    ],
)
def test_wrong_words_name_the_right_ones(overrides, message):
    with pytest.raises(UserError, match=message):
        compose(overrides)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["train.lr=-1"], r"^train\.lr=-1: "),
        (["+train.lrr=1"], r"^train\.lrr is unknown"),
        # before any data is made, not when the network is built
        (["model=143m", "model.view_transformer_n_layers=3"], r"^train\.model: .*3 decoder layers: the DPT head reads four"),
        (["model=nerf_pe"], r"^train: informed_start=true .* nerf_pe .*informed_start=inputs"),
    ],
)
def test_wrong_values_are_named_as_they_are_written(overrides, message):
    with pytest.raises(UserError, match=message):
        parse(SYSTEM.stage("train").Config, compose(overrides)["train"], "train")


def test_several_values_without_a_sweep_are_a_list():
    root = compose(["evaluate.lpips=vgg,alex", "decimate.budgets=64,128"])
    assert root["evaluate"]["lpips"] == ["vgg", "alex"] and root["decimate"]["budgets"] == [64, 128]
    with pytest.raises(UserError, match=r"^render\.max_spp=\[1, 2\]: .*for a job of each value add -m"):
        parse(SYSTEM.stage("render").Config, compose(["render.max_spp=1,2"])["render"], "render")
    with pytest.raises(UserError, match="model=tiny,base.*add -m"):
        compose(["model=tiny,base"])


@pytest.mark.parametrize("flags", [["-m"], []])
def test_command_line_accepts_the_sweep_flag_anywhere(tmp_path, flags):
    words = ["stage=train", "plan=true", "model=tiny,small" if flags else "model=tiny", f"store={tmp_path}", *flags]
    command = [sys.executable, "-m", "pipeline", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("06 train") == (2 if flags else 1)


@pytest.mark.parametrize(
    ("error", "status"),
    [(UserError("mend it"), 2), (InputError("mend it"), 2), (MachineError("mend it"), 6), (ValueError(), 1)],
)
def test_only_errors_for_people_are_one_line(tmp_path, monkeypatch, capsys, error, status):
    """Those of model/, which does not know the engine, too; any other ValueError is a bug and shows where it is."""

    def fail(*arguments) -> None:
        raise error

    monkeypatch.setattr("pipeline.__main__.run_pipeline", fail)
    monkeypatch.setattr(sys, "argv", ["lightmill"])
    words = ["stage=collect", f"store={tmp_path}"]
    for start in (main, lambda words: cli.main(["run", *words])):
        if status == 1:
            with pytest.raises(ValueError):
                start(words)
        else:
            assert start(words) == status
            assert capsys.readouterr().err.splitlines()[-1] == "error: mend it"


def test_error_is_one_line_with_a_status(tmp_path):
    command = [sys.executable, "-m", "pipeline", "render.max_spp=many", f"store={tmp_path}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: render.max_spp='many'")
    assert len(done.stderr.splitlines()) == 1
