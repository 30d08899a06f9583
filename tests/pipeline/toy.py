"""A system of three small stages without meshes or images, for tests of the engine: numbers -> squares -> total."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from pipeline.config import StageConfig, added, count, report, runtime
from pipeline.errors import Reject
from pipeline.keys import seed_for
from pipeline.stage import Item, MapStage, Record, RunStage, System


class NumbersConfig(StageConfig):
    n: int = count(10)
    scale: float = 1.0
    seed: int = 0
    payload_kb: int = added(0, legacy=0)  # of zeros, in a member of their own
    pause_s: float = runtime(0.0)
    crash: tuple[str, ...] = runtime(())  # items that kill their worker
    crash_once: str | None = runtime(None)  # a folder: the first item to find it without a mark dies
    hang: tuple[str, ...] = runtime(())
    sleep: tuple[str, ...] = runtime(())
    stubborn: tuple[str, ...] = runtime(())  # items that sleep and do not let go at SIGTERM
    greedy: tuple[str, ...] = runtime(())
    fail: tuple[str, ...] = runtime(())
    log_to: str | None = runtime(None)  # a file that gets a line per computed item
    open_s: float = runtime(0.0)  # seconds that opening a worker takes


class Numbers(MapStage):
    name = "numbers"
    version = 1
    Config = NumbersConfig
    reasons = {"unlucky": "thirteen"}

    def part_size(self, config, inputs):
        return 4

    def items(self, config, inputs):
        return [Item(f"n{index:03}", group="even" if index % 2 == 0 else "odd", needs=()) for index in range(config.n)]

    def open(self, config, inputs, environment):
        time.sleep(config.open_s)
        return config

    def process(self, config, item):
        if config.log_to:
            with open(config.log_to, "a") as file:
                file.write(item.id + "\n")
        time.sleep(config.pause_s)
        if item.id in config.crash:
            os.kill(os.getpid(), signal.SIGSEGV)
        if config.crash_once and not (Path(config.crash_once) / "mark").exists():
            (Path(config.crash_once) / "mark").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if item.id in config.hang:
            while True:
                pass
        if item.id in config.stubborn:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if item.id in (*config.sleep, *config.stubborn):
            time.sleep(3600)
        if item.id in config.greedy:
            hoard = []
            while True:
                hoard.append(bytearray(os.urandom(1 << 20)) * 16)
        if item.id in config.fail:
            raise RuntimeError("a bug")
        if item.id == "n013":
            raise Reject("unlucky", "it is thirteen")
        value = (seed_for(config.seed, self.name, item.id) % 1000) * config.scale
        payload = {"payload.bin": bytes(config.payload_kb * 1024)} if config.payload_kb else {}
        yield Record(item.id, {"value.txt": str(value).encode(), **payload})


class SquaresConfig(StageConfig):
    offset: int = 0
    heading: str = report("")  # of the card
    log_to: str | None = runtime(None)  # a file that gets a line per computed item
    finish_s: float = runtime(0.0)
    unsteady: bool = runtime(False)  # other output each time
    bug: str = runtime("")  # in finish: "value", or "file" for one that is not there


class Squares(MapStage):
    name = "squares"
    version = 1
    inputs = ("numbers",)
    Config = SquaresConfig

    def part_size(self, config, inputs):
        return 3

    def items(self, config, inputs):
        return [Item(row.id, row.group, (("numbers", row.id),)) for row in inputs["numbers"].rows()]

    def open(self, config, inputs, environment):
        return config, inputs["numbers"]

    def process(self, worker, item):
        config, numbers = worker
        if config.log_to:
            with open(config.log_to, "a") as file:
                file.write(item.id + "\n")
        value = float(numbers.read(item.id).members["value.txt"])
        unsteady = time.time_ns() % 10**6 if config.unsteady else 0
        yield Record(item.id, {"square.txt": str(value**2 + config.offset + unsteady).encode()})

    def finish(self, config, inputs, draft):
        if config.bug == "value":
            int("no number")
        if config.bug == "file":
            (inputs["numbers"].path / "files" / "nowhere").read_bytes()
        (draft.files / "card.txt").write_text(f"{config.heading}{len(draft.rows())} squares\n")
        time.sleep(config.finish_s)
        draft.note("count", len(draft.rows()))


class TotalConfig(StageConfig):
    steps: int = 3
    pause_s: float = runtime(0.0)
    plus_numbers: bool = added(False, legacy=False)


class Total(RunStage):
    name = "total"
    version = 1
    inputs = ("numbers", "squares")
    Config = TotalConfig
    headline = "total.txt"

    def reads(self, config):
        return self.inputs if config.plus_numbers else ("squares",)

    def run(self, config, inputs, draft):
        squares = inputs["squares"]
        time.sleep(config.pause_s)
        total = sum(float(squares.read(id).members["square.txt"]) for id in squares.ids())
        if config.plus_numbers:
            total += sum(float(inputs["numbers"].read(id).members["value.txt"]) for id in squares.ids())
        (draft.files / "total.txt").write_text(f"{total * config.steps}\n")
        return ["total.txt"]


SYSTEM = System(
    "toy",
    {
        "numbers": "tests.pipeline.toy:Numbers",
        "squares": "tests.pipeline.toy:Squares",
        "total": "tests.pipeline.toy:Total",
    },
)
