"""A system with its known physics, its runs, and the effects that may be hidden in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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


def _unchanged(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
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
