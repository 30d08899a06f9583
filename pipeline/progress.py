"""One line per stage: done/total, rejects, rate and time left; a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars

from pipeline.terminal import console

PLAIN_EVERY_S = 10.0
BAR_EVERY_S = 0.2


def duration(seconds: float) -> str:
    """1:02:03, 4:05 or 3.2 s."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


class Progress:
    """Progress of one stage on ``stream``. ``reused`` items count as done but not towards the rate.

    The bar is drawn by ``add`` and not by a thread of rich's own, because workers may be forked from this process.
    """

    def __init__(self, label: str, total: int, reused: int = 0, stream: TextIO | None = None):
        self.label, self.total, self.reused = label, total, reused
        self.done, self.rejects = reused, 0
        self._start = self._last = time.monotonic()
        self._console = console(stream or sys.stdout)
        self._terminal = self._console.is_terminal
        self._bars = Bars(
            TextColumn("{task.description}", markup=False), BarColumn(24),
            console=self._console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False,
        )  # fmt: skip
        self._bar = self._bars.add_task(label, total=max(total, 1), completed=reused)
        if self._terminal:
            self._bars.start()

    def line(self) -> str:
        elapsed = time.monotonic() - self._start
        rate = (self.done - self.reused) / elapsed if elapsed > 0 else 0.0
        time_left = duration((self.total - self.done) / rate) if rate > 0 else "?"
        rejects = f", {self.rejects} rejected" if self.rejects else ""
        return f"{self.label} {self.done}/{self.total}{rejects}, {rate:.2f}/s, {time_left} left"

    def add(self, done: int, rejects: int) -> None:
        self.done += done
        self.rejects += rejects
        now = time.monotonic()
        if now - self._last <= (BAR_EVERY_S if self._terminal else PLAIN_EVERY_S):
            return
        self._last = now
        if self._terminal:
            self._bars.update(self._bar, completed=self.done, description=self.line(), refresh=True)
        elif self.done < self.total:
            self.log(self.line())

    def log(self, text: str) -> None:
        """A line of its own, above the bar."""
        self._console.print(text)

    def close(self) -> None:
        """Take the bar away."""
        if self._terminal:
            self._bars.stop()
