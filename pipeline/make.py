"""Make one artifact: claim it, compute it in a draft, commit it."""

from __future__ import annotations

import contextlib
import os
import platform
import shlex
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import metadata
from typing import Any

from pipeline.code import code_digest, commit
from pipeline.errors import INTERRUPTED, STORAGE_ERRORS, Damaged, MachineError, for_people, status_of
from pipeline.executor import REASONS
from pipeline.gpus import gpu_models
from pipeline.making import Making, Run
from pipeline.mapping import run_map
from pipeline.plan import Planned, base_key
from pipeline.progress import duration
from pipeline.stage import MapStage, RunStage
from pipeline.status import RunState
from pipeline.store import DRAFT, SCHEMA, Artifact, Attempt, Claim, Draft, Store


def machine_rejects(artifact: Artifact | None) -> list[dict[str, Any]]:
    """Rejects of the artifact that are the machine's doing: items that crashed or hit a limit."""
    if artifact is None or not artifact.manifest["outputs"]["rejects"].keys() & set(REASONS):  # spares reading the listing
        return []
    return [reject for reject in artifact.rejects() if reject.get("machine")]


def describe(artifact: Artifact) -> str:
    """The artifact's name and its numbers of records and rejects, for a line of the run."""
    outputs = artifact.manifest["outputs"]
    text = artifact.name
    if outputs["items"]:
        rejects = sum(outputs["rejects"].values())
        text += f"  {outputs['records']} records" + (f", {rejects} rejected" if rejects else "")
    return text


def make_artifact(
    run: Run, planned: Planned, inputs: Mapping[str, Artifact], adopt: Callable[[Draft], None] | None = None
) -> Artifact:
    """Compute one artifact and commit it; returns that of another process which makes it meanwhile.

    ``inputs``: by role. ``adopt`` fills the draft of a repair with what is sound.
    """
    name = planned.name
    forced, retried = name in run.settings.force, name in run.settings.retry
    claim = run.store.claim(planned.place, planned.key)
    draft: Draft | None = None
    state: RunState | None = None
    began = time.monotonic()
    try:
        _take(claim, run, planned)
        existing = None if forced else run.store.find(planned.place, planned.key)
        if existing is not None and not (retried and machine_rejects(existing)):
            return existing
        code = code_digest(run.system, name)
        purpose = "repair" if adopt is not None else "force" if forced else "make"
        draft, state = _begin(run, planned, Attempt(_origin(run, planned), purpose, code))
        started = time.time()
        old_digest = _digest_of(run.store, planned.place, planned.key)
        if adopt is not None:
            adopt(draft)
        if existing is not None and draft.environment() is None:
            draft.set_environment(existing.manifest["environment"])  # its records are taken over
        environment = _environment(run, planned, draft.environment())
        draft.set_environment(environment)
        making = Making(run, planned, inputs, environment, draft, state)
        products = _compute(making)
        manifest = {**_manifest(making, products, code), "started": started}
        manifest |= {"finished": time.time(), "seconds": time.monotonic() - began}
        artifact = run.store.commit(draft, planned.stage.slug(planned.config), manifest, replace=forced or retried)
    except BaseException as error:
        if not (forced or retried) and (other := _made_by_another(run, planned, error)) is not None:
            return other
        error = _explained(error, run, planned)
        if draft is not None and state is not None:
            _end(draft, state, error)
        raise error
    finally:
        claim.release()
    verdict = _verdict(old_digest, artifact.digest) if forced or retried else ""
    run.say(name, f"done       {describe(artifact)}  in {duration(time.monotonic() - began)}{verdict}")
    return artifact


def _take(claim: Claim, run: Run, planned: Planned) -> None:
    """Wait for the claim, and say once who holds it."""
    announced = False
    while not claim.take():
        if not announced and (holder := claim.holder()) is not None:
            text = f"waiting: process {holder['pid']} on {holder['host']} is making {planned.key[:12]}"
            run.say(planned.name, text)
            announced = True
        time.sleep(0.5)


def _begin(run: Run, planned: Planned, attempt: Attempt) -> tuple[Draft, RunState]:
    """The draft to work in, new or left by an interrupted run, and the state that this run writes into it."""
    state: RunState | None = None

    def say(text: str) -> None:
        if state is not None:
            state.update(line=text)
        run.out(text)

    draft = run.store.draft(planned.place, planned.key, planned.preimage, attempt, say)
    draft.sweep()
    state = RunState(draft.path, command=shlex.join(run.command), plan=list(run.stages))
    return draft, state


def _origin(run: Run, planned: Planned) -> dict[str, Any]:
    """What it takes, beside the preimage, to make the artifact anew."""
    return {"system": run.settings.system, "config": planned.config.model_dump(mode="json")}


def _environment(run: Run, planned: Planned, previous: dict[str, Any] | None) -> dict[str, Any]:
    """The stage's runtime choices where it will run; ``previous``: those that the draft was begun with."""
    if run.cluster is not None and isinstance(planned.stage, MapStage):
        return run.cluster.environment(run.settings.system, planned.name, planned.config, previous)
    return planned.stage.environment(planned.config, previous)


def _compute(making: Making) -> list[str]:
    """Fill the draft; returns the names of the files that enter the artifact's digest."""
    planned, draft = making.planned, making.draft
    if isinstance(planned.stage, MapStage):
        run_map(making)
        return []
    assert isinstance(planned.stage, RunStage)
    making.say(f"running    {planned.stage.slug(planned.config)}-{planned.key[:12]}")
    products = planned.stage.run(planned.config, making.inputs, draft)
    draft.use_parts([])
    return products


def _manifest(making: Making, products: Sequence[str], code: str) -> dict[str, Any]:
    """What the artifact says of itself, but for its times. ``code``: the digest of the code that ends it."""
    run, planned, draft = making.run, making.planned, making.draft
    others = [other for other in draft.codes() if other != code]
    return {
        "schema": SCHEMA,
        "key": planned.key,
        "preimage": planned.preimage,
        "base_key": base_key(planned),
        **_origin(run, planned),
        "code": {"digest": code, **commit(), **({"others": others} if others else {})},
        "environment": making.environment,
        "machine": machine(run.system.packages),
        "outputs": draft.outputs(products),
        "summary": draft.summary,
        "command": shlex.join(run.command),
    }


def _made_by_another(run: Run, planned: Planned, error: BaseException) -> Artifact | None:
    """The artifact, if the error comes of another process that took the claim and was faster; None otherwise."""
    draft_path = run.store.draft_path(planned.place, planned.key)
    if (draft_path / DRAFT).exists() or not isinstance(error, Exception):
        return None
    artifact = run.store.find(planned.place, planned.key)
    if artifact is not None:
        shutil.rmtree(draft_path, ignore_errors=True)
        run.say(planned.name, f"done       {describe(artifact)}  by another process meanwhile")
    return artifact


def _explained(error: BaseException, run: Run, planned: Planned) -> BaseException:
    """The error, or one that says what to do where the store's disk is at fault; a bug is noted with its stage."""
    root = run.store.root
    if isinstance(error, OSError) and (error.errno in STORAGE_ERRORS or str(error.filename).startswith(f"{root}/")):
        where = f" ({error.filename})" if error.filename else ""
        remedy = "make room or mend the disk, and" if error.errno in STORAGE_ERRORS else "--debug says who asked for it;"
        return MachineError(
            f"{planned.name}: the store at {root} cannot be read or written: {error.strerror}{where}. Finished parts are "
            f"kept: {remedy} run the same command again"
        )
    if isinstance(error, Exception) and not for_people(error):
        error.add_note(f"in stage {planned.name} ({run.store.draft_path(planned.place, planned.key)})")
    return error


def _end(draft: Draft, state: RunState, error: BaseException) -> None:
    """Leave the draft in order, with a word on why the run stopped."""
    with contextlib.suppress(OSError):
        draft.sweep()  # on a full disk it is room to go on with
    if isinstance(error, KeyboardInterrupt):
        state.end(INTERRUPTED, "interrupted")
    else:
        state.end(status_of(error), str(error) if for_people(error) else repr(error))


def _verdict(old_digest: str | None, digest: str) -> str:
    """How the artifact compares with the one that it replaces; empty where none could say what it was."""
    if old_digest is None:
        return ""
    if old_digest == digest:
        return "  equal to before"
    change = f"{old_digest[:12]} is now {digest[:12]}"
    return f"  DIFFERENT from before ({change}); later stages still hold what was made from the old"


def _digest_of(store: Store, stage: str, key: str) -> str | None:
    """The digest of the artifact that is about to be replaced; None where there is none, or it is too damaged to say."""
    try:
        previous = store.find(stage, key)
    except Damaged:
        return None
    return previous.digest if previous else None


def machine(packages: Iterable[str]) -> dict[str, Any]:
    """The machine at work, for the manifest: platform, Python, versions of ``packages`` (None if missing), GPUs and driver."""
    versions = {}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "host": socket.gethostname(),
        "platform": platform.platform(),
        "python": sys.version.split()[0],
        "cores": os.cpu_count(),
        "gpu": gpu_models(),
        "packages": versions,
    }
