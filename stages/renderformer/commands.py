"""What `lightmill` offers for RenderFormer: export and import, sweeps of the paper's table, trace, predict, compare, report.

Heavy libraries are imported by the command that needs them, so that ``lightmill ls`` answers at once.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from stages.graphics.lpips_setting import NONE, lpips_networks, parse_lpips


def command_trace(arguments: argparse.Namespace) -> int:
    from stages.renderformer.inference.trace import trace
    from stages.renderformer.rendering.settings import RenderSettings

    settings = RenderSettings(
        arguments.resolution,
        arguments.spp,
        arguments.seed,
        mode=arguments.mode,
        denoise=arguments.denoise,
        lights_visible=arguments.lights_visible,
    )
    for path in trace(arguments.scene, arguments.out, settings, arguments.view, room=room_of(arguments)):
        print(path)
    return 0


def lpips_argument(text: str) -> str | tuple[str, ...]:
    try:
        return parse_lpips(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def room_of(arguments: argparse.Namespace) -> Any:
    from stages.renderformer.inference.room import Room

    return Room(arguments.room, arguments.up, arguments.triangles)


def renderer_of(arguments: argparse.Namespace) -> Any:
    from stages.renderformer.inference.renderer import Renderer

    return Renderer(arguments.checkpoint, arguments.device, arguments.store)


def command_predict(arguments: argparse.Namespace) -> int:
    from stages.renderformer.inference.output import Output
    from stages.renderformer.inference.renderer import predict
    from stages.renderformer.inference.settings import PredictSettings

    output = Output(Path(arguments.out), arguments.tonemap, arguments.exposure, arguments.fps)
    settings = PredictSettings(arguments.view, arguments.orbit, arguments.arc, arguments.resolution, arguments.composite_lights)
    room = room_of(arguments)  # all that can be refused is refused before the checkpoint is read
    for path in predict(renderer_of(arguments), arguments.scene, output, settings, room):
        print(path)
    return 0


def command_compare(arguments: argparse.Namespace) -> int:
    from stages.graphics.metrics import with_lpips
    from stages.renderformer.inference.compare import IMAGES, check_picture, compare_images, compare_scene
    from stages.renderformer.inference.output import write_png
    from stages.renderformer.inference.settings import PredictSettings

    first, out = Path(arguments.a), arguments.out
    metrics = with_lpips(lpips_networks(arguments.lpips), arguments.lpips_folder)
    if out is not None:
        check_picture(Path(out), [first, *([Path(arguments.b)] if arguments.b is not None else [])])
    if arguments.b is not None or first.suffix.lower() in IMAGES:
        if arguments.b is None:
            raise UserError(f"{first} is an image: give the test image as well, or one scene instead of both")
        if arguments.checkpoint is not None:
            raise UserError("two images are compared as they are: leave --checkpoint out, or give one scene")
        result = compare_images(first, arguments.b, metrics)
    else:
        settings = PredictSettings(arguments.view, resolution=arguments.resolution, composite_lights=arguments.composite_lights)
        room = room_of(arguments)
        result = compare_scene(renderer_of(arguments), first, settings, arguments.spp, room, metrics)
        out = out or f"{first.stem}-compare.png"
    print(json.dumps(result.to_json(), indent=1) if arguments.json else result.table(), flush=True)
    if out is not None:
        write_png(Path(out), result.picture())
        if not arguments.json:
            print(f"picture: {out}")
    return 0


def dataset_source(reference: str, store: str) -> Any:
    """A dataset's folder or URL as given, or a shard artifact in the store."""
    from stages.renderformer.dataset.shards import INDEX, REMOTE

    if REMOTE.match(reference) or (Path(reference) / "files" / INDEX).is_file():
        return reference
    from pipeline.store import Store

    artifact = Store(store).resolve(reference)
    if artifact.stage != "shard":
        raise UserError(f"{reference} is an artifact of stage {artifact.stage}: give one of stage shard, a folder or a URL")
    return artifact


def command_export(arguments: argparse.Namespace) -> int:
    from stages.renderformer.dataset.interchange import export

    source, out = dataset_source(arguments.dataset, arguments.store), Path(arguments.out)
    count = sum(1 for _ in export(source, out, arguments.split, arguments.images))
    print(f"{count} scenes in {out}")
    return 0


def command_import(arguments: argparse.Namespace) -> int:
    from pipeline.__main__ import main as run_main

    if arguments.out is not None or Path(arguments.source).is_file():
        return import_file(arguments)
    words = ["stage=scene", "scene=imported", f"scene.path={json.dumps(arguments.source)}", *arguments.words]
    return run_main([*words, *(["--debug"] if arguments.debug else [])])


def import_file(arguments: argparse.Namespace) -> int:
    """``lightmill import SCENE -o OUT``: a scene of a modelling tool as one in a released format."""
    from stages.renderformer.importing.convert import ImportSettings, import_scene
    from stages.renderformer.importing.write import check_out, write_scene
    from stages.renderformer.inference.limits import beyond_limits, resolution_limit

    source = Path(arguments.source)
    if arguments.words:
        raise UserError(f"unknown arguments: {' '.join(arguments.words)}; settings follow a folder, not a file")
    if arguments.out is None:
        raise UserError(f"{source} is a file: give -o OUT.json or -o OUT.h5, or a folder of scenes in a released format")
    if not source.is_file():
        raise UserError(f"{source} is not a file: give a scene that a modelling tool exported, such as scene.glb")
    out = Path(arguments.out)
    check_out(out)
    scene = import_scene(source, ImportSettings(arguments.triangles, arguments.exposure))
    for note in [*scene.meta["notes"], *write_scene(out, scene)]:
        print(f"note: {note}")
    views = range(len(scene.fov_deg))
    for sentence in beyond_limits(scene, views, (resolution_limit({}),) * 2, {}):
        print(f"beyond the training data: {sentence}")
    print(out)
    return 0


def command_publish(arguments: argparse.Namespace) -> int:
    from stages.renderformer.hub import publication, publish

    what = publication(arguments.artifact, arguments.name, arguments.store, arguments.license)
    files = list(what.listing())
    for path, size in files:
        print(f"{size:>14,}  {path}")
    print(f"{sum(size for _, size in files):>14,}  bytes in {len(files):,} files, for the {what.kind} {what.name}")
    if arguments.dry_run:
        print("\n" + what.files["README.md"].decode().split("\n---\n")[0] + "\n---\nnothing was uploaded (--dry-run)")
    else:
        print(publish(what, arguments.private))
    return 0


def command_report(arguments: argparse.Namespace) -> int:
    from pipeline.store import Store
    from stages.renderformer.evaluation.side_by_side import write_report

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


def resolution_argument(text: str) -> int | tuple[int, int]:
    """Pixels per side, or WIDTHxHEIGHT as (height, width)."""
    try:
        sides = [int(word) for word in text.split("x")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2):
        raise argparse.ArgumentTypeError(f"{text!r} is neither pixels per side nor WIDTHxHEIGHT")
    return sides[0] if len(sides) == 1 else (sides[1], sides[0])


def exposure_argument(text: str) -> float | None:
    """Factor of a number of stops; None for 'auto'."""
    if text == "auto":
        return None
    try:
        stops = float(text)
    except ValueError:
        stops = float("nan")
    if not -32 <= stops <= 32:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of stops (-32 to 32) nor 'auto'")
    return 2.0**stops


def add_commands(parsers: Any, program: str) -> None:
    """Mount the commands on ``parsers`` (argparse's subparsers). ``takes_words``: overrides follow, in any order."""

    def add(name: str, function, summary: str, example: str) -> argparse.ArgumentParser:
        sub = parsers.add_parser(name, help=summary, description=summary, epilog=f"example: {program} {name} {example}")
        sub.set_defaults(function=function, takes_words=function is command_import)
        return sub

    sub = add("export", command_export, "scenes of a dataset as released HDF5 files", "shard exported --split test --images")
    sub.add_argument("dataset", help="shard artifact's key, name or 'shard'; a dataset's folder or URL")
    sub.add_argument("out", help="folder; scenes go to OUT/SPLIT/ID.h5")
    sub.add_argument("--split", action="append", help="train, validation or test; may be repeated (default: all)")
    sub.add_argument("--images", action="store_true", help="also ID-view<camera>.exr: linear RGB with all lights on")
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")

    sub = add(
        "import", command_import,
        "a scene of a modelling tool (glTF, USD) as a scene file, or a folder of scene files as scenes to render",
        f"scene.glb -o scene.h5   |   {program} import scenes scene.split=test   (then: stage=render scene=imported ..)",
    )  # fmt: skip
    sub.add_argument("source", metavar="SCENE | FOLDER",
                     help="a .glb, .gltf or .usd*; or a folder of released JSON and HDF5 scenes: train/, validation/ and test/ "
                     "in it are splits")  # fmt: skip
    sub.add_argument("-o", "--out", help="of a scene: OUT.json (its meshes in OUT-meshes/) or OUT.h5")
    sub.add_argument("--triangles", type=int, metavar="N", default=4096,
                     help="of a scene: decimate it to N in all, or subdivide what is large (default: 4096)")  # fmt: skip
    sub.add_argument("--exposure", type=exposure_argument, default=1.0, metavar="STOPS",
                     help="of a scene: of all light, or 'auto': as bright as the training data (default: 0)")  # fmt: skip
    of_scene, of_folder = "SCENE -o OUT [--triangles N] [--exposure STOPS]", "FOLDER [name=value ...] [--debug]"
    sub.usage = f"{program} import {of_scene}  |  {program} import {of_folder}"

    scene_help = (
        "scene file in a released format (.json, .h5), or a mesh or scene (.glb, .gltf, .usd*, .obj, .off, .ply, .stl, ..)"
    )

    def add_mesh_options(sub: argparse.ArgumentParser, triangles: str) -> None:
        group = sub.add_argument_group("a mesh gets a room, lights and a camera")
        group.add_argument("--room", choices=("floor", "wall", "corner", "box"), help="default: a corner, if triangles allow")
        group.add_argument("--up", choices=("x", "-x", "y", "-y", "z", "-z"), metavar="AXIS",
                           help="the file's axis that points up: x, y, z, --up=-y .. (default: z for STL, else y)")  # fmt: skip
        group.add_argument("--triangles", type=int, metavar="N", help=f"decimate it, N triangles in all (default: {triangles})")

    def add_model_options(sub: argparse.ArgumentParser) -> None:
        sub.add_argument(
            "--checkpoint",
            help="released-format folder, hub:OWNER/NAME, ships:guided or ships:renderformer (default: the first of these that "
            "ships), or a train artifact's key, name or 'train'",
        )
        sub.add_argument("--composite-lights", action="store_true", help="one pass per light, summed: for many lights")
        sub.add_argument("--device", default="auto", help="cpu, cuda or auto (default)")
        sub.add_argument("--store", default="store", help="the store's folder (default: store)")

    sub = add("trace", command_trace, "path trace a scene or mesh file", "scene.json -o out.exr --spp 256")
    sub.add_argument("scene", help=scene_help)
    sub.add_argument("-o", "--out", required=True, help="output .exr (linear RGB float); with --view all: OUT-0.exr, OUT-1.exr")
    sub.add_argument("--resolution", type=resolution_argument, metavar="N", default=512,
                     help="pixels of the longer side, or WIDTHxHEIGHT (default: 512)")  # fmt: skip
    sub.add_argument("--spp", type=int, default=256, help="samples per pixel (default: 256)")
    sub.add_argument("--mode", choices=("physical", "cycles"), default="physical", help="what the renderer matches")
    sub.add_argument("--denoise", action=argparse.BooleanOptionalAction, default=True, help="Open Image Denoise (default: on)")
    sub.add_argument("--seed", type=int, default=0)
    sub.add_argument("--lights-visible", action="store_true",
                     help="cameras see the lights (default: as in training, they do not)")  # fmt: skip
    sub.add_argument("--view", type=view_argument, default=0, help="camera number, or 'all' (default: 0)")
    add_mesh_options(sub, "as it is")

    sub = add(
        "predict", command_predict, "render a scene or mesh file with a trained model, a still or an animation",
        "chair.glb --checkpoint train -o chair.png   |   lightmill predict chair.glb -o chair.mp4 --orbit 48",
    )  # fmt: skip
    sub.add_argument("scene", help=scene_help)
    sub.add_argument(
        "-o", "--out", required=True, help="output .exr (linear), .png, or .mp4 (its frames as PNGs in a folder of that name)"
    )
    sub.add_argument("--resolution", type=resolution_argument, metavar="N",
                     help="pixels of the longer side, by eights, or WIDTHxHEIGHT (default: as it was trained)")  # fmt: skip
    sub.add_argument("--view", type=view_argument, default=0, help="camera number, or 'all' (default: 0)")
    sub.add_argument("--orbit", type=int, metavar="FRAMES", help="so many frames around the scene, starting at --view")
    sub.add_argument("--arc", type=float, metavar="DEGREES", help="of the orbit (default: all around, or what walls allow)")
    sub.add_argument("--fps", type=int, default=24, help="frames per second of an .mp4 (default: 24)")
    sub.add_argument("--tonemap", default="none", metavar="NAME",
                     help="none (clamp, default), reinhard, filmic, aces, agx or pbr_neutral; of .png and .mp4")  # fmt: skip
    sub.add_argument("--exposure", type=exposure_argument, default=1.0, metavar="STOPS",
                     help="of .png and .mp4, or 'auto' (default: 0)")  # fmt: skip
    add_model_options(sub)
    add_mesh_options(sub, "as the checkpoint was trained")

    sub = add(
        "compare", command_compare, "all metrics between two images, or between a scene path traced and predicted",
        "scene.json --checkpoint train   |   lightmill compare reference.exr out.exr --json",
    )  # fmt: skip
    sub.add_argument("a", metavar="SCENE | A", help=f"{scene_help}; or the reference image: .exr or .png")
    sub.add_argument("b", nargs="?", metavar="B", help="test image of the same size")
    sub.add_argument("-o", "--out", help="picture: both images, their difference x5, HDR-FLIP (of a scene: SCENE-compare.png)")
    sub.add_argument("--json", action="store_true", help="print JSON")
    sub.add_argument("--lpips", metavar="NETWORK", type=lpips_argument, default=NONE,
                     help="LPIPS as well: vgg, alex, or vgg,alex")  # fmt: skip
    sub.add_argument("--lpips-folder", metavar="FOLDER", help="where its published weights lie")
    group = sub.add_argument_group("of a scene")
    group.add_argument("--resolution", type=resolution_argument, metavar="N",
                       help="pixels of the longer side, or WIDTHxHEIGHT (default: as the checkpoint was trained)")  # fmt: skip
    group.add_argument("--view", type=int, default=0, help="camera number (default: 0)")
    group.add_argument("--spp", type=int, default=256, help="samples per pixel of the reference (default: 256)")
    add_model_options(sub)
    add_mesh_options(sub, "as the checkpoint was trained")

    sub = add(
        "publish", command_publish, "upload a dataset or a checkpoint to Hugging Face's hub (by the package huggingface_hub)",
        "shard hub:OWNER/NAME --dry-run",
    )  # fmt: skip
    sub.add_argument(
        "artifact", help="key or name of an artifact of shard or train, 'shard', 'train', or a checkpoint's folder"
    )
    sub.add_argument("name", metavar="hub:OWNER/NAME", help="the repository; it is made where it does not exist")
    sub.add_argument("--dry-run", action="store_true", help="list the files and the card's header, and upload nothing")
    sub.add_argument("--private", action="store_true", help="a new repository is seen by its owner alone")
    sub.add_argument("--license", metavar="ID", help="the hub's identifier (default: a dataset's that of its objects, if one)")
    sub.add_argument("--store", default="store", help="the store's folder (default: store)")

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
