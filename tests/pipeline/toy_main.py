"""Runs the toy system from a JSON config on the command line: a process that tests can kill."""

import json
import sys

from pipeline.runner import run_pipeline

if __name__ == "__main__":
    run_pipeline(json.loads(sys.argv[1]), sys.argv)
