"""Which Mitsuba variant works here: CUDA, LLVM with one of the installed libraries, or the scalar fall-back.

A JIT compiler that does not fit the machine aborts the whole process (libLLVM 14 and 15 on recent CPUs), so each
candidate proves itself in a child process that path traces a tiny scene (``trial``). The answer
is plain JSON, which a stage records and passes to its workers: ``{"backend": "llvm", "llvm": 19}``. It names LLVM
by its major version, not by path: a path changes with every small upgrade and from machine to machine.
"""

from __future__ import annotations

import fcntl
import functools
import glob
import importlib
import itertools
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

from pipeline.errors import UserError
from pipeline.gpus import VISIBLE, visible_gpus

CHOICES = ("auto", "cuda", "llvm", "scalar")
VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}
PROBE_SECONDS = 180.0  # the first CUDA kernel of a fresh machine takes tens of seconds
FOLDERS = (
    "/usr/lib",
    "/usr/lib64",
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
INSTALL = "install libLLVM 16 or newer (Debian, Ubuntu: apt-get install libllvm19) for renders several times as fast"

OUR_FAULT = 3  # exit status of a trial that failed by a mistake in this package

log = logging.getLogger("lightmill")


def llvm_libraries() -> list[str]:
    """Paths of the libLLVM here, DRJIT_LIBLLVM_PATH first, then the newest first."""
    paths = set()
    for folder in FOLDERS:
        for name in ("libLLVM*.so*", "libLLVM*.dylib"):
            paths |= {os.path.realpath(path) for path in glob.glob(os.path.join(folder, name))}
    ldconfig = shutil.which("ldconfig") or "/sbin/ldconfig"
    if os.path.exists(ldconfig):
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
        paths |= {os.path.realpath(path) for path in re.findall(r"=> (\S*libLLVM\S*)", listing)}

    def version(path: str) -> tuple[list[int], str]:
        return [int(number) for number in re.findall(r"\d+", os.path.basename(path))], path

    ordered = sorted((path for path in paths if os.path.isfile(path)), key=version, reverse=True)
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    return ([named] if named else []) + [path for path in ordered if path != named]


def llvm_version(path: str) -> int | None:
    """The major version that the path of a libLLVM names (libLLVM-15.so.1, libLLVM.so.19.1, llvm-19/lib/libLLVM.so); the
    links of a file that is there are followed. None where none does."""
    real = os.path.realpath(path)
    digits = re.search(r"\d+", os.path.basename(real)) or re.search(r"(?<=llvm[-@/])\d+", real)
    return int(digits[0]) if digits else None


def llvm_backend(path: str) -> dict[str, Any]:
    """The backend of a libLLVM: by major version, or by path where that names none."""
    version = llvm_version(path)
    return {"backend": "llvm", "library": path} if version is None else {"backend": "llvm", "llvm": version}


def by_version(backend: dict[str, Any]) -> dict[str, Any]:
    """The backend as it is recorded now: artifacts that are older name LLVM by path."""
    return llvm_backend(backend["library"]) if backend.get("library") else backend


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Whether two recorded backends may make one artifact."""
    return by_version(a) == by_version(b)


def llvm_library(backend: dict[str, Any]) -> str | None:
    """The path of libLLVM for an LLVM backend, on this machine; None where there is none."""

    def suits(path: str) -> bool:
        return os.path.isfile(path) and llvm_backend(path) == by_version(backend)

    named = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    return named if suits(named) else next(filter(suits, llvm_libraries()), None)


_claims: list[IO] = []  # open lock files: a claim lasts as long as its process


def claim_gpu() -> None:
    """Keep this process to one GPU, the one that fewest render processes of this machine have claimed."""
    gpus = visible_gpus()
    if len(gpus) < 2 or _claims:
        return
    folder = Path(tempfile.gettempdir()) / f"lightmill-gpus-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    for place, gpu in ((place, gpu) for place in itertools.count() for gpu in gpus):
        file = (folder / f"{re.sub(r'[^A-Za-z0-9-]', '_', gpu)}.{place}").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            continue
        _claims.append(file)
        os.environ[VISIBLE] = gpu
        return


def candidates(choice: str) -> list[dict[str, Any]]:
    """Backends to try for a choice of the config, best first."""
    backends: list[dict[str, Any]] = []
    if choice in ("auto", "cuda") and visible_gpus():
        backends.append({"backend": "cuda"})
    if choice in ("auto", "llvm"):
        libraries = [llvm_backend(path) for path in llvm_libraries() if os.path.isfile(path)]
        backends += [backend for number, backend in enumerate(libraries) if backend not in libraries[:number]]
    if choice in ("auto", "scalar"):
        backends.append({"backend": "scalar"})
    return backends


def works(candidate: dict[str, Any]) -> bool:
    """True if a child process renders the tiny scene with this backend. The scalar one needs no proof."""
    if candidate["backend"] == "llvm" and llvm_library(candidate) is None:
        return False
    return candidate["backend"] == "scalar" or _proof(json.dumps(candidate, sort_keys=True))


@functools.cache
def _proof(candidate: str) -> bool:
    root = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "stages.graphics.mitsuba.trial", candidate]
    try:
        child = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, timeout=PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        log.info("renderer %s did not finish its trial within %g s", candidate, PROBE_SECONDS)
        return False
    if child.returncode == OUR_FAULT:
        raise RuntimeError(f"the renderer's trial failed by a mistake in lightmill:\n{child.stderr.decode(errors='replace')}")
    if child.returncode:
        log.info("renderer %s failed its trial: %s", candidate, child.stderr.decode(errors="replace").strip()[-300:])
    return child.returncode == 0


def choose(choice: str = "auto", previous: dict[str, Any] | None = None) -> dict[str, Any]:
    """The backend to render with, as plain JSON: ``{"backend": ..., "llvm": major version of libLLVM}``.

    ``previous`` is what an interrupted artifact was begun with: it is kept, as another one gives other bytes.
    """
    if choice not in CHOICES:
        raise UserError(f"backend={choice!r} is unknown: choose from {', '.join(CHOICES)}")
    if previous:
        previous = by_version(previous)
        if works(previous):
            return previous
        raise UserError(
            f"this artifact was begun with the backend {_title(previous)}, which does not work here: finish it "
            "where it does, or start it anew with force=STAGE"
        )
    for candidate in candidates(choice):
        if works(candidate):
            if candidate["backend"] == "scalar" and choice == "auto":
                log.warning("no JIT backend of Mitsuba works here, rendering with scalar_rgb: %s", INSTALL)
            return candidate
    needs = {"cuda": "an NVIDIA GPU and its driver", "llvm": "libLLVM 16 or newer, or DRJIT_LIBLLVM_PATH naming one"}
    raise UserError(f"backend={choice} does not work here: it needs {needs[choice]}; backend=auto takes what works")


def _title(backend: dict[str, Any]) -> str:
    return " with ".join(f"LLVM {value}" if name == "llvm" else str(value) for name, value in sorted(backend.items()))


def max_workers(backend: dict[str, Any]) -> int | None:
    """At most this many processes render at a time: one for each GPU that this process may use; None for any number."""
    return max(1, len(visible_gpus())) if backend["backend"] == "cuda" else None


def activate(backend: dict[str, Any], threads: int | None = None) -> None:
    """Select the backend's Mitsuba variant in this process, with that many threads (None: all cores)."""
    if backend["backend"] == "llvm":
        library = llvm_library(backend)
        if library is None:
            raise UserError(f"the backend {_title(backend)} is not on this machine: {INSTALL}, or set DRJIT_LIBLLVM_PATH")
        os.environ["DRJIT_LIBLLVM_PATH"] = library  # read once, when Dr.Jit first compiles
    if backend["backend"] == "cuda" and threads is not None:  # in a worker: others use the other GPUs
        claim_gpu()
    mitsuba = importlib.import_module("mitsuba")
    drjit = importlib.import_module("drjit")
    if mitsuba.variant() != VARIANTS[backend["backend"]]:
        mitsuba.set_variant(VARIANTS[backend["backend"]])
    if threads is not None:
        drjit.set_thread_count(threads)
        # Open Image Denoise reads these at its first use; pinned threads of several workers would share a core.
        os.environ |= {"OIDN_NUM_THREADS": str(threads), "OIDN_SET_AFFINITY": "0"}
