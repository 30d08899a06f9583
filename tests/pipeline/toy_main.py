"""Runs the toy system from a JSON config on the command line, as ``python -m pipeline`` does: a process that tests can kill."""

import json
import sys

from pipeline.__main__ import guarded
from pipeline.run import run_pipeline


def say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(guarded(lambda: run_pipeline(json.loads(sys.argv[1]), sys.argv, say)))
