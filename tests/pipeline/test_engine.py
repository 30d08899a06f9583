"""What would break for a user of the engine: keys, reuse, growth, faults, kills, the commands."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tarfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pipeline import commands
from pipeline.config import Section, added, parse, runtime
from pipeline.errors import MachineError, UserError
from pipeline.keys import canonical, canonical_json, seed_for
from pipeline.plan import plan_run
from pipeline.run import run_pipeline
from pipeline.stage import Record
from pipeline.store import Store
from tests.pipeline.toy import Numbers, Squares, Total

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def run(tmp_path):
    """run(numbers={...}, ...) -> (artifacts by stage, lines printed)."""

    def go(workers: int = 0, **overrides):
        lines: list[str] = []
        root = {"system": "tests.pipeline.toy", "stage": "total", "store": str(tmp_path / "store"), "workers": workers}
        root |= {"numbers": {}, "squares": {}, "total": {}} | overrides
        result = run_pipeline(root, ["test"], lines.append)
        return result["artifacts"], lines

    return go


def contents(artifacts):
    return {name: artifact.digest for name, artifact in artifacts.items()}


# -- keys and configs


class Example(Section):
    rate: float = 1.0
    device: str = runtime("cpu")
    later: int = added(5, legacy=5)


def test_key_holds_what_decides_the_output_and_nothing_else():
    assert canonical(Example(rate=2, device="cuda")) == {"rate": 2.0}
    assert canonical(Example(later=6)) == {"rate": 1.0, "later": 6}
    assert canonical_json({"b": 1, "a": (1, 2.0)}) == b'{"a":[1,2.0],"b":1}'


@pytest.mark.parametrize("value", [float("nan"), object(), {1: 2}, b"bytes", Path("/x")])
def test_key_refuses_what_has_no_canonical_form(value):
    with pytest.raises(TypeError):
        canonical(value)


def test_unknown_key_names_the_nearest():
    with pytest.raises(UserError, match="did you mean 'rate'"):
        parse(Example, {"rte": 1}, "example")
    with pytest.raises(UserError, match="example.rate"):
        parse(Example, {"rate": "fast"}, "example")


def test_seed_depends_on_the_item_not_on_the_others():
    assert seed_for(0, "scene", "a") == seed_for(0, "scene", "a")
    assert len({seed_for(s, n, i) for s in (0, 1) for n in ("x", "y") for i in ("a", "b")}) == 8


@pytest.mark.parametrize("name", ["../x", "a/b", "", "a.b", "x" * 121])
def test_record_ids_cannot_leave_their_folder(name):
    with pytest.raises(ValueError):
        Record(name, {})


# -- running


def test_an_input_that_only_an_option_reads_enters_no_other_key(run):
    plain, _ = run()
    assert set(plain["total"].manifest["preimage"]["inputs"]) == {"squares"}
    both, lines = run(total={"plus_numbers": True})
    assert set(both["total"].manifest["preimage"]["inputs"]) == {"numbers", "squares"}
    assert sum("up to date" in line for line in lines) == 2
    totals = [float(result["total"].file("total.txt").read_text()) for result in (plain, both)]
    assert totals[1] > totals[0]


def test_second_run_computes_nothing(run):
    first, _ = run()
    second, lines = run()
    assert contents(first) == contents(second)
    assert all("up to date" in line for line in lines if line[:2].isdigit())


def test_worker_count_does_not_change_bytes(run, tmp_path):
    serial, _ = run(workers=0)
    other, _ = run(workers=2, store=str(tmp_path / "other"))
    assert contents(serial) == contents(other)


def test_more_items_compute_only_the_new_ones(run, tmp_path):
    log = tmp_path / "computed"
    run(squares={"log_to": str(log)})
    assert len(log.read_text().split()) == 10
    log.unlink()
    grown, _ = run(numbers={"n": 15}, squares={"log_to": str(log)})
    assert sorted(log.read_text().split()) == ["n010", "n011", "n012", "n014"]  # n013 is rejected upstream
    fresh, _ = run(numbers={"n": 15}, store=str(tmp_path / "fresh"))
    assert contents(grown) == contents(fresh)


def test_growth_takes_over_what_a_like_environment_made(run, tmp_path, monkeypatch):
    """The stage says which environments are alike: a library's small upgrade, say."""
    tool = ["1.1"]
    monkeypatch.setattr(Numbers, "environment", lambda self, config, previous: {"tool": tool[-1]})
    run(numbers={"n": 6})
    monkeypatch.setattr(Numbers, "same_environment", lambda self, one, other: one["tool"][0] == other["tool"][0])
    for version, n, computed in (("1.2", 8, 2), ("2.0", 10, 10), ("1.3", 12, 4)):
        tool.append(version)
        log = tmp_path / f"{version}.log"
        artifacts, _ = run(numbers={"n": n, "log_to": str(log)})
        assert len(log.read_text().splitlines()) == computed, version
        assert artifacts["numbers"].manifest["environment"] == {"tool": version}


def test_one_changed_parameter_reruns_its_stage_and_what_follows(run):
    before, _ = run()
    after, _ = run(squares={"offset": 1})
    assert before["numbers"].key == after["numbers"].key
    assert before["squares"].key != after["squares"].key
    assert before["total"].key != after["total"].key


def test_force_reports_equal(run):
    run()
    _, lines = run(force="squares")
    assert any("squares" in line and "equal to before" in line for line in lines)


def test_rejects_are_recorded_with_their_reason(run):
    artifacts, _ = run(numbers={"n": 15})
    (reject,) = artifacts["numbers"].rejects()
    assert (reject["item"], reject["reason"], reject["detail"]) == ("n013", "unlucky", "it is thirteen")
    with pytest.raises(UserError, match="1 unlucky"):
        run(numbers={"n": 15, "max_reject_share": 0.01, "scale": 2})


def test_parts_are_plain_webdataset_tars(run):
    artifacts, _ = run()
    squares = artifacts["squares"]
    path, _ = squares.part_of("n004")
    with tarfile.open(path) as tar:
        members = {member.name: member for member in tar.getmembers()}
        assert members["n004.square.txt"].mtime == 0
        data = tar.extractfile("n004.square.txt").read()
    assert data == squares.read("n004").members["square.txt"]
    assert squares.read("n004", only=["square.txt"]).members == {"square.txt": data}
    assert squares.read("n004", only=[]).members == {}
    assert not [name for name in members if squares.row(name.split(".")[0]).group != squares.row("n004").group]


# -- faults


def test_crash_rejects_the_item_alone(run):
    artifacts, lines = run(workers=2, numbers={"n": 12, "crash": ["n005"]})
    (reject,) = artifacts["numbers"].rejects()
    assert (reject["item"], reject["reason"], reject["machine"]) == ("n005", "crash", True)
    assert len(artifacts["numbers"].rows()) == 11


def test_a_worker_killed_once_costs_nothing(run, tmp_path):
    (tmp_path / "once").mkdir()
    killed, _ = run(workers=2, numbers={"n": 12, "crash_once": str(tmp_path / "once")})
    undisturbed, _ = run(numbers={"n": 12}, store=str(tmp_path / "fresh"))
    assert (tmp_path / "once" / "mark").exists()
    assert contents(killed) == contents(undisturbed)


@pytest.mark.parametrize(
    ("kind", "limits", "reason"), [("hang", {"cpu_s": 0.5}, "time"), ("greedy", {"memory_gb": 0.4}, "memory")]
)
def test_limits_reject_the_item_alone(run, kind, limits, reason):
    artifacts, _ = run(workers=1, stage="numbers", numbers={"n": 6, kind: ["n003"], "limits": limits})
    assert [(r["item"], r["reason"]) for r in artifacts["numbers"].rejects()] == [("n003", reason)]


def test_a_bug_in_one_item_leaves_its_part_unfinished_and_keeps_all_other_items(run, tmp_path):
    with pytest.raises(UserError, match="n003") as caught:
        run(numbers={"fail": ["n003"]})
    assert "RuntimeError: a bug" in str(caught.value)
    (draft,) = Store(tmp_path / "store").drafts()
    assert len(list((draft / "markers").iterdir())) == 3  # of 4 parts
    _, lines = run()
    assert "9 of them already there" in " ".join(lines)


# -- the store


def test_verify_deep_finds_planted_corruption(run):
    artifacts, _ = run()
    artifact = artifacts["squares"]
    assert artifact.verify(deep=True) == []
    path, _ = artifact.part_of("n000")
    data = bytearray(path.read_bytes())
    data[600] ^= 1
    path.write_bytes(data)
    assert artifact.verify() == []
    assert "does not hash" in artifact.verify(deep=True)[0]
    path.write_bytes(data[:-512])
    assert "bytes, not" in artifact.verify()[0]


@pytest.fixture
def synced(monkeypatch):
    """Inodes in the order in which they were flushed to the disk."""
    inodes: list[int] = []
    fsync = os.fsync

    def noting(handle):
        inodes.append(os.fstat(handle).st_ino)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", noting)
    return inodes


def test_files_are_on_the_disk_before_the_manifest_vouches_for_them(run, synced, monkeypatch):
    def finish(self, config, inputs, draft):
        (draft.files / "checkpoint" / "deep").mkdir(parents=True)
        for name in ("card.txt", "checkpoint/model", "checkpoint/deep/model"):
            (draft.files / name).write_text("what a power cut would have lost")

    monkeypatch.setattr(Squares, "finish", finish)
    artifacts, _ = run()
    for artifact in artifacts.values():
        manifest = synced.index((artifact.path / "manifest.json").stat().st_ino)
        for path in [*artifact.path.glob("files/**/*"), *artifact.path.glob("parts/*.tar")]:
            assert path.stat().st_ino in synced[:manifest], path
        for path in (artifact.path / "files", artifact.path / "parts", artifact.path.parent):
            assert path.stat().st_ino in synced[manifest:], path
    assert len(list(artifacts["squares"].path.glob("files/**/*"))) == 5


def test_a_part_that_had_to_be_copied_is_flushed_too(run, synced, monkeypatch):
    """Where hard links are not possible; a link needs no flush, its bytes are on the disk."""
    old, _ = run(stage="numbers")

    def link(source, target):
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", link)
    grown, _ = run(stage="numbers", numbers={"n": 20})
    shared = {p.name for p in (old["numbers"].path / "parts").iterdir()} & {
        p.name for p in grown["numbers"].path.glob("parts/*")
    }
    assert shared
    for name in shared:
        inodes = [(artifact["numbers"].path / "parts" / name).stat().st_ino for artifact in (old, grown)]
        assert inodes[0] != inodes[1] and inodes[1] in synced


def test_gc_keeps_pinned_recent_and_their_inputs(run, tmp_path):
    old, _ = run()
    new, _ = run(squares={"offset": 1})
    store = Store(tmp_path / "store")
    past = time.time() - 30 * 86400
    for artifact in store.artifacts():
        os.utime(store.root / ".used" / artifact.key, (past, past))
    store.pin(new["squares"].key)
    gone = {path for path, _ in store.garbage(days=14)}
    assert gone == {old["squares"].path, old["total"].path, new["total"].path}


PAST = time.time() - 30 * 86400


def unused(store: Store) -> None:
    """As if nobody had used the artifacts for a month."""
    for artifact in store.artifacts():
        os.utime(store.root / ".used" / artifact.key, (PAST, PAST))


def untouched(draft: Path) -> None:
    for path in sorted(draft.rglob("*"), reverse=True):
        os.utime(path, (PAST, PAST))


def interrupted(run, store: Store) -> tuple[dict, Path]:
    """Artifacts of numbers and squares, and the draft of a total that a run left."""
    artifacts, _ = run(stage="squares")
    planned = plan_run({"system": "tests.pipeline.toy", "stage": "total", "numbers": {}, "squares": {}, "total": {}}).stages[
        "total"
    ]
    return artifacts, store.draft("total", planned.key, planned.preimage).path


@pytest.mark.parametrize("folder", ["state", "logs", "files/validation", "running", "markers"])
def test_gc_keeps_a_draft_as_long_as_anything_in_it_is_new(run, tmp_path, folder):
    """A training run that stopped a minute ago, after weeks, and all that it reads."""
    store = Store(tmp_path / "store")
    artifacts, draft = interrupted(run, store)
    unused(store)
    (draft / folder).mkdir(exist_ok=True)
    (draft / folder / "training.pt").write_bytes(b"saved a minute ago")
    untouched(draft)
    os.utime(draft / folder / "training.pt")
    assert store.garbage(days=14) == []
    untouched(draft)
    assert {path for path, _ in store.garbage(days=14)} == {draft, *(artifact.path for artifact in artifacts.values())}


def test_gc_keeps_what_a_run_at_work_reads_however_old(run, tmp_path):
    store = Store(tmp_path / "store")
    artifacts, draft = interrupted(run, store)
    unused(store)
    untouched(draft)
    claim = store.claim("total", draft.name.removesuffix(".partial"))
    with held_elsewhere(claim):
        assert store.garbage(days=14) == []
        (draft / "draft.json").write_bytes(b"damaged: it cannot say what it reads")
        assert store.garbage(days=14) == []
    assert len(store.garbage(days=14)) == 3


def test_what_a_run_found_made_is_in_use_from_its_start_on(run, tmp_path):
    """Not from when its turn comes, which may be weeks later."""
    artifacts, _ = run()
    store = Store(tmp_path / "store")
    unused(store)
    with pytest.raises(UserError, match="a bug"):
        run(force="numbers", numbers={"fail": ["n003"]})
    assert store.garbage(days=14) == []


@contextlib.contextmanager
def held_elsewhere(claim):
    """Another process has the claim."""
    code = "import time; from pathlib import Path; from pipeline.store import Claim; "
    code += f"print(Claim(Path({str(claim.path)!r})).take(), flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "True\n"
        yield
    finally:
        process.kill()
        process.wait()


def test_gc_keeps_all_that_lies_upstream_whatever_was_made_first(run, tmp_path):
    """Squares were forced after the total was made: they are newer than what needs them, and numbers are needed by them."""
    run()
    run(stage="squares", force="squares")
    store = Store(tmp_path / "store")
    unused(store)
    store.pin(store.resolve("total").key)
    assert {path.parent.name for path, _ in store.garbage(days=14)} == {".trash"}


def test_gc_keeps_the_inputs_of_what_can_be_repaired(run, tmp_path):
    artifacts, _ = run()
    store = Store(tmp_path / "store")
    unused(store)
    (artifacts["squares"].path / "manifest.json").unlink()
    assert {path for path, _ in store.garbage(days=14)} == {artifacts["total"].path}


def test_gc_looks_again_before_each_removal(run, tmp_path):
    """What came into use after the list was made stays."""
    store = Store(tmp_path / "store")
    artifacts, draft = interrupted(run, store)
    unused(store)
    untouched(draft)
    paths = [path for path, _ in store.garbage(days=14)]
    assert paths[0] == draft and len(paths) == 3
    with held_elsewhere(store.claim("total", draft.name.removesuffix(".partial"))):
        assert not any(store.remove(path, days=14) for path in paths)
    run(stage="squares")
    assert store.remove(draft, days=14)
    assert not any(store.remove(path, days=14) for path in paths[1:])
    assert set(store.folders()) == {artifact.path for artifact in artifacts.values()}
    unused(store)
    assert all(store.remove(path, days=14) for path in paths[1:])
    assert store.folders() == store.drafts() == store.garbage(days=14) == []


@pytest.mark.parametrize("struck", ["rename", "delete"])
def test_a_gc_that_is_interrupted_leaves_only_trash(run, tmp_path, monkeypatch, struck):
    """Killed after its rename or in the middle of deleting: that is no artifact any more, and the next gc ends it."""
    artifacts, _ = run()
    store = Store(tmp_path / "store")

    def die(path, **_):
        if struck == "delete":
            (path / "manifest.json").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("shutil.rmtree", die)
        with pytest.raises(KeyboardInterrupt):
            store.remove(artifacts["numbers"].path, days=0)
    assert store.find("numbers", artifacts["numbers"].key) is None
    assert len(store.folders()) == 2 and not store.drafts()
    assert [path.parent.name for path, _ in store.garbage(days=14)] == [".trash"]
    assert run(squares={"offset": 1})[0]["numbers"].digest == artifacts["numbers"].digest
    for path, _ in store.garbage(days=14):
        assert store.remove(path, days=14)
    assert store.garbage(days=14) == []


def test_what_an_earlier_gc_left_half_deleted_is_no_artifact(run, tmp_path):
    """Before there was the trash, gc renamed an artifact to .gone-<its name> beside the others."""
    artifacts, _ = run()
    store, numbers = Store(tmp_path / "store"), artifacts["numbers"]
    aside = numbers.path.with_name(f".gone-{numbers.path.name}")
    numbers.path.rename(aside)
    half = store.root / "squares" / artifacts["squares"].path.name / ".gone-markers"  # then there were no systems' folders
    half.mkdir(parents=True)
    aside.with_name(f".gone-{numbers.key}.partial").mkdir()
    assert store.find("numbers", numbers.key) is None and store.drafts() == []
    assert {path.name for path, _ in store.garbage(days=14)} == {
        aside.name, ".gone-markers", f".gone-{numbers.key}.partial",
    }  # fmt: skip
    assert run(squares={"offset": 1})[0]["numbers"].digest == numbers.digest


def test_resolve_takes_keys_names_and_stages(run, tmp_path):
    artifacts, _ = run()
    store = Store(tmp_path / "store")
    squares = artifacts["squares"]
    for reference in ("squares", squares.key[:8], f"squares/{squares.path.name}", str(squares.path)):
        assert store.resolve(reference).key == squares.key
    for reference in ("nothing", "../squares", "0000"):
        with pytest.raises(UserError):
            store.resolve(reference)


def test_difference_names_the_parameter(run):
    before, _ = run()
    after, _ = run(squares={"offset": 1})
    lines = commands.difference(before["squares"].manifest["preimage"], after["squares"].manifest["preimage"])
    assert lines == ["squares.offset: 0 -> 1"]


def test_import_rules():
    """The engine knows no mesh, image or tensor; only stages/ imports mesh, renderer and shard libraries.

    ``pipeline.atomic`` is anybody's: it writes files and knows nothing of the engine.
    """
    import ast

    forbidden = {
        "pipeline": {"numpy", "torch", "mitsuba", "drjit", "trimesh", "pymeshlab", "webdataset", "stages", "model"},
        "model": {"hydra", "omegaconf", "pipeline", "stages", "mitsuba", "trimesh", "pymeshlab", "webdataset"},
        "stages": {"hydra", "omegaconf"},
    }
    for package, names in forbidden.items():
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_bytes())):
                imported = []
                if isinstance(node, ast.Import):
                    imported = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    imported = [node.module]
                bad = {name.split(".")[0] for name in imported if name != "pipeline.atomic"} & names
                assert not bad, f"{path.relative_to(ROOT)}:{node.lineno} imports {bad}"


# -- opening a worker


def test_opening_counts_against_no_item(run):
    """An open of 2 s under a limit of 1 s: before, every process's first item was rejected as `time`."""
    numbers = {"n": 5, "open_s": 2.0, "limits": {"wall_s": 1.0}}
    artifacts, lines = run(workers=1, stage="numbers", numbers=numbers)
    assert len(artifacts["numbers"].rows()) == 5 and artifacts["numbers"].rejects() == []
    assert not any("once more" in line for line in lines)


def test_opening_has_a_limit_of_its_own_and_fails_the_stage(run, monkeypatch):
    monkeypatch.setattr(Numbers, "open_wall_s", 0.5)
    with pytest.raises(MachineError, match="workers die while they open what its items need .over 0.5 s on the clock"):
        run(workers=1, stage="numbers", numbers={"n": 5, "open_s": 30.0})


# -- followers of a torchrun


@pytest.fixture
def follower(tmp_path, monkeypatch):
    """A run as its second process sees it: it makes nothing itself."""
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setattr("pipeline.run.LEADER_PATIENCE_S", 1.0)
    sections = {"numbers": {"n": 4}, "squares": {}, "total": {}}
    root = {"system": "tests.pipeline.toy", "stage": "total", "store": str(tmp_path / "store"), "workers": 0} | sections
    return root, plan_run(root).stages


def test_a_follower_does_not_wait_for_a_leader_that_is_gone(follower):
    with pytest.raises(MachineError, match="the process that leads this torchrun is gone"):
        run_pipeline(follower[0], ["test"], print)


def test_a_follower_waits_for_what_the_stage_reads_while_the_leader_works(follower, tmp_path, monkeypatch):
    """total reads squares alone: *numbers* may be gone. The leader holds a claim for longer than the patience, then is done."""
    root, plan = follower
    followed = []
    monkeypatch.setattr(Total, "follow", lambda stage, config, inputs: followed.append(sorted(inputs)))
    claim = Store(tmp_path / "store").claim(plan["numbers"].place, plan["numbers"].key)
    with held_elsewhere(claim), ThreadPoolExecutor(1) as thread:
        waiting = thread.submit(run_pipeline, root, ["test"], print)
        time.sleep(2.5)
        assert not waiting.done()
        for name in ("RANK", "WORLD_SIZE"):
            monkeypatch.delenv(name)
        leader = {**root, "store": str(tmp_path / "other"), "stage": "squares"}
        squares = run_pipeline(leader, ["test"], print)["artifacts"]["squares"]
        target = Store(tmp_path / "store").root / squares.place / squares.path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        squares.path.rename(target)
        waiting.result(timeout=30)
    assert followed == [["squares"]]
