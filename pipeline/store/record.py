"""A record: one sample of an artifact, as named bytes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass
import hashlib

RECORD_ID = re.compile(r"[A-Za-z0-9_-]{1,120}\Z")
MEMBER_NAME = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)*\Z")


@dataclass(frozen=True)
class Record:
    """Named bytes: one sample of an artifact, stored as tar members ``<id>.<member>`` (the webdataset convention)."""

    id: str
    members: Mapping[str, bytes]

    def __post_init__(self) -> None:
        if not RECORD_ID.match(self.id):
            raise ValueError(f"record id {self.id!r} may hold only letters, digits, '_' and '-', at most 120")
        for name in self.members:
            if not MEMBER_NAME.match(name):
                raise ValueError(f"member name {name!r} of record {self.id} must be lower case words joined by dots")


def record_digest(members: Mapping[str, bytes]) -> str:
    """Hex blake2b-256 over the names and bytes of a record's members."""
    digest = hashlib.blake2b(digest_size=32)
    for name in sorted(members):
        data = members[name]
        digest.update(f"{len(name)}:{name}:{len(data)}:".encode())
        digest.update(data)
    return digest.hexdigest()
