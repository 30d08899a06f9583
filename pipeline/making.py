"""What travels with the work: a run, and one artifact in the making."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.cluster import Cluster
from pipeline.plan import Planned, RunConfig
from pipeline.stage import System
from pipeline.status import RunState
from pipeline.store import Artifact, Draft, Store


@dataclass(frozen=True)
class Run:
    """What all artifacts of a run share."""

    settings: RunConfig
    system: System
    store: Store
    command: Sequence[str]  # the words that a person typed
    out: Callable[[str], None]  # prints a line
    stages: Sequence[str] = ()  # that the run makes, in running order
    cluster: Cluster | None = None  # of Dask workers; None: parts are made on this machine

    def label(self, stage: str) -> str:
        """How lines of that stage begin: its number and name."""
        return f"{self.system.number(stage):02} {stage:<10}"

    def say(self, stage: str, text: str) -> None:
        """Print a line of that stage."""
        self.out(f"{self.label(stage)} {text}")


@dataclass(frozen=True)
class Making:
    """One artifact in the making."""

    run: Run
    planned: Planned
    inputs: Mapping[str, Artifact]  # by role
    environment: dict[str, Any]  # the stage's runtime choices
    draft: Draft
    state: RunState

    @property
    def forced(self) -> bool:
        """Whether nothing that exists may be taken over."""
        return self.planned.name in self.run.settings.force

    def say(self, text: str) -> None:
        """Print a line of the stage."""
        self.run.say(self.planned.name, text)
