"""What a file is that should have been a checkpoint's: the things that downloads and copies leave under its name."""

from __future__ import annotations

from pathlib import Path

HEAD = 512  # bytes that tell a kind


HTML = (
    "is an HTML page, not the file itself: the address was that of a page about the file, or asks for a login; "
    "download the file (on most hubs: its `resolve` or `raw` address)"
)


def failed_download(data: bytes) -> str | None:
    """What the first bytes of a file of any kind say of a download that went wrong, and what to do; None where nothing."""
    text = data[:HEAD].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith(b"version https://git-lfs.github.com/spec/"):
        return (
            "is a Git LFS pointer, not the file itself: run `git lfs pull` in the repository that it comes from, or download "
            "the file from its web page"
        )
    return HTML if text.startswith((b"<!doctype html", b"<html", b"<head")) else None


def wrong_kind(path: Path) -> str | None:
    """What the file is and what to do, to follow its name in an error; None where nothing is known."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    if not head:
        return "is empty: its download or copy has failed, fetch it again"
    if (failed := failed_download(head)) is not None:
        return failed
    if head.startswith(b"<?xml"):
        return HTML
    if head[:4] == b"PK\x03\x04" or (head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05"):
        return (
            "is a pickle that was renamed (torch.save writes them): pickles can run programs and are not read; convert it "
            "where you trust it, with safetensors.torch.save_file(torch.load(FILE, weights_only=True), 'model.safetensors')"
        )
    if head[:8] == b"\x89HDF\r\n\x1a\n":
        return "is an HDF5 file: a checkpoint's weights are a safetensors file"
    return None
