"""A page's template, filled in. Every value is escaped, but for text that our own code has marked as HTML."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

TEMPLATES = Path(__file__).parent / "templates"


def render(template: Path, title: str, **values: Any) -> str:
    """The page that ``template`` makes of ``values``. It finds templates of its own folder and those of the toolkit.

    A value that the template uses and nobody gave is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, TEMPLATES]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"inline": inline, "headings": headings}
    return environment.get_template(template.name).render(title=title, **values)


def inline(text: str) -> Markup:
    """Escaped text in which `code` and **bold** are marked up."""
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text)))
    return Markup(re.sub(r"\*\*([^*]+)\*\*", r"<b>\1</b>", marked))


def headings(content: str) -> list[tuple[str, Markup]]:
    """(anchor, heading) of every section in a page's HTML, for its table of contents."""
    anchored = re.findall(r'<section id="([^"]+)">\s*<h2>(.*?)</h2>', str(content), re.S)
    return [(anchor, Markup(heading)) for anchor, heading in anchored]
