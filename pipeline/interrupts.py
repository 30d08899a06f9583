"""How a command ends: Ctrl-C in order, errors for people as one line, each with its exit status."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

from pipeline.errors import INTERRUPTED, for_people, status_of


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C stops the workers and the run in order; a second one ends the process at once, and Linux its workers with it."""

    def at_once(number: int, frame: object) -> None:
        os._exit(INTERRUPTED)

    def in_order(number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, at_once)
        os.write(2, b"interrupted: stopping (Ctrl-C again: at once)\n")
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, in_order)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is in_order:  # else the process is about to end: a late second one finds it so
            signal.signal(signal.SIGINT, before)


def guarded(work: Callable[[], None], debug: bool = False) -> int:
    """Do the work; an error that a person can mend becomes one line and its exit status, which is returned."""
    try:
        with interruptible():
            work()
    except (ValueError, OSError) as error:
        if debug or not for_people(error):
            raise
        print(f"error: {error}", file=sys.stderr, flush=True)
        return status_of(error)
    except KeyboardInterrupt:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # all has stopped: one more would only change the exit status
        print("interrupted: what is finished is kept, the same command continues", file=sys.stderr)
        return INTERRUPTED
    return 0
