"""Random sets of samples from a counter-based hash of the seed: the same on every device, in every chunk and batch.

Number k of set s is a function of (seed, s, k) alone, by the mixing function of splitmix64 (Steele, Lea & Flood, "Fast
splittable pseudorandom number generators", OOPSLA 2014). All problems have the same sets, so that the result of a
problem does not depend on the batch that it is in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

_STEP, _FIRST, _SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_ORIGIN = 1
"""Added to the seed, so that the state of seed 0 is not 0."""

_BITS = 31
"""Bits of a hash that become a number below a limit."""


def _signed(value: int) -> int:
    """A 64-bit pattern as torch's signed integer."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value


def _shifted(z: Tensor, bits: int) -> Tensor:
    """Logical shift to the right; that of signed integers copies the sign."""
    return (z >> bits) & ((1 << (64 - bits)) - 1)


def mixed(z: Int[Tensor, "*shape"]) -> Int[Tensor, "*shape"]:
    """splitmix64's output for the states ``z``, as signed 64-bit integers."""
    z = z * _signed(_STEP) + _signed(_STEP)
    z = (z ^ _shifted(z, 30)) * _signed(_FIRST)
    z = (z ^ _shifted(z, 27)) * _signed(_SECOND)
    return z ^ _shifted(z, 31)


def _hashes(seed: int, sets: int, size: int, device: torch.device) -> Int[Tensor, "sets size"]:
    first = mixed(torch.arange(sets, device=device).unsqueeze(-1) + _signed((seed + _ORIGIN) * _SECOND))
    return mixed(first ^ torch.arange(size, device=device))


def drawn_sets(
    seed: int, sets: int, size: int, limit: int | Int[Tensor, " B"], device: torch.device
) -> Int[Tensor, "*B sets size"]:
    """Sets of ``size`` distinct numbers below ``limit``, each set with the same probability (Floyd's algorithm).

    Args:
        seed: whole number.
        sets: number of sets.
        size: numbers of a set; where ``limit`` is smaller, numbers occur more than once.
        limit: a number, or one for each of B problems.
        device: device of the result.
    """
    parts = _shifted(_hashes(seed, sets, size, device), 64 - _BITS)
    end = torch.as_tensor(limit, device=device).unsqueeze(-1) if isinstance(limit, Tensor) else limit
    found: list[Tensor] = []
    for k in range(size):
        last = end - size + k
        last = last.clamp(min=0) if isinstance(last, Tensor) else max(last, 0)
        number = (parts[:, k] * (last + 1)) >> _BITS
        for earlier in found[:]:
            number = torch.where(number == earlier, last, number)
        found.append(number)
    return torch.stack(found, -1)


def drawn_of_used(
    seed: int, sets: int, size: int, used: Bool[Tensor, "B K"] | None, count: int, device: torch.device
) -> Int[Tensor, "*B sets size"]:
    """Sets of indices of ``count`` values, of those in use only: (sets, size), or (B, sets, size) with a mask."""
    if used is None:
        return drawn_sets(seed, sets, size, count, device)
    rank = drawn_sets(seed, sets, size, used.sum(-1), device)
    places = (~used).to(torch.uint8).argsort(dim=-1, stable=True)
    return places.gather(-1, rank.flatten(1)).view_as(rank)


def drawn_samples(seed: int, count: int, number: int, device: torch.device) -> Int[Tensor, " count"]:
    """``count`` of ``number`` samples in ascending order."""
    keys = _hashes(seed, 1, number, device)[0]
    return keys.argsort()[:count].sort().values
