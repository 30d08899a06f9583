"""What workers share is made once, by the runner, before any of them opens."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipeline.atomic import write_atomic
from pipeline.config import StageConfig, runtime
from pipeline.run import run_pipeline
from pipeline.stage import Item, MapStage, Record, System


class SharedConfig(StageConfig):
    folder: str = runtime("")  # gets a file per call of prepare and per worker that opens
    fail: bool = runtime(False)  # every item, as a bug would


class Shared(MapStage):
    name = "shared"
    version = 1
    Config = SharedConfig

    def part_size(self, config, inputs):
        return 1

    def items(self, config, inputs):
        return [Item(f"i{number}") for number in range(8)]

    def prepare(self, config, inputs, folder):
        (Path(config.folder) / f"prepare-{len(list(Path(config.folder).iterdir()))}").touch()
        write_atomic(folder / "shared.txt", b"shared")

    def open_prepared(self, config, inputs, environment, folder):
        (Path(config.folder) / f"open-{os.getpid()}").touch()
        return config, (folder / "shared.txt").read_bytes()

    def process(self, worker, item):
        if worker[0].fail:
            raise RuntimeError("a bug")
        yield Record(item.id, {"text.txt": worker[1]})


SYSTEM = System("prepared", {"shared": "tests.pipeline.test_prepare:Shared"})


def calls(folder: Path, kind: str) -> int:
    return len(list(folder.glob(f"{kind}-*")))


@pytest.mark.parametrize("workers", [0, 2])
def test_prepare_runs_once_however_many_workers_there_are(tmp_path, workers):
    (tmp_path / "log").mkdir()

    def run(**section):
        root = {"system": "tests.pipeline.test_prepare", "stage": "shared", "store": str(tmp_path / "store")}
        root |= {"workers": workers, "shared": {"folder": str(tmp_path / "log")} | section}
        return run_pipeline(root, ["test"], lambda line: None)["artifacts"]["shared"]

    with pytest.raises(Exception, match="8 item"):
        run(fail=True)
    (draft,) = (tmp_path / "store").glob("*/shared/*.partial")
    prepared = draft / "state" / ".prepared" / "shared.txt"
    prepared.write_bytes(b"damaged since")
    artifact = run()
    assert {artifact.read(row.id).members["text.txt"] for row in artifact.rows()} == {b"shared"}
    assert calls(tmp_path / "log", "prepare") == 2  # once per run
    assert 1 <= calls(tmp_path / "log", "open") <= max(1, 2 * workers)
    assert not (artifact.path / "state").exists()
    run()
    assert calls(tmp_path / "log", "prepare") == 2  # there was nothing to do
