"""What a report shows: evaluated models (`Run`), from artifacts of *evaluate*, finished or in the making, and probes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import UserError
from pipeline.store import history, store_of

if TYPE_CHECKING:
    from pipeline.store import Artifact, Draft

VERSION = 6  # of stage evaluate: what the artifacts that are read here hold
PROBE_FIELDS = ("name", "title", "question", "setting", "model", "columns", "rows", "notes")  # of probe.json
CONFIGS = ("collect", "scene", "render", "train", "evaluate")  # stages whose settings the page shows


Images = Mapping[str, np.ndarray]  # target, prediction, direct: (H, W, 3) linear radiance


@dataclass(frozen=True)
class Run:
    """One evaluated model.

    summary: what metrics.json holds. timing: what timing.json holds, or None. facts: label -> text. configs: stage -> resolved
    config. log: rows of the training log. images: (scene id, camera) -> its `Images`. targets: scene id -> the digest of its
    data, by which runs on the same scenes are told.
    """

    name: str
    key: str
    summary: Mapping[str, Any]
    timing: Mapping[str, Any] | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    configs: Mapping[str, Any] = field(default_factory=dict)
    log: Sequence[Mapping[str, Any]] = ()
    images: Callable[[str, int], Images] | None = None
    targets: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Probe:
    """One artifact of stage *probe*: a question put to a model, and what came out. ``facts``: its probe.json."""

    key: str
    facts: Mapping[str, Any]
    figure: Path


def run_of(
    name: str,
    evaluated: Artifact | Draft,
    params: Mapping[str, Any],
    summary: Mapping[str, Any],
    timing: Mapping[str, Any] | None,
    shard: Artifact | None,
    train: Artifact | None,
) -> Run:
    """``params``: the config of *evaluate*. Without its shards a run has no pictures, without *train* no loss curve."""
    from stages.graphics.exr import decode_rgb
    from stages.renderformer.views import decode_view, view_members

    def images(scene_id: str, camera: int) -> Images:
        if shard is None:
            raise UserError(f"the shards that {name} was evaluated on are gone, and its targets with them: give --gallery 0")
        view = decode_view(shard.read(scene_id, view_members(camera)).members, camera)
        member = f"view{camera}.prediction.exr"
        prediction = decode_rgb(evaluated.read(scene_id, (member,)).members[member])
        return {"target": view.image, "prediction": prediction, "direct": view.direct}

    upstream = {artifact.stage: artifact for artifact in (shard, train) if artifact is not None}
    params_by_stage = {stage: preimage["params"] for stage, preimage in history(upstream).items()} | {"evaluate": params}
    log = train.file("log.jsonl").read_text().splitlines() if train is not None else []
    scenes = [scene["id"] for scene in summary["per_scene"]]
    # Without the shards, that they were the same is told by their key.
    data = summary["data"]["key"]
    return Run(
        name=name,
        key=evaluated.key,
        summary=summary,
        timing=timing,
        facts=facts(summary, evaluated.key),
        configs={stage: _settings(params_by_stage[stage]) for stage in CONFIGS if stage in params_by_stage},
        log=[json.loads(line) for line in log if line],
        images=images,
        targets={id: shard.row(id).digest if shard is not None else data for id in scenes},
    )


def _settings(params: Mapping[str, Any]) -> dict[str, Any]:
    """Without the hashes of source files, of which there may be thousands."""
    return {name: value for name, value in params.items() if name != "identity"}


def load_run(artifact: Artifact, name: str) -> Run:
    """The run of a finished artifact."""
    preimage = artifact.manifest["preimage"]
    if preimage["version"] != VERSION:
        raise UserError(
            f"{artifact.path.name} was made by version {preimage['version']} of evaluate, and this is version "
            f"{VERSION}: evaluate the model again (stage=evaluate)"
        )
    timing = artifact.path / "files" / "timing.json"
    return run_of(
        name,
        artifact,
        preimage["params"],
        json.loads(artifact.file("metrics.json").read_bytes()),
        json.loads(timing.read_bytes()) if timing.is_file() else None,
        store_of(artifact).find("shard", preimage["inputs"]["shard"]),
        store_of(artifact).find("train", preimage["inputs"]["train"]),
    )


def load_probe(artifact: Artifact) -> Probe:
    """The probe of a finished artifact."""
    facts = json.loads(artifact.file("probe.json").read_bytes())
    missing = [name for name in PROBE_FIELDS if name not in facts]
    if missing:
        raise UserError(
            f"{artifact.path.name}: files/probe.json has no {', '.join(missing)}: make the probe again (force=probe)"
        )
    return Probe(artifact.key, facts, artifact.file("figure.png"))


def facts(summary: Mapping[str, Any], key: str) -> dict[str, str]:
    """What the report says about a run: label -> text."""
    train, data = summary["train"], summary["data"]
    counts = ", ".join(
        f"{data['scenes'][split]:,} {split}" for split in ("train", "validation", "test") if split in data["scenes"]
    )
    resolution = summary["per_scene"][0]["resolution"]
    trained = "a given checkpoint" if train["steps"] is None else f"{train['steps']:,} training steps"
    return {
        "model": f"{train['network']}, {train['parameters']:,} parameters, {trained}",
        "data": f"{counts} scenes at {resolution}×{resolution} pixels; evaluated here: {data['split']}",
        **({} if "train" in data["scenes"] else {"mean training image": "of the evaluated scenes: there are no others"}),
        "train artifact": train["key"][:12],
        "shard artifact": data["key"][:12],
        "evaluate artifact": key[:12],
    }
