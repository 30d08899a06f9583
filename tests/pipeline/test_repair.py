"""Damaged bytes: ``verify --deep`` finds them all, nothing is made from them, ``repair`` makes only the damaged parts anew."""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import random
from pathlib import Path

import pytest

from pipeline import commands
from pipeline.errors import Damaged, UserError
from pipeline.repair import repair, sound_parts
from pipeline.run import run_pipeline
from pipeline.store import Artifact, Store
from pipeline.store.listing import Row


@pytest.fixture
def run(tmp_path):
    """run(numbers={...}, ...) -> (artifacts by stage, lines printed); ``computed`` says which squares were computed since."""

    def go(**overrides):
        lines: list[str] = []
        root = {"system": "tests.pipeline.toy", "stage": "total", "store": str(tmp_path / "store"), "workers": 0}
        root |= {"numbers": {"n": 15}, "squares": {"log_to": str(tmp_path / "computed")}, "total": {}} | overrides
        return run_pipeline(root, ["test"], lines.append)["artifacts"], lines

    return go


def computed(folder: Path) -> list[str]:
    """Squares computed since the last call."""
    path = folder / "computed"
    words = path.read_text().split() if path.exists() else []
    path.unlink(missing_ok=True)
    return sorted(words)


def flip(path: Path, seed: int = 0) -> None:
    """Flip one bit, drawn from the seed; an empty file gets a byte."""
    data = bytearray(path.read_bytes() or b"?")
    bit = random.Random(seed).randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    path.unlink()  # not through the hard link of another artifact
    path.write_bytes(data)


def cut(path: Path) -> None:
    data = path.read_bytes() or b"??"
    path.unlink()
    path.write_bytes(data[: len(data) // 2])


def inside(artifact: Artifact) -> list[Path]:
    """The files that make up the artifact: all but logs, which are for people."""
    return sorted(path for path in artifact.path.rglob("*") if path.is_file() and path.parent.name != "logs")


def mend(tmp_path: Path, artifact: Artifact) -> list[str]:
    lines: list[str] = []
    repair(Store(tmp_path / "store"), Artifact(artifact.path), 0, lines.append)
    return lines


def test_verify_deep_finds_every_flipped_bit_and_every_cut(run):
    artifacts, _ = run()
    for artifact in artifacts.values():
        for path in inside(artifact):
            whole = path.read_bytes()
            for seed in range(12):
                flip(path, seed)
                assert Artifact(artifact.path).verify(deep=True), f"{path} with bit {seed}"
                path.write_bytes(whole)
            for size in (0, len(whole) // 2, len(whole) - 1):
                if 0 <= size < len(whole):
                    path.write_bytes(whole[:size])
                    assert Artifact(artifact.path).verify(deep=True), f"{path} cut to {size}"
            path.unlink()
            assert Artifact(artifact.path).verify(deep=True), f"{path} missing"
            path.write_bytes(whole)
        assert not Artifact(artifact.path).verify(deep=True)


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
@pytest.mark.parametrize("name", ["parts", "files/card.txt", "items.jsonl", "rejects.jsonl", "manifest.json", "draft.json"])
def test_repair_ends_with_the_same_digest_and_computes_only_the_damaged_part(run, tmp_path, name, damage):
    artifacts, _ = run()
    artifact = artifacts["squares"]
    computed(tmp_path)
    path, group = artifact.part_of("n004")
    damage(path if name == "parts" else artifact.path / name)
    lines = mend(tmp_path, artifact)
    computed_items = computed(tmp_path)
    if name == "parts":
        assert computed_items == [row.item for row in artifact.rows() if row.part == artifact.row("n004").part]
        assert any("equal to before" in line for line in lines)
    elif name != "items.jsonl":
        assert computed_items == []
    mended = Store(tmp_path / "store").resolve("squares")
    assert mended.digest == artifact.digest and mended.path == artifact.path
    assert mended.verify(deep=True) == []
    assert {path.name for path in (tmp_path / "store" / ".trash").iterdir()} > set()
    assert [row.to_json() for row in mended.rows()] == [row.to_json() for row in artifact.rows()]
    assert list((mended.path / "logs").iterdir())
    assert not Store(tmp_path / "store").drafts()


def test_one_damaged_row_costs_one_part(run, tmp_path):
    artifacts, _ = run()
    artifact = artifacts["squares"]
    computed(tmp_path)
    path = artifact.path / "items.jsonl"
    lines = path.read_text().splitlines()
    row = json.loads(lines[4])
    row["members"]["square.txt"][0] += 1  # valid JSON, and wrong
    path.write_text("\n".join([*lines[:4], json.dumps(row, sort_keys=True), *lines[5:], ""]))
    mend(tmp_path, artifact)
    assert computed(tmp_path) == sorted(r.item for r in artifact.rows() if r.part == row["part"])
    assert Store(tmp_path / "store").resolve("squares").verify(deep=True) == []


def test_rejects_survive_a_repair(run, tmp_path):
    artifacts, _ = run()
    artifact = artifacts["numbers"]
    (reject,) = artifact.rejects()
    for path in (artifact.path / "rejects.jsonl", artifact.part_of("n000")[0]):
        flip(path)
        mend(tmp_path, artifact)
        mended = Store(tmp_path / "store").resolve("numbers")
        assert (mended.rejects(), mended.digest) == ([reject], artifact.digest)


def test_repair_says_so_where_the_result_is_another(run, tmp_path):
    artifacts, _ = run(squares={"unsteady": True})
    flip(artifacts["squares"].part_of("n004")[0])
    lines = mend(tmp_path, artifacts["squares"])
    assert any("DIFFERENT from before" in line and "later stages still hold" in line for line in lines)


@pytest.mark.parametrize("copies", ["manifest.json", "manifest.json draft.json"])
def test_an_artifact_with_a_damaged_manifest_is_found_by_its_key_and_its_name(run, tmp_path, copies):
    artifacts, _ = run()
    store, numbers = Store(tmp_path / "store"), artifacts["numbers"]
    key, name = numbers.key, numbers.path.name
    for copy in copies.split():
        flip(numbers.path / copy)
    for reference in (
        key,
        key[:12],
        key[:6],
        name,
        f"numbers/{name}",
        f"numbers/{key[:12]}",
        f"numbers/{key}",
        str(numbers.path),
    ):
        assert store.resolve(reference).path == numbers.path, reference
    assert repr(store.resolve(key)) == f"Artifact(numbers/{name})"
    for reference in (key[:4] + "zzzz", f"squares/{key}", key[1:13]):
        with pytest.raises(UserError, match="no artifact"):
            store.resolve(reference)
    other = artifacts["squares"].key  # of a readable one all letters count
    with pytest.raises(UserError, match="no artifact"):
        store.resolve(other[:20] + "zz")
    parsed = parser().parse_args(["repair", key, "--workers", "0", "--store", str(store.root)])
    if copies == "manifest.json":
        assert parsed.function(parsed) == 0
        assert store.resolve("numbers").digest == numbers.digest
    else:
        with pytest.raises(Damaged, match="delete the folder"):
            parsed.function(parsed)


def test_repair_reads_the_listing_part_by_part(run, tmp_path, monkeypatch):
    """There may be millions of rows: no more than a part's are held, wherever the listing has its damage."""
    artifacts, _ = run(numbers={"n": 40})
    artifact = artifacts["squares"]
    computed(tmp_path)
    path = artifact.path / "items.jsonl"
    lines = path.read_text().splitlines()
    for number in (4, len(lines) - 1):
        lines[number] = "?"
    path.write_text("\n".join(lines) + "\n")
    parsed: list[Row] = []
    monkeypatch.setattr(Row, "from_json", lambda line, parse=Row.from_json: parsed.append(parse(line)) or parsed[-1])
    assert len(next(sound_parts(Artifact(artifact.path)))["rows"]) == 3 and len(parsed) == 4
    mend(tmp_path, artifact)
    parts = [part["items"] for part in artifact.manifest["outputs"]["parts"]]
    assert computed(tmp_path) == sorted([*parts[1], *parts[-1]])
    assert Store(tmp_path / "store").resolve("squares").verify(deep=True) == []


@pytest.fixture
def unreadable(monkeypatch):
    """unreadable(path, ...): from here on the disk cannot read these files, as long as they are not made anew."""
    real = builtins.open
    bad = {}  # by inode; held open, so that no new file gets its number

    def spoilt(path, mode="r", *arguments, **more):
        if not isinstance(path, int) and set(mode) <= set("rbt") and Path(path).exists() and os.stat(path).st_ino in bad:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return real(path, mode, *arguments, **more)

    def spoil(*paths: Path) -> None:
        bad.update({path.stat().st_ino: real(path, "rb") for path in paths})
        monkeypatch.setattr(builtins, "open", spoilt)
        monkeypatch.setattr(io, "open", spoilt)

    yield spoil
    for file in bad.values():
        file.close()


def test_verify_and_repair_go_on_after_a_file_that_cannot_be_read(run, tmp_path, unreadable, capsys):
    artifacts, _ = run()
    artifact = artifacts["squares"]
    computed(tmp_path)
    lost, flipped = (artifact.part_of(name)[0] for name in ("n004", "n005"))
    assert lost != flipped
    flip(flipped)
    cut(artifacts["total"].file("total.txt"))
    unreadable(lost, artifact.path / "files" / "card.txt")
    parsed = parser().parse_args(["verify", "--deep", "--store", str(tmp_path / "store")])
    assert parsed.function(parsed) == Damaged.status
    output = capsys.readouterr().out
    for problem in (
        f"{lost.name} cannot be read (Input/output error)",
        "card.txt cannot be read",
        f"{flipped.name} does not hash",
    ):
        assert problem in output
    assert "1 of 3 artifacts sound" in output
    lines = mend(tmp_path, artifact)
    assert computed(tmp_path) == sorted(row.item for row in artifact.rows() if row.part in (lost.stem, flipped.stem))
    assert any("equal to before" in line for line in lines)
    assert Store(tmp_path / "store").resolve("squares").verify(deep=True) == []


@pytest.mark.parametrize("name", ["items.jsonl", "rejects.jsonl", "manifest.json"])
def test_a_listing_or_manifest_that_cannot_be_read_is_damage(run, tmp_path, unreadable, name):
    artifacts, _ = run()
    numbers = artifacts["numbers"]
    unreadable(numbers.path / name)
    (problem,) = Artifact(numbers.path).verify(deep=True)
    assert name in problem and "Input/output error" in problem
    with pytest.raises(Damaged, match="lightmill repair"):
        run(squares={"offset": 1}) if name != "rejects.jsonl" else Artifact(numbers.path).rejects()
    mend(tmp_path, numbers)
    mended = Store(tmp_path / "store").resolve("numbers")
    assert mended.digest == numbers.digest and mended.verify(deep=True) == []


def test_a_reader_meets_an_unreadable_part_as_damage(run, unreadable):
    artifacts, _ = run(stage="numbers")
    unreadable(artifacts["numbers"].part_of("n004")[0])
    with pytest.raises(Damaged, match=r"cannot be read \(Input/output error\); `lightmill repair numbers/"):
        run()


def test_a_resume_makes_a_part_that_cannot_be_read_again(run, tmp_path, unreadable):
    with pytest.raises(UserError, match="n013"):
        run(stage="numbers", numbers={"n": 15, "fail": ["n013"]})
    (draft,) = Store(tmp_path / "store").drafts()
    unreadable(sorted(draft.glob("parts/*.tar"))[0])
    artifacts, lines = run(stage="numbers")
    assert any("1 finished part(s) of the interrupted run are damaged and made again" in line for line in lines)
    assert artifacts["numbers"].verify(deep=True) == []


def test_a_damaged_part_of_a_draft_does_not_pass_for_one_that_is_taken_over(run, tmp_path):
    """An earlier artifact has the same part, sound: it replaces the damaged one of that name."""
    run(stage="numbers", numbers={"n": 8})
    with pytest.raises(UserError, match="n013"):
        run(stage="numbers", numbers={"n": 15, "fail": ["n013"]})
    (draft,) = Store(tmp_path / "store").drafts()
    for path in draft.glob("parts/*.tar"):
        flip(path)
    artifacts, _ = run(stage="numbers")
    assert artifacts["numbers"].verify(deep=True) == []


def test_a_run_stage_is_repaired_as_a_whole(run, tmp_path):
    artifacts, _ = run()
    cut(artifacts["total"].file("total.txt"))
    lines = mend(tmp_path, artifacts["total"])
    assert any("has no parts" in line for line in lines) and any("equal to before" in line for line in lines)


def test_what_cannot_be_repaired_says_what_to_do(run, tmp_path):
    artifacts, _ = run()
    store, squares = Store(tmp_path / "store"), artifacts["squares"]
    lines = mend(tmp_path, squares)
    assert lines == [f"{squares.name}: sound, nothing to repair"]
    for name in ("manifest.json", "draft.json"):
        flip(squares.path / name)
    with pytest.raises(Damaged, match="delete the folder and run"):
        repair(store, Artifact(squares.path), 0)
    total = artifacts["total"]
    cut(total.file("total.txt"))
    (squares.path).rename(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="made from squares .*, which is gone"):
        repair(store, Artifact(total.path), 0)


def test_nothing_is_made_from_damaged_bytes(run, tmp_path):
    """An input that changed on disk stops the run, which says what to do; an old artifact that gives nothing is passed over."""
    artifacts, _ = run(stage="numbers")
    numbers = artifacts["numbers"]
    path, _ = numbers.part_of("n004")
    data = path.read_bytes()
    place, _ = numbers.row("n004").members["value.txt"]
    path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    with pytest.raises(Damaged, match=f"changed at record n004; `lightmill repair numbers/{numbers.path.name}`"):
        run()
    grown, _ = run(stage="numbers", numbers={"n": 20})
    fresh, _ = run(stage="numbers", numbers={"n": 20}, store=str(tmp_path / "fresh"))
    assert grown["numbers"].digest == fresh["numbers"].digest
    assert grown["numbers"].verify(deep=True) == []
    mend(tmp_path, numbers)
    assert run()[0]["total"] is not None


def test_a_damaged_manifest_stops_only_who_needs_it(run, tmp_path, capsys):
    artifacts, _ = run()
    numbers = artifacts["numbers"]
    flip(numbers.path / "manifest.json")
    again, lines = run()
    assert again["total"].digest == artifacts["total"].digest  # up to date, needs nothing
    with pytest.raises(Damaged, match="lightmill repair"):
        run(squares={"offset": 1})
    store = ["--store", str(tmp_path / "store")]
    parsed = parser().parse_args(["verify", "--deep", *store])
    assert parsed.function(parsed) == Damaged.status
    parsed = parser().parse_args(["ls", *store])
    assert parsed.function(parsed) == 0
    assert "damaged: `lightmill verify` says how" in capsys.readouterr().out
    parsed = parser().parse_args(["repair", f"numbers/{numbers.path.name}", "--workers", "0", *store])
    assert parsed.function(parsed) == 0
    assert run(squares={"offset": 1})[0]["numbers"].digest == numbers.digest


def parser():
    import argparse

    root = argparse.ArgumentParser()
    commands.add_commands(root.add_subparsers(), "lightmill")
    return root


def test_damage_to_an_unfinished_artifact_is_made_good_by_the_next_run(run, tmp_path):
    """Whatever file of a draft changes while nobody works on it: the next run ends as if nothing had happened."""
    fine, _ = run(store=str(tmp_path / "fine"))
    seen = set()
    for seed in range(12):
        store = tmp_path / f"store{seed}"
        with pytest.raises(UserError, match="n013"):
            run(store=str(store), numbers={"n": 15, "fail": ["n013"]})
        files = sorted(
            path for path in store.glob("toy/numbers/*.partial/**/*") if path.is_file() and path.parent.name != "logs"
        )
        path = files[seed % len(files)]
        seen.add(path.parent.name)
        (flip if seed % 3 else cut)(path)
        artifacts, _ = run(store=str(store))
        assert {name: a.digest for name, a in artifacts.items()} == {name: a.digest for name, a in fine.items()}
        assert not [problem for artifact in artifacts.values() for problem in artifact.verify(deep=True)]
    assert {"parts", "markers"} <= seen
