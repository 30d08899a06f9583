"""Random numbers of the path tracer: Owen-scrambled Sobol points, padded two dimensions at a time, in Dr.Jit.

A number is a function of (key, index, dimension) alone, so there is no state to carry, and any part of a sequence can be
had on its own. The points of one key fill each pair of dimensions evenly at every power of two; pairs are independent of
each other, and so are keys. After Burley, "Practical Hash-based Owen Scrambling" (JCGT 2020), with Vegdahl's hash.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mixed(x: mi.UInt32) -> mi.UInt32:
    """A hash of 32 bits to 32 bits, one to one (lowbias32)."""
    x ^= x >> 16
    x *= 0x7FEB352D
    x ^= x >> 15
    x *= 0x846CA68B
    return x ^ (x >> 16)


def _scrambled_reversed(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen scrambling of a number whose bits are reversed: each bit is flipped as the bits below it say."""
    x ^= x * 0x3D20ADEA
    x += seed
    x *= (seed >> 16) | 1
    x ^= x * 0x05526C56
    return x ^ (x * 0x53A22864)


def _second_dimension(x: mi.UInt32) -> mi.UInt32:
    """The second Sobol coordinate of the index whose reversed bits are ``x``.

    The index read as a polynomial over GF(2), taken at z + 1 instead of z; (z + 1)^s = z^s + 1 where s is a power of two.
    """
    for shift, low in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x ^= (x & low) << shift
    return x


def _unit(x: mi.UInt32) -> mi.Float:
    return mi.Float(x >> 8) * 2.0**-24


class Sampler:
    """The points ``index`` of the sequences of ``key``; numbers in [0, 1)."""

    def __init__(self, key: mi.UInt32, index: mi.UInt32):
        self.key, self.reversed = key, dr.brev(index)

    def _shuffled(self, dimension: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        seed = mixed(self.key + mi.UInt32(dimension) * 0x9E3779B9)
        return seed, _scrambled_reversed(mi.UInt32(self.reversed), seed)

    def one(self, dimension: mi.UInt32) -> mi.Float:
        seed, x = self._shuffled(dimension)
        return _unit(dr.brev(_scrambled_reversed(dr.brev(x), mixed(seed ^ 0x68BC21EB))))

    def two(self, dimension: mi.UInt32) -> mi.Point2f:
        seed, x = self._shuffled(dimension)
        first = dr.brev(_scrambled_reversed(dr.brev(x), mixed(seed ^ 0x68BC21EB)))
        second = dr.brev(_scrambled_reversed(dr.brev(_second_dimension(mi.UInt32(x))), mixed(seed ^ 0x02E5BE93)))
        return mi.Point2f(_unit(first), _unit(second))
