"""Systems: what names them, where their configs and artifacts lie, and that RenderFormer's keys are older than they are."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.hydra_config import compose
from pipeline.keys import digest_of
from pipeline.plan import make_plan, plan_run, split_config
from pipeline.stage import Stage, load_system
from pipeline.store import Store
from stages import cli

ROOT = Path(__file__).resolve().parents[2]
TOY = "system=tests.pipeline.toy"


def run(store: Path, *words: str) -> str:
    command = [sys.executable, "-m", "pipeline", TOY, f"store={store}", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Store:
    folder = tmp_path_factory.mktemp("toy") / "store"
    run(folder)
    return Store(folder)


def test_a_system_runs_through_the_command_line_and_has_places_of_its_own(store):
    assert [artifact.name.rpartition("-")[0] for artifact in store.artifacts()] == [
        "toy/numbers/v1",
        "toy/squares/v1",
        "toy/total/v1",
    ]
    assert {artifact.system for artifact in store.artifacts()} == {"toy"}
    assert "up to date" in run(store.root, "numbers.n=10") and "running" not in run(store.root, "numbers.n=10")


def test_a_key_holds_the_system_and_renderformers_does_not(tmp_path):
    toy = plan_run(compose([TOY, f"store={tmp_path}"])).stages["numbers"]
    assert toy.preimage["system"] == "toy" and toy.key == digest_of(toy.preimage)
    collect = plan_run(compose(["stage=collect", f"store={tmp_path}"])).stages["collect"]
    assert "system" not in collect.preimage and collect.place == "collect" and toy.place == "toy/numbers"


@pytest.mark.parametrize("stage", [["squares"], ["toy/squares"], ["tests.pipeline.toy/squares"], ["squares", TOY]])
def test_why_takes_a_stage_as_ls_writes_it(store, capsys, stage):
    words = [*stage, "squares.offset=3", f"store={store.root}"]
    assert cli.main(["why", "--store", str(store.root), *words]) == 0
    assert capsys.readouterr().out.splitlines()[-1].strip() == "squares.offset: 0 -> 3"


def test_an_artifact_is_found_by_stage_system_and_key(store, capsys):
    numbers, squares, total = store.artifacts()
    for reference in ("numbers", "toy/numbers", numbers.name, numbers.key[:8], str(numbers.path)):
        assert store.resolve(reference).key == numbers.key, reference
    assert store.by_key(total.key) is not None and store.by_key("0" * 64) is None
    for what, names in (([], 3), (["toy"], 3), (["squares"], 1), (["toy/total"], 1), (["render"], 0)):
        assert cli.main(["ls", *what, "--store", str(store.root)]) == 0
        assert capsys.readouterr().out.count("toy/") == names, what
    assert cli.main(["show", "squares", "--store", str(store.root)]) == 0
    assert f"{numbers.name}\n" in capsys.readouterr().out  # in its lineage
    with pytest.raises(UserError, match="no artifact 'nothing'"):
        store.resolve("nothing")


def test_gc_pins_and_repair_know_the_systems_places(store, tmp_path, capsys):
    where = tmp_path / "store"
    run(where)
    own = Store(where)
    total = own.resolve("toy/total")
    own.pin(total.key)
    assert own.garbage(days=-1) == []  # what a pinned one was made from stays
    own.pin(total.key, on=False)
    gone = [path for path, _ in own.garbage(days=-1)]
    assert {path.parent.name for path in gone} == {"numbers", "squares", "total"}
    part = next((own.resolve("squares").path / "parts").glob("*.tar"))
    part.write_bytes(b"")
    assert cli.main(["repair", "squares", "--store", str(where)]) == 0
    assert cli.main(["verify", "--deep", "--store", str(where)]) == 0
    for path in gone:
        assert own.remove(path, days=-1)
    assert own.artifacts() == []


def test_a_stage_name_of_two_systems_is_not_guessed(store, tmp_path):
    where = tmp_path / "store"
    run(where)
    for other in ("one", "two"):
        (where / other).mkdir()
    (where / "toy" / "total").rename(where / "one" / "total")
    shutil.copytree(where / "one" / "total", where / "two" / "total")
    with pytest.raises(UserError, match="several systems: say which .one/total, two/total."):
        Store(where).resolve("total")


def test_a_target_is_a_list_of_stages():
    run_config, _, _ = split_config(compose(["stage=data"]))
    assert run_config.stage == ("shard",)
    assert split_config(compose(["stage=[train,eval]"]))[0].stage == ("train", "evaluate")


def test_an_unknown_system_and_one_without_config_are_said():
    with pytest.raises(UserError, match="system='nosuch' is unknown"):
        compose(["system=nosuch"])
    with pytest.raises(UserError, match="is not a name of a system"):
        compose(["system=../x"])


def test_inputs_have_roles():
    class Short(Stage):
        inputs = ("mesh",)

    class Named(Stage):
        inputs = {"mesh": "scaffold", "views": "capture"}

    assert Short.roles() == {"mesh": "mesh"}
    assert Named.roles() == {"mesh": "scaffold", "views": "capture"} and Named().reads(None) == ("mesh", "views")


def test_the_plan_has_roles_in_its_keys_and_leaves_out_what_is_not_read(tmp_path, monkeypatch):
    toy = load_system("tests.pipeline.toy")
    run_config, system, sections = split_config(compose([TOY, f"store={tmp_path}"]))
    assert list(make_plan(run_config, system, sections, str)["total"].preimage["inputs"]) == ["squares"]
    monkeypatch.setattr(type(toy.stage("total")), "inputs", {"addends": "squares"})
    monkeypatch.setattr(type(toy.stage("total")), "reads", Stage.reads)
    plan = make_plan(run_config, system, sections, str)
    assert plan["total"].preimage["inputs"] == {"addends": plan["squares"].key}
    assert plan["total"].inputs({"squares": 1, "numbers": 2}) == {"addends": 1}


def test_a_report_field_makes_files_anew_and_no_item(store, tmp_path):
    """A change of what only ``finish`` reads."""
    where, log = tmp_path / "store", tmp_path / "log"
    run(where, f"+squares.log_to={log}")
    computed = log.read_text()
    out = run(where, f"+squares.log_to={log}", "+squares.heading=other")
    assert "01 squares    running    10 items, 10 of them already there" in out
    assert log.read_text() == computed
    cards = [artifact.file("card.txt").read_text() for artifact in Store(where).artifacts("toy/squares")]
    assert len(cards) == 2 and cards[0] != cards[1]


def test_the_manifest_names_the_system_that_repair_loads(store):
    manifest = json.loads((store.resolve("total").path / "manifest.json").read_bytes())
    assert manifest["system"] == "tests.pipeline.toy"
