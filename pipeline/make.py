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

from pipeline.cluster import Cluster
from pipeline.code import code_digest, commit
from pipeline.errors import (
    INTERRUPTED,
    STORAGE_ERRORS,
    Damaged,
    MachineError,
    for_people,
    status_of,
)
from pipeline.executor import REASONS
from pipeline.gpus import gpu_models
from pipeline.mapping import run_map
from pipeline.plan import Planned, RunConfig, base_key, label
from pipeline.progress import duration
from pipeline.stage import MapStage, RunStage, System
from pipeline.status import RunState
from pipeline.store import DRAFT, SCHEMA, Artifact, Claim, Draft, Store


def machine_rejects(artifact: Artifact | None) -> list[dict[str, Any]]:
    """Rejects of the artifact that are the machine's doing; its listing is read only where there may be any."""
    if artifact is None or not artifact.manifest["outputs"]["rejects"].keys() & set(REASONS):
        return []
    return [reject for reject in artifact.rejects() if reject.get("machine")]


def describe(artifact: Artifact) -> str:
    outputs = artifact.manifest["outputs"]
    text = artifact.name
    if outputs["items"]:
        rejects = sum(outputs["rejects"].values())
        text += f"  {outputs['records']} records" + (f", {rejects} rejected" if rejects else "")
    return text


def make_artifact(
    run: RunConfig,
    system: System,
    planned: Planned,
    inputs: Mapping[str, Artifact],
    store: Store,
    command: Sequence[str],
    out: Callable[[str], None],
    plan: Sequence[str] = (),
    cluster: Cluster | None = None,
    adopt: Callable[[Draft], None] | None = None,
) -> Artifact:
    """Compute one artifact and commit it. ``plan``: the whole run's stages, for its state; ``adopt`` fills a repair's draft."""
    name, key = planned.name, planned.key
    forced, retried = name in run.force, name in run.retry
    claim = store.claim(planned.place, key)
    draft_path = store.draft_path(planned.place, key)
    state: RunState | None = None
    began = time.monotonic()
    try:
        made = _take(claim, store, planned, forced, lambda text: out(f"{label(system, name)} {text}"))
        if made is not None and not (retried and machine_rejects(made)):
            return made

        def say(text: str) -> None:
            if state is not None:
                state.update(line=text)
            out(text)

        origin = {"system": run.system, "config": planned.config.model_dump(mode="json")}
        code = code_digest(system, name)
        purpose = "repair" if adopt is not None else "force" if forced else "make"
        draft = store.draft(planned.place, key, planned.preimage, say, origin, purpose, code)
        draft.sweep()
        state = RunState(draft.path, command=shlex.join(command), plan=list(plan))
        started = time.time()
        old_digest = _digest_of(store, planned.place, key)
        if adopt is not None:
            adopt(draft)
        if made is not None and draft.environment() is None:
            draft.set_environment(made.manifest["environment"])  # its records are taken over
        environment = draft.environment()
        if cluster is not None and isinstance(planned.stage, MapStage):
            environment = cluster.environment(run.system, name, planned.config, environment)
        else:
            environment = planned.stage.environment(planned.config, environment)
        draft.set_environment(environment)
        if isinstance(planned.stage, MapStage):
            products: list[str] = []
            run_map(run, system, planned, planned.stage, inputs, environment, store, cluster, draft, forced, out, state)
        else:
            assert isinstance(planned.stage, RunStage)
            out(f"{label(system, name)} running    {planned.stage.slug(planned.config)}-{key[:12]}")
            products = planned.stage.run(planned.config, inputs, draft)
            draft.use_parts([])
        others = [other for other in draft.codes() if other != code]
        manifest = {
            "schema": SCHEMA,
            "key": key,
            "preimage": planned.preimage,
            "base_key": base_key(planned),
            **origin,
            "code": {"digest": code, **commit(), **({"others": others} if others else {})},
            "environment": environment,
            "machine": machine(system.packages),
            "outputs": draft.outputs(products),
            "summary": draft.summary,
            "command": shlex.join(command),
            "started": started,
            "finished": time.time(),
            "seconds": time.monotonic() - began,
        }
        artifact = store.commit(draft, planned.stage.slug(planned.config), manifest, replace=forced or retried)
    except BaseException as error:
        if not (draft_path / DRAFT).exists() and isinstance(error, Exception) and not (forced or retried):
            made = store.find(planned.place, key)
            if made is not None:  # another process took the claim from us, and was faster
                shutil.rmtree(draft_path, ignore_errors=True)
                out(f"{label(system, name)} done       {describe(made)}  by another process meanwhile")
                return made
        if isinstance(error, OSError) and (error.errno in STORAGE_ERRORS or str(error.filename).startswith(f"{store.root}/")):
            where = f" ({error.filename})" if error.filename else ""
            remedy = "make room or mend the disk, and" if error.errno in STORAGE_ERRORS else "--debug says who asked for it;"
            error = MachineError(
                f"{name}: the store at {store.root} cannot be read or written: {error.strerror}{where}. Finished parts are "
                f"kept: {remedy} run the same command again"
            )
        if isinstance(error, Exception) and not for_people(error):
            error.add_note(f"in stage {name} ({draft_path})")
        if state is not None:
            with contextlib.suppress(OSError):
                draft.sweep()  # on a full disk it is room to go on with
            interrupted = isinstance(error, KeyboardInterrupt)
            message = "interrupted" if interrupted else str(error) if for_people(error) else repr(error)
            state.end(INTERRUPTED if interrupted else status_of(error), message)
        raise error
    finally:
        claim.release()
    verdict = ""
    if (forced or retried) and old_digest is not None:
        verdict = "  equal to before" if artifact.digest == old_digest else "  DIFFERENT from before"
        if artifact.digest != old_digest:
            verdict += f" ({old_digest[:12]} is now {artifact.digest[:12]}); later stages still hold what was made from the old"
    out(f"{label(system, name)} done       {describe(artifact)}  in {duration(time.monotonic() - began)}{verdict}")
    return artifact


def _take(claim: Claim, store: Store, planned: Planned, forced: bool, say: Callable[[str], None]) -> Artifact | None:
    """Wait for the claim. Returns the artifact if another process has made it by then."""
    told = False
    while not claim.take():
        if not told and (holder := claim.holder()) is not None:
            say(f"waiting: process {holder['pid']} on {holder['host']} is making {planned.key[:12]}")
            told = True
        time.sleep(0.5)
    return None if forced else store.find(planned.place, planned.key)


def _digest_of(store: Store, stage: str, key: str) -> str | None:
    """The digest of the artifact that is about to be replaced, if it is there and can still say so."""
    try:
        previous = store.find(stage, key)
    except Damaged:
        return None
    return previous.digest if previous else None


def machine(packages: Iterable[str]) -> dict[str, Any]:
    """Where an artifact was made: Python, the named packages, the GPU and its driver."""
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
