"""The normaliser of a few channels in NumPy: for few numbers, torch's overhead per call dominates."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped

if TYPE_CHECKING:
    from jaxtyping import Float64
    from numpy import ndarray

__all__ = ["is_few", "log_partition_and_slopes"]

_FEW = 64
"""Channels up to which NumPy is faster than torch."""

_SERIES = tuple((-1) ** n / (math.factorial(n) * (n + 2)) for n in range(8))
"""Coefficients of ``(1 - exp(-x) (1 + x)) / x²``, accurate to all digits for x below 0.05."""


def is_few(*values: Tensor) -> bool:
    """Whether these are plain tensors of few numbers on the CPU: not of a subclass, not under a function transform."""
    return all(
        type(value) is Tensor and value.device.type == "cpu" and value.numel() <= _FEW and not is_wrapped(value)
        for value in values
    )


def log_partition_and_slopes(
    kappa: Float64[ndarray, "*m"],
    length: Float64[ndarray, "*m"],
    nodes: Float64[ndarray, " q"],
    weights: Float64[ndarray, " q"],
    tolerance: float,
) -> tuple[Float64[ndarray, "*m"], Float64[ndarray, "*m"], Float64[ndarray, "*m"]]:
    """``log Z`` and its derivatives by kappa and by length; see :func:`mkc_torch.functional.log_partition`.

    Args:
        kappa, length: 1/σ² and half-width of the domain over d, of each channel.
        nodes, weights: quadrature rule of the head.
        tolerance: excess of the density over its flat tail at the end of the head.
    """
    positive = kappa > 1e-3
    safe = np.where(positive, kappa, 1.0)
    tail = np.where(positive, np.exp(-1.0 / safe), 0.0)
    least = np.maximum(kappa, 1e-3)
    reach = np.sqrt(-2.0 * np.log(least * np.logaddexp(0.0, 1.0 / least + math.log(tolerance))) / least)
    end = np.clip(length, -reach, reach)[..., None]
    share = end * weights
    q = 0.5 * (end * nodes) ** 2
    own = kappa[..., None]
    x = own * q
    density = np.exp(-_energy(q, x, own))
    small = x < 0.05
    direct = np.where(small, 1.0, x)
    curve = (1.0 - np.exp(-direct) * (1.0 + direct)) / direct**2
    if small.any():
        near = np.where(small, x, 0.0)
        series = _SERIES[-1]
        for coefficient in _SERIES[-2::-1]:
            series = coefficient + near * series
        curve = np.where(small, series, curve)
    z = 2.0 * length * tail + (share * (density - tail[..., None])).sum(-1)
    slope = tail / safe**2
    by_kappa = (2.0 * length * slope + (share * (q * q * curve * density - slope[..., None])).sum(-1)) / z
    half = 0.5 * length * length
    by_length = 2.0 * np.exp(-_energy(half, kappa * half, kappa)) / z
    return np.log(z), by_kappa, by_length


def _energy(q: ndarray, x: ndarray, kappa: ndarray) -> ndarray:
    """``(1 - exp(-x)) / kappa`` with ``x = kappa q``; q where x is 0."""
    return np.where(x > 0, -np.expm1(-x) / np.where(kappa > 0, kappa, 1.0), q)
