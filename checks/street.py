"""A sheet of the made-up places: two seeds of the street from the lane, one of them 3 m aside, and two views of the flight.
With ``--objects`` one of the objects that stand alone.

python checks/street.py docs/street.jpg
python checks/street.py --objects docs/objects.jpg
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from PIL import Image

from stages.graphics.mitsuba import backend
from stages.neuras.street.settings import StreetConfig
from stages.neuras.street.source import StreetSource, prepare

PLACES = (
    (StreetConfig(), ("frame-drive_0013", "frame-shift_3m_right_0002")),
    (StreetConfig(seed=1), ("frame-drive_0003", "frame-drive_0020")),
    (StreetConfig(preset="drone", length=200), ("frame-flight_0000", "frame-flight_0011")),
)
OBJECTS = tuple(  # as in conf/neuras/experiment/table5
    (
        StreetConfig(preset="object", object=name, seed=seed, width=200, height=200, fov_deg=40, training_frames=40),
        tuple(f"frame-around_{number:04d}" for number in (3, 24, 41, 66)),
    )
    for name, seed in (("car", 3), ("house", 0), ("tree", 0))
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", help="the sheet, .jpg or .png")
    parser.add_argument("--objects", action="store_true")
    arguments = parser.parse_args()
    backend.activate(backend.choose(), threads=1)
    rows = OBJECTS if arguments.objects else PLACES
    config, ids = rows[0]
    sheet = Image.new("RGB", (len(ids) * config.width, len(rows) * config.height))
    for row, (config, ids) in enumerate(rows):
        with tempfile.TemporaryDirectory() as folder:
            prepare(config, Path(folder))
            source = StreetSource(config, Path(folder))
            for column, id in enumerate(ids):
                sheet.paste(Image.fromarray(source.frame(id).image()), (column * config.width, row * config.height))
    sheet.save(arguments.out)


if __name__ == "__main__":
    main()
