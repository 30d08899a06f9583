"""The decoder of the token probe: cross-attention to the registers, then an MLP, from a token to a texture."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pipeline.keys import seed_for

HEADS = 4


def kept_texels(size: int) -> np.ndarray:
    """(P, P) bool: texels of a patch that belong to the triangle."""
    return np.add.outer(np.arange(size), np.arange(size)) <= size


class Decoder(nn.Module):
    """Tokens (T, d) and the registers of their scenes (T, R, d) -> log10(1 + radiance) of the kept texels (T, K, 3)."""

    def __init__(self, dim: int, width: int, texels: int):
        super().__init__()
        self.token_norm, self.register_norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attention = nn.MultiheadAttention(dim, HEADS if dim % HEADS == 0 else 1, batch_first=True)
        self.mlp = nn.Sequential(
            nn.LayerNorm(dim), nn.Linear(dim, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 3 * texels),
        )  # fmt: skip
        # all texels start alike, or their random weights would stay visible as grain
        nn.init.zeros_(self.mlp[-1].weight)

    def forward(self, tokens: Tensor, registers: Tensor) -> Tensor:
        x = self.token_norm(tokens)
        if registers.shape[1]:
            keys = self.register_norm(registers)
            x = x + self.attention(x[:, None], keys, keys, need_weights=False)[0][:, 0]
        return self.mlp(x).unflatten(-1, (-1, 3))


def fit_decoder(samples: list[tuple[Tensor, Tensor, dict[str, np.ndarray]]], config: Any) -> Decoder:
    """Fitted to the scenes' (registers (R, d), triangles (F, d), recorded truth); a function of its arguments."""
    kept = kept_texels(config.size)
    columns: list[list[Tensor]] = [[], [], [], []]
    for registers, triangles, truth in samples:
        use = truth["met"].any(axis=(1, 2))
        faces = torch.from_numpy(truth["faces"][use].astype(np.int64))
        values = (
            triangles[faces],
            registers.expand(len(faces), -1, -1),
            torch.from_numpy(truth["radiance"][use][:, kept].astype(np.float32)),
            torch.from_numpy(truth["met"][use][:, kept]),
        )
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    tokens, registers, target, met = (torch.cat(column) for column in columns)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_for(config.seed, "probe/tokens", "decoder") % 2**31)
        decoder = Decoder(tokens.shape[1], config.width, target.shape[1])
        optimizer = torch.optim.AdamW(decoder.parameters(), lr=config.lr, weight_decay=0.01)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.lr, total_steps=config.steps + 1, pct_start=0.1)
        for _ in range(config.steps):
            chosen = torch.randint(len(tokens), (min(config.batch, len(tokens)),))
            valid = met[chosen][..., None]
            loss = ((decoder(tokens[chosen], registers[chosen]) - target[chosen]).abs() * valid).sum() / (3 * valid.sum())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return decoder.eval()


@torch.no_grad()
def decode(decoder: Decoder, registers: Tensor, triangles: Tensor, faces: np.ndarray, size: int) -> np.ndarray:
    """(T, P, P, 3) float32 log10(1 + radiance) of the triangles ``faces``."""
    chosen = triangles[torch.from_numpy(faces.astype(np.int64))]
    out = np.zeros((len(faces), size, size, 3), np.float32)
    out[:, kept_texels(size)] = decoder(chosen, registers.expand(len(faces), -1, -1)).clamp(min=0).numpy()
    return out
