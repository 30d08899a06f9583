"""Vector quantization: each texel's feature is replaced by its nearest code (section 3.2, eq. 5 and 9)."""

from __future__ import annotations

import torch
from torch import Tensor

BLOCK = 512  # rows whose scores fit a core's cache: 512 x 1024 floats are 2 MB
GROUP = 32  # codes whose scores are compared in one vector instruction after another


def nearest(rows: Tensor, codes: Tensor) -> Tensor:
    """(N,) int64: the nearest of ``codes`` (K, D) for each of ``rows`` (N, D).

    arg-max of x.c - |c|^2 / 2. On a CPU block by block into one buffer, because allocating is most of the time, and in two
    steps, the largest of each residue modulo ``GROUP`` first, because that is vectorized and an arg-max is not.
    """
    rows, codes = rows.detach(), codes.detach()
    offset = -0.5 * codes.square().sum(dim=1)
    if rows.device.type != "cpu":
        return torch.cat([torch.addmm(offset, part, codes.T).argmax(dim=1) for part in rows.split(1 << 18)])
    missing = -len(codes) % GROUP
    transposed = torch.nn.functional.pad(codes, (0, 0, 0, missing)).T.contiguous()
    offset = torch.nn.functional.pad(offset, (0, missing), value=-torch.inf)
    found = torch.empty(len(rows), dtype=torch.int64)
    buffer = torch.empty(BLOCK, len(offset))
    for first in range(0, len(rows), BLOCK):
        part = rows[first : first + BLOCK]
        scores = torch.addmm(offset, part, transposed, out=buffer[: len(part)]).view(len(part), -1, GROUP)
        residue = scores.amax(dim=1).argmax(dim=1)
        of_residue = scores.gather(2, residue[:, None, None].expand(-1, scores.shape[1], 1))[:, :, 0]
        found[first : first + BLOCK] = of_residue.argmax(dim=1) * GROUP + residue
    return found


def straight_through(features: Tensor, codes: Tensor, commitment: float) -> tuple[Tensor, Tensor]:
    """Quantized features (N, D), whose gradient goes to ``features`` as if nothing had happened, and the loss of eq. 9.

    The loss, a mean over rows, pulls codes to features (alignment) and, ``commitment`` times, features to codes.
    """
    chosen = torch.nn.functional.embedding(nearest(features, codes), codes)
    alignment = (features.detach() - chosen).square().sum(dim=1).mean()
    pull = (chosen.detach() - features).square().sum(dim=1).mean()
    return features + (chosen - features).detach(), alignment + commitment * pull


def clusters(rows: Tensor, count: int, rounds: int, generator: torch.Generator) -> Tensor:
    """(K, D) codes to start from: ``rounds`` of k-means over ``rows`` (N, D), from rows drawn at random.

    A code without rows moves to a random row.
    """

    def drawn() -> Tensor:
        return rows[torch.randint(len(rows), (count,), generator=generator).to(rows.device)]

    codes = drawn()
    for _ in range(rounds):
        chosen = nearest(rows, codes)
        members = torch.bincount(chosen, minlength=count).unsqueeze(1)
        sums = torch.zeros_like(codes).index_add_(0, chosen, rows)
        codes = torch.where(members > 0, sums / members.clamp(min=1), drawn())
    return codes
