"""``lightmill.view(..)``: the viewer in a frame of a notebook, served by the notebook's own process."""

from __future__ import annotations

from html import escape
from pathlib import Path

from stages import systems
from stages.viewer.command import viewer_of
from stages.viewer.server import Server


class Frame:
    """A viewer that runs until it is closed, or the process ends. A notebook shows it; elsewhere ``address`` is for a browser.

    Served on 127.0.0.1: of a notebook on another machine, forward the port (``ssh -L PORT:127.0.0.1:PORT``).
    """

    def __init__(self, server: Server, height: int):
        self._server, self.height = server, height
        self.address = server.address + server.viewer.start

    def __repr__(self) -> str:
        return f"<viewer at {self.address}>"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {int(self.height)}px; border: 0"
        address = escape(self.address, quote=True)
        return f'<iframe src="{address}" style="{style}"></iframe><p><a href="{address}" target="_blank">{address}</a></p>'

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()


def view(
    what: Path | str | None = None, *, store: Path | str = "store", checkpoint: Path | str | None = None, device: str = "auto",
    height: int = 720, port: int = 0,
) -> Frame:  # fmt: skip
    """The viewer as an inline frame, for notebooks: ``lightmill.view("chair.glb", checkpoint="train")``.

    what: a store's folder, an artifact, ARTIFACT/RECORD, or a mesh or scene file; None: ``store``.
    checkpoint: a model to try first: a released-format folder, or a train artifact. height: of the frame, pixels.
    port: 0 for a free one. UserError: there is no such thing to view.
    """
    words = None if what is None else str(what)
    model = None if checkpoint is None else str(checkpoint)
    server = Server(viewer_of(words, str(store), model, device, list(systems())), port=port)
    server.serve_in_background()
    return Frame(server, height)
