"""Counts the words of each sentence in README.md and docs/: plain pages have short sentences. Run by hand:

    python checks/sentences.py [PAGE.md ...] [--long 35]

Code blocks, tables, headings, pictures and front matter are left out. A point of a list and a paragraph end a sentence too;
code in backquotes counts as one word. Prints a line per page, with ``--long N`` also the sentences of N words or more, and
exits with 1 where the mean of a page is over MEAN.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MEAN = 20  # words
LEFT_OUT = re.compile(r"#|\||!\[|<")  # how lines begin that hold no sentence
POINT = re.compile(r"\s*([-*]|\d+\.) ")
END = re.compile(r"""(?<=[^.][.!?])["')*_]*\s+(?=["'(*_\[]*(?:[A-Z0-9`]|lightmill\b))""")
SHORT = re.compile(r"\b(e\.g|i\.e|et al|vs|cf)\.")
WORD = re.compile(r"\w")


def blocks(text: str) -> list[str]:
    """Paragraphs and points of lists, each as one line."""
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)  # front matter
    text = re.sub(r"^```.*?^```$", "\n", text, flags=re.MULTILINE | re.DOTALL)
    found = [""]
    for line in text.splitlines():
        if not line.strip() or LEFT_OUT.match(line.strip()):
            found.append("")
        elif POINT.match(line):
            found.append(POINT.sub("", line, count=1))
        else:
            found[-1] += f" {line.strip()}"
    return [block.strip() for block in found if block.strip()]


def sentences(text: str) -> list[str]:
    """The sentences of a page."""
    found = []
    for block in blocks(text):
        block = re.sub(r"\]\([^)]*\)", "]", block)  # addresses of links
        block = re.sub(r"`[^`]*`", "`code`", block)  # a name or a command counts as one word
        block = SHORT.sub(lambda match: match[0].replace(".", ""), block)
        found += [sentence for sentence in END.split(block) if sentence and WORD.search(sentence)]
    return found


def words(sentence: str) -> int:
    return sum(bool(WORD.search(word)) for word in sentence.split())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", type=Path, metavar="PAGE.md", help="default: README.md and all of docs")
    parser.add_argument("--long", type=int, metavar="N", help="also print sentences of so many words or more")
    args = parser.parse_args()
    pages = args.pages or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    failed = 0
    print(f"{'page':<24} {'sentences':>9} {'mean':>5} {'longest':>7}")
    for page in pages:
        found = sentences(page.read_text(encoding="utf-8"))
        lengths = [words(sentence) for sentence in found] or [0]
        mean = sum(lengths) / len(lengths)
        failed += mean > MEAN
        print(f"{os.path.relpath(page):<24} {len(found):>9} {mean:>5.1f} {max(lengths):>7}{'  over' if mean > MEAN else ''}")
        for length, sentence in zip(lengths, found, strict=False):
            if args.long and length >= args.long:
                print(f"    {length}: {sentence}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
