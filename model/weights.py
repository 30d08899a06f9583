"""Published weights that metrics and losses need: which files they are, where they come from, where they lie here.

`fetch` downloads a set into one folder. A file appears there only whole, with the digest below, and only if it holds tensors
alone. Nothing else in the project downloads weights.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model.errors import InputError
from pipeline.atomic import atomic_path

CHUNK = 1 << 20  # bytes at a time
LARGEST = 1 << 30  # bytes of a download; the largest file here has 553 MB
PATIENCE = 60.0  # seconds without a byte


@dataclass(frozen=True)
class WeightFile:
    """A file of tensors, and the SHA-256 of its bytes in hexadecimal digits."""

    name: str
    url: str
    sha256: str


@dataclass(frozen=True)
class WeightSet:
    """Files that lie in one folder. name: of `lightmill weights NAME`. variable: the environment's, which names the folder."""

    name: str
    variable: str
    files: tuple[WeightFile, ...]

    def folder(self, given: Path | str | None = None) -> Path:
        """The folder ``given``, or else the environment's, or else one in the user's cache."""
        if given is not None:
            return Path(given).expanduser()
        if os.environ.get(self.variable):
            return Path(os.environ[self.variable]).expanduser()
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return home / "lightmill" / "weights" / self.name

    def find(self, file: WeightFile, given: Path | str | None, needed_by: str, without: str) -> Path:
        """Where the file lies; an error says how to get it, and ``without`` says how to go without."""
        path = self.folder(given) / file.name
        if not path.is_file():
            raise InputError(
                f"{needed_by} needs {file.name}, but {path} does not exist: `lightmill weights {self.name}` fetches it from "
                f"{file.url}; {self.name}_folder or {self.variable} names another folder; or go without: {without}"
            )
        return path


TORCHVISION = "https://download.pytorch.org/models"
HEADS = "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1"
VGG16 = WeightFile(
    "vgg16-397923af.pth",
    f"{TORCHVISION}/vgg16-397923af.pth",
    "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
)
ALEXNET = WeightFile(
    "alexnet-owt-7be5be79.pth",
    f"{TORCHVISION}/alexnet-owt-7be5be79.pth",
    "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
)
VGG_HEADS = WeightFile("vgg.pth", f"{HEADS}/vgg.pth", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868")
ALEX_HEADS = WeightFile("alex.pth", f"{HEADS}/alex.pth", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0")
INCEPTION_2015 = WeightFile(
    "pt_inception-2015-12-05-6726825d.pth",
    "https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/pt_inception-2015-12-05-6726825d.pth",
    "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2",
)
LPIPS_SET = WeightSet("lpips", "LIGHTMILL_LPIPS", (VGG16, ALEXNET, VGG_HEADS, ALEX_HEADS))
INCEPTION_SET = WeightSet("inception", "LIGHTMILL_INCEPTION", (INCEPTION_2015,))
SETS = {chosen.name: chosen for chosen in (LPIPS_SET, INCEPTION_SET)}


def read(path: Path) -> dict[str, Any]:
    """The file's tensors by name. No code in the file runs."""
    import torch

    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # pickle, zip and torch have a dozen kinds for bytes that are something else
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} is no file of tensors (read with weights_only): {reason}; fetch it again") from None
    if not isinstance(found, dict) or not all(isinstance(value, torch.Tensor) for value in found.values()):
        raise InputError(f"{path} is no file of named tensors; fetch it again")
    return found


def fetch(chosen: WeightSet, folder: Path | str | None = None, say: Callable[[str], None] = print) -> Path:
    """Make sure that the whole set lies in its folder, and return that folder.

    A file that is there with the right digest stays. Any other is downloaded anew from its start. InputError where that fails.
    """
    target = chosen.folder(folder)
    target.mkdir(parents=True, exist_ok=True)
    for file in chosen.files:
        path = target / file.name
        if path.is_file() and digest(path) == file.sha256:
            say(f"{path}: already there")
            continue
        say(f"{path}: from {file.url}")
        with atomic_path(path) as temporary:
            with _told(file, target):
                _download(file.url, temporary)
            found = digest(temporary)
            if found != file.sha256:
                raise InputError(
                    f"{file.url} gave other bytes than expected: SHA-256 {found[:16]}..., not {file.sha256[:16]}...; nothing "
                    f"was kept. Is a proxy's page in the way? {_by_hand(file, target)}"
                )
            try:
                read(temporary)
            except InputError:
                raise InputError(f"{file.url} is no file of tensors; nothing was kept") from None
    return target


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _download(url: str, path: Path) -> None:
    """The bytes behind ``url``; ValueError where there are fewer than announced, or too many."""
    with urllib.request.urlopen(url, timeout=PATIENCE) as answer, path.open("wb") as file:
        announced, got = answer.headers.get("Content-Length"), 0
        while chunk := answer.read(CHUNK):
            got += len(chunk)
            if got > LARGEST:
                raise ValueError(f"more than {LARGEST:,} bytes")
            file.write(chunk)
        if announced is not None and got != int(announced):
            raise ValueError(f"it ended after {got:,} of {int(announced):,} bytes")


@contextlib.contextmanager
def _told(file: WeightFile, folder: Path) -> Iterator[None]:
    """A failed download as an error that says what to do. Trouble with the disk stays as it is."""
    try:
        yield
    except (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError, ValueError) as error:
        raise InputError(
            f"{file.url} cannot be had: {getattr(error, 'reason', error)}; nothing was kept. {_by_hand(file, folder)}"
        ) from None


def _by_hand(file: WeightFile, folder: Path) -> str:
    return (
        f"Without a network: download {file.url} on a machine that has one, put it into {folder} as {file.name}, "
        "and run this command again, which checks it"
    )
