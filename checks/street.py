"""A sheet of the made-up places: two seeds of the street from the lane, one of them 3 m aside, and two views of the flight.

python checks/street.py docs/street.jpg
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from stages.graphics.mitsuba import backend
from stages.neuras.street.settings import StreetConfig
from stages.neuras.street.source import StreetSource, prepare

ROWS = (
    (StreetConfig(), ("frame-drive_0013", "frame-shift_3m_right_0002")),
    (StreetConfig(seed=1), ("frame-drive_0003", "frame-drive_0020")),
    (StreetConfig(preset="drone", length=200), ("frame-flight_0000", "frame-flight_0011")),
)


def main(out: str) -> None:
    backend.activate(backend.choose(), threads=1)
    width, height = ROWS[0][0].width, ROWS[0][0].height
    sheet = Image.new("RGB", (2 * width, len(ROWS) * height))
    for row, (config, ids) in enumerate(ROWS):
        with tempfile.TemporaryDirectory() as folder:
            prepare(config, Path(folder))
            source = StreetSource(config, Path(folder))
            for column, id in enumerate(ids):
                sheet.paste(Image.fromarray(source.frame(id).image()), (column * width, row * height))
    sheet.save(out)


if __name__ == "__main__":
    main(sys.argv[1])
