"""Which frames are learned from, and which are held out."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Literal

import numpy as np

from pipeline.keys import seed_for
from stages.neuras.records import Split

Rule = Literal["auto", "every_other", "random_half"]
VALIDATION_EVERY = 5  # training moments; the middle one of each run of these


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


def assigned(moments: Sequence[Hashable], named: Sequence[Split | None], rule: Rule, seed: int) -> tuple[list[Split], str]:
    """The split of each frame, and the rule in words. Frames of one moment, of several cameras say, share their split.

    ``rule`` "auto": the names that the set gives, else every other moment.
    """
    splits: list[Split]
    if rule == "auto" and any(named):
        splits = [split or "train" for split in named]
        said = "train and test as the set names them"
    else:
        order = list(dict.fromkeys(moments))
        if rule == "random_half":
            chosen = np.random.default_rng(seed_for(seed, "capture", "split")).permutation(len(order))[: len(order) // 2]
            test = {order[index] for index in chosen}
            said = f"a random half is test (seed {seed})"
        else:
            test = set(order[1::2])
            said = "every other frame is test"
        splits = ["test" if moment in test else "train" for moment in moments]
    if "validation" in splits:
        return splits, said + ", and so is validation"
    training = list(dict.fromkeys(moment for moment, split in zip(moments, splits, strict=True) if split == "train"))
    chosen = set(training[VALIDATION_EVERY // 2 :: VALIDATION_EVERY])
    pairs = zip(moments, splits, strict=True)
    splits = ["validation" if split == "train" and moment in chosen else split for moment, split in pairs]
    return splits, said + ", every fifth training frame is validation"
