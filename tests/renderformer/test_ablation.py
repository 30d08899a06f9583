"""The rows of table 1 compose, are the paper's and differ in the model alone; the table says what ran and what did not."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from model.renderformer.network import RenderFormer
from pipeline.errors import UserError
from pipeline.hydra_config import CONF
from pipeline.sweep import Job
from stages.renderformer.evaluation import ablation
from stages.renderformer.evaluation.ablation import (
    COLUMNS,
    PAPER,
    ROWS,
    Result,
    difference,
    gather,
    jobs_of,
    markdown,
    settings,
    write_table,
)

NEEDED = {"table1": ["collect.ids=[a]"], "table1_small": []}


@pytest.fixture(scope="module", params=sorted(NEEDED))
def jobs(request, tmp_path_factory) -> dict[str, Job]:
    store = tmp_path_factory.mktemp("store")
    return jobs_of(request.param, None, [*NEEDED[request.param], f"store={store}"])


def network(jobs: dict[str, Job], row: str):
    return jobs[row].plan["train"].config.model


def test_every_row_is_a_file_and_every_file_a_row(jobs):
    assert list(jobs) == [row.name for row in ROWS] and len(jobs) == 12
    for table in NEEDED:
        assert {path.stem for path in (CONF / "renderformer" / "experiment" / table).glob("*.yaml")} == set(jobs)


def test_rows_differ_in_the_model_alone(jobs):
    preimages = {name: dict(job.plan["train"].preimage["params"]) for name, job in jobs.items()}
    models = [json.dumps(params.pop("model"), sort_keys=True) for params in preimages.values()]
    assert len(set(models)) == 12
    assert len({json.dumps(params, sort_keys=True) for params in preimages.values()}) == 1
    assert len({job.plan["shard"].key for job in jobs.values()}) == 1
    assert len({json.dumps(job.plan["evaluate"].preimage["params"], sort_keys=True) for job in jobs.values()}) == 1


def test_rows_are_what_the_paper_says(jobs):
    switches = {
        "no_dpt": {"use_dpt_decoder": False},
        "no_self_attention": {"view_transformer_include_self_attn": False},
        "neither": {"use_dpt_decoder": False, "view_transformer_include_self_attn": False},
        "world_space": {"turn_to_cam_coord": False},
        "nerf_pe": {"pe_type": "nerf"},
    }
    full = network(jobs, "full").model_dump(exclude={"name"})
    for name, changed in switches.items():
        assert network(jobs, name).model_dump(exclude={"name"}) == full | changed
    small = full["latent_dim"] == 384
    for name, (width, encoder, decoder) in {
        "full": (384, 8, 4), "143m": (384, 4, 4), "71m": (256, 4, 4), "45m": (128, 4, 4),
        "9_9": (384, 6, 6), "6_12": (384, 4, 8), "0_18": (384, 0, 12),
    }.items() if small else {
        "full": (768, 12, 6), "143m": (768, 8, 4), "71m": (512, 8, 4), "45m": (384, 8, 4),
        "9_9": (768, 9, 9), "6_12": (768, 6, 12), "0_18": (768, 0, 18),
    }.items():  # fmt: skip
        model = network(jobs, name)
        assert (model.latent_dim, model.num_layers, model.view_transformer_n_layers) == (width, encoder, decoder)
        assert model.latent_dim == 128 * model.num_heads == 128 * model.view_transformer_n_heads
        assert model.dim_feedforward == model.view_transformer_ffn_hidden_dim == 4 * width


def test_sizes_are_those_that_the_paper_states():
    stated = {row.name: row.parameters for row in ROWS if row.parameters}
    for name, job in jobs_of("table1", list(stated), NEEDED["table1"]).items():
        with torch.device("meta"):
            network = RenderFormer(job.plan["train"].config.model.build())
        assert f"{sum(tensor.numel() for tensor in network.state_dict().values()) // 10**6}M" == stated[name]


def test_a_wrong_row_table_or_dataset_is_told():
    with pytest.raises(UserError, match="table 'table2' is unknown: choose from default, priors, shipped, table1, table1_s"):
        jobs_of("table2", None, [])
    with pytest.raises(UserError, match="no_dtp is unknown.*no_dpt"):
        jobs_of("table1_small", ["no_dtp"], [])
    with pytest.raises(UserError, match="one value"):
        jobs_of("table1_small", ["full"], ["train.seed=0,1"])
    with pytest.raises(UserError, match="DPT head reads four"):
        jobs_of("table1_small", ["full"], ["model.view_transformer_n_layers=3"])


def result(psnrs: dict[str, list[float]]) -> Result:
    def view(index: int, psnr: float) -> dict:
        return {"index": index, "scores": {"model": {"psnr": psnr, "ssim": psnr / 100, "flip": 1 / psnr}}}

    scenes = [{"id": id, "views": [view(i, value) for i, value in enumerate(values)]} for id, values in psnrs.items()]
    means = {
        name: {
            "mean": float(np.mean([v["scores"]["model"][name] for s in scenes for v in s["views"]])),
            "low": 0.0,
            "high": 1.0,
        }
        for name in ("psnr", "ssim", "flip")
    }
    metrics = {
        "per_scene": scenes, "scenes": len(scenes), "views": sum(len(values) for values in psnrs.values()),
        "methods": dict.fromkeys(("model", "mean_image", "constant", "direct"), means),
        "train": {"parameters": 33_000_000, "key": "t"}, "data": {"scenes": {"train": 413}},
    }  # fmt: skip
    log = [{"step": 1, "loss": 0.5, "grad_norm": 2.0}, {"step": 2, "loss": 0.25, "grad_norm": 1.0}, {"step": 2}]
    training = {"steps": 2, "skipped": 0, "seconds": 12.5}
    return Result(metrics, training, log, SimpleNamespace(key="e"))


def test_differences_are_paired_by_view():
    rng = np.random.default_rng(0)
    base = {f"s{i}": list(rng.uniform(5, 35, rng.integers(1, 5))) for i in range(40)}
    # listed in another order, as scenes of another run may be
    row = {id: [value - 0.5 for value in values] for id, values in reversed(base.items())}
    differences = difference(result(row), result(base))
    assert differences["psnr"] == pytest.approx({"mean": -0.5, "low": -0.5, "high": -0.5})  # however far views lie apart
    assert set(differences) == {"psnr", "ssim", "flip"}  # LPIPS was not measured


def test_the_table_says_what_ran_what_did_not_and_what_differs(monkeypatch, tmp_path, capsys):
    results = {
        "full": result({"a": [20.0, 30.0], "b": [10.0], "c": [20.0]}),
        "no_dpt": result({"a": [19.0, 29.0], "b": [9.0], "c": [19.0]}),
    }
    monkeypatch.setattr(ablation, "load", lambda job: results.get(job.plan["train"].config.model.name.replace("base", "full")))
    words = [f"store={tmp_path}/store", "train.steps=7"]
    assert write_table("table1_small", None, words, tmp_path / "out") == 1  # rows are missing
    assert "no_self_attention" in capsys.readouterr().out
    table = json.loads((tmp_path / "out" / "table.json").read_text())
    rows = {row["name"]: row for row in table["rows"]}
    assert rows["no_dpt"]["difference"]["psnr"]["mean"] == pytest.approx(-1)
    assert rows["no_dpt"]["paper_difference"]["psnr"] == pytest.approx(-0.02)
    assert rows["no_dpt"]["training"] == {"loss": 0.25, "largest_grad_norm": 2.0, "steps": 2, "skipped": 0, "seconds": 12.5}
    assert "ours" not in rows["143m"] and rows["143m"]["paper"]["flip"] == 0.1873
    text = (tmp_path / "out" / "table.md").read_text()
    assert "| full model | 8 + 4 | 384 | 33.0M | 205M | 20.00 [0.00, 1.00] | 29.77 |" in text
    assert "| without DPT | **−1.00** [−1.00, −1.00] | −0.02 |" in text
    assert "| without self-attention | no result |" in text
    assert "| training | 500,000 steps of 128 scenes x 4 views | 7 steps of" in text
    assert (tmp_path / "out" / "table.png").stat().st_size > 10_000
    assert write_table("table1_small", ["full", "no_dpt"], words, tmp_path / "out") == 0


def test_a_table_without_results_is_still_the_papers(jobs):
    table = "table1_small" if network(jobs, "full").latent_dim == 384 else "table1"
    text = markdown(gather(table, jobs))
    assert text.count("no result") == 12 and "29.77" in text
    assert settings(jobs["full"], jobs["full"], None).keys() == PAPER.keys()
    assert settings(jobs["full"], None, None)["full model"] == "–"
    if table == "table1":  # what the configs can say of the paper's size is the paper's
        here, paper = settings(jobs["full"], jobs["full"], None), dict(PAPER)
        same = ("training scenes", "triangles per scene, at most", "images", "samples per pixel, at most", "training",
                "visits of each training scene", "optimizer", "loss", "start", "full model")  # fmt: skip
        assert {name: here[name] for name in same} == {name: paper[name] for name in same}
    assert len(COLUMNS) == 4
