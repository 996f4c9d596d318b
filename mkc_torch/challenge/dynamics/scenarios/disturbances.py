"""Process noise: an unrecorded disturbance of the rate of one state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import log_uniform, normal, uniform, whole
from mkc_torch.challenge.dynamics.plant import Array, Plant, RunSet

SLOW = (0.03, 0.15)
"""Correlation time of slow process noise, as a share of a run."""

LASTING = (0.3, 1.0)
"""Correlation time of a lasting disturbance, as a share of a run."""

GUSTS = (2, 5)
"""Number of gusts in a run."""

GUST = (0.04, 0.15)
"""Length of a gust, as a share of a run."""


@dataclass(frozen=True)
class DisturbanceShape:
    """A disturbance of size 1 in each run.

    Attributes:
        fine: value in each fine step (F - 1, R).
        covariance: covariance of its means over the intervals between samples, for each run (R, T - 1, T - 1).
        words: times in s, by name.
    """

    fine: Array
    covariance: Array
    words: Mapping[str, float]

    def at(self, plant: Plant, state: str) -> Array:
        """Return the rates (n, F - 1, R) that it adds to one state."""
        rates = np.zeros((len(plant.states), *self.fine.shape))
        rates[plant.row(state)] = self.fine
        return rates


def white(g: Generator, trial: RunSet, fine: int) -> DisturbanceShape:
    """Draw white noise of spectral density 1, in the rate's unit times √s; fine steps are independent."""
    intervals, runs = trial.samples - 1, trial.runs
    values = normal(g, intervals * fine, runs).numpy() / np.sqrt(trial.step / fine)
    covariance = np.broadcast_to(np.eye(intervals) / trial.step, (runs, intervals, intervals))
    return DisturbanceShape(values, covariance, {})


def slow(g: Generator, trial: RunSet, fine: int, lasting: tuple[float, float] = SLOW) -> DisturbanceShape:
    """Draw an Ornstein-Uhlenbeck process of variance 1, stationary from the start of each run and new in each.

    Args:
        g: generator of the draws.
        trial: the runs.
        fine: integration steps between two samples.
        lasting: range of the correlation time, as a share of a run.
    """
    intervals, runs = trial.samples - 1, trial.runs
    constant = log_uniform(g, *lasting) * intervals * trial.step
    keep = np.exp(-trial.step / fine / constant)
    values = normal(g, intervals * fine, runs).numpy()
    values[1:] *= np.sqrt(1.0 - keep**2)
    for k in range(1, len(values)):
        values[k] += keep * values[k - 1]
    moments = trial.step * np.arange(intervals)
    kernel = np.exp(-np.abs(moments[:, None] - moments) / constant)
    return DisturbanceShape(values, np.broadcast_to(kernel, (runs, *kernel.shape)), {"correlation time": constant})


def gusts(g: Generator, trial: RunSet, fine: int) -> DisturbanceShape:
    """Draw a few gusts of constant height and either sign in each run; the disturbance is 0 between them."""
    intervals, runs = trial.samples - 1, trial.runs
    values, covariance = np.zeros((intervals, runs)), np.zeros((runs, intervals, intervals))
    for run in range(runs):
        for _ in range(whole(g, *GUSTS)):
            length = max(round(uniform(g, *GUST) * intervals), 2)
            start = whole(g, 0, intervals - length)
            height = uniform(g, 0.5, 1.5) * (1.0 if uniform(g, 0.0, 1.0) < 0.5 else -1.0)
            # a later gust replaces an earlier one
            values[start : start + length, run] = height
            covariance[run, start : start + length] = covariance[run, :, start : start + length] = 0.0
            covariance[run, start : start + length, start : start + length] = 1.0
    return DisturbanceShape(np.repeat(values, fine, 0), covariance, {})


SHORT = ("pushed_white", "pushed_slowly", "gusts")
"""Scenarios whose disturbances also act in other scenarios, in every second recording with hidden physics."""

LASTING_ALONE, LASTING_RUNS = "lasting_push", "lasting_push_runs"
"""Scenarios with a disturbance about as long as a run, in one run and in four. It acts in all their recordings."""

_lasting = partial(slow, lasting=LASTING)

KINDS: Mapping[str, Callable[[Generator, RunSet, int], DisturbanceShape]] = MappingProxyType(
    {"pushed_white": white, "pushed_slowly": slow, "gusts": gusts, LASTING_ALONE: _lasting, LASTING_RUNS: _lasting}
)
"""Draws of disturbances, by scenario."""
