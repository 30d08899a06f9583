"""Text of mesh formats: bytes in one encoding with one line end, numbers as exporters write them, and where a word stands."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Sequence

import numpy as np

from pipeline.errors import Reject

BYTE_ORDER_MARKS = (  # the longer ones first
    (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"), (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\Z")
NOT_A_NUMBER = re.compile(rb"[+-]?(?:nan|inf|infinity|\d+\.#\w+)(?:\(\w*\))?\Z", re.IGNORECASE)


def plain_text(data: bytes) -> bytes:
    """The text in UTF-8 or whatever 8-bit encoding it has, without byte order mark; lines end with ``\\n``."""
    encoding = next((name for mark, name in BYTE_ORDER_MARKS if data.startswith(mark)), None)
    head = data[:64]
    if encoding is None and len(head) > 3 and not any(head[1::2]) and all(head[::2]):
        encoding = "utf-16-le"
    if encoding is None and len(head) > 3 and not any(head[::2]) and all(head[1::2]):
        encoding = "utf-16-be"
    if encoding is not None:
        data = data.decode(encoding).encode()
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def shown(word: bytes) -> str:
    """A word as a message quotes it."""
    return repr(word[:40].decode("utf-8", "replace"))


def number(word: bytes) -> float:
    """The number that a word means; not a number and infinity in any spelling are nan. ValueError where it is none.

    Besides what C reads: ``1.0d5`` (Fortran) and a sign before the ``e``, as in ``3.1+e2``.
    """
    plain = re.sub(rb"([+-])[eE]", rb"e\1", word).replace(b"d", b"e").replace(b"D", b"e")
    if NUMBER.match(plain):
        return float(plain)
    if NOT_A_NUMBER.match(word):
        return float("nan")
    raise ValueError


class Words:
    """The words of a text and the lines that they stand in.

    first_line: number of the text's first line in its file.
    """

    def __init__(self, text: bytes, first_line: int = 1):
        self.text, self.first_line = text, first_line
        self.words = text.split()

    def __len__(self) -> int:
        return len(self.words)

    def line(self, index: int) -> int:
        """Number of the line that a word stands in; beyond the last word, that of the last line with any."""
        for count, match in enumerate(re.finditer(rb"\S+", self.text)):
            if count == index:
                return self.first_line + self.text.count(b"\n", 0, match.start())
        return self.first_line + self.text.rstrip().count(b"\n")

    def place(self, index: int) -> str:
        return f"line {self.line(index)}"

    def floats(self, places: slice | np.ndarray) -> np.ndarray:
        """(n,) float64 of the words at these places; a Reject names the line of one that is no number."""
        return self._values(places, floats, "is not a number")

    def integers(self, places: slice | np.ndarray) -> np.ndarray:
        """(n,) int64 of the words at these places; a Reject names the line of one that is no whole number."""
        return self._values(places, integers, "is not a whole number")

    def _values(self, places: slice | np.ndarray, read: Callable, what: str) -> np.ndarray:
        words = self.words[places] if isinstance(places, slice) else [self.words[place] for place in places]
        fault, values = read(words)
        if fault is None:
            return values
        index = range(len(self))[places][fault] if isinstance(places, slice) else int(places[fault])
        raise Reject("unreadable", f"{self.place(index)}: {shown(words[fault])} {what}")


def floats(words: Sequence[bytes]) -> tuple[int | None, np.ndarray]:
    """(index of the first word that is no number, or None; float64 values)."""
    try:
        if not any(b"_" in word for word in words):  # which Python takes as a separator of digits
            return None, np.array(list(map(float, words)), np.float64)
    except ValueError:
        pass
    values = np.zeros(len(words))
    for index, word in enumerate(words):
        try:
            values[index] = number(word)
        except ValueError:
            return index, values
    return None, values


def integers(words: Sequence[bytes]) -> tuple[int | None, np.ndarray]:
    """(index of the first word that is no whole number, or None; int64 values). ``7.0`` is one."""
    try:
        if not any(b"_" in word for word in words):
            return None, np.array(list(map(int, words)), np.int64)
    except (ValueError, OverflowError):
        pass
    values = np.zeros(len(words), np.int64)
    for index, word in enumerate(words):
        try:
            value = number(word)
        except ValueError:
            return index, values
        if value != value or value % 1 or abs(value) >= 1 << 53:
            return index, values
        values[index] = int(value)
    return None, values
