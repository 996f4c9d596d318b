"""The normaliser of the density in NumPy, for a few channels, where torch's overhead per call would dominate."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.density.energy import curve_array, energy_array

if TYPE_CHECKING:
    from jaxtyping import Float64
    from numpy import ndarray

_FEW = 64
"""Channels up to which NumPy is faster than torch."""


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
    density = np.exp(-energy_array(q, x, own))
    curve = curve_array(x)
    z = 2.0 * length * tail + (share * (density - tail[..., None])).sum(-1)
    slope = tail / safe**2
    by_kappa = (2.0 * length * slope + (share * (q * q * curve * density - slope[..., None])).sum(-1)) / z
    half = 0.5 * length * length
    by_length = 2.0 * np.exp(-energy_array(half, kappa * half, kappa)) / z
    return np.log(z), by_kappa, by_length
