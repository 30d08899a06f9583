"""Pictures of a report's sections for the documentation, as a browser shows them.

``python bench/screenshots.py REPORT.html docs/report summary breakdowns gallery [--dark]`` writes ``docs/report-summary.png``
and so on; needs Chromium or Chrome. A section is cut out of the page, since headless browsers picture only a page's beginning.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageChops

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def sections(page: str) -> dict[str, str]:
    """Id of a section -> the page with its head and this section alone; ``top`` is what comes before the first one."""
    head, body = page.split("<body>")
    starts = [
        ("top", 0),
        *((match[1], match.start()) for match in re.finditer(r'<section id="([^"]+)"', body)),
        ("", len(body)),
    ]
    return {
        name: f"{head}<body>{body[start:end]}</body></html>"
        for (name, start), (_, end) in zip(starts, starts[1:], strict=False)
    }


def picture(browser: str, page: Path, out: Path, width: int, height: int, dark: bool) -> None:
    """The page's upper ``height`` pixels, less what is empty below."""
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    command = [browser, "--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu", scheme]
    command += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},{height}", f"--screenshot={out}"]
    subprocess.run([*command, page.as_uri()], check=True, capture_output=True)
    with Image.open(out) as image:
        shown = image.convert("RGB")
    background = Image.new("RGB", shown.size, shown.getpixel((0, 0)))
    _, _, _, bottom = ImageChops.difference(shown, background).getbbox() or (0, 0, 0, height)
    shown.crop((0, 0, width, min(bottom + 24, height))).save(out, optimize=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", type=Path)
    parser.add_argument("out", help="beginning of the pictures' names")
    parser.add_argument(
        "sections", nargs="+", help="top, summary, differences, runs, training, breakdowns, timing, probes, gallery"
    )
    parser.add_argument("--dark", action="store_true", help="as readers see it whose system is dark")
    parser.add_argument("--width", type=int, default=1200)
    parser.add_argument("--height", type=int, default=1600, help="most pixels of a section's height (default: 1600)")
    arguments = parser.parse_args()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        parser.error(f"no browser is installed: one of {', '.join(BROWSERS)} takes the pictures")
    found = sections(arguments.report.read_text(encoding="utf-8"))
    for name in arguments.sections:
        if name not in found:
            parser.error(f"{arguments.report} has no section {name!r}: it has {', '.join(found)}")
        with tempfile.TemporaryDirectory() as folder:
            page, out = Path(folder) / "page.html", Path(f"{arguments.out}-{name}.png").absolute()
            page.write_text(found[name], encoding="utf-8")
            picture(browser, page, out, arguments.width, arguments.height, arguments.dark)
        print(f"{out}  {out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
