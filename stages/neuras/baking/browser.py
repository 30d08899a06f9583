"""Pictures of a baked site as a browser draws them: Chromium without a window, WebGL in software.

The site is served on 127.0.0.1, beside a small page that opens it in a frame, asks for one view after the other and sends back
what the canvas holds.
"""

from __future__ import annotations

import functools
import io
import json
import queue
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SOFTWARE = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-extensions", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--force-device-scale-factor=1", "--force-color-profile=srgb",
)  # fmt: skip
ASKING = """<!doctype html><meta charset="utf-8"><iframe id="site" width="1600" height="1000"></iframe><script type="module">
const send = (name, body) => fetch("/.answers/" + name, { method: "POST", body });
const pause = () => new Promise((done) => setTimeout(done, 20));
try {
  const { links, timing } = await (await fetch("/.questions")).json();
  const site = document.getElementById("site");
  site.src = "index.html#still=1";
  const page = () => site.contentDocument?.documentElement?.dataset.ready;
  while (!page()) await pause();
  if (page() === "failed") throw new Error(site.contentDocument.getElementById("message").textContent);
  const viewer = site.contentWindow.lightmill;
  for (const link of links) {
    viewer.follow("#still=1&" + link);
    await send("picture", await new Promise((done) => viewer.canvas.toBlob(done, "image/png")));
  }
  const times = [];
  for (let i = 0; i < timing; i++) {
    const began = performance.now();
    viewer.draw();
    viewer.gl.readPixels(0, 0, 1, 1, viewer.gl.RGBA, viewer.gl.UNSIGNED_BYTE, new Uint8Array(4));
    times.push(performance.now() - began);
  }
  await send("times", JSON.stringify(times));
} catch (error) { await send("error", String(error.message ?? error)); }
</script>"""


def find_browser() -> str | None:
    """The path of a Chromium or Chrome, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class _Handler(SimpleHTTPRequestHandler):
    """Serves the site, and the page that asks for pictures of it."""

    def __init__(self, *words: Any, questions: bytes, answers: queue.Queue[tuple[str, bytes]], **settings: Any):
        self._questions, self._answers = questions, answers
        super().__init__(*words, **settings)

    def log_message(self, *words: object) -> None:
        pass

    def do_GET(self) -> None:
        special = {"/.asking": ("text/html", ASKING.encode()), "/.questions": ("application/json", self._questions)}
        if self.path not in special:
            super().do_GET()
            return
        kind, body = special[self.path]
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self._answers.put((self.path.rpartition("/")[2], body))
        self.send_response(204)
        self.end_headers()


def pictures(site: Path, links: Sequence[str], timing: int = 0, wait_s: float = 180.0) -> tuple[list[np.ndarray], list[float]]:
    """(H, W, 3) uint8 pictures of the links, such as "frame=3&shift=2", each of its frame's size; and ``timing`` frame times
    of the last one, in ms.

    Raises RuntimeError without a browser, where the page fails (with its words), or where it is silent for ``wait_s``.
    """
    browser = find_browser()
    if browser is None:
        raise RuntimeError(f"no browser: install chromium (looked for {', '.join(NAMES)})")
    answers: queue.Queue[tuple[str, bytes]] = queue.Queue()
    questions = json.dumps({"links": list(links), "timing": timing}).encode()
    handler = functools.partial(_Handler, directory=str(site), questions=questions, answers=answers)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    serving = threading.Thread(target=server.serve_forever, daemon=True)
    serving.start()
    with tempfile.TemporaryDirectory() as profile:
        address = f"http://127.0.0.1:{server.server_address[1]}/.asking"
        process = subprocess.Popen(
            [browser, *SOFTWARE, f"--user-data-dir={profile}", "--remote-debugging-port=0", address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            images = []
            while True:
                name, body = answers.get(timeout=wait_s)
                if name == "error":
                    raise RuntimeError(f"the page fails: {body.decode()}")
                if name == "times":
                    return images, json.loads(body)
                images.append(np.array(Image.open(io.BytesIO(body)).convert("RGB")))
        except queue.Empty:
            raise RuntimeError(f"{browser} has said nothing for {wait_s:g} s") from None
        finally:
            process.kill()
            process.wait()
            server.shutdown()
            server.server_close()
            serving.join()
