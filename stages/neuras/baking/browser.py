"""A baked site in a browser. It is served on 127.0.0.1, and led by ``stages.graphics.browser``."""

from __future__ import annotations

import contextlib
import functools
import json
import threading
from collections.abc import Iterator, Sequence
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from stages.graphics import browser

READY = "document.documentElement?.dataset.ready ?? ''"
# all that this view needs of a scene in tiles, and of residuals, is there
SETTLED = "(!lightmill.scene.tiles || Boolean(lightmill.tiles?.settled())) && lightmill.settled()"
TIMES = """(() => {
  const { gl } = lightmill, times = [];
  for (let i = 0; i < COUNT; i++) {
    const began = performance.now();
    lightmill.draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    times.push(performance.now() - began);
  }
  return times;
})()"""


def pictures(site: Path, links: Sequence[str], timing: int = 0, wait_s: float = 180.0) -> tuple[list[np.ndarray], list[float]]:
    """(H, W, 3) uint8 pictures of the links, such as "frame=3&shift=2", each of its frame's size; and ``timing`` frame times
    of the last one, in ms.

    Raises RuntimeError without a browser, where the page fails (with its words), or where it is silent for ``wait_s``.
    """
    with opened(site, "still=1", wait_s=wait_s) as page:
        images = []
        for link in links:
            page.value(f"lightmill.follow({json.dumps('#still=1&' + link)})")
            page.until(SETTLED)
            images.append(page.canvas())
        return images, page.value(TIMES.replace("COUNT", str(timing)))


@contextlib.contextmanager
def opened(site: Path, link: str = "", size: tuple[int, int] = (1600, 1000), wait_s: float = 180.0) -> Iterator[browser.Page]:
    """The site's page, loaded, in a window of ``size``. Raises as ``pictures`` does."""
    with _served(site) as address, browser.opened(f"{address}/index.html#{link}", size, wait_s) as page:
        if page.until(READY) == "failed":
            raise RuntimeError(f"the page fails: {page.value('document.getElementById(`message`).textContent')}")
        yield page


class _Handler(SimpleHTTPRequestHandler):
    def log_message(self, *words: object) -> None:
        pass


class _Server(ThreadingHTTPServer):
    def handle_error(self, *words: object) -> None:
        """A browser that is closed while files are on their way breaks the pipe; a page that lacks a file says so itself."""


@contextlib.contextmanager
def _served(site: Path) -> Iterator[str]:
    """The address at which the folder is served."""
    server = _Server(("127.0.0.1", 0), functools.partial(_Handler, directory=str(site)))
    serving = threading.Thread(target=server.serve_forever, daemon=True)
    serving.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        serving.join()
