"""A stage's code may not change silently: bump its ``version``, or state here that its output is unchanged.

After a change: ``python tests/renderformer/test_versions.py`` rewrites versions.json; the commit's message says which it was.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.code import code_digest
from pipeline.stage import load_system

SYSTEM = load_system("renderformer")
FILE = Path(__file__).with_name("versions.json")


def current() -> dict[str, dict]:
    return {name: {"version": SYSTEM.stage(name).version, "code": code_digest(SYSTEM, name)} for name in SYSTEM.modules}


@pytest.mark.parametrize("name", SYSTEM.modules)
def test_version_belongs_to_the_code(name):
    known = json.loads(FILE.read_text())[name]
    assert current()[name] == known, (
        f"the code behind {name} changed: bump its version if its output did, then run "
        "python tests/renderformer/test_versions.py"
    )


if __name__ == "__main__":
    FILE.write_text(json.dumps(current(), indent=1) + "\n")
