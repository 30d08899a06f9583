"""Progress and tables: a bar and colours on a terminal, plain lines elsewhere."""

from __future__ import annotations

import io

import pytest

from pipeline import progress, terminal


class Screen(io.StringIO):
    """A terminal that keeps what was written to it."""

    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(progress, "BAR_EVERY_S", -1)
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", -1)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")


def output_of(stream: io.StringIO) -> str:
    bar = progress.Progress("04 render", 8, reused=2, stream=stream)
    bar.add(2, 1)
    bar.log("a/[b]/" + 100 * "c")
    bar.add(4, 0)
    bar.close()
    return stream.getvalue()


def test_in_a_pipe_there_are_plain_whole_lines():
    first, second = output_of(io.StringIO()).splitlines()
    assert first.startswith("04 render 4/8, 1 rejected, ") and first.endswith(" left")
    assert second == "a/[b]/" + 100 * "c"


def test_on_a_terminal_there_is_a_bar_that_goes_away():
    text = output_of(Screen())
    assert "04 render 4/8, 1 rejected, " in text and "━" in text and "a/[b]/" + 100 * "c" in text
    assert text.endswith("\x1b[2K") or text.rstrip().endswith("\x1b[?25h\r\x1b[1A\x1b[2K")


@pytest.mark.parametrize("stream", [io.StringIO(), Screen()], ids=["pipe", "terminal"])
def test_a_table_has_columns(stream, monkeypatch):
    monkeypatch.setattr("sys.stdout", stream)
    terminal.print_table([("scene/[x]", "7", "a"), ("remesh", "12", 60 * "long ")], right=[1])
    text = stream.getvalue()
    if stream.isatty():
        assert "\x1b[1m" in text and "12" in text
    else:
        lines = [line.rstrip() for line in text.splitlines()]
        assert lines == ["scene/[x]   7  a", "remesh     12  " + (60 * "long ").rstrip()]
