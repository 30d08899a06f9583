"""The paper's tables: every row is a config that differs in what it says, and the page holds ours beside the published."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import UserError
from pipeline.experiments import Order, experiments_of
from pipeline.experiments import tables as folders
from stages.neuras.evaluation import summary, tables
from stages.neuras.evaluation.paper import TABLES
from tests.neuras.test_evaluation import view


@pytest.fixture(scope="module")
def jobs() -> dict[str, dict]:
    """Table -> row -> job."""
    return {table.name: dict(tables.files_of(table).jobs(None, [])) for table in TABLES}


def test_every_row_is_a_file_and_every_file_a_row(jobs):
    assert folders("neuras") == sorted(table.name for table in TABLES)
    for table in TABLES:
        assert set(jobs[table.name]) == {row.file for row in table.rows if row.file}
        assert set(table.columns) <= set(tables.COLUMNS)
        assert all(set(row.figures) <= set(table.columns) for row in table.rows)
        labels = [row.label for row in table.rows]
        assert len(set(labels)) == len(labels)


def test_rows_differ_in_what_they_say_alone(jobs):
    def keys(table: str, stage: str) -> dict[str, str]:
        return {row: job.keys[stage] for row, job in jobs[table].items()}

    def differ(table: str, stage: str) -> dict[str, list]:
        """Settings of the stage that are not the same in all rows."""
        configs = [job.plan[stage].config.model_dump() for job in jobs[table].values()]
        return {name: [config[name] for config in configs] for name in configs[0] if len({str(c[name]) for c in configs}) > 1}

    for table in ("table1", "table2", "table3", "table4"):
        atlases = {key for row, key in keys(table, "atlas").items() if row != "extended"}
        assert len(atlases) == 1 and len(set(keys(table, "fit").values())) == len(jobs[table])
    for table, past in (("table1", ["extended"]), ("limits", ["extended", "all_surfels"])):
        assert [row for row, job in jobs[table].items() if job.plan["bake"].config.residuals] == past
        assert [row for row, job in jobs[table].items() if job.plan["scaffold"].config.surfels] == past
    for table in ("table1", "limits"):
        assert [row for row, job in jobs[table].items() if job.plan["refine"].config.surfels] == ["extended"]
    assert differ("limits", "fit") == {
        "texture_levels": [3] * 4 + [1] + [3] * 4, "coarser_share": [0.15] * 5 + [0.0] + [0.15] * 3,
        "near_opacity": [0.12] * 6 + [0.5, 0.12, 0.12], "skyboxes": [6] * 7 + [1, 6],
        "sky_near_m": [150.0] * 7 + [2400.0, 150.0], "direction_noise": [0.0] * 8 + [0.08]
    }  # fmt: skip
    assert differ("table3", "fit") == {
        "layers": [3, 3, 0], "channels": [12, 12, 4], "view_direction": [True, False, True]
    }  # fmt: skip
    assert differ("table4", "fit") == {"codes": [1024, 0]}
    assert differ("figure7", "scaffold") == {"faces": [190_000, 10_000, None], "weld_m": [0.02, 0.2, 0.02]}
    assert differ("figure7", "atlas") == {"charts": ["xatlas", "xatlas", "planar"]}
    assert differ("table6", "capture") == {"true_mesh": [False, False, True]}
    assert differ("table6", "scaffold") == {
        "source": ["auto", "distance_field", "auto"], "faces": [150_000, 150_000, None], "speck_faces": [25, 25, 0]
    }  # fmt: skip
    assert differ("table6", "atlas") == {"charts": ["xatlas", "planar", "planar"]}
    assert differ("table5", "capture")["object"] == ["car", "house", "tree", "tree"]
    assert jobs["table2"]["ours"].plan["capture"].config.preset == "drone"
    # one street, one fit, however many tables show it
    (same,) = {jobs[t][r].keys["evaluate"] for t, r in (("table1", "ours"), ("table3", "full"), ("table4", "with_vq"))}
    assert jobs["table6"]["poisson"].keys["evaluate"] == jobs["limits"]["ours"].keys["evaluate"] == same
    assert jobs["table1"]["extended"].keys["evaluate"] == jobs["limits"]["extended"].keys["evaluate"]
    assert jobs["table3"]["no_mlp"].keys["evaluate"] == jobs["table1"]["plain"].keys["evaluate"]


def encoded(value: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.full((8, 12, 3), value, np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def made(key: str, better: float, vertices: int, photo: int = 10, split: str = "test") -> tables.Made:
    """A row whose PSNR is ``better`` dB above others' in every frame, whatever the frame."""
    rng = np.random.default_rng(0)
    views = [
        *(view(f"t{i}", 0.0, 20 + rng.normal(0, 4) + better, 25 + i, split) for i in range(6)),
        *(view(f"r{i}", 3.0, 18 + i + better, 17 + i) for i in range(4)),
    ]
    numbers = summary.summarise(views) | {
        "storage": {"stored": 6_400_000}, "device": {"fp16": 30_000_000, "geometry": 2_000_000, "residuals": 0},
        "distributions": [
            {"label": "3 m, both sides", "views": 4, "photos": 6, "methods": {"ours": {"fid": 99.0}, "warping": {"fid": 88.0}}}
        ],
    }  # fmt: skip
    notes = {
        "capture": {"frames": {"train": 7, "test": 6}, "sizes": {"12 x 8": 13}, "split_rule": "every other frame"},
        "scaffold": {"vertices": vertices}, "atlas": {"faces": 2 * vertices, "charts": 7, "width": 64, "height": 32},
    }  # fmt: skip
    pictures = {"photo": photo, "ours": 100, "warping": 200}

    def read(id: str, names: tuple[str]) -> SimpleNamespace:
        return SimpleNamespace(members={names[0]: encoded(pictures[names[0].removesuffix(".png")])})

    timing = {"opengl": {"neural_fps": 0.95, "ratio": 7.7, "drawn_by": "llvmpipe", "size": [1920, 1080]}}
    return tables.Made(SimpleNamespace(key=key, read=read), numbers, timing, notes)


def written(tmp_path, monkeypatch, results: dict[str, tables.Made], table: str = "paper", status: int = 1) -> dict[str, dict]:
    """The page of these results, by the rows' files; others are missing. Returns its JSON by table and row."""

    def of(job) -> tables.Made | None:
        return results.get(next(word for word in job.words if word.startswith("experiment=")).removeprefix("experiment="))

    monkeypatch.setattr(tables.Made, "of", of)
    order = Order(table, None, [f"store={tmp_path / 'store'}"], tmp_path / "out")
    assert experiments_of("neuras").write(order) == status
    numbers = json.loads((tmp_path / "out" / "report.json").read_text())
    return {one["table"]: {row["label"]: row for row in one["rows"]} | {"differs": one["differs"]} for one in numbers}


def test_the_page_holds_ours_beside_the_published_and_what_differs(tmp_path, monkeypatch, capsys):
    results = {
        "table1/ours": made("a", 0.0, 40_000), "table1/plain": made("b", -0.5, 40_000), "table5/car": made("c", 3.0, 900),
        "figure7/vertices_50k": made("f", 0.0, 50_000), "table3/no_mlp": made("g", -1.0, 40_000),
        "figure7/vertices_5k": made("d", -1.0, 5000), "figure7/whole": made("e", 1.0, 300_000, photo=11),
    }  # fmt: skip
    found = written(tmp_path, monkeypatch, results)
    assert list(found) == [table.name for table in TABLES]
    table = found["table1"]
    psnr = results["table1/ours"].summary["groups"][0]["methods"]["ours"]["psnr"]["mean"]
    assert table["ours"]["ours"]["psnr"]["mean"] == pytest.approx(psnr)
    assert table["ours"]["ours"]["fps"] == {"mean": 0.95} and table["ours"]["ours"]["memory"]["mean"] == pytest.approx(32)
    assert table["ours"]["published"]["psnr"] == 25.45 and "gain" not in table["ours"]
    plain = table["plain colours"]
    assert plain["gain"]["mean"] == pytest.approx(-0.5) and plain["gain"]["high"] == pytest.approx(-0.5)  # paired
    assert plain["gain_3"]["mean"] == pytest.approx(-0.5) and table["multi-view warping"]["gain_3"] is not None
    assert plain["ours"]["psnr_3"]["mean"] == pytest.approx(19.0)
    warping = table["multi-view warping"]
    assert warping["ours"]["psnr"]["mean"] == pytest.approx(27.5) and "fps" not in warping["ours"]
    assert warping["ours"]["fid_3"] == {"mean": 88.0} and "gain" in warping
    assert "ours" not in table["UniSim"] and table["UniSim"]["published"]["psnr"] == 26.28
    assert ["training", "20,000 steps, learning rate 0.01", "1,500 steps of 8,192 pixels, learning rate 0.003"] in table[
        "differs"
    ]
    assert ["texture", "8192 x 8192, one level, 12 channels", "64 x 32, 3 levels, 12 channels"] in table["differs"]
    assert found["figure7"]["the whole scaffold"]["gain"] is None  # its photos are others: no pair
    assert found["figure7"]["about 5,000 vertices"]["ours"]["vertices"] == {"mean": 5000}
    assert not any("gain" in row for row in found["table3"].values())  # its first row is missing
    assert all("gain" not in row for label, row in found["table5"].items() if label != "differs")
    page = (tmp_path / "out" / "report.html").read_text()
    for text in ("25.45", "published", "UniSim", "llvmpipe", "7.7 times", "-0.50"):
        assert text in page, text
    assert page.count("data:image/jpeg") == 4 + 2 + 4 + 2  # a photo and pictures of tables 1 and 5, of figure 7, of table 3
    words = (tmp_path / "out" / "report.md").read_text()
    assert "## Table 4: what quantization gives" in words and "data:image" not in words
    said = capsys.readouterr().out
    assert "not in the store: car" not in said and "lightmill sweep table2 makes what is missing" in said


def test_a_single_table_and_what_is_wrong_with_an_order(tmp_path, monkeypatch):
    everything = {f"table4/{row}": made(row, 0.0, 10) for row in ("with_vq", "without_vq")}
    assert list(written(tmp_path, monkeypatch, everything, "table4", status=0)) == ["table4"]
    with pytest.raises(UserError, match="'table9' is unknown: choose from paper, table1"):
        tables.write(Order("table9", None, [], tmp_path))
    with pytest.raises(UserError, match="--rows chooses among the rows of one table"):
        tables.write(Order("paper", ["ours"], [], tmp_path))
    with pytest.raises(UserError, match="row no is unknown: choose from with_vq, without_vq"):
        tables.write(Order("table4", ["no"], [], tmp_path))
    with pytest.raises(UserError, match="rows with_vq and without_vq of table4 are the same run.*fit.codes=64"):
        tables.write(Order("table4", None, ["fit.codes=64"], tmp_path))
    with pytest.raises(UserError, match="one value"):
        tables.write(Order("table4", None, ["fit.steps=1,2"], tmp_path))


def test_rows_without_test_views_have_pictures_of_others(tmp_path, monkeypatch):
    """With evaluate.splits=[validation]."""
    results = {f"table4/{row}": made(row, 0.0, 10, split="validation") for row in ("with_vq", "without_vq")}
    found = written(tmp_path, monkeypatch, results, "table4", status=0)["table4"]
    assert all(found[label]["ours"]["psnr_3"]["mean"] > 0 for label in ("with codes", "without"))
    assert (tmp_path / "out" / "report.html").read_text().count("data:image/jpeg") == 3


def test_a_row_of_residuals_that_nobody_made_is_a_dash(tmp_path, monkeypatch):
    """With bake.residuals=0 no picture is without residuals."""
    results = {"limits/ours": made("a", 0.0, 40_000), "limits/extended": made("b", 0.5, 40_000)}
    found = written(tmp_path, monkeypatch, results, "limits")["limits"]
    without, both = (found[label] for label in list(found)[1:3])
    assert without["method"] == "textures" and without["gain"] is None and "psnr" not in without["ours"]
    assert both["gain"]["mean"] == pytest.approx(0.5)
