"""Who works on a draft: claims, held by a kernel lock."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
from pathlib import Path
from typing import Any

import psutil

STALE_CLAIM_S = 120.0  # another host's claim without a heartbeat for this long is taken over


class Claim:
    """Who works on a draft: a file with host and pid, held by a kernel lock that ends with its process, however that ends.

    Where locks do not reach other hosts, a heartbeat (the file's time) stands in for them. Losing a claim wastes work, never
    corrupts: the commit does not rely on it.
    """

    def __init__(self, path: Path):
        self.path = path
        self._handle: int | None = None
        self._stop = threading.Event()

    def holder(self) -> dict[str, Any] | None:
        """Host, pid and start time of who holds it now; None if nobody does."""
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except OSError:
            return None
        try:
            return self._other(handle, fcntl.LOCK_SH)
        finally:
            os.close(handle)

    @staticmethod
    def _other(handle: int, lock: int) -> dict[str, Any] | None:
        """Who else holds the open claim file; where nobody does it is locked now."""
        locked, free = False, True
        try:
            fcntl.flock(handle, lock | fcntl.LOCK_NB)
            locked = True
        except BlockingIOError:
            free = False
        except OSError:  # a file system without locks
            pass
        try:
            owner = json.loads(os.pread(handle, 4096, 0))
        except ValueError:
            owner = None if free else {"host": "?", "pid": 0}
        if owner is None or not free:
            return owner
        if owner["host"] == socket.gethostname():
            return None if locked or not psutil.pid_exists(owner["pid"]) or owner["pid"] == os.getpid() else owner
        return owner if abs(time.time() - os.fstat(handle).st_mtime) < STALE_CLAIM_S else None

    def take(self) -> bool:
        """Take it unless another process holds it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if self._other(handle, fcntl.LOCK_EX) is not None:
                return False
            if not self._is_at_path(handle):  # its last holder has just let go of it, and of its name
                return False
            me = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.time()}
            os.truncate(handle, 0)
            os.pwrite(handle, json.dumps(me).encode(), 0)
            self._handle, handle = handle, -1
        finally:
            if handle >= 0:
                os.close(handle)

        def beat() -> None:
            while not self._stop.wait(STALE_CLAIM_S / 8):
                with contextlib.suppress(OSError):
                    os.utime(self.path)

        threading.Thread(target=beat, daemon=True).start()
        return True

    def _is_at_path(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(handle))
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Let go of it, if this process holds it."""
        self._stop.set()
        if self._handle is not None:
            if self._is_at_path(self._handle):
                self.path.unlink(missing_ok=True)
            os.close(self._handle)
            self._handle = None
