"""``lightmill view``: what WHAT names, the server, the browser."""

from __future__ import annotations

import argparse
import os
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.stage import System, load_system
from pipeline.store import Artifact, Store
from stages.graphics.panels import Context
from stages.viewer.pages import views_of
from stages.viewer.server import LOCAL, Server, Viewer

PORT = 8890


def viewer_of(
    what: str | None, store: str = "store", checkpoint: str | None = None, device: str = "auto", systems: Sequence[System] = ()
) -> Viewer:
    """What the words name: a store's folder, an artifact, a record of one, or a file. UserError where it is none of them."""
    path = Path(what or store)
    root = Path(store)
    context = Context(Store(root) if root.is_dir() else None, checkpoint=checkpoint, device=device)
    if path.is_file():
        suffixes = {suffix for system in systems if (views := views_of(system)) is not None for suffix in views.suffixes}
        if path.suffix.lower() not in suffixes:
            raise UserError(
                f"{path} is nothing to view: expected a store, an artifact or a file of {', '.join(sorted(suffixes))}"
            )
        context.path = path
        return Viewer(context, systems, "#/file")
    if (path / "config.json").is_file():
        raise UserError(f"{path} is a checkpoint: name a scene with it, lightmill view SCENE --checkpoint {path}")
    if path.is_dir() and not (path / "manifest.json").is_file():
        context.store = Store(path)
        return Viewer(context, systems)
    if what is None:
        raise UserError(f"there is no store at {store}: give --store DIR, or make one with `make data`")
    if context.store is None and (path / "manifest.json").is_file():
        context.store = _store_around(path)
    if context.store is None:
        raise UserError(f"{what} does not exist: give a store, an artifact, a record of one, or a mesh or scene file")
    artifact, record = _artifact(context.store, what)
    artifact.manifest  # noqa: B018 - Damaged, if it is
    if record is not None:
        artifact.row(record)
    return Viewer(context, systems, f"#/record/{artifact.name}/{record}" if record else f"#/artifact/{artifact.name}")


def _artifact(store: Store, what: str) -> tuple[Artifact, str | None]:
    """An artifact, as all commands name one, or ARTIFACT/RECORD."""
    try:
        return store.resolve(what), None
    except UserError as error:
        name, _, record = what.rpartition("/")
        try:
            artifact = store.resolve(name) if name else None
        except UserError:
            artifact = None
        if artifact is None:
            raise error from None
        return artifact, record


def _store_around(path: Path) -> Store:
    """The store that an artifact's folder lies in: one or two folders above its stage."""
    artifact = Artifact(path.absolute())
    return Store(artifact.path.parents[len(artifact.place.split("/"))])


def serve(viewer: Viewer, host: str = "127.0.0.1", port: int = PORT, browser: bool = True) -> int:
    """Serve until Ctrl-C."""
    server = Server(viewer, host, port)
    address = server.address + viewer.start
    print(f"{address}  (Ctrl-C stops)", flush=True)
    if host not in LOCAL:
        print(
            f"warning: anybody who reaches {host} can see this store and have this machine compute; there is no password",
            file=sys.stderr,
            flush=True,
        )
    if browser:
        try:
            webbrowser.get()
            webbrowser.open(address)
        except webbrowser.Error:
            pass
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print("stopped", flush=True)
        if viewer.busy:  # a renderer cannot be interrupted, and would be waited for; nothing here is half written
            os._exit(0)
    finally:
        server.server_close()
    return 0


def add_command(parsers: Any, program: str, systems: Sequence[System]) -> None:
    """Mount ``view`` on ``parsers`` (argparse's subparsers)."""
    summary = "look at a store, an artifact, a record, a mesh or a scene in the browser"
    example = f"example: {program} view   |   {program} view render   |   {program} view chair.glb --checkpoint train"
    sub = parsers.add_parser("view", help=summary, description=summary, epilog=example)
    sub.add_argument(
        "what", nargs="?", metavar="WHAT",
        help="a store (default), an artifact, ARTIFACT/RECORD, or a mesh or scene file",
    )  # fmt: skip
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")
    sub.add_argument("--checkpoint", help="model to try: released-format folder, or a train artifact (default: the newest)")
    sub.add_argument("--device", default="auto", help="cpu, cuda or auto (default), for models")
    sub.add_argument("--system", action="append", default=[], metavar="MODULE", help="a system of your own, for its views")
    sub.add_argument("--port", type=int, default=PORT, help=f"0 for a free one (default: {PORT})")
    sub.add_argument(
        "--host", default="127.0.0.1",
        help="address to serve on (default: 127.0.0.1, this machine alone). With any other, everybody who reaches it sees the "
        "store and can make this machine compute: there is no password",
    )  # fmt: skip
    sub.add_argument("--no-browser", action="store_true", help="only print the address")

    def command(arguments: argparse.Namespace) -> int:
        brought = [*systems, *map(load_system, arguments.system)]
        viewer = viewer_of(arguments.what, arguments.store, arguments.checkpoint, arguments.device, brought)
        return serve(viewer, arguments.host, arguments.port, not arguments.no_browser)

    sub.set_defaults(function=command)
