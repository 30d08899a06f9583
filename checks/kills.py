"""Kills runs at random points and compares what they end with to an undisturbed run. Run by hand:

    python checks/kills.py --what synthetic --kills 150 --seed 0
    python checks/kills.py --what data --kills 50
    python checks/kills.py --what train --kills 30
    python checks/kills.py --what neuras --kills 36

*synthetic* is the toy system of tests/pipeline/toy.py, *data* the line from collect to shard, *train* training on such shards,
*neuras* the line of that system from a tiny street to its report.
A run is started, struck once or twice by SIGKILL (its runner; or one of its workers, after which it must go on by itself),
started again and so on until one run ends; then digests and files (of training also the loss log) must be those of the
undisturbed run, every byte must verify, and no part that was finished when a kill struck may have been written again. Then the
next round begins from nothing. Each kill aims at the stage that was struck least. Half of them wait a random time in it, the
others for a moment that is short: a part just finished, a listing, a manifest, a commit. Exits non-zero at any difference.
``--store`` keeps the undisturbed run for the next slice.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import psutil

from pipeline.store import Artifact, Store
from pipeline.store.folder import PLACES

ROOT = Path(__file__).resolve().parents[1]
DATA = (
    "remesh.resolution=24", "decimate.budgets=[64]", "scene.count.train=6", "scene.count.validation=2", "scene.count.test=2",
    "scene.cameras.views=2", "render.resolution=32", "render.max_spp=1", "shard.shard_mb=0.05",
)  # fmt: skip
TRAIN = (
    "train.steps=40", "train.batch_scenes=2", "train.views_per_scene=2", "train.warmup=2", "train.ema=0.9",
    "train.device=cpu", "train.threads=1", "train.log_every=1", "train.validate_every=13", "train.checkpoint_every=5",
    "train.tensorboard=false", "model.latent_dim=128", "model.num_heads=1", "model.dim_feedforward=512", "model.num_layers=1",
    "model.view_transformer_latent_dim=128", "model.view_transformer_n_heads=1", "model.view_transformer_ffn_hidden_dim=512",
    "model.view_transformer_n_layers=4",
)  # fmt: skip
NEURAS = (
    "capture.length=90", "capture.texture_size=64", "capture.training_frames=3", "capture.width=96", "capture.height=54",
    "capture.spp=1", "capture.shifts=[-2.0,2.0]", "capture.shift_frames=2", "capture.columns=90", "capture.beams=32",
    "scaffold.voxel_m=0.2", "scaffold.depth=8", "scaffold.faces=4000", "scaffold.speck_faces=4", "scaffold.cull_rays=1",
    "atlas.tile_faces=500", "fit.steps=200", "fit.sky_side=32", "fit.codes=64", "fit.device=cpu",
    "fit.checkpoint_every=5", "fit.log_every=1", "fit.validate_every=13", "evaluate.video_frames=2", "evaluate.timing_frames=1",
    "evaluate.timing_size=[64,36]", "evaluate.page_views=1", "workers=2",
)  # fmt: skip
NEURAS_STAGES = ("capture", "scaffold", "refine", "atlas", "fit", "bake", "evaluate")
MEASURED = ("seconds", "scenes_per_s", "tokens_per_s", "memory_gb", "mfu")  # of a log row; all else must be equal
MEASURED_FILES = ("log.jsonl", "timing.json", "report.html", "tensorboard/*")  # hold times; other files must be equal
# Pattern of what appears -> at most so many of them are waited for.
COMMIT = {"{stage}/*.partial/items.jsonl": 1, "{stage}/*.partial/manifest.json": 1, "{stage}/*-*/manifest.json": 1}
FILES = {"{stage}/*.partial/files/**/*": 2}
PARTS = {"{stage}/*.partial": 1, "{stage}/*.partial/markers/[!.]*.json": 4, "{stage}/*.partial/parts/*.tar": 4}
CHECKPOINTS = {"{stage}/*.partial/state/*": 1, "{stage}/*.partial/state/.*": 1}
MAP_MOMENTS, RUN_MOMENTS = PARTS | FILES | COMMIT, CHECKPOINTS | FILES | COMMIT
KILLS_PER_ROUND = 6
PATIENCE_S = 3600.0  # no run here takes so long, even on a busy machine: one that does hangs


@dataclass(frozen=True)
class Campaign:
    """What is killed: a command over a store, and the first stage that it makes anew in each round."""

    command: Callable[[Path], list[str]]
    stages: tuple[str, ...]  # their places in a store; made anew in each round; others are taken from the undisturbed run
    begun: str = " running "  # in the output: from here on there is something to lose


def meshes(folder: Path) -> Path:
    """Eight small meshes, enough for three splits: boxes of different proportions."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(8):
        x, y, z = 1.0, 1.0 + 0.2 * number, 0.5 + 0.1 * number**1.5
        corners = [f"v {x * (i & 1)} {y * (i >> 1 & 1)} {z * (i >> 2)}" for i in range(8)]
        faces = ("1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6")
        (folder / f"box{number}.obj").write_text("\n".join([*corners, *(f"f {face}" for face in faces), ""]))
    return folder


def line(stage: str, overrides: Sequence[str], stages: tuple[str, ...], **more: Any) -> Campaign:
    def command(store: Path) -> list[str]:
        where = [f"store={store}", f"hydra.run.dir={store}/.runs"]
        return [sys.executable, "-m", "pipeline", f"stage={stage}", *where, *overrides]

    return Campaign(command, stages, **more)


def renderformer(stage: str, overrides: Sequence[str], stages: tuple[str, ...], **more: Any) -> Campaign:
    def command(store: Path) -> list[str]:
        source = ["collect=folder", f"collect.path={meshes(store.parent / 'meshes')}"]
        return [*line(stage, overrides, stages).command(store), *source]

    return Campaign(command, stages, **more)


def synthetic(store: Path) -> list[str]:
    numbers, squares = {"n": 30, "pause_s": 0.02}, {"finish_s": 0.05}
    root = {"system": "tests.pipeline.toy", "stage": "total", "store": str(store), "workers": 2}
    root |= {"numbers": numbers, "squares": squares, "total": {"pause_s": 0.1}}
    return [sys.executable, "-m", "tests.pipeline.toy_main", json.dumps(root)]


CAMPAIGNS = {
    "synthetic": Campaign(synthetic, ("toy/numbers", "toy/squares", "toy/total")),
    "data": renderformer("shard", DATA, ("collect", "remesh", "decimate", "scene", "render", "shard")),
    "train": renderformer("train", (*DATA, *TRAIN), ("train",), begun="parameters ("),
    "neuras": line("evaluate", ("system=neuras", *NEURAS), tuple(f"neuras/{stage}" for stage in NEURAS_STAGES)),
}


class Run:
    """One process of a campaign, its output in a file."""

    def __init__(self, campaign: Campaign, store: Path):
        store.mkdir(parents=True, exist_ok=True)
        self.campaign, self.store = campaign, store
        self.output = store / ".output.txt"
        with open(self.output, "w") as file:
            self.process = subprocess.Popen(campaign.command(store), cwd=ROOT, stdout=file, stderr=subprocess.STDOUT)
        self.began, self.began_at = time.monotonic(), time.time()
        self.at_work: float | None = None  # seconds after the start

    def text(self) -> str:
        return self.output.read_text()

    def wait_until(self, ready: Callable[[], bool], pause_s: float = 0.002) -> bool:
        """False if the process ended first."""
        while not ready():
            if self.process.poll() is not None:
                return False
            if time.monotonic() - self.began > PATIENCE_S:
                self.process.kill()
                raise SystemExit(f"a run hangs; its output:\n{self.text()}")
            time.sleep(pause_s)
        return True

    def begin(self) -> bool:
        found = self.wait_until(lambda: self.campaign.begun in self.text(), 0.01)
        self.at_work = time.monotonic() - self.began
        return found

    def end(self) -> int:
        self.wait_until(lambda: False, 0.01)
        return self.process.returncode

    def workers(self) -> list[psutil.Process]:
        with contextlib.suppress(psutil.Error):
            children = psutil.Process(self.process.pid).children()
            return [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        return []


def rows(path: Path) -> list[dict]:
    """The complete lines of a loss log, less what was measured."""
    found = []
    for text in path.read_text().splitlines():
        try:
            found.append({name: value for name, value in json.loads(text).items() if name not in MEASURED})
        except ValueError:
            break
    return found


def inside(store: Path, pattern: str) -> list[Path]:
    """What matches in any place of the store."""
    return [path for place in PLACES for path in store.glob(f"{place}/{pattern}")]


def draft_of(store: Path) -> Path | None:
    """The draft at work: of several (one that another stage left) the newest."""
    found = sorted(inside(store, "*.partial"), key=lambda path: path.stat().st_mtime)
    return found[-1] if found else None


def written(store: Path, pattern: str, since: float) -> int:
    """How many matches were written since that time."""
    count = 0
    for path in store.glob(pattern):
        with contextlib.suppress(OSError):
            count += path.stat().st_mtime >= since
    return count


def where(store: Path) -> str:
    """How far the run in the store is, for the table: stage and phase."""
    with contextlib.suppress(OSError):
        draft = draft_of(store)
        if draft is None:
            return "between stages"
        phase = "parts"
        if (draft / "manifest.json").exists():
            phase = "commit, manifest"
        elif (draft / "items.jsonl").exists():
            phase = "commit, listings"
        elif (draft / "state" / "log.jsonl").exists():
            phase = "steps"
        elif any((draft / "files").iterdir()):
            phase = "files"
        return f"{draft.parent.name}: {phase}"
    return "between stages"


def finished(store: Path) -> dict[tuple[str, str], int]:
    """(stage, file) -> inode, of every part with a marker and every manifest of an artifact: what must not be made again."""
    found = {}
    for marker in inside(store, "*.partial/markers/[!.]*.json"):
        with contextlib.suppress(OSError, ValueError):
            digest = json.loads(marker.read_bytes())["digest"]
            if digest is not None:
                path = marker.parents[1] / "parts" / f"{digest}.tar"
                found[path.parents[2].name, path.name] = path.stat().st_ino
    for manifest in inside(store, "*-*/manifest.json"):
        found[manifest.parents[1].name, manifest.name] = manifest.stat().st_ino
        for path in manifest.parent.glob("parts/*.tar"):
            found[path.parents[2].name, path.name] = path.stat().st_ino
    return found


def other_files(artifact: Artifact) -> dict[str, str]:
    """Digests of the artifact's files, less those that hold times."""
    files = artifact.manifest["outputs"]["files"].items()
    return {name: entry["digest"] for name, entry in files if not any(fnmatch(name, pattern) for pattern in MEASURED_FILES)}


def differences(calm: Path, killed: Path, stages: Sequence[str]) -> list[str]:
    """What the killed run's artifacts have other than the undisturbed one's; empty where they are the same."""
    found = []
    for stage in stages:
        wanted, got = Store(calm).artifacts(stage), Store(killed).artifacts(stage)
        if len(wanted) != 1 or len(got) != 1:
            found.append(f"{stage}: {len(got)} artifacts, not {len(wanted)}")
            continue
        (a,), (b,) = wanted, got
        if (a.key, a.digest) != (b.key, b.digest):
            found.append(f"{stage}: digest {b.digest[:12]}, not {a.digest[:12]}")
        found += [f"{stage}: {problem}" for problem in b.verify(deep=True)]
        files = [other_files(artifact) for artifact in (a, b)]
        unequal = sorted(name for name in files[0].keys() | files[1] if files[0].get(name) != files[1].get(name))
        if a.digest == b.digest:  # else it is said already
            found += [f"{stage}: files/{name} differs" for name in unequal]
        logs = [artifact.path / "files" / "log.jsonl" for artifact in (a, b)]
        if logs[0].exists() and rows(logs[0]) != rows(logs[1]):
            found.append(f"{stage}: the loss logs differ")
    found += [f"a draft is left: {draft.parent.name}/{draft.name}" for draft in Store(killed).drafts()]
    return found


@dataclass
class Tally:
    kills: int = 0
    rounds: int = 0
    starts: int = 0
    retries: int = 0
    again: int = 0  # finished parts that were written again
    wrong: list[str] = field(default_factory=list)
    struck: Counter = field(default_factory=Counter)


class Striker:
    """One seeded series of rounds."""

    def __init__(self, campaign: Campaign, calm: Path, folder: Path, seed: int, work_s: float):
        self.campaign, self.calm, self.folder, self.work_s = campaign, calm, folder, work_s
        self.random = random.Random(seed)
        self.tally = Tally()
        self.aims: Counter = Counter()  # by stage
        self.kept: dict[tuple[str, str], int] = {}

    def round(self, kills: int) -> None:
        """Kill at most ``kills`` times, then let a run end, and compare."""
        tally = self.tally
        tally.rounds += 1
        store = self.folder / f"round-{tally.rounds}"
        ignored = shutil.ignore_patterns(*(Path(stage).name for stage in self.campaign.stages), ".*")
        shutil.copytree(self.calm, store, ignore=ignored)
        self.kept = {}
        before, status = tally.kills, None
        while status is None:
            status = self.life(store, tally.kills - before < kills)
        self.check_kept(store)
        wrong = differences(self.calm, store, self.campaign.stages)
        if status:
            wrong.append(f"the last run ended with status {status}:\n{(store / '.output.txt').read_text()}")
        tally.wrong += wrong
        print(f"round {tally.rounds:3}: {tally.kills - before} kills, {'; '.join(wrong) or 'same digests'}", flush=True)
        if not wrong:
            shutil.rmtree(store)

    def life(self, store: Path, may_kill: bool) -> int | None:
        """One process: its exit status, or None if its runner was killed."""
        self.tally.starts += 1
        run = Run(self.campaign, store)
        try:
            if may_kill and run.begin():
                stage = self.aim(store)
                to_worker = self.random.random() < 0.4 and bool(self.parts(stage))
                struck = to_worker and self.strike(run, stage, worker=True)
                if struck:
                    stage = self.aim(store)
                if (not struck or self.random.random() < 0.5) and self.strike(run, stage, worker=False):
                    return None
            status = run.end()
        finally:
            run.process.kill()
            run.process.wait()
            text = run.text()
            self.tally.retries += text.count("trying it once more") + text.count("starts again")
        return status

    def aim(self, store: Path) -> str:
        """The stage to strike: of those that the run has yet to make, the one that was aimed at least."""
        stages = self.campaign.stages
        stage = min((s for s in stages if not list(store.glob(f"{s}/*-*"))), key=lambda s: self.aims[s], default=stages[-1])
        self.aims[stage] += 1
        return stage

    def parts(self, stage: str) -> list[Path]:
        """The tars of the undisturbed run's artifact: none of a run stage."""
        return list(self.calm.glob(f"{stage}/*/parts/*.tar"))

    def starts(self, stage: str) -> list[str]:
        """What appears in the draft where a random time may begin: the draft itself, or the first of many steps."""
        return ["", "/state/log.jsonl"] if "steps" in Store(self.calm).resolve(stage).manifest["config"] else [""]

    def strike(self, run: Run, stage: str, worker: bool) -> bool:
        """Kill the runner or a worker at a random point of the stage; False if the run ended before."""
        if self.random.random() < 0.5:
            delay = self.random.uniform(0, 0.9 * self.left(run.store, stage))
            aim = f"{delay:.2f} s into {stage}"
            start, since = self.random.choice(self.starts(stage)), run.began_at
            arrived = run.wait_until(lambda: written(run.store, f"{stage}/*.partial{start}", since) > 0)
            began = time.monotonic()
            arrived = arrived and run.wait_until(lambda: time.monotonic() - began > delay)
        else:
            moments = MAP_MOMENTS if self.parts(stage) else RUN_MOMENTS
            pattern = self.random.choice(list(moments))
            number, jitter = self.random.randint(1, moments[pattern]), self.random.uniform(0, 0.004)
            aim, since = f"at {pattern.format(stage=stage)}", time.time()
            arrived = run.wait_until(lambda: written(run.store, pattern.format(stage=stage), since) >= number, 0.0005)
            time.sleep(jitter)
        if worker:
            run.wait_until(lambda: bool(run.workers()), 0.01)
        targets = run.workers() if worker else [run.process]
        if not arrived or not targets or run.process.poll() is not None:
            return False
        place = where(run.store)
        with contextlib.suppress(psutil.Error):
            self.random.choice(targets).kill()
        if not worker and run.process.wait() != -signal.SIGKILL:  # it ended just before
            return False
        self.check_kept(run.store)
        self.kept = finished(run.store)
        who = "worker" if worker else "runner"
        self.tally.kills += 1
        self.tally.struck[place, who] += 1
        print(f"  kill {self.tally.kills:3}: {who} {aim:<44} {place}", flush=True)
        return True

    def check_kept(self, store: Path) -> None:
        """Count what was finished at the last kill and has been written again since."""
        now = finished(store)
        again = [key for key, inode in self.kept.items() if key in now and now[key] != inode and key[1] != "manifest.json"]
        self.tally.again += len(again)
        self.tally.wrong += [f"{stage}: part {name} was finished and made again" for stage, name in again]

    def left(self, store: Path, stage: str) -> float:
        """Seconds that the stage still needs, roughly: the undisturbed run's, by the parts or steps that are missing."""
        calm = Store(self.calm).resolve(stage)
        parts, logs = self.parts(stage), list(store.glob(f"{stage}/*.partial/state/log.jsonl"))
        done = 0.0
        if parts:
            done = len(list(store.glob(f"{stage}/*.partial/parts/*.tar"))) / len(parts)
        elif logs:
            done = max((row["step"] for row in rows(logs[0])), default=0) / calm.manifest["config"]["steps"]
        return min(calm.manifest["seconds"], self.work_s) * max(0.1, 1 - done)


def undisturbed(campaign: Campaign, store: Path) -> tuple[float, float]:
    """Make the artifacts to compare with, where they are missing. Returns seconds until work began, and of work."""
    stages = [stage for stage in campaign.stages if (store / stage).exists()]
    for stage in stages:
        shutil.rmtree(store / stage)
    run = Run(campaign, store)
    run.begin()
    if run.end():
        raise SystemExit(f"a run that nobody killed failed:\n{run.text()}")
    return run.at_work or 0.0, time.monotonic() - run.began - (run.at_work or 0.0)


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=tuple(CAMPAIGNS), default="synthetic")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", type=Path, help="folder that keeps what the campaign reads (train: shards) for other slices")
    arguments = parser.parse_args(words)
    campaign = CAMPAIGNS[arguments.what]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        calm = (arguments.store or Path(folder)) / f"calm-{arguments.what}"
        start_s, work_s = undisturbed(campaign, calm)
        print(f"undisturbed: {start_s:.1f} s until work begins, {work_s:.1f} s of work", flush=True)
        striker = Striker(campaign, calm, Path(folder) / "killed", arguments.seed, work_s)
        tally = striker.tally
        while tally.kills < arguments.kills and not tally.wrong:
            striker.round(min(KILLS_PER_ROUND, arguments.kills - tally.kills))
        elapsed = time.monotonic() - began
        print(f"\n{'struck':<40} {'runner':>7} {'worker':>7}")
        for place in sorted({place for place, _ in tally.struck}):
            print(f"{place:<40} {tally.struck[place, 'runner']:>7} {tally.struck[place, 'worker']:>7}")
        print(
            f"\n{arguments.what}, seed {arguments.seed}: {tally.kills} kills in {tally.rounds} rounds, {tally.starts} starts, "
            f"{tally.retries} retries, {tally.again} finished parts made again, "
            f"{len(tally.wrong)} differences; {elapsed:.0f} s, {elapsed / max(tally.kills, 1):.1f} s a kill"
        )
        for problem in tally.wrong:
            print(f"DIFFERENT: {problem}")
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
