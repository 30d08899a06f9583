"""Tables of models: their rows share one dataset, differ in what they say, and end on one page."""

from __future__ import annotations

import os
import subprocess

import pytest

from pipeline.errors import UserError
from pipeline.experiments import Table, experiments_of
from stages.renderformer.evaluation import ablation, comparison
from stages.renderformer.evaluation.comparison import jobs_of
from tests.conftest import ROOT


def test_the_papers_tables_are_no_comparisons():
    assert ablation.names() == ["table1", "table1_small"] and experiments_of("renderformer").default == "table1_small"
    with pytest.raises(UserError, match="table 'prior' is unknown: choose from default, priors, shipped, table1, table1_small"):
        Table.of("renderformer", "prior")
    with pytest.raises(UserError, match="row x is unknown: choose from guided, renderformer"):
        Table.of("renderformer", "default").chosen(["x"])


def test_every_rung_gives_one_thing_more_and_all_read_one_dataset():
    jobs = dict(jobs_of("priors", None, []))
    assert len({job.keys["shard"] for job in jobs.values()}) == 1 and len({job.keys["train"] for job in jobs.values()}) == 10
    models = {name: job.plan["train"].config.model for name, job in jobs.items()}
    guides = [
        set(k for k, on in model.guide.model_dump().items() if on) for name, model in models.items() if name[0] in "1234567"
    ]
    assert [len(b - a) for a, b in zip(guides, guides[1:], strict=False)] == [1] * 6 and not guides[0]
    assert [models[name].tokens for name in ("7_bounces", "8_all_lookup", "9_all_pixels")] == ["encoder", "lookup", "none"]
    assert not hasattr(models["0_renderformer"], "guide")


def test_the_default_is_the_single_models_on_shards_with_guides():
    from pipeline.sweep import expand

    jobs = dict(jobs_of("default", None, []))
    assert list(jobs) == ["guided", "renderformer"]
    (guided,) = expand(["stage=evaluate", "model=guided"])
    (tiny,) = expand(["stage=evaluate", "shard=guided"])
    assert jobs["guided"].keys == guided.keys and jobs["renderformer"].keys == tiny.keys


def test_seeds_are_runs_of_their_own():
    jobs = jobs_of("default", ["guided"], ["train.seed=0,1"])
    assert [name for name, _ in jobs] == ["guided", "guided"] and jobs[0][1].keys["train"] != jobs[1][1].keys["train"]


def test_rows_on_several_datasets_are_refused():
    with pytest.raises(UserError, match="the rows of default read 2 different artifacts of stage shard"):
        jobs_of("default", None, ["scene.count.train=10,20"])


def test_missing_runs_are_named_and_no_page_is_written(tmp_path, capsys):
    assert comparison.write_page("default", None, [f"store={tmp_path / 'store'}"], tmp_path / "out") == 1
    assert "not in the store: guided, renderformer (lightmill sweep default makes" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["data"], "-m pipeline stage=data shard=guided"),
        (["train"], "-m stages.cli sweep default --until train"),
        (["eval", "ARGS=scene.count.train=9"], "-m stages.cli sweep default scene.count.train=9"),
        (["train", "ARGS=model=tiny"], "-m pipeline system=renderformer stage=train model=tiny"),
        (["eval", "ARGS=x=1 experiment=overfit"], "-m pipeline system=renderformer stage=eval x=1 experiment=overfit"),
        (["eval", "SYSTEM=neuras"], "-m pipeline system=neuras stage=eval"),
    ],
)
def test_make_trains_both_unless_one_is_chosen(arguments, expected):
    # the tests themselves run under make: its flags and its level would add lines of their own
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    command = ["make", "-n", *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.rstrip().splitlines()[-1].endswith(expected)
