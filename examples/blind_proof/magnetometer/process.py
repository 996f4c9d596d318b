"""Autoregressive processes and random walks: coefficients, draws, and whitening by a Kalman filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import unit_variance

if TYPE_CHECKING:
    from jaxtyping import Float


_BURN_IN = 1000


@dataclass(frozen=True)
class Process:
    """``x[k] = Σ coefficients[j] x[k-1-j] + innovation · e[k]``, e of variance 1.

    A random walk has the coefficient 1 and begins at 0; any other process is stationary.
    """

    coefficients: tuple[float, ...]
    innovation: float
    family: str = "gaussian"

    @property
    def walks(self) -> bool:
        return self.coefficients == (1.0,)

    def sample(self, g: Generator, count: int) -> Float[Tensor, " N"]:
        lead = 0 if self.walks else _BURN_IN
        errors = (self.innovation * unit_variance(g, self.family, count + lead)).tolist()
        values: list[float] = []
        past = [0.0] * len(self.coefficients)
        for error in errors:
            value = error + sum(c * v for c, v in zip(self.coefficients, past, strict=True))
            past = [value, *past[:-1]]
            values.append(value)
        return torch.tensor(values[lead:], dtype=torch.float64)

    def transition(self) -> np.ndarray:
        """Return the companion matrix (p, p); the first entry of the state is the process."""
        order = len(self.coefficients)
        companion = np.eye(order, k=-1)
        companion[0] = self.coefficients
        return companion

    def start(self) -> np.ndarray:
        """Return the covariance (p, p) of the state before the first sample."""
        order = len(self.coefficients)
        drive = np.zeros((order, order))
        drive[0, 0] = self.innovation**2
        if self.walks:
            return drive
        f = self.transition()
        return np.linalg.solve(np.eye(order * order) - np.kron(f, f), drive.ravel()).reshape(order, order)


def autoregressive(coefficients: tuple[float, ...], deviation: float, family: str = "gaussian") -> Process:
    """Return the stationary process with a standard deviation.

    Example:
        >>> round(autoregressive((0.6,), 2.0).innovation, 6)
        1.6
    """
    unit = math.sqrt(Process(coefficients, 1.0).start()[0, 0])
    return Process(coefficients, deviation / unit, family)


def resonance(radius: float, frequency: float) -> tuple[float, float]:
    """Return AR(2) coefficients with poles at ``radius · exp(±2πi frequency)``, frequency in cycles per sample."""
    return 2.0 * radius * math.cos(2.0 * math.pi * frequency), -radius * radius


def whitened(
    values: Float[Tensor, "N c K"],
    white: Float[Tensor, "N c"],
    gains: Float[Tensor, "N c s"],
    processes: Sequence[Process],
    keep: Float[Tensor, " N"] | None = None,
) -> Float[Tensor, "N*c K"]:
    """Return ``L⁻¹ values``, where ``L Lᵀ`` is the covariance.

    Args:
        values: columns to whiten, each a series of N samples of c channels.
        white: variance of the independent part.
        gains: how each process enters each channel.
        processes: the s independent processes.
        keep: mask of samples in use; the rows of the others are 0.

    Returns:
        Columns whose inner products are those of the inverse covariance.
    """
    count, channels, columns = values.shape
    used = torch.ones(count, dtype=torch.bool) if keep is None else keep
    if not processes:
        return (values / white.sqrt()[..., None] * used[:, None, None]).reshape(-1, columns)
    transition, drive, start, places = _stacked(processes)
    rows = np.zeros((count, channels, len(start)))
    rows[:, :, places] = gains.numpy()
    y, variance, use = values.numpy(), white.numpy(), used.tolist()
    covariance, state = start, np.zeros((len(start), columns))
    out = np.zeros((count, channels, columns))
    for k in range(count):
        if k:
            state = transition @ state
            covariance = transition @ covariance @ transition.T + drive
        if not use[k]:
            continue
        for c in range(channels):
            h = rows[k, c]
            ph = covariance @ h
            total = h @ ph + variance[k, c]
            error = y[k, c] - h @ state
            out[k, c] = error / total**0.5
            state = state + (ph / total)[:, None] * error
            covariance = covariance - np.outer(ph, ph / total)
    return torch.from_numpy(out.reshape(-1, columns))


def _stacked(processes: Sequence[Process]) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Return the transition, the process noise, the initial covariance, and the place of each process in the state."""
    size = sum(len(process.coefficients) for process in processes)
    transition, drive, start = np.zeros((3, size, size))
    places, at = [], 0
    for process in processes:
        order = len(process.coefficients)
        part = slice(at, at + order)
        transition[part, part] = process.transition()
        start[part, part] = process.start()
        drive[at, at] = process.innovation**2
        places.append(at)
        at += order
    return transition, drive, start, places
