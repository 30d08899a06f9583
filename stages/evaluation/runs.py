"""Evaluated models as the report shows them (`Run`), from an artifact of *evaluate*, finished or in the making."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError
from pipeline.store import history

if TYPE_CHECKING:
    from pipeline.store import Artifact, Draft, Store
    from stages.evaluation.report import Images, Run

CONFIGS = ("collect", "scene", "render", "train", "evaluate")  # stages whose settings the page shows


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
    from stages.evaluation.report import Run
    from stages.exr import decode_rgb, decode_view, view_members

    def images(scene_id: str, camera: int) -> Images:
        if shard is None:
            raise UserError(f"the shards that {name} was evaluated on are gone, and its targets with them: give --gallery 0")
        view = decode_view(shard.read(scene_id, view_members(camera)).members, camera)
        member = f"view{camera}.prediction.exr"
        prediction = decode_rgb(evaluated.read(scene_id, (member,)).members[member])
        return {"target": view.image, "prediction": prediction, "direct": view.direct}

    upstream = {artifact.stage: artifact for artifact in (shard, train) if artifact is not None}
    found = {stage: preimage["params"] for stage, preimage in history(upstream).items()} | {"evaluate": params}
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
        configs={stage: found[stage] for stage in CONFIGS if stage in found},
        log=[json.loads(line) for line in log if line],
        images=images,
        targets={id: shard.row(id).digest if shard is not None else data for id in scenes},
    )


def load_run(artifact: Artifact, store: Store, name: str) -> Run:
    """The run of a finished artifact."""
    from stages.s07_evaluate import Evaluate

    preimage = artifact.manifest["preimage"]
    if preimage["version"] != Evaluate.version:
        raise UserError(
            f"{artifact.path.name} was made by version {preimage['version']} of evaluate, and this is version "
            f"{Evaluate.version}, which holds more: evaluate the model again (stage=evaluate)"
        )
    timing = artifact.path / "files" / "timing.json"
    return run_of(
        name,
        artifact,
        preimage["params"],
        json.loads(artifact.file("metrics.json").read_bytes()),
        json.loads(timing.read_bytes()) if timing.is_file() else None,
        store.find("shard", preimage["inputs"]["shard"]),
        store.find("train", preimage["inputs"]["train"]),
    )


def facts(summary: Mapping[str, Any], key: str) -> dict[str, str]:
    """What the report says about a run: label -> text."""
    train, data = summary["train"], summary["data"]
    counts = ", ".join(
        f"{data['scenes'][split]:,} {split}" for split in ("train", "validation", "test") if split in data["scenes"]
    )
    resolution = summary["per_scene"][0]["resolution"]
    return {
        "model": f"{train['layers']} + {train['view_layers']} layers, width {train['width']}, "
        f"{train['parameters']:,} parameters, {train['steps']:,} training steps",
        "data": f"{counts} scenes at {resolution}×{resolution} pixels; evaluated here: {data['split']}",
        **({} if "train" in data["scenes"] else {"mean training image": "of the evaluated scenes: there are no others"}),
        "train artifact": train["key"][:12],
        "shard artifact": data["key"][:12],
        "evaluate artifact": key[:12],
    }
