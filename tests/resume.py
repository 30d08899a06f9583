"""Kills training at random steps and compares its log and checkpoint with those of an undisturbed run. Run by hand:

    python tests/resume.py --kills 3 --seed 0 [--store STORE] [overrides]

Overrides choose data and training (by default a small set, 60 steps). With --store the data in it is used.
Exits non-zero when a line of the loss log or a byte of the checkpoint differs.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pipeline.store import Store

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ("seconds", "scenes_per_s", "tokens_per_s", "memory_gb", "mfu")  # of a log row; all else must be equal
SMALL = (
    "collect.per_family=1", "scene.count.train=24", "scene.count.validation=4", "scene.count.test=4", "render.max_spp=4",
    "train.steps=60", "train.ema=0.9", "train.validate_every=20",
)  # fmt: skip


def start(stage: str, store: Path, overrides: list[str]) -> subprocess.Popen:
    command = [sys.executable, "-m", "pipeline", f"stage={stage}", f"store={store}", f"hydra.run.dir={store}/runs", *overrides]
    always = ["train.log_every=1", "train.checkpoint_every=7", "train.device=cpu"]
    return subprocess.Popen([*command, *always], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen) -> None:
    output, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"a run that nobody killed failed:\n{output}")


def rows(path: Path) -> list[dict]:
    """The log's complete lines, less what was measured."""
    found = []
    for line in path.read_text().splitlines():
        try:
            found.append({name: value for name, value in json.loads(line).items() if name not in MEASURED})
        except ValueError:
            break
    return found


def reached(store: Path) -> int:
    """The last step in the log of the run in the making."""
    logs = list(store.glob("train/*.partial/state/log.jsonl"))
    lines = rows(logs[0]) if logs else []
    return lines[-1]["step"] if lines else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--store", type=Path, help="with the shards of the same overrides")
    parser.add_argument("overrides", nargs="*", default=list(SMALL))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        calm, killed = Path(folder) / "calm", Path(folder) / "killed"
        if arguments.store:
            shutil.copytree(arguments.store, calm, ignore=shutil.ignore_patterns("train", "evaluate", "runs"))
        finish(start("shard", calm, arguments.overrides))
        shutil.copytree(calm, killed)
        finish(start("train", calm, arguments.overrides))
        whole = Store(calm).resolve("train")
        steps = rows(whole.file("log.jsonl"))[-1]["step"]
        when = sorted(random.Random(arguments.seed).sample(range(1, steps), arguments.kills))
        for step in when:
            process = start("train", killed, arguments.overrides)
            while process.poll() is None and reached(killed) < step:
                time.sleep(0.02)
            print(f"killed after step {reached(killed)} (wanted {step})", flush=True)
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
        finish(start("train", killed, arguments.overrides))
        resumed = Store(killed).resolve("train")
        same_log = rows(whole.file("log.jsonl")) == rows(resumed.file("log.jsonl"))
        print(f"loss log: {len(rows(whole.file('log.jsonl')))} lines, {'equal' if same_log else 'DIFFERENT'}")
        print(f"checkpoint: {'equal' if whole.digest == resumed.digest else 'DIFFERENT'}")
        return 0 if same_log and whole.digest == resumed.digest else 1


if __name__ == "__main__":
    sys.exit(main())
