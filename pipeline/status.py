"""The state of runs, readable while they run and after they died: ``lightmill status``.

A run writes what it knows into ``running/run.json`` of the draft that it is making, at most once a second; whoever asks reads
that, counts the draft's markers and looks whether the claim is held. There is no server: the store alone answers.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.atomic import atomic_path
from pipeline.progress import duration
from pipeline.store import Store

WRITE_EVERY_S = 1.0
MAX_FAILURES = 100  # that a state names
RUN = "run.json"


class RunState:
    """What a run says of the artifact it is making. Losing it costs nothing: a full disk must not stop a run here."""

    def __init__(self, draft: Path, **facts: Any):
        self._path = draft / "running" / RUN
        self._began = time.monotonic()
        self._written = -WRITE_EVERY_S
        self._facts = {
            "host": socket.gethostname(), "pid": os.getpid(), "started": time.time(), "failures": [], "rejects": {}, **facts,
        }  # fmt: skip
        self.update(now=True)

    def update(self, now: bool = False, **facts: Any) -> None:
        """Change facts; written at once on ``now``, else at the next chance after a second."""
        self._facts.update(facts)
        elapsed = time.monotonic() - self._began
        if not now and elapsed - self._written < WRITE_EVERY_S:
            return
        self._written = elapsed
        with contextlib.suppress(OSError), atomic_path(self._path, durable=False) as temporary:
            temporary.write_text(json.dumps({**self._facts, "seconds": round(elapsed, 3)}))

    def add_rejects(self, rejects: Mapping[str, int]) -> None:
        """Add numbers of rejects by reason."""
        counts = self._facts["rejects"]
        for reason, count in rejects.items():
            counts[reason] = counts.get(reason, 0) + count

    def add_failure(self, item: str, trace: str, log: Path) -> None:
        """Name an item that raised. Only the first ``MAX_FAILURES`` are named."""
        if len(self._facts["failures"]) < MAX_FAILURES:
            last = trace.strip().splitlines()[-1]
            self._facts["failures"].append({"item": item, "error": last, "log": f"logs/{log.name}"})

    def end(self, status: int, message: str) -> None:
        """The run stops here without an artifact."""
        self.update(now=True, status=status, message=message)


def read_states(store: Store, place: str | None = None) -> list[dict[str, Any]]:
    """One plain dict per draft of the store, the one that changed last at the end.

    ``state``: running (``items``: which process is at what, and for how long), stopped (``message`` says why) or dead.
    """
    states = []
    for path in store.drafts():
        draft_place = store.place_of(path)
        if place not in (None, draft_place):
            continue
        key = path.name.removesuffix(".partial")
        facts = _read(path / "running" / RUN)
        holder = store.claim(draft_place, key).holder()
        state = "running" if holder else "stopped" if "status" in facts else "dead"
        marked = list((path / "markers").glob("[!.]*.json"))
        items = []
        if holder:
            for file in sorted((path / "running").glob("[!.]*.json")):
                item = _read(file)
                if "item" in item:
                    seconds = round(time.time() - item["time"], 1)
                    items.append({"item": item["item"] or "opening", "pid": item["pid"], "seconds": seconds})
        changed = max([file.stat().st_mtime for file in (path / "markers", path / "running") if file.exists()], default=0.0)
        states.append(
            {**facts, "stage": path.parent.name, "place": draft_place,
             "key": key, "state": state, "holder": holder, "parts_done": len(marked),
             "items": items, "changed": changed, "path": str(path)}
        )  # fmt: skip
    return sorted(states, key=lambda state: state["changed"])


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}


def lines(state: Mapping[str, Any]) -> list[str]:
    """A draft's state for people."""
    clock = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(state["changed"]))
    holder = state["holder"] or {}
    headline = {
        "running": f"running, process {holder.get('pid')} on {holder.get('host')}",
        "stopped": f"stopped with status {state.get('status')} at {clock}",
        "dead": f"not running: its process ended without a word (killed?), last sign {clock}",
    }[state["state"]]
    out = [f"{state['place']}/{state['key'][:12]}.partial  {headline}"]

    def add(name: str, text: str) -> None:
        out.append(f"  {name:<9} {text}")

    if state.get("plan"):
        at = state["plan"].index(state["stage"])  # the plan is in running order
        marks = ["done"] * at + [state["state"]] + ["to come"] * (len(state["plan"]) - at - 1)
        add("stages", ", ".join(f"{name} {mark}" for name, mark in zip(state["plan"], marks, strict=True)))
    if state.get("parts"):
        rate = (state["done"] - state["reused"]) / state["seconds"] if state["seconds"] else 0.0
        reused = f", {state['reused']} of them from before" if state["reused"] else ""
        time_left = ""
        if state["state"] == "running":
            time_left = f", {duration((state['total'] - state['done']) / rate)} left" if rate else ", time left not known yet"
        add("parts", f"{state['parts_done']} of {state['parts']}")
        add("items", f"{state['done']} of {state['total']}{reused}, {rate:.2f}/s{time_left}")
    elif state["parts_done"]:
        add("parts", str(state["parts_done"]))
    if state.get("line"):
        add("last", state["line"])
    if state.get("rejects"):
        add("rejects", ", ".join(f"{count} {reason}" for reason, count in sorted(state["rejects"].items())))
    for failure in state.get("failures", ()):
        add("failed", f"{failure['item']}: {failure['error']}  ({state['path']}/{failure['log']})")
    for item in state["items"]:
        add("now", f"{item['item']} for {duration(item['seconds'])}, process {item['pid']}")
    if state.get("message"):
        add("message", state["message"])
    if state["state"] != "running" and state.get("command"):
        add("go on", state["command"])
    return out
