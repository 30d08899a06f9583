"""JSON that notices damage, and the deterministic tar that parts are made of."""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.atomic import write_atomic
from pipeline.keys import blake


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode()


def write_json(path: Path, value: Any) -> None:
    write_atomic(path, _json(value))


UNSEALED = "0" * 64


def write_sealed(path: Path, value: Mapping[str, Any]) -> None:
    """JSON that notices damage: ``check`` is the hash of the file's own bytes with that hash replaced by zeros."""
    data = _json({**value, "check": UNSEALED})
    write_atomic(path, data.replace(_check(UNSEALED), _check(blake(data)), 1))


def read_sealed(path: Path, schema: int = 0) -> dict[str, Any]:
    """What ``write_sealed`` wrote; ValueError where a byte has changed. Below ``schema`` a file may be without a seal."""
    data = path.read_bytes()
    value = json.loads(data)
    check = value.pop("check", None) if isinstance(value, dict) else None
    if check is None and not (isinstance(value, dict) and value.get("schema", schema) < schema):
        raise ValueError("it has no check sum")
    if check is not None and blake(data.replace(_check(check), _check(UNSEALED), 1)) != check:
        raise ValueError("its bytes are not those that were written")
    return value


def _check(digest: Any) -> bytes:
    return f'"check": "{digest}"'.encode()


_encode = json.JSONEncoder(sort_keys=True, ensure_ascii=False).encode


def json_line(value: Mapping[str, Any]) -> bytes:
    return _encode(value).encode() + b"\n"


def write_jsonl(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    write_atomic(path, (json_line(row) for row in rows))


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    with open(path, encoding="utf-8") as file:
        return [json.loads(line) for line in file]


def hash_file(path: Path) -> str:
    """Hex blake2b-256 of a file's bytes."""
    digest = hashlib.blake2b(digest_size=32)
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class TarWriter:
    """Writes tar members without times or owners and hashes the archive as it goes."""

    def __init__(self, file: BinaryIO):
        self._file = file
        self._digest = hashlib.blake2b(digest_size=32)
        self.size = 0

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._digest.update(data)
        self.size += len(data)

    def add(self, name: str, data: bytes) -> int:
        """Append one member; returns the offset of its data in the archive."""
        info = tarfile.TarInfo(name)
        info.size = len(data)
        info.mode = 0o644
        self._write(info.tobuf(tarfile.PAX_FORMAT))
        offset = self.size
        self._write(data)
        self._write(b"\0" * (-len(data) % tarfile.BLOCKSIZE))
        return offset

    def close(self) -> str:
        """End the archive; returns its hex digest."""
        self._write(b"\0" * (2 * tarfile.BLOCKSIZE))
        return self._digest.hexdigest()
