"""The parts of a page as Markdown, to be read on a host of repositories or pasted into a document."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from stages.graphics.page.parts import Block, Cell, Section


def table(columns: Sequence[Any], rows: Iterable[Sequence[Any]], numeric: bool = False) -> list[str]:
    """Lines of a table. numeric: all columns but the first are set flush right."""
    rule = ["---", *(["---:" if numeric else "---"] * (len(columns) - 1))]
    return [line(columns), "| " + " | ".join(rule) + " |", *map(line, rows)]


def line(cells: Sequence[Any]) -> str:
    return "| " + " | ".join(map(cell, cells)) + " |"


def cell(value: Any) -> str:
    """A cell on one line, with nothing in it that would end the cell or begin a tag."""
    text = value.text if isinstance(value, Cell) else value
    return "–" if text is None else " ".join(str(text).split()).replace("|", "\\|").replace("<", "\\<")


def document(title: str, lead: Iterable[Block], sections: Iterable[Section]) -> str:
    """A title, what stands below it, and sections."""
    lines = [f"# {title}", "", *blocks(lead)]
    for section in sections:
        lines += [f"## {section.title}", "", *blocks(section.blocks)]
    return "\n".join(lines)


def blocks(blocks: Iterable[Block]) -> list[str]:
    """Lines of blocks, an empty one after each."""
    lines: list[str] = []
    for block in blocks:
        if block.kind == "text":
            lines += [block.text, ""]
        elif block.kind == "code":
            lines += [f"**{block.title}**", ""] if block.title else []
            lines += ["```", block.text, "```", ""]
        elif block.kind == "figure":
            lines += [f"![{block.caption}]({block.source})", "", f"*{block.caption}*", ""]
        elif block.kind == "table":
            lines += [*table(block.columns, block.rows, block.numeric), ""]
        else:
            raise ValueError(f"Markdown has no {block.kind}")
    return lines
