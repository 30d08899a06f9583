"""What an unfinished artifact remembers: which code made its parts, and what it was begun for."""

from __future__ import annotations

import argparse

import pytest

from pipeline import commands
from pipeline.errors import ItemsFailed
from pipeline.repair import repair
from pipeline.run import run_pipeline
from pipeline.status import read_states
from pipeline.store import DRAFT, Draft, Store
from pipeline.store.files import read_sealed, write_sealed
from tests.pipeline.toy import Numbers, Total

BUG = {"n": 12, "fail": ["n011"]}  # two of the items are in its part: n009 is done, n011 is not


@pytest.fixture
def run(tmp_path):
    """run(numbers={...}, ...) -> (artifacts by stage, lines printed, numbers computed)."""

    def go(**overrides):
        lines: list[str] = []
        log = tmp_path / "computed"
        log.unlink(missing_ok=True)
        root = {"system": "tests.pipeline.toy", "stage": "numbers", "store": str(tmp_path / "store"), "workers": 0}
        root |= {"numbers": {"n": 12}, "squares": {}, "total": {}} | overrides
        root["numbers"] = {**root["numbers"], "log_to": str(log)}
        artifacts = run_pipeline(root, ["test"], lines.append)["artifacts"]
        return artifacts, lines, log.read_text().split() if log.exists() else []

    return go


@pytest.fixture
def code(monkeypatch):
    """code(digest): from here on the stages' code has that digest."""

    def change(digest: str) -> None:
        for module in ("make", "run"):
            monkeypatch.setattr(f"pipeline.{module}.code_digest", lambda system, name: digest)

    return change


def notes(lines: list[str]) -> list[str]:
    return [line for line in lines if "note:" in line]


def stop(run, **overrides) -> None:
    """A run that leaves three of the four parts finished, and of the fourth one item of two."""
    with pytest.raises(ItemsFailed):
        run(**{"numbers": BUG, **overrides})


def test_a_draft_that_other_code_began_is_continued_and_the_manifest_names_both(run, code, tmp_path, capsys):
    code("a" * 64)
    stop(run)
    code("b" * 64)
    stop(run)  # begun by a, nothing finished by b
    artifacts, lines, computed = run()
    assert computed == ["n011"]
    (note,) = notes(lines)
    assert "what is finished of toy/numbers was made by other code of the same version; it is kept" in note
    code_facts = artifacts["numbers"].manifest["code"]
    assert (code_facts["digest"], code_facts["others"]) == ("b" * 64, ["a" * 64])
    assert any("the code of numbers has changed" in line for line in notes(run()[1]))
    arguments = argparse.Namespace(artifact="numbers", rejects=1)
    assert commands.command_show(Store(tmp_path / "store"), arguments) == 0
    assert f"parts of it were made by other code: {'a' * 12}" in capsys.readouterr().out


def test_code_that_finished_nothing_is_not_named(run, code):
    code("a" * 64)
    with pytest.raises(ItemsFailed):
        run(numbers={"n": 3, "fail": ["n000", "n001", "n002"]})
    code("b" * 64)
    artifacts, lines, _ = run(numbers={"n": 3})
    assert notes(lines) == [] and "others" not in artifacts["numbers"].manifest["code"]


def test_one_code_leaves_nothing_to_say(run):
    stop(run)
    artifacts, lines, _ = run()
    assert notes(lines) == notes(run()[1]) == []
    assert "others" not in artifacts["numbers"].manifest["code"]


def test_a_draft_of_before_codes_were_noted_is_continued(run, tmp_path):
    stop(run)
    (draft,) = Store(tmp_path / "store").drafts()
    about = read_sealed(draft / DRAFT)
    write_sealed(draft / DRAFT, {name: value for name, value in about.items() if name not in ("codes", "purpose")})
    artifacts, lines, computed = run()
    assert computed == ["n011"]
    assert "made by code that nobody noted" in notes(lines)[0]
    assert artifacts["numbers"].manifest["code"]["others"] == ["unknown"]


def test_parts_of_earlier_artifacts_bring_their_code_along(run, code):
    code("a" * 64)
    run()
    code("b" * 64)
    artifacts, lines, computed = run(numbers={"n": 20})
    assert len(computed) == 8
    assert "what is taken over from earlier artifacts was made by other code of the same version" in notes(lines)[0]
    assert artifacts["numbers"].codes == ["b" * 64, "a" * 64]


@pytest.mark.parametrize("lost", ["part", "manifest.json"])
def test_a_repair_names_the_code_of_what_it_keeps(run, code, tmp_path, lost):
    code("a" * 64)
    artifacts, _, _ = run()
    numbers = artifacts["numbers"]
    (numbers.part_of("n000")[0] if lost == "part" else numbers.path / lost).unlink()
    code("b" * 64)
    lines: list[str] = []
    mended = repair(Store(tmp_path / "store"), Store(tmp_path / "store").resolve(str(numbers.path)), 0, lines.append)
    assert "what is sound was made by other code of the same version" in notes(lines)[0]
    assert mended.codes == ["b" * 64, "a" * 64] and mended.digest == numbers.digest


# -- parts of which an item failed


def undisturbed(run, tmp_path, **numbers) -> str:
    """The digest of the same numbers in a store of their own."""
    return run(store=str(tmp_path / "undisturbed"), numbers=numbers)[0]["numbers"].digest


def states(tmp_path) -> list[dict]:
    return read_states(Store(tmp_path / "store"))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_failed_item_costs_only_itself(run, tmp_path, monkeypatch, workers):
    monkeypatch.setattr(Numbers, "part_size", lambda self, config, inputs: 5)
    with pytest.raises(ItemsFailed):
        run(workers=workers, numbers={"n": 10, "fail": ["n004"]})  # the third of the five even ones
    (state,) = states(tmp_path)
    assert (state["parts_done"], state["parts"], state["done"], state["total"]) == (1, 2, 9, 10)
    artifacts, lines, computed = run(workers=workers, numbers={"n": 10})
    assert computed == ["n004"]
    assert "10 items, 9 of them already there" in " ".join(lines)
    assert artifacts["numbers"].digest == undisturbed(run, tmp_path, n=10)
    assert artifacts["numbers"].verify(deep=True) == []
    assert sorted(path.name for path in artifacts["numbers"].path.iterdir() if path.is_dir()) == ["files", "logs", "parts"]


def test_each_run_adds_to_what_a_part_has(run, tmp_path):
    """The second run mends one of two items; its tar takes the first one's place, and no tar is left behind."""
    for fail, computed_then in ((["n000", "n004"], 16), (["n004"], 2), (["n004"], 1)):
        with pytest.raises(ItemsFailed):
            run(numbers={"n": 16, "fail": fail})
        assert len((tmp_path / "computed").read_text().split()) == computed_then
        (draft,) = Store(tmp_path / "store").drafts()
        assert len(list((draft / "unfinished").iterdir())) == 1 and len(list((draft / "parts").iterdir())) == 4
    artifacts, _, computed = run(numbers={"n": 16})
    assert computed == ["n004"] and artifacts["numbers"].digest == undisturbed(run, tmp_path, n=16)


def test_rejects_of_an_unfinished_part_are_kept_and_counted(run, tmp_path):
    with pytest.raises(ItemsFailed):
        run(numbers={"n": 14, "fail": ["n009"]})  # n013, which is rejected, is in its part
    assert states(tmp_path)[0]["rejects"] == {"unlucky": 1}
    artifacts, _, computed = run(numbers={"n": 14})
    assert computed == ["n009"] and [reject["item"] for reject in artifacts["numbers"].rejects()] == ["n013"]
    assert artifacts["numbers"].digest == undisturbed(run, tmp_path, n=14)


@pytest.mark.parametrize("killed", ["keep_unfinished", "finish_part", "_drop_tar"])
def test_a_kill_around_an_unfinished_parts_marker_costs_nothing_that_was_kept(run, tmp_path, monkeypatch, killed):
    """Power fails as the marker is about to be written, or as the tar that it replaces is about to go."""
    with pytest.raises(ItemsFailed):
        run(numbers={"n": 8, "fail": ["n000", "n004"]})
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Draft, killed, interrupt)
        run(numbers={"n": 8, "fail": [] if killed == "finish_part" else ["n004"]})
    artifacts, _, computed = run(numbers={"n": 8})
    assert computed == (["n004"] if killed == "_drop_tar" else ["n000", "n004"])
    assert artifacts["numbers"].digest == undisturbed(run, tmp_path, n=8)
    assert artifacts["numbers"].verify(deep=True) == []


def test_a_damaged_unfinished_part_is_computed_again(run, tmp_path):
    with pytest.raises(ItemsFailed):
        run(numbers={"n": 4, "fail": ["n001", "n003", "n002"]})
    (draft,) = Store(tmp_path / "store").drafts()
    (tar,) = (draft / "parts").iterdir()
    tar.write_bytes(tar.read_bytes()[:-600])
    artifacts, _, computed = run(numbers={"n": 4})
    assert len(computed) == 4 and artifacts["numbers"].digest == undisturbed(run, tmp_path, n=4)


@pytest.mark.parametrize("source", ["unfinished part", "artifact"])
def test_the_log_calls_nothing_taken_over_that_was_damaged_and_computed_again(run, tmp_path, source):
    """A byte of n000's record changes. n002 lies beside it, and is sound."""
    if source == "artifact":
        run(numbers={"n": 6})
        (part,) = (path for path in (tmp_path / "store").glob("toy/numbers/*/parts/*.tar") if b"n000." in path.read_bytes())
    else:
        with pytest.raises(ItemsFailed):
            run(numbers={"n": 6, "fail": ["n001", "n003", "n004", "n005"]})
        (part,) = (tmp_path / "store").glob("toy/numbers/*.partial/parts/*.tar")
    data = bytearray(part.read_bytes())
    data[512] ^= 1  # the first byte after the first member's header
    part.write_bytes(data)
    artifacts, _, computed = run(numbers={"n": 8 if source == "artifact" else 6})
    lines = "".join(path.read_text() for path in (artifacts["numbers"].path / "logs").iterdir()).splitlines()
    first, last = (line.partition("n000: ")[2] for line in [line for line in lines if "n000: " in line][-2:])
    assert "n000" in computed and "n002" not in computed
    assert first.startswith("not taken over: ") and last.endswith("1 record(s)")
    where = "from before" if source == "unfinished part" else "from v1-"
    assert f"1 record(s), taken over {where}" in [line for line in lines if "n002: " in line][-1]


def test_an_item_that_exceeded_a_limit_in_an_unfinished_part_is_tried_under_a_higher_one(run, tmp_path):
    with pytest.raises(ItemsFailed):
        run(workers=1, numbers={"n": 8, "fail": ["n000"], "sleep": ["n002"], "limits": {"wall_s": 0.5}})
    assert states(tmp_path)[0]["rejects"] == {"time": 1}
    artifacts, lines, computed = run(workers=1, numbers={"n": 8, "limits": {"wall_s": 60.0}})
    assert computed == ["n000", "n002"] and "1 item(s) that lower limits rejected" in " ".join(lines)
    assert artifacts["numbers"].digest == undisturbed(run, tmp_path, n=8)


# -- force


def test_force_takes_nothing_that_another_run_had_finished(run, tmp_path):
    stop(run)
    artifacts, lines, computed = run(force="numbers")
    assert len(computed) == 12
    assert "force takes nothing of what an earlier run had finished" in notes(lines)[0]
    assert len(list((tmp_path / "store" / ".trash").glob("toy-numbers-*.partial-*/markers/*"))) == 3
    assert Store(tmp_path / "store").drafts() == []
    assert artifacts["numbers"].verify(deep=True) == []


def test_force_takes_nothing_that_a_repair_had_finished(run, tmp_path, monkeypatch):
    artifacts, _, _ = run()
    artifacts["numbers"].part_of("n000")[0].unlink()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Store, "commit", interrupt)
        repair(Store(tmp_path / "store"), artifacts["numbers"], 0, lambda line: None)
    assert len(Store(tmp_path / "store").drafts()) == 1
    forced, lines, computed = run(force="numbers")
    assert len(computed) == 12 and any("equal to before" in line for line in lines)


def interrupt(*arguments, **more):
    raise KeyboardInterrupt


def test_a_forced_run_that_was_killed_keeps_its_own_parts(run, monkeypatch):
    first, _, _ = run()
    stop(run, force="numbers")
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Store, "commit", interrupt)
        run(force="numbers")
    _, lines, computed = run(force="numbers")
    assert computed == [] and notes(lines) == []
    assert any("equal to before" in line for line in lines)


def test_what_force_began_and_another_run_went_on_with_is_not_forces_own(run):
    """An ordinary run may take parts over from elsewhere."""
    stop(run, force="numbers")
    stop(run)
    assert len(run(force="numbers")[2]) == 12


def test_force_begins_a_training_anew(run, monkeypatch):
    """A run stage has no parts but a state, which is weeks of another run's work or force's own."""
    seen: list[list[str]] = []

    def steps(self, config, inputs, draft):
        seen.append(sorted(path.name for path in draft.state.iterdir()))
        (draft.state / f"step{len(seen[-1])}").touch()
        if len(seen[-1]) < 2:
            raise KeyboardInterrupt
        (draft.files / "total.txt").touch()
        return ["total.txt"]

    monkeypatch.setattr(Total, "run", steps)
    for force in ([], "total", "total", "total"):
        try:
            run(stage="total", force=force)
        except KeyboardInterrupt:
            continue
    assert seen == [[], [], ["step0"], ["step0", "step1"]]
