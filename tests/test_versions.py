"""A stage's code may not change silently: bump its ``version``, or state here that its output is unchanged.

After a change: ``python -m tests.test_versions`` rewrites versions.json; the commit's message says which it was.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.code import code_digest
from pipeline.stage import load_system

SYSTEMS = [load_system(name) for name in ("renderformer", "neuras")]
FILE = Path(__file__).with_name("versions.json")


def current() -> dict[str, dict]:
    return {
        system.name: {
            name: {"version": system.stage(name).version, "code": code_digest(system, name)} for name in system.modules
        }
        for system in SYSTEMS
    }


@pytest.mark.parametrize(("system", "name"), [(system.name, name) for system in SYSTEMS for name in system.modules])
def test_version_belongs_to_the_code(system, name):
    known = json.loads(FILE.read_text())[system][name]
    assert current()[system][name] == known, (
        f"the code behind {system}'s {name} changed: bump its version if its output did, then run python -m tests.test_versions"
    )


if __name__ == "__main__":
    FILE.write_text(json.dumps(current(), indent=1) + "\n")
