"""Inputs that excite: multisines and random steps."""

from __future__ import annotations

import math

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import happens, log_uniform, uniform, whole
from mkc_torch.challenge.dynamics.plant import Array


def moments(step: float, samples: int) -> Array:
    """Return times (T,) from 0, ``step`` apart, s."""
    return np.arange(samples, dtype=np.float64) * step


def multisine(g: Generator, time: Array, slowest: float, fastest: float) -> Array:
    """Draw a multisine (T,) with frequencies in a range in Hz; its largest value is 1."""
    total = np.zeros_like(time)
    for _ in range(whole(g, 3, 6)):
        frequency, phase = log_uniform(g, slowest, fastest), uniform(g, 0.0, 2.0 * math.pi)
        total += uniform(g, 0.5, 1.0) * np.sin(2.0 * math.pi * frequency * time + phase)
    return total / np.abs(total).max()


def steps(g: Generator, time: Array, shortest: float, longest: float) -> Array:
    """Draw steps (T,) between -1 and 1 with alternating signs, each held for a random time in s."""
    values = np.empty_like(time)
    start, way = 0.0, 1.0 if happens(g, 0.5) else -1.0
    while start <= time[-1]:
        end = start + uniform(g, shortest, longest)
        values[(time >= start) & (time < end)] = way * uniform(g, 0.1, 1.0)
        start, way = end, -way
    return values


def excitation(g: Generator, time: Array, period: float) -> Array:
    """Draw a multisine or steps (T,) between -1 and 1, about a system's period in s."""
    if happens(g, 0.6):
        return multisine(g, time, 0.15 / period, 1.5 / period)
    return steps(g, time, 0.3 * period, 2.0 * period)


def runs_of(signals: list[Array]) -> Array:
    """Stack the runs of one input to (1, T, R)."""
    return np.stack(signals, -1)[None]
