"""Bytes and speed of a dataset against the released HDF5 files of the same scenes, and the figures behind its encoding:

    python bench/dataset.py DATASET [--split train] [--scenes 200] [--only bytes,speed,exr,precision] [--checkpoints FOLDER...]

DATASET is a shard artifact's folder. Rates are per second of CPU time ("and core"), in one process, so that a busy machine does
not change them; lines that say *wall* are by the clock. The HDF5 files are written to a temporary folder first, deflated as the
released ones are. ``--checkpoints`` are folders of released-format checkpoints, for *precision*.
"""

from __future__ import annotations

import argparse
import io
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipeline.store import Artifact, Store, iter_inputs
from stages.graphics import exr
from stages.graphics.exr import decode_lights
from stages.renderformer.dataset import BatchConfig, Batches, Needs, Relight, ShardDataset, prefetch
from stages.renderformer.dataset.encoding import decode_scene
from stages.renderformer.dataset.interchange import write_hdf5
from stages.renderformer.dataset.shards import Reader
from stages.renderformer.records import SceneRecord
from stages.renderformer.views import LAYERS, decode_layers, view_members

BLOCK = 512  # of a tar


def cpu(function: Callable[[], object]) -> float:
    """CPU seconds of this process."""
    began = time.process_time()
    function()
    return time.process_time() - began


def wall(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began


def row(label: str, value: str, note: str = "") -> None:
    print(f"  {label:58s} {value:>16s}  {note}", flush=True)


def members_of(dataset: ShardDataset, index: int, views: int | None, layers: bool) -> dict[str, bytes]:
    """The bytes of a sample's members, with the first ``views`` of its views (None: all)."""
    entry = dataset.row(index)
    names = ["scene.npz", "meta.json"]
    for view in entry["views"][:views]:
        names += view_members(view) if layers else view_members(view)[:1]
    with Reader(dataset, entry) as reader:
        return {name: reader[name] for name in names}


def decode(id: str, members: dict[str, bytes]) -> None:
    """Every member as the arrays that ``ShardDataset`` hands out (float32, lights apart), nothing more."""
    decode_scene(id, members["scene.npz"], members["meta.json"])
    for name, data in members.items():
        if name.endswith(".aov.exr"):
            decode_layers(data)
        elif name.endswith(".exr"):
            decode_lights(data)


def in_tar(members: dict[str, int]) -> int:
    """Bytes that members take in a shard, headers and padding included."""
    return sum(BLOCK + -(-size // BLOCK) * BLOCK for size in members.values())


def bytes_and_speed(dataset: ShardDataset, count: int, folder: Path, what: set[str]) -> None:
    indices = list(range(min(count, len(dataset))))
    for index in indices:
        scene = dataset.read(index, []).scene
        write_hdf5(folder / f"{dataset.ids[index]}.h5", scene)
    paths = [folder / f"{dataset.ids[index]}.h5" for index in indices]
    n, triangles = len(indices), int(dataset.triangles[indices].sum())

    if "bytes" in what:
        sizes = [{name: size for name, (_, size, _) in dataset.row(i)["members"].items()} for i in indices]
        released = sum(path.stat().st_size for path in paths)
        ours = sum(in_tar({name: s[name] for name in ("scene.npz", "meta.json")}) for s in sizes)
        npz, images = sum(s["scene.npz"] for s in sizes), sum(map(in_tar, sizes))
        views = sum(len(dataset.row(i)["views"]) for i in indices)
        print(f"bytes per scene ({n} scenes, {triangles / n:.0f} triangles, {views / n:.2f} views in the mean)")
        row("released HDF5, no images", f"{released / n:,.0f}")
        row("ours without images, tar headers and JSON included", f"{ours / n:,.0f}", f"1/{released / ours:.1f}")
        row("  scene.npz alone", f"{npz / n:,.0f}", f"1/{released / npz:.1f}")
        row("ours with all views and layers", f"{images / n:,.0f}", f"{(images - ours) / views:,.0f} per view")
    if "speed" not in what:
        return

    import h5py

    def read_released() -> None:
        for path in paths:
            with h5py.File(path) as file:
                {name: file[name][...] for name in file}

    print(f"samples per second and core ({n} scenes)")
    released = n / cpu(read_released)
    row("released HDF5 read, no images", f"{released:,.1f}")
    everything = tuple(LAYERS)
    relit = {
        "rotate": True,
        "translate_sigma": 0.25,
        "mirror": True,
        "relight": True,
        "lighting": Relight(keep=0.8, saturation=0.5),
        "exposure_stops": 1.0,
    }
    rates = {}
    for label, views, layers in (("no images", 0, ()), ("2 views, image", 2, ()), ("2 views, all layers", 2, everything)):
        config = BatchConfig(batch_scenes=4, views_per_scene=views, bucket=4, **relit)
        fresh = ShardDataset(dataset.source.root, dataset.split, cache_mb=0)
        batches = Batches(fresh, config, needs=Needs(layers=layers))
        steps = n // config.batch_scenes

        def load(batches: Batches = batches, steps: int = steps) -> None:
            for step in range(steps):
                batches(step)  # and let go, as training does

        batches(steps)  # imports and the epoch's order are paid once
        rates[label] = steps * config.batch_scenes / cpu(load)
        parts = [members_of(dataset, index, views, bool(layers)) for index in indices]
        alone = n / cpu(lambda p=parts: [decode(dataset.ids[i], m) for i, m in zip(indices, p, strict=True)])
        note = f"{rates[label] / released:.1f} x HDF5, {rates[label] / alone:.0%} of decoding alone ({alone:,.1f})"
        row(f"whole loader, {label}", f"{rates[label]:,.1f}", note)
        del parts
    config = BatchConfig(batch_scenes=4, bucket=4)
    batches = Batches(dataset, config)
    row("triangles padded, in buckets of 4 batches", f"{batches.padding_waste(0, max(1, n // 4)):.1%}")
    plain = Batches(dataset, config.model_copy(update={"bucket": 0}))
    row("  without buckets", f"{plain.padding_waste(0, max(1, n // 4)):.1%}")

    print("the same loader by the clock, 2 views, image (wall)")
    steps = n // 4
    for label, workers in (("threads", 0), ("1 process", 1), ("2 processes", 2)):
        batches = Batches(
            ShardDataset(dataset.source.root, dataset.split, cache_mb=0),
            BatchConfig(batch_scenes=4, views_per_scene=2, **relit),
        )
        stream = prefetch(batches, 0, steps, 4, workers)
        next(stream)  # workers have started
        seconds = wall(lambda s=stream: [None for _ in s])
        row(label, f"{(steps - 1) * 4 / seconds:,.1f}", f"samples/s; load average {os.getloadavg()[0]:.1f}")

    print("reading, out of the page cache (wall)")
    shards = sorted({dataset.source.root / dataset.row(index)["shard"] for index in indices})

    def forget() -> None:
        for path in shards:
            with open(path, "rb") as file:
                os.fsync(file.fileno())
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def sequential() -> None:
        for path in shards:
            with open(path, "rb", buffering=0) as file:
                while file.read(1 << 20):
                    pass

    total = sum(path.stat().st_size for path in shards)
    forget()
    plain = total / wall(sequential) / 1e6
    row("plain sequential read of the shards", f"{plain:,.0f} MB/s")
    order = np.random.default_rng(0).permutation(indices).tolist()
    forget()
    began = time.perf_counter()
    size = sum(len(data) for index in order for data in members_of(dataset, index, None, True).values())
    seconds = time.perf_counter() - began
    rate = size / seconds / 1e6
    row("all members, samples in random order, CRC checked", f"{rate:,.0f} MB/s", f"{rate / plain:.0%}")
    forget()
    batches = Batches(
        ShardDataset(dataset.source.root, dataset.split, cache_mb=0), BatchConfig(batch_scenes=4, views_per_scene=2, **relit)
    )
    used = sum(len(d) for i in indices for d in members_of(dataset, i, 2, False).values())
    forget()
    seconds = wall(lambda: [batches(step) for step in range(n // 4)])
    row("whole loader, 2 views, image, one core", f"{used / seconds / 1e6:,.0f} MB/s")


def exr_table(dataset: ShardDataset, views: int = 16) -> None:
    """Bytes and decoding time of a view's two members under every lossless compression of OpenEXR."""
    import OpenEXR

    step = max(1, len(dataset) // views)
    samples = [members_of(dataset, index, 1, True) for index in range(0, len(dataset), step)][:views]
    print(f"EXR compression ({len(samples)} views; ms of CPU time per view)")
    for suffix, words in ((".exr", "lights"), (".aov.exr", "AOVs")):
        images = [
            exr.decode(data, name)[1]
            for members in samples
            for name, data in members.items()
            if name.endswith(suffix) and name.endswith(".aov.exr") == (suffix == ".aov.exr")
        ]
        raw = sum(pixels.nbytes for channels in images for pixels in channels.values())
        for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "HTJ2K32", "HTJ2K256", "ZSTD"):
            header = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION"), "type": OpenEXR.scanlineimage}
            encoded: list[bytes] = []

            def encode(header: dict = header, images: list = images, encoded: list[bytes] = encoded) -> None:
                for channels in images:
                    buffer = io.BytesIO()
                    OpenEXR.File(header, dict(channels), 0).write(buffer)  # it replaces the values by its own objects
                    encoded.append(buffer.getvalue())

            encoding = cpu(encode)
            decoding = min(cpu(lambda e=encoded: [exr.decode(data, "") for data in e]) for _ in range(3))
            for channels, data in zip(images, encoded, strict=True):
                back = exr.decode(data, "")[1]
                same = (np.array_equal(back[n].view(np.uint8), pixels.view(np.uint8)) for n, pixels in channels.items())
                assert all(same), f"{name} is not lossless"
            each = 1000 / len(images)
            size = sum(map(len, encoded))
            note = f"{size / raw:6.1%} of raw; encode {encoding * each:5.1f} ms, decode {decoding * each:5.1f} ms"
            row(f"{words:8s} {name}", f"{size / len(images) / 1e3:,.0f} kB", note)


# --- precision --------------------------------------------------------------------------------------------------------


def grid(values: np.ndarray, bits: int, span: float) -> np.ndarray:
    step = span / (2**bits - 1)
    return (np.round(values / step) * step).astype(np.float32)


def unit(values: np.ndarray, bits: int) -> np.ndarray:
    rounded = np.round(values * (2 ** (bits - 1) - 1))
    return (rounded / np.linalg.norm(rounded, axis=-1, keepdims=True)).astype(np.float32)


def half(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float16).astype(np.float32)


CODES: dict[str, dict[str, Callable[[np.ndarray], np.ndarray]]] = {
    "corners on a 16-bit grid": {"triangles": lambda v: grid(v, 16, 5.5)},
    "corners as half floats": {"triangles": half},
    "corners on a 12-bit grid": {"triangles": lambda v: grid(v, 12, 5.5)},
    "normals in 16 bits": {"vertex_normals": lambda v: unit(v, 16)},
    "normals in 8 bits": {"vertex_normals": lambda v: unit(v, 8)},
    "materials as half floats": dict.fromkeys(("diffuse", "specular", "roughness"), half),
    "materials in 8 bits": dict.fromkeys(("diffuse", "specular", "roughness"), lambda v: grid(v, 8, 1.0)),
    "the encoding (16-bit grid, 16-bit normals, half materials)": {
        "triangles": lambda v: grid(v, 16, 5.5), "vertex_normals": lambda v: unit(v, 16),
        **dict.fromkeys(("diffuse", "specular", "roughness"), half),
    },
}  # fmt: skip


def precision(scenes: list[SceneRecord], checkpoints: list[Path]) -> None:
    """What each dtype moves: corners in pixels at 512 px, and the networks' outputs, as shares of their own spread."""
    import warnings
    from dataclasses import replace

    import torch

    from stages.graphics.tonemap import log_encode
    from stages.renderformer.inference.predict import load_model, predict_scene

    def pixels(scene: SceneRecord, triangles: np.ndarray) -> np.ndarray:
        points = triangles[scene.light_index < 0].reshape(-1, 3).astype(np.float64)
        inverse = np.linalg.inv(scene.camera_to_world.astype(np.float64))
        camera = np.einsum("vij,nj->vni", inverse[:, :3, :3], points) + inverse[:, None, :3, 3]
        focal = 256 / np.tan(np.radians(scene.fov_deg.astype(np.float64)) / 2)
        return focal[:, None, None] * camera[..., :2] / -camera[..., 2:]

    def seen(model: object, scene: SceneRecord) -> np.ndarray:
        return log_encode(predict_scene(model, scene, [0, 1], 64))

    warnings.filterwarnings("ignore", message="Mismatch dtype")
    models = {
        (folder.parents[1].name if folder.name == "checkpoint" else folder.name): load_model(folder) for folder in checkpoints
    }
    print(
        f"precision ({len(scenes)} scenes; largest corner shift in pixels of 512; mean and largest change of the output "
        "log10(1 + x), over its standard deviation)"
    )
    print(f"  {'':58s} {'pixels':>8s}  " + "  ".join(f"{name:>19s}" for name in models))
    exact = {name: [seen(model, scene) for scene in scenes] for name, model in models.items()}

    def line(label: str, shift: float, changes: dict[str, list[np.ndarray]]) -> None:
        cells = []
        for name, diffs in changes.items():
            flat = np.concatenate([d.reshape(-1) for d in diffs]) / np.std(exact[name])
            cells.append(f"{flat.mean():9.2e} {flat.max():9.2e}")
        print(f"  {label:58s} {shift:8.4f}  " + "  ".join(cells), flush=True)

    for label, codes in CODES.items():
        shift, changes = 0.0, {name: [] for name in models}
        for number, scene in enumerate(scenes):
            coded = replace(scene, **{name: code(getattr(scene, name)) for name, code in codes.items()})
            shift = max(shift, float(np.abs(pixels(scene, coded.triangles) - pixels(scene, scene.triangles)).max()))
            for name, model in models.items():
                changes[name].append(np.abs(seen(model, coded) - exact[name][number]))
        line(label, shift, changes)
    print("  for comparison")
    line("images as half floats", 0.0, {n: [np.abs(log_encode(half(10**y - 1)) - y) for y in ys] for n, ys in exact.items()})
    changes = {name: [] for name in models}
    for name, model in models.items():
        plain = model.encode

        def encode(*arguments: object, plain: Callable = plain) -> torch.Tensor:
            with torch.autocast("cpu", dtype=torch.bfloat16):
                return plain(*arguments).float()

        model.encode = encode
        changes[name] = [np.abs(seen(model, scene) - exact[name][number]) for number, scene in enumerate(scenes)]
        model.encode = plain
    line("the view-independent stage in bfloat16, as trained", 0.0, changes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="folder of a shard artifact")
    parser.add_argument("--split", default="train")
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--only", default="bytes,speed,exr,precision")
    parser.add_argument("--checkpoints", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    what = set(arguments.only.split(","))
    dataset = ShardDataset(arguments.dataset, arguments.split, cache_mb=0)
    print(f"{arguments.dataset.name}: {len(dataset)} {arguments.split} scenes of {dataset.resolution} px")
    if what & {"bytes", "speed"}:
        with tempfile.TemporaryDirectory() as folder:
            bytes_and_speed(dataset, arguments.scenes, Path(folder), what)
    if "exr" in what:
        exr_table(dataset)
    if "precision" in what:
        chosen = np.unique(np.linspace(0, len(dataset) - 1, 4).round().astype(int))
        artifact = Artifact(arguments.dataset.absolute())
        found = {name: parent for name, _, parent in iter_inputs(Store(artifact.path.parents[1]), artifact)}
        if found.get("scene") is None:
            raise SystemExit("precision needs the scenes before encoding: DATASET in a store that still holds them")
        scenes = [SceneRecord.from_record(found["scene"].read(dataset.ids[index])) for index in chosen]
        precision(scenes, arguments.checkpoints)


if __name__ == "__main__":
    main()
