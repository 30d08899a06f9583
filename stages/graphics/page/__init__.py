"""HTML pages that open from disk: one style, one set of parts, for any system's cards and reports.

A page is data and a Jinja2 template that extends ``base.html.j2``::

    {% extends "base.html.j2" %}
    {% import "parts.html.j2" as parts %}
    {% block content %}
    {% call parts.section("summary", "Summary") %}{{ parts.table(summary) }}{% endcall %}
    {% endblock %}

``render`` fills it in. ``parts`` holds the data (tables, pictures, clips) that the templates' macros of the same names draw.
``plots`` makes SVG that follows the page's light or dark setting. ``markdown`` writes the same parts as Markdown. Every
string is escaped, because names and licences come from strangers.
"""

from stages.graphics.page.parts import Cell, Clip, Code, Picture, Section, Table, Text, embed, png
from stages.graphics.page.render import render

__all__ = ["Cell", "Clip", "Code", "Picture", "Section", "Table", "Text", "embed", "png", "render"]
