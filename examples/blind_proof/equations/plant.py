"""A system with its known physics, its runs, the inputs that excite it, and the effects that may be hidden in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Generator

from examples.blind_proof.draws import happens, log_uniform, uniform, whole

Array = NDArray[np.float64]

Rate = Callable[[Array, Array, Array], Array]
"""Returns the rates of the states (n, *), given states (n, *), inputs (k, *) and parameters (p,)."""


@dataclass(frozen=True)
class Plant:
    """A system without hidden effects, in state space.

    Attributes:
        name: name of the system, the prefix of its recordings' names.
        states, inputs: names, in the order of ``rate``.
        outputs: the measured states.
        units: units of the states.
        speeds: state of the speed, by its position.
        parameters: true values by name, in the order of ``rate``.
        fine: even number of integration steps between two samples.
        reads: for a system without states, returns its outputs (m, *), given inputs (k, *) and parameters (p,).
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    speeds: Mapping[str, str]
    parameters: Mapping[str, float]
    rate: Rate
    fine: int
    reads: Callable[[Array, Array], Array] | None = None

    def row(self, state: str) -> int:
        return self.states.index(state)

    @property
    def values(self) -> Array:
        """True values of the parameters (p,)."""
        return np.array(list(self.parameters.values()))

    def read(self, states: Array, inputs: Array) -> Array:
        """Return outputs (m, F, R), given states (n, F, R) and inputs (k, F, R)."""
        if self.reads is not None:
            return self.reads(inputs, self.values)
        return states[[self.row(name) for name in self.outputs]]


@dataclass(frozen=True)
class RunSet:
    """Runs of one length: inputs (k, T, R) at the samples, and initial states (n, R).

    Between samples the inputs are linear, or ``held`` at the previous sample.
    """

    step: float
    inputs: Array
    begin: Array
    held: bool = False

    @property
    def samples(self) -> int:
        """T, of each run."""
        return self.inputs.shape[1]

    @property
    def runs(self) -> int:
        """R."""
        return self.inputs.shape[2]


RateChange = Callable[[Array, Array, Array, Array, Array], tuple[Array, Array]]
"""Returns rates (n, R) and own rates (e, R), given states, own states (e, R), inputs, known rates, and sizes (R,)."""

SignalChange = Callable[[Array, float, float], Array]
"""Returns changed signals (channels, times, R), given the signals, the time step in s, and a size."""


def _unchanged(values: Array, step: float, size: float) -> Array:
    return values


@dataclass(frozen=True)
class HiddenTerm:
    """An effect without its size; size 0 is no effect.

    Attributes:
        effect: right name in a diagnosis.
        form: the true form.
        at: right ports in a diagnosis; one of them suffices.
        large: an obvious size.
        rate: change of the rates; None for no change.
        own: number of states of its own.
        inputs, outputs: changes of the inputs and of the measured outputs.
        begin: returns initial own states (e, R), given initial states (n, R); None for 0.
        twins: names of the same effect at another port that no data can distinguish.
    """

    effect: str
    form: str
    at: tuple[str, ...]
    large: float
    rate: RateChange | None = None
    own: int = 0
    inputs: SignalChange = field(default=_unchanged)
    outputs: SignalChange = field(default=_unchanged)
    begin: Callable[[Array], Array] | None = None
    twins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Setting:
    """A plant, its runs, and the runs of the second recording."""

    plant: Plant
    trial: RunSet
    later: RunSet


Trial = Callable[[Generator, Plant, int, int], RunSet]
"""Draws runs of a plant, given their number and the samples of each."""


def setting(g: Generator, plant: Plant, trial: Trial, *, most_runs: int, samples: int, later: int) -> Setting:
    """Draw up to ``most_runs`` runs with ``samples`` samples in all, and a second recording of ``later`` samples."""
    runs = whole(g, 1, most_runs)
    return Setting(plant, trial(g, plant, runs, samples // runs), trial(g, plant, 1, later))


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
