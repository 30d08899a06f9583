"""Pages: strangers' strings stay strings, a page fetches nothing from elsewhere, and HTML and Markdown say the same."""

from __future__ import annotations

import base64
from html.parser import HTMLParser

import jinja2
import pytest

from stages.graphics.page import Cell, Clip, Code, Picture, Section, Table, Text, embed, markdown, plots, render
from stages.graphics.page.render import inline

BAD = "<script>alert(1)</script>"
PNG = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg==")

PAGE = """{% extends "base.html.j2" %}
{% import "parts.html.j2" as parts %}
{% block content %}
{% for section in sections %}
{% call parts.section(section.id, section.title) %}
{% for block in section.blocks %}{{ parts.block(block) }}{% endfor %}
{% endcall %}
{% endfor %}
{{ parts.gallery(items, columns=2) }}
{{ parts.tiles({"scenes": 3}) }}
{% endblock %}
"""


@pytest.fixture
def page(tmp_path):
    """page(sections, items, title) -> HTML of a template in a folder of its own, as another system's would be."""
    (tmp_path / "own.html.j2").write_text(PAGE)
    return lambda sections=(), items=(), title="A page": render(tmp_path / "own.html.j2", title, sections=sections, items=items)


def test_everything_is_escaped(page):
    table = Table([BAD, Cell(BAD)], [[BAD, Cell(BAD, note=BAD, kind='"' + BAD)], [None, 1]])
    blocks = [table, Text(f"`{BAD}` **{BAD}** {BAD}"), Code(BAD, title=BAD), Picture("a.png", BAD), Clip("a.mp4", BAD)]
    html = page([Section(BAD, blocks)], title=BAD)
    tags = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: tags.append((tag, {name for name, _ in attributes}))
    parser.feed(html)
    assert "script" not in {tag for tag, _ in tags} and html.count("&lt;script&gt;") >= 12
    assert all(names <= {"class"} for tag, names in tags if tag in ("td", "th", "span"))  # a quote ends no attribute


def test_a_page_has_the_parts_that_it_was_given(page):
    picture = Picture(embed(PNG), "truth")
    html = page(
        [Section("One & two", [Table(["a", "b"], [["x", None]], numeric=True)]), Section("Three", [picture])], [picture]
    )
    assert '<a href="#one-two">One &amp; two</a><a href="#three">Three</a>' in html  # the table of contents
    assert '<section id="one-two">' in html and "<td>–</td>" in html and '<table class="numeric">' in html
    assert html.count("<img") == 2 and html.count("<figcaption>truth</figcaption>") == 2
    video = page(items=[Clip("frames/orbit.mp4", "an orbit", poster="frames/first.png")])
    assert '<video src="frames/orbit.mp4" poster="frames/first.png" controls' in video and "an orbit" in video


@pytest.mark.parametrize(
    "source", ["", "https://example.org/a.png", "//example.org/a.png", "/etc/a.png", "../a.png", "a/..\\b.png", "javascript:x"]
)
def test_what_lies_elsewhere_is_refused(source):
    with pytest.raises(ValueError, match="own folder"):
        Picture(source)
    with pytest.raises(ValueError, match="own folder"):
        Clip(source)


def test_a_missing_value_is_an_error(tmp_path):
    (tmp_path / "own.html.j2").write_text(PAGE)
    with pytest.raises(jinja2.UndefinedError, match="sections"):
        render(tmp_path / "own.html.j2", "A page", items=[])


def test_inline_marks_code_and_bold_and_nothing_else():
    assert inline("`a*b` **c** <d>") == "<code>a*b</code> <b>c</b> &lt;d&gt;"


def test_markdown_says_the_same():
    blocks = [Text("`x`"), Code("1 < 2"), Picture("a.png", "truth"), Table(["a|", "b"], [[Cell("<x>"), None]], numeric=True)]
    text = markdown.document("Title", [Text("lead")], [Section("Part", blocks)])
    assert text.startswith("# Title\n\nlead\n\n## Part\n\n`x`\n\n```\n1 < 2\n```\n\n![truth](a.png)")
    assert "| a\\| | b |\n| --- | ---: |\n| \\<x> | – |" in text


def test_plots_share_no_ids_and_take_the_pages_ink():
    svg = plots.svg_axes(lambda axes: axes.plot([0, 1], [0, 1]), 3, 2)
    assert svg.startswith("<svg") and "figure_1" not in svg and "var(--soft)" in svg and plots.INK not in svg
