"""A system as everybody knows it, the runs that are made with it, and what may be hidden in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Rate = Callable[[Array, Array, Array], Array]
"""From states (n, *), inputs (k, *) and parameters (p,) the rates of the states (n, *)."""


@dataclass(frozen=True)
class Plant:
    """A system without what is hidden, in state space.

    Attributes:
        name: of the system, with which the names of its recordings begin.
        states, inputs: their names, in the order of ``rate``.
        outputs: those states that are measured.
        units: of states.
        speeds: position to the state that is its speed.
        parameters: name to true value, in the order of ``rate``.
        fine: even number of steps of the integration between two samples.
        reads: of a system without states, its outputs (m, *) from inputs (k, *) and parameters (p,).
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
        """(p,) of the parameters."""
        return np.array(list(self.parameters.values()))

    def read(self, states: Array, inputs: Array) -> Array:
        """Outputs (m, F, R) at states (n, F, R) and inputs (k, F, R)."""
        if self.reads is not None:
            return self.reads(inputs, self.values)
        return states[[self.row(name) for name in self.outputs]]


@dataclass(frozen=True)
class RunSet:
    """Runs of one length: inputs (k, T, R) at the samples, and first states (n, R).

    Between samples inputs are linear, or ``held`` at what they were at the sample before.
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
"""From states (n, R), own states (e, R), inputs (k, R), known rates (n, R) and sizes (R,): rates (n, R), own (e, R)."""

SignalChange = Callable[[Array, float, float], Array]
"""From signals (channels, moments, R), the time between moments in s and a size: the signals as changed."""


def _unchanged(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
    return values


@dataclass(frozen=True)
class HiddenTerm:
    """An effect before its size is known; of size 0 it is not there.

    Attributes:
        effect: what a diagnosis should call it.
        form: what it really is.
        at: where a diagnosis may say that it acts, one place of several being enough.
        large: a size that nobody could overlook.
        rate: what it makes of the rates; None if it leaves them alone.
        own: number of states of its own.
        inputs, outputs: what it makes of inputs and of what is measured.
        begin: from first states (n, R) its own ones (e, R); None where they begin at 0.
        twins: names of the same thing at another place, from which no data tells it.
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
    """A plant, its runs, and those of the second recording."""

    plant: Plant
    trial: RunSet
    later: RunSet
