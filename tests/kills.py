"""Kills the line at random moments of each stage and compares the digests with those of an undisturbed run. Run by hand:

    python tests/kills.py --kills 3 --seed 0 [overrides]

Overrides choose the data (by default a small set that takes a few minutes). Exits non-zero when a digest differs.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pipeline.stage import load_system
from pipeline.store import Store

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("collect", "remesh", "decimate", "scene", "render", "shard")
SMALL = ("collect.per_family=1", "scene.count.train=24", "scene.count.validation=4", "scene.count.test=4", "render.max_spp=4")


def start(stage: str, store: Path, overrides: list[str]) -> subprocess.Popen:
    command = [sys.executable, "-m", "pipeline", f"stage={stage}", f"store={store}", f"hydra.run.dir={store}/runs", *overrides]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen) -> None:
    output, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"a run that nobody killed failed:\n{output}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=3, help="kills per stage")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("overrides", nargs="*", default=list(SMALL))
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)
    different = 0
    with tempfile.TemporaryDirectory() as folder:
        calm, killed = Path(folder) / "calm", Path(folder) / "killed"
        for stage in STAGES:
            began = time.monotonic()
            finish(start(stage, calm, arguments.overrides))
            took = time.monotonic() - began
            when = []
            for _ in range(arguments.kills):
                process = start(stage, killed, arguments.overrides)
                when.append(moments.uniform(0.2, 1.0) * took)
                try:
                    process.wait(when[-1])
                except subprocess.TimeoutExpired:
                    os.kill(process.pid, signal.SIGKILL)
                process.communicate()
            finish(start(stage, killed, arguments.overrides))
            (a,), (b,) = Store(calm).artifacts(stage), Store(killed).artifacts(stage)
            same = a.digest == b.digest and a.key == b.key and not b.verify(deep=True)
            different += not same
            print(
                f"{load_system('renderformer').number(stage):02} {stage:<9} {took:6.1f} s  killed after "
                f"{', '.join(f'{moment:.1f}' for moment in when)} s: {'same digest' if same else 'DIFFERENT'}",
                flush=True,
            )
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
