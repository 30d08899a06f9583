"""What a training run says: one JSON line per interval, the same as TensorBoard events, and an aligned line for people.

A resumed run cuts the JSON lines back to the step that it goes on from, so that nothing is in them twice.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import write_atomic

LOG = "log.jsonl"


def cut(path: Path, step: int) -> None:
    """Drop lines after ``step``, and a last one that a kill cut short."""
    lines = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            break
        if row["step"] <= step:
            lines.append(line + "\n")
    write_atomic(path, "".join(lines).encode())


class TrainingLog:
    """Rows to ``folder/log.jsonl`` and, where ``tensorboard`` names a folder, to events in it. Without a folder: nothing."""

    def __init__(
        self, folder: Path | None, tensorboard: Path | None, step: int, steps: int, say: Callable[[str], None]
    ):  # fmt: skip
        self.file = self.events = None
        self.width, self.steps, self.say = len(f"{steps}"), steps, say
        if folder is not None:
            cut(folder / LOG, step)
            self.file = (folder / LOG).open("a")
        if tensorboard is not None:
            from torch.utils.tensorboard import SummaryWriter

            self.events = SummaryWriter(str(tensorboard), purge_step=step + 1)

    def row(self, row: dict[str, Any]) -> None:
        """A row with its ``step``; numbers become scalars ``train/loss`` or, named validation_psnr, ``validation/psnr``."""
        if self.file is not None:
            self.file.write(json.dumps(row) + "\n")
            self.file.flush()
        if self.events is not None:
            for name, value in row.items():
                if name != "step" and value is not None:
                    group, _, metric = name.rpartition("validation_")
                    self.events.add_scalar(f"{'validation' if name != metric else 'train'}/{metric}", value, row["step"])
            self.events.flush()

    def picture(self, name: str, picture: np.ndarray, step: int) -> None:
        """(H, W, 3) uint8."""
        if self.events is not None:
            self.events.add_image(name, picture, step, dataformats="HWC")

    def interval(self, row: dict[str, Any]) -> None:
        """Log a training interval; keys as below."""
        self.row(row)

        def number(name: str, form: str) -> str:
            width = int(form.split(".")[0].lstrip(","))
            return f"{'nan':>{width}}" if row[name] is None else f"{row[name]:{form}}"

        skipped = f"  {row['skipped']} skipped" if row["skipped"] else ""
        self.say(
            f"step {row['step']:>{self.width}}/{self.steps}  loss {number('loss', '8.5f')}  lr {row['lr']:.2e}  "
            f"grad {number('grad_norm', '8.3f')}  {row['scenes_per_s']:8.2f} scenes/s  {row['tokens_per_s']:9,.0f} tokens/s  "
            f"{row['memory_gb']:6.2f} GB  mfu {100 * row['mfu']:5.1f} %{skipped}"
        )

    def validation(self, step: int, metrics: dict[str, float], best: bool) -> None:
        self.row({"step": step} | {f"validation_{name}": value for name, value in metrics.items()})
        self.say(
            f"step {step:>{self.width}}/{self.steps}  validation: log error {metrics['log_error']:.5f}  "
            f"psnr {metrics['psnr']:5.2f} dB{'  best so far' if best else ''}"
        )

    def close(self) -> None:
        for sink in (self.file, self.events):
            if sink is not None:
                sink.close()
