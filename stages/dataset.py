"""The loader: shards in, batches of plain arrays out. Training and evaluation read the dataset only through it.

Reads a *shard* artifact, writes nothing. One design choice: a batch is a pure function of (config, step), order and
augmentation being seeded by seed, epoch and sample id; to resume is to ask for the next step. Augmentations are exact:
light transport is linear in the lights, and rigid motions and mirrors move triangles, normals and cameras together (paper
section 3.3).

A batch holds, for B scenes padded to N triangles with V views of H x W pixels (float32 unless said):
    triangles, vertex_normals (B, N, 3, 3); diffuse, specular (B, N, 3); roughness (B, N);
    emission (B, N, 3) radiance; mask (B, N) bool, True = a triangle, False = padding (zeros);
    camera_to_world (B, V, 4, 4); fov_deg (B, V); image (B, V, H, W, 3) linear radiance;
    direct (B, V, H, W, 3) linear radiance after at most one bounce, left out when lights are reweighted;
    views (B, V) int64, camera index of each view; ids, a list of B sample ids.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from pipeline.config import Section
from pipeline.errors import UserError
from pipeline.keys import seed_for
from stages.records import SceneRecord, ViewRecord

Batch = dict[str, Any]


@dataclass
class Sample:
    """One scene with its kept views; treat as read only, the cache shares it."""

    scene: SceneRecord
    views: dict[int, ViewRecord]  # camera index -> what it saw


class ShardDataset:
    """Random access to the samples of one split, with a bounded cache of decoded ones. Safe to use from threads."""

    def __init__(self, artifact: Any, split: str, max_triangles: int | None = None, cache_mb: float = 1024.0):
        index = json.loads(artifact.file("index.json").read_text())
        ids = artifact.ids(split)
        self.ids = [id for id in ids if max_triangles is None or index[id]["triangles"] <= max_triangles]
        self.dropped = len(ids) - len(self.ids)  # over max_triangles
        if not self.ids:
            over = f" with at most {max_triangles} triangles" if self.dropped else ""
            raise UserError(
                f"the dataset has no {split} scenes{over}: its splits are {', '.join(artifact.groups()) or 'empty'}"
            )
        self.artifact, self.split = artifact, split
        self._cache: OrderedDict[str, tuple[Sample, int]] = OrderedDict()
        self._room, self._lock = int(cache_mb * 1e6), threading.Lock()

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> Sample:
        id = self.ids[index]
        with self._lock:
            if id in self._cache:
                self._cache.move_to_end(id)
                return self._cache[id][0]
        sample = decode_sample(self.artifact.read(id))
        size = _nbytes(sample)
        with self._lock:
            if id not in self._cache and size <= self._room:
                self._cache[id] = sample, size
                self._room -= size
                while self._room < 0:
                    self._room += self._cache.popitem(last=False)[1][1]
        return sample


def decode_sample(record: Any) -> Sample:
    """A shard's record as arrays."""
    from stages.exr import decode_view

    scene = SceneRecord.from_record(record)
    return Sample(scene, {index: decode_view(record.members[f"view{index}.exr"]) for index in scene.meta["views"]})


def _nbytes(sample: Sample) -> int:
    holders = [sample.scene, *sample.views.values()]
    return sum(value.nbytes for holder in holders for value in vars(holder).values() if isinstance(value, np.ndarray))


class Relight(Section):
    """Fresh lighting from the stored per-light layers; image and emission follow exactly."""

    share: float = Field(1.0, ge=0, le=1)  # of the samples that are relit
    keep: float = Field(1.0, gt=0, le=1)  # probability that a light stays on; at least one does
    scale: tuple[float, float] = (0.5, 2.0)  # log-uniform factor of each light's radiance
    saturation: float = Field(0.0, ge=0, le=1)  # 0: white stays white; 1: any colour


class BatchConfig(Section):
    """What a training batch holds."""

    seed: int = 0
    batch_scenes: int = Field(4, ge=1)  # over all ranks
    views_per_scene: int = Field(2, ge=1)
    rotate: bool = True  # rotation vector ~ N(0, I)
    translate_sigma: float = Field(0.25, ge=0)  # scene units, translation ~ N(0, sigma^2 I)
    mirror: bool = False  # x -> -x, for half of the samples
    relight: bool = False
    lighting: Relight = Relight()  # what relight draws from


class Batches:
    """``batches(step)``: the batch of a step. Rank r of ``world`` gets its slice of the same global batch."""

    def __init__(self, dataset: ShardDataset, config: BatchConfig, rank: int = 0, world: int = 1):
        if config.batch_scenes % world:
            raise UserError(
                f"batch_scenes={config.batch_scenes} cannot be shared by {world} processes: make it a multiple of {world}"
            )
        self.dataset, self.config, self.rank, self.world = dataset, config, rank, world

    def __call__(self, step: int) -> Batch:
        share = self.config.batch_scenes // self.world
        first = step * self.config.batch_scenes + self.rank * share
        return collate([self._example(position) for position in range(first, first + share)])

    def _example(self, position: int) -> Batch:
        """The sample at that position of the endless sequence of epochs; each epoch visits every scene once."""
        config = self.config
        epoch, place = divmod(position, len(self.dataset))
        order = np.random.default_rng(seed_for(config.seed, "epoch", str(epoch))).permutation(len(self.dataset))
        sample = self.dataset[int(order[place])]
        rng = np.random.default_rng(seed_for(config.seed, "augment", f"{epoch}/{sample.scene.id}"))
        kept = np.array(sorted(sample.views))
        wanted = config.views_per_scene
        views = rng.choice(kept, size=wanted, replace=wanted > len(kept))
        factors = draw_light_factors(config.lighting, rng, sample.scene.n_lights) if config.relight else None
        example = make_example(sample, views, factors)
        if config.mirror and rng.random() < 0.5:
            example = mirror(example)
        if config.rotate or config.translate_sigma:
            vector = rng.normal(size=3) if config.rotate else np.zeros(3)
            example = move(example, rotation_from_vector(vector), rng.normal(size=3) * config.translate_sigma)
        return example


def evaluation_samples(dataset: ShardDataset) -> Iterator[Batch]:
    """One scene at a time with all its kept views, exactly as stored."""
    for index in range(len(dataset)):
        sample = dataset[index]
        yield collate([make_example(sample, np.array(sorted(sample.views)), None)])


def draw_light_factors(config: Relight, rng: np.random.Generator, n_lights: int) -> np.ndarray | None:
    """(L, 3) factors of the lights' radiance, or None for the lights as stored."""
    if rng.random() >= config.share:
        return None
    on = rng.random(n_lights) < config.keep
    on[rng.integers(n_lights)] = True
    scale = np.exp(rng.uniform(*np.log(config.scale), size=n_lights))
    hue = rng.uniform(size=(n_lights, 3))
    colour = 1 + config.saturation * (hue / hue.max(axis=1, keepdims=True) - 1)
    return (on * scale)[:, None] * colour


def make_example(sample: Sample, views: np.ndarray, factors: np.ndarray | None) -> Batch:
    """The sample seen by some of its cameras, its lights reweighted by (L, 3) factors where given."""
    scene = sample.scene
    example: Batch = {name: getattr(scene, name) for name in _PADDED if name != "mask"}
    example |= {"id": scene.id, "views": np.asarray(views, np.int64), "mask": np.ones(len(scene.triangles), bool)}
    example |= {name: getattr(scene, name)[views] for name in ("camera_to_world", "fov_deg")}
    if factors is None:
        example["image"] = np.stack([sample.views[int(v)].image for v in views])
        example["direct"] = np.stack([sample.views[int(v)].direct for v in views])
    else:
        weights = factors.astype(np.float32)
        lit = scene.light_index >= 0
        example["emission"] = scene.emission.copy()
        example["emission"][lit] *= weights[scene.light_index[lit]]
        example["image"] = np.stack([np.einsum("lhwc,lc->hwc", sample.views[int(v)].lights, weights) for v in views])
    return example


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about the vector by its length in radians (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def move(example: Batch, rotation: np.ndarray, translation: np.ndarray) -> Batch:
    """The example rigidly moved; what the cameras see stays the same."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return {
        **example,
        "triangles": (example["triangles"] @ rotation.T + translation).astype(np.float32),
        "vertex_normals": (example["vertex_normals"] @ rotation.T).astype(np.float32),
        "camera_to_world": (matrix @ example["camera_to_world"]).astype(np.float32),
    }


def mirror(example: Batch) -> Batch:
    """The example mirrored at x = 0: corners change order to keep facing outwards, images flip left to right."""
    flip = np.array([-1, 1, 1], np.float32)
    flip4 = np.diag(np.array([-1, 1, 1, 1], np.float32))
    out = {
        **example,
        "triangles": example["triangles"][:, [0, 2, 1]] * flip,
        "vertex_normals": example["vertex_normals"][:, [0, 2, 1]] * flip,
        # The mirrored camera would be left-handed: turn its x axis round and the image with it.
        "camera_to_world": flip4 @ example["camera_to_world"] @ flip4,
    }
    return out | {name: example[name][:, :, ::-1] for name in ("image", "direct") if name in example}


_PADDED = ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission", "mask")


def collate(examples: list[Batch]) -> Batch:
    """Examples stacked, triangles padded with zeros to the longest."""
    longest = max(len(example["mask"]) for example in examples)
    shared = set.intersection(*(set(example) for example in examples)) - {"id"}
    batch: Batch = {"ids": [example["id"] for example in examples]}
    for name in sorted(shared):
        arrays = [example[name] for example in examples]
        if name in _PADDED:
            padded = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), arrays[0].dtype)
            for row, array in zip(padded, arrays, strict=True):
                row[: len(array)] = array
            batch[name] = padded
        else:
            batch[name] = np.stack(arrays)
    return batch


def prefetch(batches: Callable[[int], Batch], start: int, stop: int, ahead: int = 2) -> Iterator[Batch]:
    """The batches of steps start..stop-1 in order, prepared by threads up to ``ahead`` steps early."""
    pool = ThreadPoolExecutor(max_workers=max(1, ahead), thread_name_prefix="prefetch")
    try:
        waiting: deque = deque()
        for step in range(start, stop):
            waiting.append(pool.submit(batches, step))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
