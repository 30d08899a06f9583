"""One line per stage: done/total, rejects, rate and time left; a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO

PLAIN_EVERY_S = 10.0
BAR_EVERY_S = 0.2
BAR_WIDTH = 24


def duration(seconds: float) -> str:
    """1:02:03, 4:05 or 3.2 s."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


class Progress:
    """Progress of one stage on ``stream``. ``reused`` items count as done but not towards the rate."""

    def __init__(self, label: str, total: int, reused: int = 0, stream: TextIO | None = None):
        self.label = label
        self.total = total
        self.reused = reused
        self.done = reused
        self.rejects = 0
        self._stream = stream or sys.stdout
        self._start = time.monotonic()
        self._terminal = self._stream.isatty()
        self._last = self._start if not self._terminal else 0.0

    def line(self) -> str:
        elapsed = time.monotonic() - self._start
        rate = (self.done - self.reused) / elapsed if elapsed > 0 else 0.0
        left = duration((self.total - self.done) / rate) if rate > 0 else "?"
        rejects = f", {self.rejects} rejected" if self.rejects else ""
        return f"{self.label} {self.done}/{self.total}{rejects}, {rate:.2f}/s, {left} left"

    def add(self, done: int, rejects: int) -> None:
        self.done += done
        self.rejects += rejects
        now = time.monotonic()
        if self._terminal and now - self._last > BAR_EVERY_S:
            filled = round(BAR_WIDTH * self.done / max(self.total, 1))
            self._stream.write(f"\r\033[K{self.line()} [{'#' * filled}{'.' * (BAR_WIDTH - filled)}]")
            self._stream.flush()
            self._last = now
        elif not self._terminal and now - self._last > PLAIN_EVERY_S and self.done < self.total:
            print(self.line(), file=self._stream, flush=True)
            self._last = now

    def log(self, text: str) -> None:
        """A line of its own, above the bar."""
        if self._terminal:
            self._stream.write("\r\033[K")
        print(text, file=self._stream, flush=True)

    def close(self) -> None:
        if self._terminal:
            self._stream.write("\r\033[K")
            self._stream.flush()
