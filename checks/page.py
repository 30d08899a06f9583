"""A sheet of what the page of a baked scene can show, as a browser draws it: one tile for each way.

python checks/page.py store/neuras/bake/ARTIFACT/files/site docs/page.jpg --frame 13
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from stages.neuras.baking import browser

WINDOW, TILE, COLUMNS = (960, 540), (480, 270), 2  # pixels
TILES = {  # words on the tile -> the end of a link
    "the page": "",
    "mesh only": "mode=1",
    "skyboxes only": "mode=2",
    "opacity of the nearest skybox": "mode=3&skybox=0",
    "UV charts": "mode=4",
    "code indices": "mode=5",
    "wireframe": "wireframe=1",
    "photo on the left of the slider": "",
}
ONCE = "delete lightmill.draw; lightmill.follow('%s'); lightmill.draw = () => {}"  # software is slow: not again and again
LAST = list(TILES)[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frame", type=int, default=0, help="number of a frame of the page")
    arguments = parser.parse_args()
    sheet = Image.new("RGB", (COLUMNS * TILE[0], -(-len(TILES) // COLUMNS) * TILE[1]))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(16)
    with browser.opened(arguments.site, size=WINDOW) as page:
        page.value("lightmill.draw = () => {}")
        for number, (words, link) in enumerate(TILES.items()):
            if words == LAST:
                page.value("document.getElementById('compare').click(), document.getElementById('photo').decode()")
            page.value(ONCE % f"#frame={arguments.frame}&{link}")
            page.value(f"document.getElementById('panel').hidden = {str(number > 0).lower()}")
            corner = number % COLUMNS * TILE[0], number // COLUMNS * TILE[1]
            sheet.paste(Image.fromarray(page.screenshot()).resize(TILE, Image.Resampling.LANCZOS), corner)
            pen.text((corner[0] + 8, corner[1] + 6), words, "white", font, stroke_width=2, stroke_fill="black")
    sheet.save(arguments.out, quality=72)


if __name__ == "__main__":
    main()
