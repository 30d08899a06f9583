"""The ``lightmill`` command: run, the store's commands, export and import, and trace, predict, compare for single scenes.

Heavy libraries are imported by the command that needs them, so that ``lightmill ls`` answers at once.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.commands import add_commands
from pipeline.errors import INTERRUPTED, UserError, status_of

PROGRAM = "lightmill"


def command_run(arguments: argparse.Namespace) -> int:
    from pipeline.__main__ import main as run_main

    return run_main([*arguments.words, *(["--debug"] if arguments.debug else [])])


def command_trace(arguments: argparse.Namespace) -> int:
    from stages.trace import trace

    for path in trace(
        Path(arguments.scene),
        Path(arguments.out),
        resolution=arguments.resolution,
        spp=arguments.spp,
        mode=arguments.mode,
        denoise=arguments.denoise,
        seed=arguments.seed,
        view=arguments.view,
    ):
        print(path)
    return 0


def checkpoint_folder(reference: str | None, store: str) -> Path:
    """A released-format checkpoint folder as given, or that of a train artifact in the store; None: the one that ships."""
    if reference is None:
        from stages.predict import shipped_checkpoint

        return shipped_checkpoint()
    if (Path(reference) / "config.json").is_file():
        return Path(reference)
    if Path(reference).is_dir() and not (Path(reference) / "manifest.json").is_file():
        raise UserError(f"{reference} is no checkpoint folder: it has no config.json (and no model.safetensors beside it)")
    from pipeline.store import Store

    artifact = Store(store).resolve(reference)
    if artifact.stage != "train":
        raise UserError(
            f"{reference} is an artifact of stage {artifact.stage}: give one of stage train, or a checkpoint folder"
        )
    return artifact.file("checkpoint")


def command_predict(arguments: argparse.Namespace) -> int:
    from stages.predict import predict

    for path in predict(
        Path(arguments.scene),
        checkpoint_folder(arguments.checkpoint, arguments.store),
        Path(arguments.out),
        resolution=arguments.resolution,
        view=arguments.view,
        device=arguments.device,
    ):
        print(path)
    return 0


def command_compare(arguments: argparse.Namespace) -> int:
    from stages.compare import compare, table

    metrics = compare(Path(arguments.a), Path(arguments.b))
    print(json.dumps(metrics, indent=1) if arguments.json else table(metrics))
    return 0


def dataset_source(reference: str, store: str) -> Any:
    """A dataset's folder or URL as given, or a shard artifact in the store."""
    from stages.dataset.shards import INDEX, REMOTE

    if REMOTE.match(reference) or (Path(reference) / "files" / INDEX).is_file():
        return reference
    from pipeline.store import Store

    artifact = Store(store).resolve(reference)
    if artifact.stage != "shard":
        raise UserError(f"{reference} is an artifact of stage {artifact.stage}: give one of stage shard, a folder or a URL")
    return artifact


def command_export(arguments: argparse.Namespace) -> int:
    from stages.interchange import export

    source, out = dataset_source(arguments.dataset, arguments.store), Path(arguments.out)
    count = sum(1 for _ in export(source, out, arguments.split, arguments.images))
    print(f"{count} scenes in {out}")
    return 0


def command_sweep(arguments: argparse.Namespace) -> int:
    from stages.ablation import sweep

    return sweep(arguments.table, arguments.rows, arguments.words, Path(arguments.out or f"runs/{arguments.table}"))


def command_table(arguments: argparse.Namespace) -> int:
    from stages.ablation import write_table

    return write_table(arguments.table, arguments.rows, arguments.words, Path(arguments.out or f"runs/{arguments.table}"))


def command_import(arguments: argparse.Namespace) -> int:
    from pipeline.__main__ import main as run_main

    words = ["stage=scene", "scene=imported", f"scene.path={json.dumps(arguments.folder)}", *arguments.words]
    return run_main([*words, *(["--debug"] if arguments.debug else [])])


def command_report(arguments: argparse.Namespace) -> int:
    from pipeline.store import Store
    from stages.report import write_report

    for path in write_report(
        arguments.keys,
        Store(arguments.store),
        Path(arguments.out),
        gallery=arguments.gallery,
        different_data=arguments.different_data,
        title=arguments.title,
    ):
        print(path)
    return 0


def view_argument(text: str) -> int | str:
    if text == "all":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor 'all'") from None


def build_parser() -> argparse.ArgumentParser:
    debug = argparse.ArgumentParser(add_help=False)
    debug.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser = argparse.ArgumentParser(
        PROGRAM, description="Make data for, train and evaluate neural renderers of triangle meshes.", parents=[debug]
    )
    parsers = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, function, summary: str, example: str) -> argparse.ArgumentParser:
        sub = parsers.add_parser(name, help=summary, description=summary, epilog=f"example: {PROGRAM} {name} {example}")
        sub.set_defaults(function=function)
        return sub

    sub = add("run", command_run, "run stages (the same as python -m pipeline)", "stage=shard scene.count.train=200")
    sub.usage = f"{PROGRAM} run [stage=STAGE] [name=value ...] [-m] [--debug]"
    add_commands(parsers, PROGRAM)

    sub = add("export", command_export, "scenes of a dataset as released HDF5 files", "shard exported --split test --images")
    sub.add_argument("dataset", help="shard artifact's key, name or 'shard'; a dataset's folder or URL")
    sub.add_argument("out", help="folder; scenes go to OUT/SPLIT/ID.h5")
    sub.add_argument("--split", action="append", help="train, validation or test; may be repeated (default: all)")
    sub.add_argument("--images", action="store_true", help="also ID-view<camera>.exr: linear RGB with all lights on")
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")

    sub = add(
        "import", command_import, "released JSON and HDF5 scenes as scenes to render (then: stage=render scene=imported ..)",
        "scenes scene.split=test",
    )  # fmt: skip
    sub.add_argument("folder", help="folder of scene files; train/, validation/ and test/ in it are splits")
    sub.usage = f"{PROGRAM} import FOLDER [name=value ...] [--debug]"

    for name, function, summary in (
        ("sweep", command_sweep, "train and evaluate the rows of the paper's table 1, then write the table"),
        ("table", command_table, "write the table of the rows that the store holds"),
    ):
        sub = add(name, function, summary, "table1_small --rows full,no_dpt jobs=2")
        sub.add_argument("table", nargs="?", default="table1_small", help="folder of conf/experiment (default: table1_small)")
        sub.add_argument("--rows", type=lambda text: text.split(","), help="some rows, comma-separated (default: all)")
        sub.add_argument("-o", "--out", help="folder of table.md, table.json and table.png (default: runs/TABLE)")
        sub.usage = f"{PROGRAM} {name} [TABLE] [--rows ROW,...] [-o FOLDER] [name=value ...] [--debug]"

    sub = add("trace", command_trace, "path trace a scene given as released JSON or HDF5", "scene.json -o out.exr --spp 256")
    sub.add_argument("scene", help="scene file: .json or .h5")
    sub.add_argument("-o", "--out", required=True, help="output .exr (linear RGB float); with --view all: OUT-0.exr, OUT-1.exr")
    sub.add_argument("--resolution", type=int, default=512, help="pixels per side (default: 512)")
    sub.add_argument("--spp", type=int, default=256, help="samples per pixel (default: 256)")
    sub.add_argument("--mode", choices=("physical", "cycles"), default="physical", help="what the renderer matches")
    sub.add_argument("--denoise", action=argparse.BooleanOptionalAction, default=True, help="Open Image Denoise (default: on)")
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--view", type=view_argument, default=0, help="camera number, or 'all' (default: 0)")

    sub = add(
        "predict", command_predict, "render a scene with a trained model", "scene.json --checkpoint train -o out.png"
    )  # fmt: skip
    sub.add_argument("scene", help="scene file: .json or .h5")
    sub.add_argument(
        "--checkpoint",
        help="released-format folder, or a train artifact's key, name or 'train' (default: the model that ships)",
    )
    sub.add_argument("-o", "--out", required=True, help="output .exr (linear) or .png (sRGB)")
    sub.add_argument("--resolution", type=int, default=512, help="pixels per side, divisible by 8 (default: 512)")
    sub.add_argument("--view", type=view_argument, default=0, help="camera number, or 'all' (default: 0)")
    sub.add_argument("--device", default="auto", help="cpu, cuda or auto (default)")
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")

    sub = add("compare", command_compare, "the metrics between two images, A the reference", "reference.exr out.exr --json")
    sub.add_argument("a", help="reference: .exr or .png")
    sub.add_argument("b", help="test image of the same size")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = add(
        "report", command_report, "runs side by side, and probes, on one HTML page (with JSON and Markdown beside it)",
        "small=evaluate/test-0123456789ab tiny=evaluate/test-ba9876543210 -o ablation.html",
    )  # fmt: skip
    sub.add_argument("keys", nargs="+", metavar="KEY", help="artifacts of evaluate and probe, or NAME=KEY with a name to show")
    sub.add_argument("-o", "--out", required=True, help="the page, .html")
    sub.add_argument("--gallery", type=int, default=24, help="views shown, evenly spaced from worst to best (default: 24)")
    sub.add_argument("--different-data", action="store_true", help="also runs that were evaluated on different scenes")
    sub.add_argument("--title", help="the page's title")
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")
    for sub in parsers.choices.values():
        sub.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error")
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0, or that of the error (see pipeline.errors)."""
    arguments, unknown = build_parser().parse_known_args(words)
    if arguments.function in (command_run, command_import, command_sweep, command_table):
        arguments.words = unknown  # overrides and Hydra's own flags, in any order
    elif unknown:
        build_parser().error(f"unknown arguments: {' '.join(unknown)}; see {PROGRAM} COMMAND --help")
    try:
        return arguments.function(arguments)
    except BrokenPipeError:  # the reader (head, less) went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except (ValueError, OSError) as error:
        if arguments.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return status_of(error)
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
