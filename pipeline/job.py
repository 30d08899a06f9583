"""One job of a sweep in a process of its own: ``python -m pipeline.job`` reads from standard input what the sweep composed."""

from __future__ import annotations

import json
import signal
import sys

from pipeline.interrupts import guarded
from pipeline.run import run_plan
from pipeline.sweep import plan_again
from pipeline.worker import die_with_parent


def main() -> int:
    """Returns the exit status of the run."""
    die_with_parent()  # it ends with the sweep that started it ...
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ... but Ctrl-C shall reach it
    job = json.load(sys.stdin)

    def work() -> None:
        plan = plan_again(job["name"], job["root"], job["keys"])
        run_plan(plan, job["command"], lambda text: print(text, flush=True))

    return guarded(work, debug=job["root"]["debug"])


if __name__ == "__main__":
    sys.exit(main())
