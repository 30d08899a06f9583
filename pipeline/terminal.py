"""What people read: colours, bars and tables on a terminal, plain lines that nothing wraps or colours in a pipe or a file."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import TextIO

from rich.console import Console
from rich.table import Table

WIDEST = 10_000  # characters: rich would fold a table's cells at the terminal's width, and at 80 in a pipe


def console(stream: TextIO | None = None, width: int | None = None) -> Console:
    """Prints text as it is: ``[x]`` is no markup, and a long path stays on one line."""
    return Console(file=stream or sys.stdout, width=width, highlight=False, markup=False, emoji=False, soft_wrap=True)


def print_table(rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> None:
    """Rows of equal length in columns, those numbered in ``right`` flush right and the first in bold.

    Nothing is cut or folded, so names can be copied.
    """
    rows = list(rows)
    table = Table.grid(padding=(0, 2))
    for number in range(len(rows[0]) if rows else 0):
        style = "bold" if number == 0 else None
        table.add_column(justify="right" if number in right else "left", style=style, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    if rows:
        console(width=WIDEST).print(table)
