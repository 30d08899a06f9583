"""Compares two stores that two versions of the code made from the same command: keys, and digests of parts and products.

    python checks/same_parts.py STORE_A STORE_B

One line per artifact. Exits with 1 where a key of one store is missing in the other, or where a digest differs. Digests of
artifacts cover the parts and the products of run stages; files of measured times are not in them.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipeline.store import Store  # noqa: E402


def digests(root: str) -> dict[tuple[str, str], tuple[str, int]]:
    """(stage, key) -> (digest over parts and products, number of parts) of every artifact in the store."""
    return {
        (artifact.stage, artifact.key): (artifact.digest, len(artifact.manifest["outputs"]["parts"]))
        for artifact in Store(root).artifacts()
    }


def main(first: str, second: str) -> int:
    a, b = digests(first), digests(second)
    different = 0
    for name in sorted(a.keys() | b.keys()):
        verdict = "only in one store" if name not in a or name not in b else "equal" if a[name] == b[name] else "DIFFERENT"
        different += verdict != "equal"
        digest, parts = a.get(name) or b[name]
        print(f"{name[0]:<10} key {name[1][:12]}  digest {digest[:12]}  {parts:>3} parts  {verdict}")
    return int(different > 0 or not a)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
