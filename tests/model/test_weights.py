"""Weights from a server on this machine, which also serves what a bad network gives."""

from __future__ import annotations

import functools
import hashlib
import http.server
import io
import threading
from pathlib import Path

import pytest
import torch

from model import weights
from model.weights import LPIPS_SET, SETS, WeightFile, WeightSet, fetch
from stages import cli
from tests.model.lpips import write_weights


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """No test sees or fills the user's cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for chosen in SETS.values():
        monkeypatch.delenv(chosen.variable, raising=False)


class Handler(http.server.SimpleHTTPRequestHandler):
    """Files of a folder. Of one whose name has "cut" only the first half comes; ``asked`` lists the paths."""

    asked: list[str]

    def do_GET(self):  # noqa: N802 (the library's name)
        self.asked.append(self.path)
        if "cut" not in self.path:
            return super().do_GET()
        data = Path(self.translate_path(self.path)).read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[: len(data) // 2])

    def log_message(self, *words):
        pass


@pytest.fixture
def server(tmp_path):
    """(folder that is served, its address, paths asked for)."""
    folder, asked = tmp_path / "served", []
    folder.mkdir()
    kind = type("Counting", (Handler,), {"asked": asked})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(kind, directory=str(folder))) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{running.server_port}", asked
        running.shutdown()
        thread.join()


def tensors(value: float) -> bytes:
    buffer = io.BytesIO()
    torch.save({"a": torch.full((50,), value)}, buffer)
    return buffer.getvalue()


def served(server, name: str, data: bytes, sha256: str | None = None) -> WeightFile:
    folder, address, _ = server
    (folder / name).write_bytes(data)
    return WeightFile(name, f"{address}/{name}", sha256 or hashlib.sha256(data).hexdigest())


def test_a_set_is_fetched_once_and_a_damaged_file_again(server, tmp_path):
    files = tuple(served(server, f"{i}.pth", tensors(i)) for i in range(2))
    chosen, said = WeightSet("few", "LIGHTMILL_FEW", files), []
    folder = fetch(chosen, say=said.append)
    assert folder == tmp_path / "cache" / "lightmill" / "weights" / "few" == chosen.folder()
    assert sorted(path.name for path in folder.iterdir()) == ["0.pth", "1.pth"]
    assert [weights.read(chosen.find(file, None, "it", ""))["a"][0] for file in files] == [0, 1]
    (folder / "1.pth").write_bytes(b"half")
    fetch(chosen, say=said.append)
    assert server[2] == ["/0.pth", "/1.pth", "/1.pth"]
    assert weights.read(folder / "1.pth")["a"][0] == 1
    assert [text.endswith("already there") for text in said] == [False, False, True, False]


@pytest.mark.parametrize("case", ["cut", "digest", "page", "gone", "silent"])
def test_what_is_not_the_file_leaves_nothing(server, tmp_path, case):
    data = tensors(3)
    file, words = {
        "cut": lambda: (served(server, "cut.pth", data), f"ended after {len(data) // 2:,} of {len(data):,} bytes"),
        "digest": lambda: (served(server, "a.pth", data, "0" * 64), "other bytes than expected"),
        "page": lambda: (served(server, "a.pth", b"<html>sign in</html>"), "no file of tensors"),
        "gone": lambda: (WeightFile("b.pth", f"{server[1]}/b.pth", "0" * 64), "cannot be had.*not found"),
        "silent": lambda: (WeightFile("b.pth", "http://127.0.0.1:9/b.pth", "0" * 64), "cannot be had.*refused"),
    }[case]()
    chosen = WeightSet("few", "LIGHTMILL_FEW", (file,))
    with pytest.raises(ValueError, match=f"(?i){words}") as caught:
        fetch(chosen, tmp_path / "out", lambda text: None)
    if case != "page":
        assert f"put it into {tmp_path / 'out'} as {file.name}" in str(caught.value)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_good_file_outlives_a_failed_download(server, tmp_path):
    good = served(server, "a.pth", tensors(1))
    chosen = WeightSet("few", "LIGHTMILL_FEW", (good, WeightFile("b.pth", f"{server[1]}/b.pth", "0" * 64)))
    with pytest.raises(ValueError, match="b.pth"):
        fetch(chosen, tmp_path / "out", lambda text: None)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.pth"]


def test_a_download_without_end_is_stopped(server, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "LARGEST", 100)
    with pytest.raises(ValueError, match="more than 100 bytes"):
        fetch(WeightSet("few", "X", (served(server, "a.pth", tensors(1)),)), tmp_path / "out", lambda text: None)


def test_the_folder_is_the_given_one_or_the_variables_or_the_caches(tmp_path, monkeypatch):
    assert LPIPS_SET.folder() == tmp_path / "cache" / "lightmill" / "weights" / "lpips"
    monkeypatch.setenv("LIGHTMILL_LPIPS", str(tmp_path / "named"))
    assert LPIPS_SET.folder() == tmp_path / "named" and LPIPS_SET.folder(tmp_path / "given") == tmp_path / "given"


def test_the_command_fetches_what_lpips_then_finds_by_itself(server, tmp_path, monkeypatch, capsys):
    from model.lpips import LPIPS

    for network in ("vgg", "alex"):
        write_weights(server[0], network)
    files = tuple(served(server, file.name, (server[0] / file.name).read_bytes()) for file in LPIPS_SET.files)
    monkeypatch.setattr(weights, "LPIPS_SET", WeightSet("lpips", "LIGHTMILL_LPIPS", files))
    monkeypatch.setitem(SETS, "lpips", weights.LPIPS_SET)
    assert cli.main(["weights", "lpips"]) == 0
    assert "complete" in capsys.readouterr().out
    assert LPIPS.load(None, "alex")(torch.zeros(1, 3, 40, 40), torch.ones(1, 3, 40, 40)) > 0
    assert cli.main(["weights", "lpips", "--folder", str(tmp_path / "other")]) == 0
    assert "LIGHTMILL_LPIPS" in capsys.readouterr().out


def test_the_command_looks_into_the_file_of_inception(server, monkeypatch, capsys):
    """The tensors of another network, whose digest is as expected."""
    name = weights.INCEPTION_2015.name
    chosen = WeightSet("inception", "LIGHTMILL_INCEPTION", (served(server, name, tensors(1)),))
    monkeypatch.setitem(SETS, "inception", chosen)
    assert cli.main(["weights", "inception"]) == 2
    assert "does not hold the Inception network of FID" in capsys.readouterr().err


def test_the_command_says_what_to_do_without_a_network(monkeypatch, capsys):
    """Nothing listens on that port."""
    files = tuple(WeightFile(file.name, f"http://127.0.0.1:9/{file.name}", file.sha256) for file in LPIPS_SET.files)
    monkeypatch.setitem(SETS, "lpips", WeightSet("lpips", "LIGHTMILL_LPIPS", files))
    assert cli.main(["weights", "lpips"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: http://127.0.0.1:9/vgg16") and "Without a network: download" in said


@pytest.mark.parametrize("data", [b"", b"<html>", tensors(1)[:200], None])
def test_what_is_no_file_of_tensors_says_so(tmp_path, data):
    if data is None:
        torch.save([torch.zeros(1)], tmp_path / "a.pth")
    else:
        (tmp_path / "a.pth").write_bytes(data)
    with pytest.raises(ValueError, match="a.pth is no file of"):
        weights.read(tmp_path / "a.pth")


def test_published_files_carry_the_head_of_their_digest_in_their_names():
    for file in (file for chosen in SETS.values() for file in chosen.files):
        assert len(file.sha256) == 64 and file.url.startswith("https://") and file.url.endswith(f"/{file.name}")
        assert "-" not in file.name or file.name.endswith(f"-{file.sha256[:8]}.pth")
