"""A small store of both systems, made by hand in a second: real records of every stage, committed as the engine does."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.keys import digest_of
from pipeline.stage import Record
from pipeline.store import Artifact, Store
from stages.graphics.arrays import pack_arrays, pack_json
from stages.graphics.exr import encode_rgb
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.neuras.baking.site import write_site
from stages.neuras.records import CaptureInfo, FrameRecord, PointsRecord, save
from stages.renderformer.inference.renderer import shipped_checkpoint
from stages.renderformer.objects.rungs import rungs_record
from stages.renderformer.s05_shard import merge
from tests.neuras import scenes
from tests.renderformer import fakes

SIZE = 16  # pixels of the stored images
INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "lidar", "every other")
PLACES = [(5.0, 0.0, 2.0), (4.9, 0.5, 2.0), (4.8, 1.0, 2.0)]
ORIGIN = {
    "command": "made by hand",
    "machine": {"host": "here", "gpu": None},
    "code": {"digest": "0" * 64, "commit": "0" * 40, "dirty": False},
    "environment": {},
    "started": 1.0e9,
    "finished": 1.0e9 + 5,
    "seconds": 5.0,
}


def commit(
    root: Path,
    place: str,
    records: Iterable[Record] = (),
    inputs: Mapping[str, Artifact] | None = None,
    files: Mapping[str, bytes] | None = None,
    rejects: Iterable[tuple[str, str, str]] = (),
) -> Artifact:
    """An artifact at ``STAGE`` or ``SYSTEM/STAGE``. rejects: (item, reason, detail)."""
    store = Store(root)
    system, _, stage = place.rpartition("/")
    preimage = {"stage": stage, "version": 1, "params": {"made": "by hand"}}
    preimage |= {"inputs": {role: artifact.key for role, artifact in (inputs or {}).items()}}
    preimage |= {"system": system} if system else {}
    draft = store.draft(place, digest_of(preimage), preimage)
    part, items = draft.open_part(), []
    for record in records:
        items.append(record.id)
        part.add(record, record.id, record.id.partition("-")[0], "")
    lost = [{"item": item, "group": "", "reason": reason, "detail": detail, "item_key": ""} for item, reason, detail in rejects]
    marker = {"part_key": "0", "group": "", "items": [*items, *(reject["item"] for reject in lost)], "rejects": lost}
    draft.use_parts([{**marker, **part.close()}] if items or lost else [])
    for name, data in (files or {}).items():
        (draft.files / name).parent.mkdir(parents=True, exist_ok=True)
        (draft.files / name).write_bytes(data)
    manifest = {**ORIGIN, "key": draft.key, "preimage": preimage, "outputs": draft.outputs(), "summary": {}}
    manifest |= {"system": system or "renderformer"}
    return store.commit(draft, "small", manifest)


def png(seed: int, size: tuple[int, int] = (32, 20)) -> bytes:
    buffer = io.BytesIO()
    noise = np.random.default_rng(seed).integers(0, 256, (5, 8, 3), np.uint8)
    Image.fromarray(noise).resize(size).save(buffer, "PNG")
    return buffer.getvalue()


def renderformer(root: Path) -> dict[str, Artifact]:
    """Every stage of RenderFormer: two meshes, three scenes with images of ``SIZE`` pixels, the shipped model as *train*."""
    meta = {"object_id": "ball", "licence": "CC0", "origin": "here"}
    meshes = {id: MeshRecord(id, *fakes.blob(3, seed), meta) for seed, id in enumerate(("ball-0", "ball-1"))}
    mesh = meshes["ball-0"]
    texture = TextureRecord(
        mesh.id + TextureRecord.SUFFIX, np.full((len(mesh.faces), 3, 2), 0.5), np.zeros(len(mesh.faces)),
        np.ones((1, 3)), np.zeros(1), np.zeros((1, 2)), [np.full((2, 2, 3), 128, np.uint8)],
    )  # fmt: skip
    made = {"collect": commit(root, "collect", [*(mesh.to_record() for mesh in meshes.values()), texture.to_record()])}
    remeshed = [MeshRecord(id, *fakes.blob(5, seed), meta).to_record() for seed, id in enumerate(meshes)]
    made["remesh"] = commit(root, "remesh", remeshed, {"collect": made["collect"]})
    rungs = {48: fakes.blob(1, 0), 192: fakes.blob(3, 0)}
    facts = {"rungs": {str(budget): {"faces": len(faces)} for budget, (_, faces) in rungs.items()}}
    made["decimate"] = commit(
        root, "decimate", [rungs_record("ball-0", rungs, facts)], {"remesh": made["remesh"]},
        rejects=[("ball-1", "no_rung", "kept 1 % of it")],
    )  # fmt: skip
    inputs = fakes.dataset_inputs(root.parent / "fakes", train=1, test=2, size=SIZE)
    of = {role: [artifact.read(id) for id in artifact.ids()] for role, artifact in inputs.items()}
    made["scene"] = commit(root, "scene", of["scene"], {"decimate": made["decimate"]})
    made["render"] = commit(root, "render", of["render"], {"scene": made["scene"]})
    samples = [merge(scene, render) for scene, render in zip(of["scene"], of["render"], strict=True)]
    card = {"card.html": b"<!doctype html><title>card</title><p>a card", "contact.png": png(3)}
    made["shard"] = commit(root, "shard", samples, {"scene": made["scene"], "render": made["render"]}, card)
    log = [{"step": step, "loss": 1 / step, "validation_psnr": 10.0 + step} for step in (1, 2, 3)]
    files = {
        f"checkpoint/{name}": (shipped_checkpoint("renderformer") / name).read_bytes()
        for name in ("config.json", "model.safetensors")
    }
    files |= {"log.jsonl": "\n".join(map(json.dumps, log)).encode()}
    files |= {f"validation/step-{step:07}.png": png(step) for step in (1, 2, 3)}
    made["train"] = commit(root, "train", [], {"shard": made["shard"]}, files)
    test = [sample for sample in samples if sample.id.startswith("test")]
    image = np.random.default_rng(1).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    scores = {"metrics.json": pack_json({"id": "test", "views": []}), "view0.prediction.exr": encode_rgb(image)}
    pages = {"report.html": b"<!doctype html><title>report</title><script>document.title = 'read'</script>"}
    judged = [Record(sample.id, scores) for sample in test]
    made["evaluate"] = commit(root, "evaluate", judged, {"shard": made["shard"], "train": made["train"]}, pages)
    probed = [
        Record("test-1", {"metrics.json": pack_json({}), "reference.exr": encode_rgb(image), "method0.exr": encode_rgb(image)})
    ]
    made["probe"] = commit(root, "probe", probed, {"shard": made["shard"]}, {"figure.png": png(4), "table.md": b"| a |"})
    return made


def neuras(root: Path) -> dict[str, Artifact]:
    """Every stage of NeuRas: a ball, seen by three cameras."""
    flat = scenes.atlas()
    cameras = [scenes.looking_at(place, size=(32, 20)) for place in PLACES]
    frames = [FrameRecord(f"frame-drive_{n}", camera, png(n), "train") for n, camera in enumerate(cameras)]
    points = PointsRecord("points-0", np.random.default_rng(0).normal(size=(50, 3)), np.zeros(3))
    info = {"capture.json": pack_json(INFO.to_json())}
    records = [*(frame.to_record() for frame in frames), points.to_record()]
    made = {"capture": commit(root, "neuras/capture", records, files=info)}
    arrays = pack_arrays({"vertices": flat.vertices, "faces": flat.faces})
    surface = [Record("mesh", {"mesh.npz": arrays, "mesh.json": pack_json({"faces": len(flat.faces)})})]
    made["scaffold"] = commit(root, "neuras/scaffold", surface, {"capture": made["capture"]})
    refined = [Record("mesh", {**surface[0].members, "poses.json": pack_json({})})]
    made["refine"] = commit(root, "neuras/refine", refined, {"capture": made["capture"], "scaffold": made["scaffold"]})
    work = root.parent / "neuras"
    work.mkdir()
    save(work / "atlas.npz", flat)
    tile = [Record("tile_0000", {"tile.npz": pack_arrays({name: np.asarray(value) for name, value in vars(flat).items()})})]
    unfolded = {"atlas.npz": (work / "atlas.npz").read_bytes()}
    made["atlas"] = commit(root, "neuras/atlas", tile, {"scaffold": made["refine"]}, unfolded)
    curve = {"curve.csv": b"step,loss,validation_psnr\n1,0.5,\n2,0.25,20\n", "validation/step-0000002.png": png(5)}
    made["fit"] = commit(
        root, "neuras/fit", [], {"atlas": made["atlas"], "capture": made["capture"], "scaffold": made["refine"]}, curve
    )
    write_site(work / "site", scenes.baked(flat, networks=False), flat, INFO, frames, (0.1, 100.0), "fp16")
    site = {str(path.relative_to(work)): path.read_bytes() for path in sorted((work / "site").rglob("*")) if path.is_file()}
    made["bake"] = commit(root, "neuras/bake", [], {"fit": made["fit"], "capture": made["capture"]}, site)
    seen = {"metrics.json": pack_json({"psnr": 20.0}), "photo.png": png(0), "ours.png": png(1)}
    judged = [Record("frame-drive_0", seen)]
    made["evaluate"] = commit(root, "neuras/evaluate", judged, {"bake": made["bake"], "capture": made["capture"]})
    shutil.rmtree(work)
    return made
