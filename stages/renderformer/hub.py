"""Hugging Face's hub: checkpoints by name, and artifacts that are published there. By the package huggingface_hub, optional.

``hub:OWNER/NAME`` or ``hub:OWNER/NAME@REVISION`` names a repository. What is downloaded lies in the package's own cache, where
it is found without a network. What is published keeps its paths, so that its address works as a dataset's URL.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.store import Store

PREFIX = "hub:"
NAME = re.compile(r"hub:([\w.-]+/[\w.-]+)(?:@([\w./-]+))?\Z")
CHECKPOINT_FILES = ("config.json", "model.safetensors", "objects.json")
INSTALL = "needs the package huggingface_hub: pip install huggingface_hub"
BATCH = 50  # files of one commit
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"), (10_000_000, "1M<n<10M"))
LICENCES = {"CC0-1.0": "cc0-1.0", "CC-BY-4.0": "cc-by-4.0", "MIT": "mit"}  # ours -> the hub's


def is_hub(reference: Any) -> bool:
    return str(reference).startswith(PREFIX)


def _parsed(reference: str) -> tuple[str, str | None]:
    """(OWNER/NAME, revision)."""
    match = NAME.match(reference)
    if not match or ".." in reference:
        raise UserError(f"{reference!r} is no name on the hub: give hub:OWNER/NAME, or hub:OWNER/NAME@REVISION")
    return match[1], match[2]


def _client(what: str) -> Any:
    try:
        import huggingface_hub
    except ImportError:
        raise UserError(f"{what} {INSTALL}") from None
    return huggingface_hub


# --- down ---------------------------------------------------------------------------------------------------------------------


def checkpoint(reference: str) -> Path:
    """The folder of a checkpoint on the hub, downloaded once. A UserError says why it cannot be had."""
    name, revision = _parsed(reference)
    hub = _client(reference)
    try:
        folder = Path(hub.snapshot_download(name, revision=revision, allow_patterns=list(CHECKPOINT_FILES)))
    except Exception as error:  # the package's own errors, those of its HTTP library, and the disk's
        raise UserError(f"{reference} {_reason(error, name)}") from None
    if not (folder / "config.json").is_file() or not (folder / "model.safetensors").is_file():
        raise UserError(f"{reference} is no checkpoint: it holds no config.json and model.safetensors on top")
    return folder


def _reason(error: Exception, name: str) -> str:
    """What an error of the package means, and what to do. By the names of its classes, which are its interface."""
    names = {kind.__name__ for kind in type(error).__mro__}
    if "GatedRepoError" in names:
        return f"is gated: accept its terms at https://huggingface.co/{name}, log in (`hf auth login`), and try again"
    if "RevisionNotFoundError" in names:
        return "has no such revision: leave @REVISION out, or give a branch, tag or commit of it"
    if "RepositoryNotFoundError" in names:
        return "does not exist there, or is private: look for a typing error, or log in (`hf auth login`)"
    if names & {"LocalEntryNotFoundError", "OfflineModeIsEnabled", "ConnectionError", "ConnectError", "TimeoutException"}:
        return (
            "is not in the cache, and the hub cannot be reached: connect once, or download the repository's config.json and "
            "model.safetensors elsewhere and give their folder"
        )
    if isinstance(error, OSError) and error.errno is not None:
        return f"cannot be kept: {error.strerror}"
    return (
        f"cannot be had from the hub: {str(error).strip().splitlines()[0][:200] if str(error).strip() else 'no reason given'}"
    )


# --- up -----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Publication:
    """What is uploaded: ``files`` by their path there, a path here or bytes; in this order, the card last.

    kind: ``dataset`` or ``model``, of the repository.
    """

    name: str
    kind: str
    files: Mapping[str, Path | bytes]

    def listing(self) -> Iterator[tuple[str, int]]:
        """(path there, bytes) of each file."""
        for path, content in self.files.items():
            yield path, len(content) if isinstance(content, bytes) else content.stat().st_size


def publication(reference: str, name: str, store: Path | str = "store", licence: str | None = None) -> Publication:
    """What publishing an artifact (of stage shard or train), or a checkpoint's folder, under a name uploads.

    licence: the hub's identifier. None: of a dataset that of its objects, where it is one for all.
    """
    target, revision = _parsed(name)
    if revision is not None:
        raise UserError(f"{name}: a revision is made by publishing, leave @{revision} out")
    folder = Path(reference)
    if (folder / "config.json").is_file():
        return Publication(target, "model", _model_files(folder, target, licence))
    artifact = Store(store).resolve(reference)
    if artifact.stage == "train":
        return Publication(target, "model", _model_files(artifact.file("checkpoint"), target, licence))
    if artifact.stage == "shard":
        return Publication(target, "dataset", _dataset_files(artifact, target, licence))
    raise UserError(
        f"{reference} is an artifact of stage {artifact.stage}: a dataset (shard) or a checkpoint (train) is published"
    )


def publish(what: Publication, private: bool = False) -> str:
    """Upload it, and return its address. Files that are there already stay; a killed upload is taken up by the same command."""
    hub = _client(f"publishing {what.name}")
    try:
        api = hub.HfApi()
        api.create_repo(what.name, repo_type=what.kind, private=private, exist_ok=True)
        there = set(api.list_repo_files(what.name, repo_type=what.kind))
        # a part is named after its bytes, all else may have changed
        left = [path for path in what.files if not (path.startswith("parts/") and path in there)]
        for start in range(0, len(left), BATCH):
            batch = left[start : start + BATCH]
            operations = [hub.CommitOperationAdd(path, _given(what.files[path])) for path in batch]
            message = f"lightmill publish: files {start + 1} to {start + len(batch)} of {len(left)}"
            api.create_commit(what.name, operations, commit_message=message, repo_type=what.kind)
    except Exception as error:  # as above
        raise UserError(f"{PREFIX}{what.name} {_reason(error, what.name)}") from None
    return f"https://huggingface.co/{'datasets/' if what.kind == 'dataset' else ''}{what.name}"


def _given(content: Path | bytes) -> str | bytes:
    return content if isinstance(content, bytes) else str(content)


def _dataset_files(artifact: Any, name: str, licence: str | None) -> dict[str, Path | bytes]:
    shards = json.loads(artifact.file("shards.json").read_bytes())
    objects = json.loads(artifact.file("objects.json").read_bytes())
    files: dict[str, Path | bytes] = {
        part["path"]: artifact.path / part["path"] for split in shards.values() for part in split["parts"]
    }
    for path in sorted((artifact.path / "files").rglob("*")):
        if path.is_file() and path.name != "README.md":
            files[path.relative_to(artifact.path).as_posix()] = path
    stated = {entry.get("licence", "") for split in objects.values() for entry in split.values()}
    if licence is None:
        licence = LICENCES.get(next(iter(stated)), "other") if len(stated) == 1 else "other"
    samples = sum(split["samples"] for split in shards.values())
    header = [
        f"pretty_name: {json.dumps(name.partition('/')[2])}",
        f"license: {licence}",
        "task_categories:\n- image-to-3d\n- other",
        "tags:\n- webdataset\n- rendering\n- path-tracing\n- global-illumination\n- renderformer\n- lightmill",
        f"size_categories:\n- {next((label for most, label in SIZES if samples < most), 'n>10M')}",
        "configs:\n- config_name: default\n  data_files:\n" + "\n".join(_split_lines(split, shards[split]) for split in shards),
    ]
    card = artifact.file("README.md").read_text(encoding="utf-8")
    for picture in ("contact.png", "distributions.png"):
        card = card.replace(f"]({picture})", f"](files/{picture})")
    files["README.md"] = _with_header(header, card + _dataset_use(name, shards)).encode()
    return files


def _split_lines(split: str, shards: Mapping[str, Any]) -> str:
    paths = "\n".join(f"    - {part['path']}" for part in shards["parts"])
    return f"  - split: {split}\n    path:\n{paths}"


def _dataset_use(name: str, shards: Mapping[str, Any]) -> str:
    split = next(iter(shards))
    part = shards[split]["parts"][0]["path"]
    address = f"https://huggingface.co/datasets/{name}/resolve/main"
    return f"""
## From the hub

Nothing has to be downloaded first.

```python
from stages.renderformer.dataset import ShardDataset  # lightmill: checked, shuffled, batched
ShardDataset("{address}", "{split}")

import webdataset  # each sample's members as bytes
webdataset.WebDataset("{address}/{part}", shardshuffle=False)

import datasets
datasets.load_dataset("{name}", split="{split}", streaming=True)
```
"""


def _model_files(folder: Path, name: str, licence: str | None) -> dict[str, Path | bytes]:
    from model.renderformer import checkpoint as checkpoints

    model, trained_with = checkpoints.load(folder)  # what is published can be read
    files: dict[str, Path | bytes] = {file: folder / file for file in CHECKPOINT_FILES if (folder / file).is_file()}
    parameters = sum(tensor.numel() for tensor in model.parameters())
    header = [
        *([f"license: {licence}"] if licence else []),
        "library_name: lightmill",
        "tags:\n- renderformer\n- neural-rendering\n- lightmill",
    ]
    facts = "".join(f"| {key} | {value} |\n" for key, value in sorted(trained_with.items()))
    card = f"""# {name.partition("/")[2]}

A RenderFormer checkpoint in the released format: `config.json` and `model.safetensors`, {parameters:,} parameters.

```
lightmill predict chair.glb --checkpoint hub:{name} -o chair.png
```

| trained with | |
| --- | --- |
{facts}| layers, view-independent and view-dependent | {model.config.num_layers} + {model.config.view_transformer_n_layers} |
| width | {model.config.latent_dim} |
"""
    files["README.md"] = _with_header(header, card).encode()
    return files


def _with_header(lines: list[str], card: str) -> str:
    """A card behind the YAML that the hub reads."""
    return "\n".join(["---", *lines, "---", "", card])
