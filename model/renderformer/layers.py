"""The transformer's parts: encodings, rotary positions, attention, feed-forward (sections 3.1 and 3.2).

Attribute names are the released parameter names, so a state dict *is* a released checkpoint. Scenes of different size are
packed one after the other, never padded: every token is real, and attention runs scene by scene through
``scaled_dot_product_attention`` without a mask, which leaves the choice of the fastest kernel to the device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

EMBEDDING_EPS = torch.finfo(torch.float32).eps  # RMSNorms of the texture, normal, ray and position embeddings
LAYER_EPS = 1e-6  # every other RMSNorm

Rotation = tuple[Tensor, Tensor]  # cos and sin, each (..., tokens, head_dim / 2)
KeysValues = tuple[Tensor, Tensor]  # of the cross-attention, each (V or 1, heads, S, head_dim)


class RMSNorm(nn.RMSNorm):
    """In the weight's float32 also where autocast made the input bfloat16: exact, and fused into one kernel."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.to(self.weight.dtype))


def sinusoids(x: Tensor, n_freqs: int) -> Tensor:
    """(..., C) -> (..., C (1 + 2 n)): x, sin(f x), sin(f x + pi/2) for f = 2^0..2^(n-1), each value-major."""
    freqs = 2.0 ** torch.arange(n_freqs, device=x.device, dtype=x.dtype)
    angles = (x[..., None] * freqs).flatten(-2)
    return torch.cat([x, torch.sin(angles), torch.sin(angles + torch.pi / 2)], dim=-1)


class RotaryFrequencies(nn.Module):
    """The stored frequencies of the triangle rotary encoding: n/2 of them, log-spaced from 1."""

    def __init__(self, n: int, double_max: bool):
        super().__init__()
        top = n - 1 if double_max else n // 2 - 1
        self.register_buffer("freqs", 2.0 ** torch.linspace(0, math.log2(top), n // 2))

    def forward(self, positions: Tensor, head_dim: int) -> Rotation:
        """positions: (..., S, 9) vertex coordinates -> cos and sin (..., S, head_dim / 2), zero angles at the end."""
        angles = (positions[..., None].float() * self.freqs.float()).flatten(-2)
        angles = F.pad(angles, (0, head_dim // 2 - angles.shape[-1]))
        return angles.cos(), angles.sin()


def rotate(x: Tensor, rotation: Rotation | None) -> Tensor:
    """Turn (..., S, head_dim) by the angles of ``rotation``, in the half-split form."""
    if rotation is None:
        return x
    cos, sin = rotation
    a, b = x.chunk(2, dim=-1)
    return torch.cat([a * cos - b * sin, b * cos + a * sin], dim=-1)


def split_heads(x: Tensor, heads: int) -> Tensor:
    """(..., S, d) -> (..., heads, S, d / heads)."""
    return x.unflatten(-1, (heads, -1)).transpose(-3, -2)


def merge_heads(x: Tensor) -> Tensor:
    """(..., heads, S, d / heads) -> (..., S, d)."""
    return x.transpose(-3, -2).flatten(-2)


class Segments:
    """Where each of B sequences lies in a packed row of tokens: ``lengths``, in order.

    A plain object on purpose: compiled layers hand it on without looking inside, so that other lengths do not compile again.
    """

    def __init__(self, lengths: Sequence[int]):
        self.lengths = tuple(lengths)

    def __len__(self) -> int:
        return len(self.lengths)

    def split(self, x: Tensor, dim: int) -> tuple[Tensor, ...]:
        """One view per sequence."""
        return x.split(self.lengths, dim)

    def index(self, device: torch.device | None = None) -> Tensor:
        """(S,) int64: which sequence each token belongs to."""
        lengths = torch.tensor(self.lengths, device=device)
        return torch.arange(len(self), device=device).repeat_interleave(lengths, output_size=sum(self.lengths))


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """Attention of (B, heads, Q, c) to (B, heads, K, c); the encodings may be float32 while the values are not."""
    return F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, attn_mask=mask)


@torch.compiler.disable
def attend_packed(q: Tensor, k: Tensor, v: Tensor, segments: Segments) -> Tensor:
    """Attention within each sequence of packed (heads, S, c) tokens.

    One unmasked call per sequence: a mask, or padding, would keep the device from its fastest kernel and make it compute
    what is thrown away, and sequences of a thousand tokens keep a device busy one by one.
    """
    parts = zip(*(segments.split(x, 1) for x in (q, k, v)), strict=True)
    outputs = [attend(a[None], b[None], c[None])[0] for a, b, c in parts]
    return outputs[0] if len(outputs) == 1 else torch.cat(outputs, dim=1)


@torch.compiler.disable
def attend_across(q: Tensor, k: Tensor, v: Tensor, segments: Segments) -> Tensor:
    """Attention of rays (B V, heads, T, c) to their scene's packed tokens: k, v (V, heads, S, c), or 1 for V alike."""
    views = len(q) // len(segments)
    parts = zip(q.split(views), segments.split(k, 2), segments.split(v, 2), strict=True)
    outputs = [attend(a, *(x.expand(views, -1, -1, -1) for x in (b, c))) for a, b, c in parts]
    return outputs[0] if len(outputs) == 1 else torch.cat(outputs)


class SelfAttention(nn.Module):
    """Attention among tokens, with q and k normalised over the full width before the heads split."""

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.heads = heads
        self.in_proj = nn.Linear(dim, 3 * dim, bias=False)
        self.q_norm = RMSNorm(dim, LAYER_EPS)
        self.k_norm = RMSNorm(dim, LAYER_EPS)
        self.out_proj = nn.Linear(dim, dim, bias=False)

    def forward(
        self, x: Tensor, rotation: Rotation | None = None, segments: Segments | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """x: packed (S, d) with ``segments``, or (B, S, d) with a mask (B, 1, S, S) or none.

        rotation: cos and sin, (1, S, c / 2) or (B, 1, S, c / 2).
        """
        q, k, v = self.in_proj(x).chunk(3, dim=-1)
        q = rotate(split_heads(self.q_norm(q), self.heads), rotation)
        k = rotate(split_heads(self.k_norm(k), self.heads), rotation)
        v = split_heads(v, self.heads)
        return self.out_proj(merge_heads(attend(q, k, v, mask) if segments is None else attend_packed(q, k, v, segments)))


class CrossAttention(nn.Module):
    """Attention of ray tokens to triangle tokens. Keys and values depend on the scene only: project them once."""

    def __init__(self, dim: int, heads: int):
        super().__init__()
        self.heads = heads
        self.q_proj = nn.Linear(dim, dim, bias=False)
        self.k_proj = nn.Linear(dim, dim, bias=False)
        self.v_proj = nn.Linear(dim, dim, bias=False)
        self.q_norm = RMSNorm(dim, LAYER_EPS)
        self.k_norm = RMSNorm(dim, LAYER_EPS)
        self.out_proj = nn.Linear(dim, dim, bias=False)

    def keys_values(self, tokens: Tensor) -> KeysValues:
        """(V or 1, S, d), already normalised -> keys, not yet rotated, and values, each (V or 1, heads, S, c)."""
        return split_heads(self.k_norm(self.k_proj(tokens)), self.heads), split_heads(self.v_proj(tokens), self.heads)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, rotation: Rotation | None, segments: Segments) -> Tensor:
        """x: (B V, T, d) rays, already normalised; keys (rotated), values: (V or 1, heads, S, c); rotation: the rays'."""
        q = rotate(split_heads(self.q_norm(self.q_proj(x)), self.heads), rotation)
        return self.out_proj(merge_heads(attend_across(q, keys, values, segments)))


class FeedForward(nn.Module):
    """SwiGLU: w2(silu(w1 x) * w3 x)."""

    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.w1 = nn.Linear(dim, hidden, bias=False)
        self.w2 = nn.Linear(hidden, dim, bias=False)
        self.w3 = nn.Linear(dim, hidden, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if torch.is_grad_enabled():
            return self.w2(F.silu(self.w1(x)) * self.w3(x))
        hidden = self.w1(x)  # in place: fresh memory of this size costs a CPU as much time as the arithmetic
        return self.w2(F.silu(hidden, inplace=True).mul_(self.w3(x)))


class EncoderLayer(nn.Module):
    """Section 3, item 5: pre-norm self-attention, then feed-forward."""

    def __init__(self, dim: int, heads: int, hidden: int):
        super().__init__()
        self.query_norm = RMSNorm(dim, LAYER_EPS)
        self.multihead_attn = SelfAttention(dim, heads)
        self.ffn_norm = RMSNorm(dim, LAYER_EPS)
        self.ffn = FeedForward(dim, hidden)

    def forward(self, x: Tensor, rotation: Rotation | None, segments: Segments) -> Tensor:
        x = x + self.multihead_attn(self.query_norm(x), rotation, segments)
        return x + self.ffn(self.ffn_norm(x))


class Windows:
    """Swin's partition of a grid of h x w tokens into 8 x 8 windows, shifted by 4 or not, as a permutation of tokens."""

    SIZE, SHIFT = 8, 4

    def __init__(self, h: int, w: int, shifted: bool, device: torch.device):
        size, shift = self.SIZE, self.SHIFT if shifted else 0
        index = torch.arange(h * w, device=device).view(h, w).roll((-shift, -shift), dims=(0, 1))
        self.order = self._partition(index).flatten()  # token that sits at each place of each window
        self.inverse = self.order.argsort()
        self.mask = None
        if shifted:  # tokens that met by wrapping around do not see one another
            rows, columns = (
                (torch.arange(n, device=device) >= n - size).int() + (torch.arange(n, device=device) >= n - shift).int()
                for n in (h, w)
            )
            region = self._partition(rows[:, None] * 3 + columns[None, :])
            self.mask = (region[:, None, :] == region[:, :, None])[:, None]  # (windows, 1, 64, 64)

    def _partition(self, grid: Tensor) -> Tensor:
        """(h, w) -> (windows, 64)."""
        h, w = grid.shape
        size = self.SIZE
        return grid.view(h // size, size, w // size, size).transpose(1, 2).reshape(-1, size * size)

    def apply(self, attention: SelfAttention, x: Tensor) -> Tensor:
        """Self-attention of (B, h w, d) within each window; no rotary: position is left to the rays."""
        batch, tokens, dim = x.shape
        windows = x[:, self.order].view(-1, self.SIZE**2, dim)
        mask = None if self.mask is None else self.mask.repeat(batch, 1, 1, 1)
        return attention(windows, mask=mask).view(batch, tokens, dim)[:, self.inverse]


class DecoderLayer(nn.Module):
    """Section 3, item 7: cross-attention to triangles, self-attention among rays, feed-forward."""

    def __init__(self, dim: int, heads: int, hidden: int, self_attention: bool):
        super().__init__()
        self.query_norm = RMSNorm(dim, LAYER_EPS)
        self.kv_norm = RMSNorm(dim, LAYER_EPS)
        self.multihead_attn = CrossAttention(dim, heads)
        if self_attention:
            self.self_attn_norm = RMSNorm(dim, LAYER_EPS)
            self.self_attn = SelfAttention(dim, heads)
        else:
            self.self_attn = None
        self.ffn_norm = RMSNorm(dim, LAYER_EPS)
        self.ffn = FeedForward(dim, hidden)

    def keys_values(self, tokens: Tensor) -> KeysValues:
        """What the rays attend to, from the scenes' tokens (V or 1, S, d)."""
        return self.multihead_attn.keys_values(self.kv_norm(tokens))

    def forward(
        self, x: Tensor, tokens: Tensor | KeysValues, key_rotation: Rotation | None, ray_rotation: Rotation | None,
        segments: Segments, windows: Windows | None,
    ) -> Tensor:  # fmt: skip
        """x: (B V, T, d) rays; tokens: the scenes' (V or 1, S, d), or what ``keys_values`` made of them."""
        keys, values = self.keys_values(tokens) if isinstance(tokens, Tensor) else tokens
        x = x + self.multihead_attn(self.query_norm(x), rotate(keys, key_rotation), values, ray_rotation, segments)
        if self.self_attn is not None:
            # All rays of a view share one position, and rotary attention only sees differences: nothing to turn here.
            y = self.self_attn_norm(x)
            x = x + (self.self_attn(y) if windows is None else windows.apply(self.self_attn, y))
        return x + self.ffn(self.ffn_norm(x))
