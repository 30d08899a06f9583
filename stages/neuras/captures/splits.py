"""Which frames are learned from, and which are held out."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.keys import seed_for
from stages.neuras.records import Split

RuleName = Literal["auto", "every_other", "every_nth", "random_half"]
VALIDATION_EVERY = 5  # training moments; the middle one of each run of these
HELD_OUT_VALIDATION = 10  # held-out moments, likewise, where training is thin


@dataclass(frozen=True)
class Rule:
    """name "auto": the names that the set gives, else every_other. seed: of random_half. nth: of every_nth."""

    name: RuleName = "auto"
    seed: int = 0
    nth: int = 8


def kept(named: Sequence[Split | None], every: int) -> list[int]:
    """Indices of every ``every``-th frame; where the set names splits, of each split by itself."""
    seen: dict[Split | None, int] = {}
    found = []
    for index, split in enumerate(named):
        number = seen.get(split, 0)
        seen[split] = number + 1
        if number % every == 0:
            found.append(index)
    return found


def assigned(moments: Sequence[Hashable], named: Sequence[Split | None], rule: Rule) -> tuple[list[Split], str]:
    """The split of each frame, and the rule in words. Frames of one moment, of several cameras say, share their split.

    Validation comes from training frames where the set names none; with every_nth, which leaves few, from held-out ones.
    """
    if rule.name == "auto" and any(named):
        splits: list[Split] = [split or "train" for split in named]
        said = "train and test as the set names them"
    else:
        order = list(dict.fromkeys(moments))
        test, said = _held_out(order, rule)
        splits = ["test" if moment in test else "train" for moment in moments]
    if "validation" in splits:
        return splits, said + ", and so is validation"
    thin = rule.name == "every_nth"
    source, step = ("test", HELD_OUT_VALIDATION) if thin else ("train", VALIDATION_EVERY)
    candidates = list(dict.fromkeys(moment for moment, split in zip(moments, splits, strict=True) if split == source))
    chosen = set(candidates[step // 2 :: step])
    pairs = zip(moments, splits, strict=True)
    splits = ["validation" if split == source and moment in chosen else split for moment, split in pairs]
    return splits, said + f", every {'tenth held-out' if thin else 'fifth training'} frame is validation"


def _held_out(order: Sequence[Hashable], rule: Rule) -> tuple[set[Hashable], str]:
    """The moments that are test, and the rule in words."""
    if rule.name == "random_half":
        chosen = np.random.default_rng(seed_for(rule.seed, "capture", "split")).permutation(len(order))[: len(order) // 2]
        return {order[index] for index in chosen}, f"a random half is test (seed {rule.seed})"
    if rule.name == "every_nth":
        return set(order) - set(order[:: rule.nth]), f"one frame in {rule.nth} is for training, the rest is test"
    return set(order[1::2]), "every other frame is test"
