"""Feed collect with damaged mesh files, and count what becomes of them. Run by hand:

    python checks/fuzz_meshes.py --path DIR --store STORE [--count 2000] [--seed 0] [--largest-kb 96]

Takes the small mesh files below DIR that are accepted as they are, the twins. Makes seeded mutants of them: flipped bits,
truncations, swapped numbers, blocks that are lost, doubled or replaced. Runs *collect* with colours on all of them as any run
does, in worker processes with limits. Prints what each kind of file came to, how long it took and how much memory. Exits with
1 where a twin is rejected, a worker crashed, an item hit a limit, a detail names an exception, a record is not finite, or
under a fifth of the mutants is accepted. Mutants lie in STORE/mutants, so that one that fails can be looked at.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from pipeline.errors import Reject  # noqa: E402
from pipeline.store import Store  # noqa: E402
from stages.graphics.geometry.load import SUFFIXES, load_mesh  # noqa: E402
from stages.graphics.geometry.records import MeshRecord  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
CRASHED = ("crash", "time", "memory")
CLASSES = re.compile(r"\b\w*(?:Error|Exception)\b|Traceback|NoneType|object has no")
SWAPS = b'0 -1 1 7 65535 4294967295 1e38 -1e-30 1e999 nan x null "" [] 2.5'.split()
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


# -- mutants


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """One to eight flipped bits."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        changed[rng.integers(len(changed))] ^= 1 << rng.integers(8)
    return bytes(changed)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of the file, most often nearly all of it."""
    left = rng.integers(1, len(data)) if rng.random() < 0.5 else len(data) - rng.integers(1, min(len(data), 65))
    return data[: int(left)]


def swap_number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number in text, of a GLB in its JSON, becomes another of the file or one that is none of them."""
    head = 20 + struct.unpack_from("<I", data, 12)[0] if data[:4] == b"glTF" and len(data) > 20 else min(len(data), 1 << 16)
    places = list(NUMBER.finditer(data, 20 if data[:4] == b"glTF" else 0, head))
    if not places:
        return flip(data, rng)
    place = places[rng.integers(len(places))]
    new = SWAPS[rng.integers(len(SWAPS))] if rng.random() < 0.7 else places[rng.integers(len(places))][0]
    if data[:4] != b"glTF":
        return data[: place.start()] + new + data[place.end() :]
    text = data[20 : place.start()] + new + data[place.end() : head]
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + data[16:20] + text + data[head:]
    return data[:8] + struct.pack("<I", 12 + len(body)) + body


def block(data: bytes, rng: np.random.Generator) -> bytes:
    """A block of up to 64 bytes is lost, comes twice, is zeros, or is random bytes."""
    start = int(rng.integers(len(data)))
    end = start + int(rng.integers(1, 65))
    middle = [b"", data[start:end] * 2, bytes(len(data[start:end])), rng.bytes(end - start)][rng.integers(4)]
    return data[:start] + middle + data[end:]


MUTATIONS: list[Callable[[bytes, np.random.Generator], bytes]] = [flip, truncate, swap_number, block]


def twins(root: Path, largest: int) -> dict[str, bytes]:
    """The small mesh files below a folder that are whole in themselves and accepted, by name."""
    found = {}
    for path in sorted(path for path in root.rglob("*") if path.suffix.lower() in SUFFIXES):
        data = path.read_bytes()
        if len(data) > largest or re.search(rb'"uri"\s*:\s*"(?!data:)', data):
            continue
        try:
            load_mesh(path, path.parent, 1 << 28, 2_000_000)
        except Reject:
            continue
        found[f"{len(found):03d}-{path.stem}{path.suffix.lower()}"] = data
    if not found:
        sys.exit(f"no small mesh file below {root} is accepted: give a folder of sound files, or a larger --largest-kb")
    return found


def write_files(folder: Path, originals: dict[str, bytes], count: int, seed: int) -> dict[str, str]:
    """Twins and mutants in a folder; returns the mutation of each file's name, "" for a twin. Formats take turns."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    mutations = dict.fromkeys(originals, "")
    by_suffix: dict[str, list[str]] = {}
    for name in originals:
        by_suffix.setdefault(Path(name).suffix, []).append(name)
    for name, data in originals.items():
        (folder / name).write_bytes(data)
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        suffixes = sorted(by_suffix)
        names = by_suffix[suffixes[number % len(suffixes)]]
        original = names[rng.integers(len(names))]
        mutate = MUTATIONS[rng.integers(len(MUTATIONS))]
        name = f"m{number:04d}-{mutate.__name__}{Path(original).suffix}"
        (folder / name).write_bytes(mutate(originals[original], rng))
        mutations[name] = mutate.__name__
    return mutations


# -- the run


def collect(folder: Path, store: Path) -> float:
    """Run collect on the folder; returns the seconds that it took."""
    words = ["stage=collect", "collect=folder", f"collect.path={folder}", "collect.textures=true", "collect.max_reject_share=1"]
    words += [f"store={store}", "workers=1"]
    start = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-m", "pipeline", *words], cwd=ROOT, env=environment, check=True)
    return time.perf_counter() - start


def outcomes(store: Path) -> tuple[dict[str, tuple[str, str]], int]:
    """(reason and detail) of each file, "accepted" where there is a record; and how many records are not finite.

    A file whose surface is that of another is one that was accepted as well.
    """
    artifact = Store(store).artifacts("collect")[-1]
    found = {row["item"]: (row["reason"], row["detail"]) for row in artifact.rejects()}
    found = {item: ("accepted", "") if reason == "duplicate" else (reason, detail) for item, (reason, detail) in found.items()}
    bad = 0
    for row in artifact.rows():
        if row.item in found and found[row.item][0] != "accepted":
            sys.exit(f"{row.item} is both a record and a reject")
        found[row.item] = ("accepted", "")
        record = artifact.read(row.id)
        if "mesh.npz" in record.members:
            mesh = MeshRecord.from_record(record)
            bad += int(not np.isfinite(mesh.vertices).all() or mesh.faces.max() >= len(mesh.vertices))
    return found, bad


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--path", type=Path, required=True)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--largest-kb", type=int, default=96)
    arguments = parser.parse_args()
    folder = arguments.store / "mutants"
    mutations = write_files(folder, twins(arguments.path, arguments.largest_kb * 1024), arguments.count, arguments.seed)
    seconds = collect(folder, arguments.store)
    found, bad = outcomes(arguments.store)
    faults = [f"{name}: no outcome" for name in mutations if name not in found]
    faults += [f"twin {n}: {': '.join(found[n])}" for n, how in mutations.items() if not how and found[n][0] != "accepted"]
    faults += [f"{name}: {reason}: {detail}" for name, (reason, detail) in found.items() if reason in CRASHED]
    faults += [f"{name}: {detail}" for name, (_, detail) in found.items() if CLASSES.search(detail)]
    if bad:
        faults.append(f"{bad} records are not finite")
    mutants = [name for name, how in mutations.items() if how]
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"\n{len(mutations) - len(mutants)} twins, {len(mutants)} mutants, {seconds:.0f} s, {peak:.0f} MB at most\n")
    print("| | mutants | accepted | most frequent rejects |\n| --- | ---: | ---: | --- |")
    for kind in [*sorted({Path(name).suffix for name in mutants}), *(m.__name__ for m in MUTATIONS), ""]:
        of_kind = [name for name in mutants if not kind or Path(name).suffix == kind or mutations[name] == kind]
        reasons = Counter(found[name][0] for name in of_kind)
        accepted = reasons.pop("accepted", 0)
        rejects = ", ".join(f"{reason} {number}" for reason, number in reasons.most_common(6))
        print(f"| {kind or 'all'} | {len(of_kind)} | {accepted} | {rejects} |")
    if sum(found[name][0] == "accepted" for name in mutants) < len(mutants) / 5:
        faults.append("under a fifth of the mutants is accepted")
    (arguments.store / "outcomes.json").write_text(json.dumps(found, indent=1))
    for fault in faults:
        print(f"FAULT {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
