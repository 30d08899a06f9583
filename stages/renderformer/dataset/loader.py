"""The order of samples, and what hands batches out: on any number of ranks and workers, resumable to the next batch.

Reads a ``ShardDataset``, writes nothing. One design choice: a batch is a pure function of (dataset, config, step). Order comes
from seed and epoch, augmentation from seed, epoch and sample id; a rank takes its slice of the global batch; workers only
decide who computes a step. So to resume is to remember one number.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from pipeline.config import Section, added
from pipeline.errors import UserError
from pipeline.keys import seed_for
from stages.renderformer.dataset.augment import (
    GUIDE,
    Batch,
    Relight,
    collate,
    draw_light_factors,
    expose,
    make_example,
    mirror,
    move,
    rotation_from_vector,
    take_bundles,
)
from stages.renderformer.dataset.shards import DamagedSample, ShardDataset
from stages.renderformer.views import LAYERS

MOST_DAMAGED = 64  # samples in a row that cannot be read before it is the dataset that is damaged


class BatchConfig(Section):
    """What a training batch holds; a part of *train*'s config. The defaults suit runs of minutes."""

    seed: int = 0
    batch_scenes: int = Field(4, ge=1)  # over all ranks
    views_per_scene: int = Field(4, ge=0)  # 0: no images; a scene is encoded once for all of its views
    rotate: bool = False  # rotation vector ~ N(0, I): the view-independent stage must not learn an orientation
    translate_sigma: float = Field(0.0, ge=0)  # scene units, translation ~ N(0, sigma^2 I)
    mirror: bool = False  # x -> -x, for half of the samples
    relight: bool = True  # reweight the lights' own images: light transport is linear
    lighting: Relight = Relight()  # what relight draws from
    exposure_stops: float = added(0.0, 0.0, ge=0)  # radiance, seen and emitted, times 2^U(-stops, stops)
    shuffle_shards: int = added(0, 0, ge=0)  # scenes are shuffled over this many shards at a time; 0: over the whole split
    bucket: int = added(0, 0, ge=0)  # global batches whose scenes are sorted by triangle count together; 0: none
    bundles_per_view: int = added(0, 0, ge=0)  # ray bundles of a view that a step learns from; 0: all


@dataclass(frozen=True)
class Needs:
    """What a network reads besides the scenes and their images.

    guides: what ray casting says of scene and views. layers: AOV layers. bundle: pixels along a ray bundle's side.
    """

    guides: bool = False
    layers: tuple[str, ...] = ()
    bundle: int = 8


class Batches:
    """``batches(step)``: the batch of a step. Rank r of ``world`` gets its slice of the same global batch.

    ``needs``: what a batch holds besides the image; only then is it read.
    """

    def __init__(self, dataset: ShardDataset, config: BatchConfig, rank: int = 0, world: int = 1, needs: Needs = Needs()):
        if unknown := set(needs.layers) - LAYERS.keys():
            raise UserError(f"layers {', '.join(sorted(unknown))} are unknown: choose from {', '.join(LAYERS)}")
        if config.batch_scenes % world:
            raise UserError(
                f"batch_scenes={config.batch_scenes} cannot be shared by {world} processes: make it a multiple of {world}"
            )
        self.dataset, self.config, self.rank, self.world, self.needs = dataset, config, rank, world, needs
        self._orders: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_orders": {}, "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lock = threading.Lock()

    def __call__(self, step: int) -> Batch:
        share = self.config.batch_scenes // self.world
        first = step * self.config.batch_scenes + self.rank * share
        damaged: dict[str, str] = {}
        examples = (self._example(position, damaged) for position in range(first, first + share))
        return collate(examples, share) | {"damaged": sorted(damaged.items())}

    def order(self, epoch: int) -> np.ndarray:
        """(len(dataset),) indices in the order of that epoch: each exactly once.

        With ``shuffle_shards`` the shards are shuffled and their scenes mixed only within windows of that many of them, so that
        few shards are in use at a time: for disks that hate seeks, and splits that are fetched and do not fit.

        With buckets, scenes are shuffled first and sorted only inside pools of ``bucket`` global batches, and a pool's batches
        are shuffled again: what a batch holds changes with every epoch, its mean size carries no order.
        """
        with self._lock:
            if epoch not in self._orders:
                self._orders = {**dict(list(self._orders.items())[-3:]), epoch: self._draw_order(epoch)}
            return self._orders[epoch]

    def _draw_order(self, epoch: int) -> np.ndarray:
        config, counts, shards = self.config, self.dataset.triangles, self.dataset.shard_of
        rng = np.random.default_rng(seed_for(config.seed, "epoch", str(epoch)))
        order = rng.permutation(len(counts))
        if config.shuffle_shards:  # by windows of shards; stable, so that scenes stay shuffled within a window
            window = np.argsort(rng.permutation(shards.max() + 1)) // config.shuffle_shards
            order = order[np.argsort(window[shards[order]], kind="stable")]
        if config.bucket:
            batch = config.batch_scenes
            start = -epoch * len(counts) % batch  # the last batch of the epoch before takes its rest from this one's head
            for first in range(start, len(order), config.bucket * batch):
                pool = order[first : first + config.bucket * batch]
                pool = pool[np.argsort(counts[pool], kind="stable")]
                in_batches = len(pool) // batch * batch
                shuffled = rng.permutation(pool[:in_batches].reshape(-1, batch), axis=0).reshape(-1)
                order[first : first + len(pool)] = np.concatenate([shuffled, pool[in_batches:]])
        return order

    def padding_waste(self, first_step: int, steps: int) -> float:
        """Share of padded triangles in those global batches, all ranks together, from the index alone."""
        scenes, share = self.config.batch_scenes, self.config.batch_scenes // self.world
        positions = range(first_step * scenes, (first_step + steps) * scenes)
        counts = np.array([self.dataset.triangles[self._index(position)[1]] for position in positions]).reshape(-1, share)
        longest = counts.max(axis=1)
        return float(1 - counts.sum() / (longest * share).sum())

    def _index(self, position: int) -> tuple[int, int]:
        """Epoch and dataset index at that position of the endless sequence of epochs."""
        epoch, place = divmod(position, len(self.dataset))
        return epoch, int(self.order(epoch)[place])

    def _example(self, position: int, damaged: dict[str, str]) -> Batch:
        """The example at that position; in the place of a damaged sample, the next in the epoch's order that is not."""
        epoch, place = divmod(position, len(self.dataset))
        order = self.order(epoch)
        for ahead in range(min(len(order), MOST_DAMAGED)):
            index = int(order[(place + ahead) % len(order)])
            try:
                return self._augmented(index, epoch)
            except DamagedSample as error:
                damaged[self.dataset.ids[index]] = str(error)
        raise UserError(f"{len(damaged)} samples in a row cannot be read, the last because {list(damaged.values())[-1]}")

    def _augmented(self, index: int, epoch: int) -> Batch:
        config, row = self.config, self.dataset.row(index)
        rng = np.random.default_rng(seed_for(config.seed, "augment", f"{epoch}/{row['id']}"))
        kept_views, view_count = np.array(row["views"]), config.views_per_scene
        views = rng.choice(kept_views, size=view_count, replace=view_count > len(kept_views))
        sample = self.dataset.read(index, views, self.needs.layers, None, self.needs.guides)
        factors = draw_light_factors(config.lighting, rng, sample.scene.n_lights) if config.relight else None
        example = make_example(sample, views, factors, self.needs.layers)
        if config.mirror and rng.random() < 0.5:
            example = mirror(example)
        if config.rotate or config.translate_sigma:
            vector = rng.normal(size=3) if config.rotate else np.zeros(3)
            example = move(example, rotation_from_vector(vector), rng.normal(size=3) * config.translate_sigma)
        if config.exposure_stops:
            example = expose(example, 2.0 ** rng.uniform(-config.exposure_stops, config.exposure_stops))
        if config.bundles_per_view:
            total = (self.dataset.resolution // self.needs.bundle) ** 2
            count = min(config.bundles_per_view, total)
            chosen = np.stack([choose(rng, landed, count) for landed in landed_bundles(example, self.needs.bundle, total)])
            example = take_bundles(example, chosen, self.needs.bundle)
        return example


def landed_bundles(example: Batch, side: int, total: int) -> np.ndarray:
    """(V, K = ``total``) bool: which of a view's bundles of side x side pixels hit anything; all, where there are no guides."""
    main = example.get(f"{GUIDE}main")
    if main is None:
        return np.ones((len(example["views"]), total), bool)
    views, height, width = main.shape
    return (main >= 0).reshape(views, height // side, side, width // side, side).any(axis=(2, 4)).reshape(views, total)


def choose(rng: np.random.Generator, landed: np.ndarray, count: int) -> np.ndarray:
    """(count,) sorted numbers of bundles: of those that hit something, as far as they go. The others are black, whatever a
    network says, so they teach nothing."""
    there = rng.permutation(np.flatnonzero(landed))[:count]
    others = rng.permutation(np.flatnonzero(~landed))[: count - len(there)]
    return np.sort(np.concatenate([there, others]))


def evaluation_samples(dataset: ShardDataset, guides: bool = False) -> Iterator[Batch]:
    """One scene at a time with all its kept views, exactly as stored, and the direct light beside it; guides if wanted."""
    for index in range(len(dataset)):
        sample = dataset.read(index, layers=("direct",), guides=guides)
        yield collate([make_example(sample, np.array(sorted(sample.views)), None, ("direct",))], 1)


# --- workers ----------------------------------------------------------------------------------------------------------


def prefetch(
    batches: Callable[[int], Batch], start: int, stop: int | None, ahead: int = 2, workers: int = 0
) -> Iterator[Batch]:
    """The batches of steps ``start`` .. ``stop`` - 1 (None: without end) in order, prepared up to ``ahead`` steps early.

    By threads of this process, which is enough for few cores (OpenEXR, zlib and numpy release Python's lock while they work),
    or by ``workers`` processes, which also share what is left of Python (docs/dataset.md has the figures).
    """
    return _by_processes(batches, start, stop, ahead, workers) if workers else _by_threads(batches, start, stop, ahead)


def _steps(start: int, stop: int | None) -> Iterator[int]:
    step = start
    while stop is None or step < stop:
        yield step
        step += 1


def _by_threads(batches: Callable[[int], Batch], start: int, stop: int | None, ahead: int) -> Iterator[Batch]:
    pool = ThreadPoolExecutor(max_workers=max(1, ahead), thread_name_prefix="prefetch")
    try:
        waiting: deque = deque()
        for step in _steps(start, stop):
            waiting.append(pool.submit(batches, step))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


class _Steps:
    """``batches`` as a map-style dataset over steps, for torch's DataLoader; arrays travel as tensors, in shared memory."""

    def __init__(self, batches: Callable[[int], Batch]):
        self.batches = batches

    def __getitem__(self, step: int) -> tuple[Batch, str | None]:
        import torch

        try:
            batch = self.batches(step)
        except UserError as error:  # DataLoader would bury it in the worker's traceback
            return {}, str(error)
        arrays = {name: torch.from_numpy(value) for name, value in batch.items() if isinstance(value, np.ndarray)}
        return {**batch, **arrays}, None


class _Sampler:
    def __init__(self, start: int, stop: int | None):
        self.start, self.stop = start, stop

    def __iter__(self) -> Iterator[int]:
        return _steps(self.start, self.stop)


def _by_processes(batches: Callable[[int], Batch], start: int, stop: int | None, ahead: int, workers: int) -> Iterator[Batch]:
    import torch
    from torch.utils.data import DataLoader

    dataset = getattr(batches, "dataset", None)
    cache_bytes = getattr(dataset, "cache_bytes", 0)
    if dataset is not None:
        dataset.cache_bytes = cache_bytes // workers  # every process has its own
    try:
        rows = iter(
            DataLoader(
                _Steps(batches),  # type: ignore[arg-type]
                batch_size=None,
                collate_fn=_as_it_is,
                sampler=_Sampler(start, stop),  # type: ignore[arg-type]
                num_workers=workers,
                prefetch_factor=max(1, -(-ahead // workers)),
                worker_init_fn=_one_thread,
            )
        )
    finally:
        if dataset is not None:
            dataset.cache_bytes = cache_bytes
    for batch, error in rows:
        if error is not None:
            raise UserError(error)
        yield {name: value.numpy() if isinstance(value, torch.Tensor) else value for name, value in batch.items()}


def _as_it_is(batch: Any) -> Any:
    return batch


def _one_thread(worker: int) -> None:
    import torch

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"
