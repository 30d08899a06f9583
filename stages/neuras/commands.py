"""What `lightmill` offers for NeuRas: drive, scores.

Heavy libraries are imported by the command that needs them, so that ``lightmill ls`` answers at once.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any


def command_drive(arguments: argparse.Namespace) -> int:
    from pipeline.store import Store
    from stages.neuras.evaluation.drive import Trip, drive

    trip = Trip(
        None if arguments.trajectory is None else Path(arguments.trajectory),
        arguments.lane_shift,
        arguments.frames,
        arguments.size,
        arguments.fps,
    )
    for line in drive(Store(arguments.store), arguments.key, trip, Path(arguments.out), arguments.renderer):
        print(line)
    return 0


def command_scores(arguments: argparse.Namespace) -> int:
    from pipeline.store import Store
    from stages.neuras.evaluation.side_by_side import written

    print(written(Store(arguments.store), arguments.keys))
    return 0


def size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    try:
        width, height = (int(word) for word in text.split("x"))
    except ValueError:
        width = height = 0
    if not (2 <= width <= 16384 and 2 <= height <= 16384):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 1280x720")
    return width, height


def count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number above 0")
    return int(text)


def add_commands(parsers: Any, program: str) -> None:
    """Mount the commands on ``parsers`` (argparse's subparsers)."""

    def add(name: str, function: Callable[[argparse.Namespace], int], summary: str, example: str) -> argparse.ArgumentParser:
        sub = parsers.add_parser(name, help=summary, description=summary, epilog=f"example: {program} {name} {example}")
        sub.set_defaults(function=function)
        sub.add_argument("--store", default="store", help="the store's folder (default: store)")
        return sub

    summary = "drive through a baked scene, along its capture's path, beside it, or along poses of your own"
    sub = add("drive", command_drive, summary, "bake --lane-shift 3 -o drive.mp4")
    sub.add_argument("key", metavar="KEY", help="a bake artifact's key or name, or 'bake' for the newest")
    sub.add_argument("-o", "--out", required=True, help="FILE.mp4, or a folder for PNGs")
    sub.add_argument("--trajectory", metavar="FILE", help="JSON: a list of camera-to-world matrices, or a transforms.json")
    sub.add_argument("--lane-shift", type=float, default=0.0, metavar="M", help="metres to the right of the path (default: 0)")
    sub.add_argument("--frames", type=count, metavar="N", help="pictures (default: the file's, or 4 seconds)")
    sub.add_argument("--size", type=size, metavar="WxH", help="pixels (default: as the capture)")
    sub.add_argument("--fps", type=count, default=24, help="frames per second of an .mp4 (default: 24)")
    sub.add_argument(
        "--renderer", choices=("auto", "opengl", "torch"), default="auto", help="auto (default): OpenGL, or torch without it"
    )

    summary = "evaluations of several fits of one capture as a Markdown table, with paired differences"
    sub = add("scores", command_scores, summary, "ours=KEY plain=KEY > table.md")
    sub.add_argument("keys", nargs="+", metavar="KEY", help="artifacts of neuras' evaluate, or NAME=KEY; the first is compared")
