"""The kinds of trouble a person can have with the engine, apart from bugs (which stay ordinary exceptions).

Each kind has an exit status of its own, so that scripts can tell what may be run again as it is (docs/faults.md).
"""

import errno

INTERRUPTED = 130  # the shells' number for Ctrl-C
STORAGE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.ESTALE}  # the disk's fault, no item's


class UserError(ValueError):
    """Something the user can mend. The message says what was given, what was expected and what to do.

    Commands print it as one line and exit with ``status``; ``--debug`` shows the traceback. A package that must not know the
    engine has a ValueError of its own with a ``status``. Any other exception is a bug: a traceback, and status 1.
    """

    status = 2


class ItemsFailed(UserError):
    """Exceptions in single items, a bug or a library's: their parts are missing, all others are kept."""

    status = 3


class TooManyRejects(UserError):
    """More items were rejected than ``max_reject_share`` allows."""

    status = 4


class Damaged(UserError):
    """Bytes in the store are not those that were written: ``lightmill repair`` makes them anew."""

    status = 5


class MachineError(UserError):
    """The machine, not the config: a disk that is full or read-only, workers that keep dying. Run again when mended."""

    status = 6


class Reject(Exception):
    """Expected data loss: this item cannot be turned into a record.

    ``reason`` is a key of the stage's closed list ``Stage.reasons``; ``detail`` is free text for a person. The item is
    written to ``rejects.jsonl`` and the run goes on.
    """

    def __init__(self, reason: str, detail: str = ""):
        super().__init__(reason, detail)
        self.reason = reason
        self.detail = detail

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}" if self.detail else self.reason


def for_people(error: BaseException) -> bool:
    """Whether the error's message says to a person what is wrong; else it is a bug."""
    if isinstance(error, OSError):
        return error.errno in STORAGE_ERRORS
    return isinstance(error, ValueError) and isinstance(getattr(error, "status", None), int)


def status_of(error: BaseException) -> int:
    """The exit status of a command that stops with this error."""
    if not for_people(error):
        return 1
    return MachineError.status if isinstance(error, OSError) else error.status  # type: ignore[attr-defined]
