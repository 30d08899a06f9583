"""The two kinds of trouble a person can have with the engine, apart from bugs (which stay ordinary exceptions)."""


class UserError(ValueError):
    """Something the user can mend. The message says what was given, what was expected and what to do.

    Commands print it as one line and exit with status 2; ``--debug`` shows the traceback.
    """


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
