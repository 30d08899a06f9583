"""What an unfinished artifact remembers: which code made its parts, and what it was begun for."""

from __future__ import annotations

import argparse

import pytest

from pipeline import commands
from pipeline.errors import ItemsFailed
from pipeline.repair import repair
from pipeline.run import run_pipeline
from pipeline.store import DRAFT, Store
from pipeline.store.files import read_sealed, write_sealed
from tests.pipeline.toy import Total

BUG = {"n": 12, "fail": ["n011"]}  # two of the items are in its part


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
    """A run that leaves three of the four parts finished."""
    with pytest.raises(ItemsFailed):
        run(**{"numbers": BUG, **overrides})


def test_a_draft_that_other_code_began_is_continued_and_the_manifest_names_both(run, code, tmp_path, capsys):
    code("a" * 64)
    stop(run)
    code("b" * 64)
    stop(run)  # begun by a, nothing finished by b
    artifacts, lines, computed = run()
    assert len(computed) == 2
    (note,) = notes(lines)
    assert "what is finished of toy/numbers was made by other code of the same version; it is kept" in note
    made = artifacts["numbers"].manifest["code"]
    assert (made["digest"], made["others"]) == ("b" * 64, ["a" * 64])
    assert any("the code of numbers has changed" in line for line in notes(run()[1]))
    arguments = argparse.Namespace(artifact="numbers", rejects=1)
    assert commands.command_show(Store(tmp_path / "store"), arguments) == 0
    assert f"parts of it were made by other code: {'a' * 12}" in capsys.readouterr().out


def test_code_that_finished_nothing_is_not_named(run, code):
    code("a" * 64)
    with pytest.raises(ItemsFailed):
        run(numbers={"n": 3, "fail": ["n000", "n001"]})
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
    assert len(computed) == 2
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
