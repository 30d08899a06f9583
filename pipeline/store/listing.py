"""Where every record of an artifact lies: the rows of ``items.jsonl``, read when they are asked for.

A dataset may have millions of records and every process that reads some of them needs to find them: a listing keeps where the
lines of its file begin and what the records' digests are (about 190 bytes a record), not the parsed rows (about 1,500).

SQLite was tried as the index of a million rows (303 MB), in a file of 70 MB. It needs less memory (92 MB at most, not 250)
and is slower. Reading the lines' beginnings, as below, takes 2.3 s of CPU; parsing the rows into an indexed table takes 6.2 s.
Finding a record's digest takes 14 us instead of 1.5, a row 27 instead of 16. The runner of a resume and each of its workers
read a listing, and a resume of a million items has 2 s left to its bar of 30 (docs/scale.md). An index kept in the store would
take no time, but it would be one more file to trust.
"""

from __future__ import annotations

import json
import os
import re
import sys
from array import array
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, overload

# a line's beginning, as ``json_line`` writes a row: keys are sorted, and an id has nothing to escape
_BEGINNING = re.compile(rb'\{"digest": "([0-9a-f]{64})", "group": "(?:[^"\\]|\\.)*", "id": "([A-Za-z0-9_-]+)", ')
_DIGEST_BYTES = 32


class Row(NamedTuple):
    """Where one record lies: ``members`` maps a member's name to (offset, bytes) in the part's tar."""

    id: str
    item: str
    group: str
    part: str
    digest: str
    item_key: str
    members: Mapping[str, tuple[int, int]]

    def to_json(self) -> dict[str, Any]:
        return self._asdict()

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Row:
        members = {name: (int(offset), int(size)) for name, (offset, size) in data["members"].items()}
        group, part = sys.intern(data["group"]), sys.intern(data["part"])
        return cls(data["id"], data["item"], group, part, data["digest"], data["item_key"], members)


class Listing(Sequence[Row]):
    """The rows of one file, in its order."""

    def __init__(self, path: Path):
        self._path = path

    @cached_property
    def _file(self) -> BinaryIO:
        return open(self._path, "rb")  # noqa: SIM115 - for single lines, as long as the listing lives

    @cached_property
    def _lines(self) -> tuple[array, dict[str, int], bytearray]:
        """Where each line begins and the last ends, the number of each record's line, and the records' digests in a row."""
        starts, numbers, digests = array("Q", [0]), {}, bytearray()
        with open(self._path, "rb") as file:
            for number, text in enumerate(file):
                match = _BEGINNING.match(text)
                if match is None:
                    raise ValueError(f"{self._path}: line {number + 1} is no row")
                starts.append(starts[-1] + len(text))
                digest, record_id = match.groups()
                numbers[record_id.decode()] = number
                digests += bytes.fromhex(digest.decode())
        return starts, numbers, digests

    def __len__(self) -> int:
        return len(self._lines[0]) - 1

    def __iter__(self) -> Iterator[Row]:
        with open(self._path, "rb") as file:
            for text in file:
                yield Row.from_json(json.loads(text.decode()))  # of bytes, json guesses the encoding anew each time

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> list[Row]: ...
    def __getitem__(self, index: int | slice) -> Row | list[Row]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        starts, number = self._lines[0], range(len(self))[index]
        start, end = starts[number], starts[number + 1]
        return Row.from_json(json.loads(os.pread(self._file.fileno(), end - start, start)))

    def holds(self, record_id: str) -> bool:
        return record_id in self._lines[1]

    def number(self, record_id: str) -> int:
        """The place of the record in the order of the file; KeyError if there is none."""
        return self._lines[1][record_id]

    def digest(self, record_id: str) -> str:
        """The record's digest, without reading its row; KeyError if there is none."""
        start = self._lines[1][record_id] * _DIGEST_BYTES
        return self._lines[2][start : start + _DIGEST_BYTES].hex()

    def find(self, record_id: str) -> Row:
        """The record's row; KeyError if there is none."""
        return self[self._lines[1][record_id]]
