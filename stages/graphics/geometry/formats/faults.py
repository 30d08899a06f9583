"""Rejects that name their place, and the one translator of what parsers and libraries raise.

Every call that can fail on a stranger's bytes runs inside ``at(place)``. Places nest, so a detail reads
"a.glb: accessor 3: 12 elements end at byte 160 of a buffer view of 144 bytes".
"""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from collections.abc import Iterator

from pipeline.errors import Reject

LONGEST = 400  # characters of a detail


@contextlib.contextmanager
def at(place: str) -> Iterator[None]:
    """Within, every Reject gets the place in front, and any other error of a parser becomes ``unreadable`` at the place."""
    try:
        yield
    except Reject as reject:
        raise Reject(reject.reason, f"{place}: {reject.detail}"[:LONGEST]) from None
    except MemoryError:
        raise
    except Exception as error:  # parsers of strangers' files fail in every way
        raise Reject("unreadable", f"{place}: {in_words(error)}"[:LONGEST]) from None


def in_words(error: Exception) -> str:
    """What an exception means for the file, in words for a person; never the exception's class."""
    if isinstance(error, json.JSONDecodeError):
        return f"line {error.lineno}, column {error.colno}: this is not JSON"
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start}: this is not text in {error.encoding}"
    if isinstance(error, KeyError):
        return f"{str(error.args[0])[:60]!r} is missing" if error.args else "something is missing"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, IndexError):
        return "it refers to something that does not exist"
    if isinstance(error, OverflowError):
        return "a number is too large"
    if isinstance(error, TypeError | AttributeError):
        return "a value has the wrong type"
    if isinstance(error, struct.error | EOFError):
        return "it ends too early"
    if isinstance(error, zlib.error):
        return "its compressed data is damaged"
    if isinstance(error, FileNotFoundError):
        return "the file is missing"
    if isinstance(error, OSError):
        return error.strerror or "it cannot be read"
    return "it is damaged"
