"""A page in a browser: Chromium without a window, WebGL in software, led through its DevTools.

Commands and answers are JSON over two pipes, so no port is open and no package is needed; a browser whose pipes are closed ends
by itself, so none is left where this process is killed.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SOFTWARE = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-extensions", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--force-device-scale-factor=1", "--force-color-profile=srgb",
)  # fmt: skip
CONSOLE = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")


def find_browser() -> str | None:
    """The path of a Chromium or Chrome, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@contextlib.contextmanager
def opened(address: str, size: tuple[int, int] = (1600, 1000), wait_s: float = 180.0, mobile: bool = False) -> Iterator[Page]:
    """A page at that address, in a window of ``size``, CSS pixels. It may still be loading.

    Raises RuntimeError without a browser, or where it is silent for ``wait_s``.
    """
    browser = find_browser()
    if browser is None:
        raise RuntimeError(f"no browser: install chromium (looked for {', '.join(NAMES)})")
    with _devtools(browser, wait_s) as devtools:
        page = Page(devtools, size, mobile)
        page.ask("Page.navigate", url=address)
        yield page


class Page:
    """One page of a browser: its values, its pictures, and a person's hands on it. Places are in CSS pixels."""

    def __init__(self, devtools: _DevTools, size: tuple[int, int], mobile: bool = False):
        target = devtools.ask("Target.createTarget", None, url="about:blank")["targetId"]
        self._session = devtools.ask("Target.attachToTarget", None, targetId=target, flatten=True)["sessionId"]
        self._devtools, self._forgotten = devtools, set()
        self.resize(size, mobile)
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def resize(self, size: tuple[int, int], mobile: bool = False) -> None:
        width, height = size
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)

    def problems(self) -> list[str]:
        """Errors and warnings of the console, and exceptions that nothing caught, since the page was opened."""
        self.value("0")  # events that have not been read yet
        found = []
        for event in self._devtools.events:
            facts = event["params"]
            if event["method"] == "Runtime.exceptionThrown":
                details = facts["exceptionDetails"]
                found.append(details.get("exception", {}).get("description", details["text"]))
            elif event["method"] == "Runtime.consoleAPICalled" and facts["type"] in ("error", "warning", "assert"):
                found.append(" ".join(str(word.get("value", word.get("description"))) for word in facts["args"]))
            elif event["method"] == "Log.entryAdded" and facts["entry"]["level"] in ("error", "warning"):
                found.append(f"{facts['entry']['text']} {facts['entry'].get('url', '')}".strip())
        return [problem for problem in found if problem not in self._forgotten]

    def forget(self, problems: Sequence[str]) -> None:
        """Leave these out of ``problems`` from now on."""
        self._forgotten |= set(problems)

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._devtools.ask(method, self._session, **parameters)

    def value(self, script: str) -> Any:
        """What the script's last expression is, once it is there if it is a promise."""
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if problem := answer.get("exceptionDetails"):
            raise RuntimeError(f"the page fails: {problem.get('exception', {}).get('description', problem['text'])}")
        return answer["result"].get("value")

    def canvas(self, script: str = "lightmill.canvas") -> np.ndarray:
        """(H, W, 3) uint8: what is drawn on the canvas that the script gives."""
        return _pixels(self.value(f"({script}).toDataURL('image/png').split(',')[1]"))

    def until(self, script: str) -> Any:
        """The script's value, once it is true. RuntimeError where that takes longer than pages may take to load."""
        end = time.monotonic() + self._devtools.wait_s
        while not (value := self.value(script)):
            if time.monotonic() > end:
                raise RuntimeError(f"{script} is not true after {self._devtools.wait_s:g} s")
            time.sleep(0.02)
        return value

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) uint8: all that a person sees, with the panel and the photo over the canvas."""
        return _pixels(self.ask("Page.captureScreenshot", format="png")["data"])

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """Left, top, width and height of an element."""
        box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        return tuple(self.value(f"(({{x, y, width, height}}) => [x, y, width, height])({box})"))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """The left mouse button is pressed at ``start``, moved and released at ``end``."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def click(self, selector: str) -> None:
        left, top, width, height = self.place(selector)
        middle = left + width / 2, top + height / 2
        self.drag(middle, middle)

    @contextlib.contextmanager
    def held(self, *keys: str) -> Iterator[None]:
        """These keys, by their names in the web ("w", "ArrowUp", "Shift"), are down meanwhile."""
        for key in keys:
            self.ask("Input.dispatchKeyEvent", type="keyDown", key=key)
        try:
            yield
        finally:
            for key in keys:
                self.ask("Input.dispatchKeyEvent", type="keyUp", key=key)


def _pixels(png: str) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB"))


class _DevTools:
    """Commands to a browser and its answers: JSON that a zero byte ends."""

    def __init__(self, process: subprocess.Popen[bytes], commands: int, answers: int, wait_s: float):
        self._process, self._commands, self._answers, self.wait_s = process, commands, answers, wait_s
        self._number, self._read = 0, b""
        self.events: list[dict[str, Any]] = []  # of the console

    def ask(self, method: str, session: str | None, **parameters: Any) -> dict[str, Any]:
        """The answer to a command. Of events that come meanwhile, those of the console are kept."""
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
        left = memoryview(json.dumps(command).encode() + b"\0")
        with contextlib.suppress(BrokenPipeError):  # it has ended: no answer will come, and that says more
            while left:
                left = left[os.write(self._commands, left) :]
        while True:
            answer = self._message()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"the browser refuses {method}: {answer['error']['message']}")
                return answer["result"]
            if answer.get("method") in CONSOLE:
                self.events.append(answer)

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._read:
            if not select.select([self._answers], [], [], self.wait_s)[0]:
                raise RuntimeError(f"the browser has said nothing for {self.wait_s:g} s")
            data = os.read(self._answers, 1 << 20)
            if not data:
                raise RuntimeError(f"the browser has ended with status {self._process.wait()}")
            self._read += data
        message, _, self._read = self._read.partition(b"\0")
        return json.loads(message)


@contextlib.contextmanager
def _devtools(browser: str, wait_s: float) -> Iterator[_DevTools]:
    """A browser that runs. It reads commands from its descriptor 3 and writes answers to 4."""
    theirs_in, commands = os.pipe()
    answers, theirs_out = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [browser, *SOFTWARE, f"--user-data-dir={profile}", "--remote-debugging-pipe", "about:blank"]
        process = subprocess.Popen(
            ["/bin/sh", "-c", f'exec "$0" "$@" 3</dev/fd/{theirs_in} 4>/dev/fd/{theirs_out}', *words],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        try:
            yield _DevTools(process, commands, answers, wait_s)
        finally:
            process.kill()
            process.wait()
            os.close(commands)
            os.close(answers)
