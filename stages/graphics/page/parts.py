"""What pages are made of, as plain data: tables, pictures, clips, text, code, and sections of them.

``templates/parts.html.j2`` draws them as HTML, `markdown` writes them as Markdown.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Cell:
    """A table's cell that is more than its text.

    note: smaller, below the text. kind: CSS classes (``best``, ``good``, ``bad``, ``soft``,
    ``strong``, ``code``). colour: of a dot
    before the text, or, with ``share`` (0 to 1), of a bar behind it.
    """

    text: str
    note: str = ""
    kind: str = ""
    colour: str = ""
    share: float | None = None


@dataclass(frozen=True)
class Table:
    """Columns' headings and rows of cells: strings, numbers, `Cell`, or None where nothing is known.

    numeric: all columns but the first hold numbers, and are set flush right.
    """

    kind: ClassVar[str] = "table"
    columns: Sequence[str | Cell]
    rows: Sequence[Sequence[Any]]
    numeric: bool = False


@dataclass(frozen=True)
class Text:
    """A paragraph, in which `code` and **bold** are marked up. quiet: set in grey, as a note to what is above it."""

    kind: ClassVar[str] = "text"
    text: str
    quiet: bool = False


@dataclass(frozen=True)
class Code:
    """Lines to be read as they are. title: where given, HTML shows them only when it is clicked."""

    kind: ClassVar[str] = "code"
    text: str
    title: str = ""


@dataclass(frozen=True)
class Picture:
    """An image. source: a data URI (`embed`), or the path of a file beside the page. pixels: enlarge without smoothing."""

    kind: ClassVar[str] = "figure"
    source: str
    caption: str = ""
    alt: str = ""  # "": the caption
    pixels: bool = False

    def __post_init__(self) -> None:
        check_source(self.source, "image")


@dataclass(frozen=True)
class Clip:
    """A video, that plays again and again when it is started. poster: the picture shown before that."""

    kind: ClassVar[str] = "video"
    source: str
    caption: str = ""
    poster: str = ""

    def __post_init__(self) -> None:
        check_source(self.source, "video")
        if self.poster:
            check_source(self.poster, "image")


Block = Table | Text | Code | Picture | Clip


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it."""

    title: str
    blocks: Sequence[Block]

    @property
    def id(self) -> str:
        """The heading as an anchor: lower case, hyphens between words."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def check_source(source: str, kind: str) -> None:
    """ValueError unless the source is inside the page or beside it: a page fetches nothing from elsewhere."""
    inside = source.startswith(f"data:{kind}/")
    beside = not re.match(r"[a-zA-Z][a-zA-Z0-9+.-]*:|[/\\]", source) and ".." not in re.split(r"[/\\]", source)
    if not source or not (inside or beside):
        excerpt = source if len(source) <= 80 else source[:80] + ".."
        raise ValueError(f"{excerpt!r}: a page's {kind} is a data URI or a file in the page's own folder")


def embed(data: bytes, media_type: str = "image/png") -> str:
    """The bytes of a file as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


def png(pixels: np.ndarray) -> bytes:
    """(H, W, 3) uint8 as the bytes of a PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
