"""probe: what a trained network can and cannot do, one question at a time (paper, figures 5 to 16).

Reads *shard* (held-out scenes) and *train* (checkpoint); writes a record per item of the probe (metrics, reference and
predictions as half-float EXR), and ``files/``: figure.png, table.md, probe.json. ``probe=NAME`` chooses one of
``stages.renderformer.probes``, each an artifact of its own: ``stage=probe probe=lights,fov -m`` makes several.

One design choice: what can be repeated to the byte (images, metrics) is in the records; times are measured as the figure
is made and are only in ``files/``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from pipeline.config import StageConfig
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.device import choose_device
from stages.renderformer.probes import attention, built_scenes, sweeps, timing, tokens
from stages.renderformer.probes.probe import Outcome, Probe, ProbeConfig, Worker

if TYPE_CHECKING:
    from pipeline.store import Draft

PROBES: Mapping[str, Probe] = {
    probe.name: probe() for module in (timing, sweeps, built_scenes, attention, tokens) for probe in module.PROBES
}


class RunProbe(MapStage):
    name = "probe"
    headline = "figure.png"
    version = 4
    inputs = ("decimate", "shard", "train")
    Config = Annotated[reduce(lambda a, b: a | b, [probe.Config for probe in PROBES.values()]), Field(discriminator="name")]
    reasons = {
        "dark": "no light reaches the camera",
        "too_close": "something is nearer to the camera than 0.01 scene units",
    }

    def reads(self, config: ProbeConfig) -> tuple[str, ...]:
        return PROBES[config.name].reads

    def agree(self, config: ProbeConfig, configs: Mapping[str, StageConfig]) -> None:
        scene = configs.get("scene")
        if "decimate" in self.reads(config) and scene is not None and scene.name == "imported":
            raise UserError(f"probe={config.name} shows objects by other meshes of their ladder, which imported scenes lack")

    def slug(self, config: ProbeConfig) -> str:
        return config.name.replace("_", "-")

    def part_size(self, config: ProbeConfig, inputs: Inputs) -> int:
        return 4

    def environment(self, config: ProbeConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        """The network's device and the path tracer's backend: others round otherwise."""
        from stages.graphics.mitsuba.backend import choose

        device = choose_device(config.device if previous is None else previous["device"], "probe.device")
        return {"device": device, "renderer": choose(config.backend, None if previous is None else previous["renderer"])}

    def same_environment(self, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        from stages.graphics.mitsuba.backend import same

        return one["device"] == other["device"] and same(one["renderer"], other["renderer"])

    def max_workers(self, config: ProbeConfig, environment: dict[str, Any]) -> int | None:
        from stages.graphics.mitsuba.backend import max_workers

        return 1 if environment["device"] == "cuda" else max_workers(environment["renderer"])

    def items(self, config: ProbeConfig, inputs: Inputs) -> Iterator[Item]:
        yield from PROBES[config.name].items(config, inputs)

    def open(self, config: ProbeConfig, inputs: Inputs, environment: dict[str, Any]) -> Worker:
        import torch

        torch.set_num_threads(1)  # sums in another order round differently
        worker = Worker(config, inputs, environment["renderer"], environment["device"])
        if reason := PROBES[config.name].refusal(worker.model):
            raise UserError(f"probe={config.name}: {reason}; choose another probe, or another model")
        return worker

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        yield from PROBES[worker.config.name].process(worker, item)

    def finish(self, config: ProbeConfig, inputs: Inputs, draft: Draft) -> None:
        environment = draft.environment()
        worker = Worker(config, inputs, environment["renderer"], environment["device"])
        probe = PROBES[config.name]
        outcome = probe.finish(worker, draft)
        if {"triangles", "resolution"} <= worker.trained_with.keys():
            triangles, resolution = worker.trained_with["triangles"], worker.trained_with["resolution"]
            outcome.notes.append(f"Trained with scenes of at most {triangles} triangles, at {resolution} px.")
        outcome.figure.savefig(draft.files / "figure.png", metadata={"Software": None})
        probe_json = {
            "name": probe.name,
            "title": probe.title,
            "question": probe.question,
            "setting": probe.setting,
            "model": model_facts(worker),
            "columns": outcome.columns,
            "rows": outcome.rows,
            "notes": outcome.notes,
        }
        (draft.files / "probe.json").write_text(json.dumps(probe_json, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
        (draft.files / "table.md").write_text(markdown(probe, outcome), encoding="utf-8")
        draft.note("probe", {"question": probe.question, "notes": outcome.notes})
        for note in outcome.notes:
            draft.log(f"   {note}")

    def check(self, draft: Draft) -> None:
        for name in ("figure.png", "probe.json", "table.md"):
            assert (draft.files / name).is_file(), f"probe wrote no {name}"


def model_facts(worker: Worker) -> dict[str, Any]:
    """What is said of the network."""
    return {
        "key": worker.inputs["train"].key,
        "parameters": sum(parameter.numel() for parameter in worker.model.parameters()),
        **worker.model.config.facts,
        "trained_with": worker.trained_with,
    }


def markdown(probe: Probe, outcome: Outcome) -> str:
    """Title, question, table and notes."""

    def line(cells: list[Any]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"

    rows = [line(row) for row in outcome.rows]
    rule = "| --- |" + " ---: |" * (len(outcome.columns) - 1)
    notes = [f"- {note}" for note in outcome.notes]
    return "\n".join([f"**{probe.title}.** {probe.question}", "", line(outcome.columns), rule, *rows, "", *notes]) + "\n"
