"""The generator's own integration: the classical Runge-Kutta method at a fixed fine step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from examples.blind_proof.equations.plant import Array, HiddenTerm, Plant, RunSet


@dataclass(frozen=True)
class Course:
    """A trajectory: states (n, F, R) at the fine times, the actual inputs (k, F, R), and the outputs (m, T, R)."""

    states: Array
    inputs: Array
    outputs: Array


def between(values: Array, parts: int) -> Array:
    """Interpolate signals (k, T, R) linearly at ``parts`` times an interval: (k, (T - 1) parts + 1, R).

    Example:
        >>> between(np.array([[[0.0], [1.0]]]), 2)[0, :, 0].tolist()
        [0.0, 0.5, 1.0]
    """
    share = np.arange(parts)[None, None, :, None] / parts
    inside = values[:, :-1, None] * (1.0 - share) + values[:, 1:, None] * share
    k, samples, runs = values.shape
    return np.concatenate([inside.reshape(k, (samples - 1) * parts, runs), values[:, -1:]], 1)


def holding(values: Array, parts: int) -> Array:
    """Sample held signals (k, T, R) at ``parts`` times an interval: (k, (T - 1) parts + 1, R).

    Example:
        >>> holding(np.array([[[0.0], [1.0]]]), 2)[0, :, 0].tolist()
        [0.0, 0.0, 1.0]
    """
    return np.concatenate([np.repeat(values[:, :-1], parts, 1), values[:, -1:]], 1)


def simulate(
    plant: Plant, trial: RunSet, hidden: HiddenTerm | None = None, size: float = 0.0, disturbance: Array | None = None
) -> Course:
    """Simulate the runs of a trial, with or without a hidden effect.

    Args:
        plant: the system.
        trial: the runs.
        hidden: effect in addition to the known physics.
        size: size of the effect.
        disturbance: added rates (n, F - 1, R), constant in each fine step.
    """
    h = trial.step / plant.fine
    half = _sent(plant, trial)
    sent = half if hidden is None else hidden.inputs(half, 0.5 * h, size)
    states = _states(plant, h, sent, trial, hidden, np.full(trial.runs, size), disturbance)
    return Course(states, half[:, ::2], _measured(plant, states, sent[:, ::2], h, hidden, size))


def outputs_of_sizes(plant: Plant, trial: RunSet, hidden: HiddenTerm, sizes: Array) -> list[Array]:
    """Return outputs (m, T, R) for each of several sizes, integrated in parallel."""
    h = trial.step / plant.fine
    half = _sent(plant, trial)
    sent = np.concatenate([hidden.inputs(half, 0.5 * h, size) for size in sizes], -1)
    many = replace(trial, begin=np.tile(trial.begin, len(sizes)))
    states = _states(plant, h, sent, many, hidden, np.repeat(sizes, trial.runs))
    parts = zip(np.split(states, len(sizes), -1), np.split(sent[:, ::2], len(sizes), -1), sizes, strict=True)
    return [_measured(plant, part, inputs, h, hidden, size) for part, inputs, size in parts]


def _sent(plant: Plant, trial: RunSet) -> Array:
    """Return inputs (k, 2F - 1, R) at every half fine step."""
    return (holding if trial.held else between)(trial.inputs, 2 * plant.fine)


def _states(
    plant: Plant,
    h: float,
    sent: Array,
    trial: RunSet,
    hidden: HiddenTerm | None,
    sizes: Array,
    disturbance: Array | None = None,
) -> Array:
    """Return states (n, F, R), given inputs (k, 2F - 1, R), initial states (n, R) and sizes of the effect (R,)."""
    own = 0 if hidden is None else hidden.own
    n, p = len(plant.states), plant.values

    def rate(x: Array, u: Array, disturbed: Array | None) -> Array:
        known, inner = plant.rate(x[:n], u, p), x[n:]
        if hidden is not None and hidden.rate is not None:
            known, inner = hidden.rate(x[:n], x[n:], u, known, sizes)
        if disturbed is not None:
            known = known + disturbed
        return np.concatenate([known, inner]) if own else known

    inner = np.zeros((own, trial.begin.shape[1]))
    if hidden is not None and hidden.begin is not None:
        inner = hidden.begin(trial.begin)
    x = np.concatenate([trial.begin, inner])
    path = np.empty((sent.shape[1] // 2 + 1, *x.shape))
    path[0] = x
    for k in range(len(path) - 1):
        a, b, c = sent[:, 2 * k], sent[:, 2 * k + 1], sent[:, 2 * k + 2]
        if trial.held:
            c = b  # a held input jumps at the end of the step
        w = None if disturbance is None else disturbance[:, k]
        k1 = rate(x, a, w)
        k2 = rate(x + 0.5 * h * k1, b, w)
        k3 = rate(x + 0.5 * h * k2, b, w)
        x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + rate(x + h * k3, c, w))
        path[k + 1] = x
    return path.transpose(1, 0, 2)[:n]


def _measured(plant: Plant, states: Array, inputs: Array, h: float, hidden: HiddenTerm | None, size: float) -> Array:
    """Return outputs (m, T, R), given states (n, F, R) and inputs (k, F, R)."""
    found = plant.read(states, inputs)
    return (found if hidden is None else hidden.outputs(found, h, size))[:, :: plant.fine]


def variation(jacobian: Array, forcing: Array, begin: Array, step: float) -> Array:
    """Solve the variational equation ``δẋ = A δx + f`` along a trajectory.

    Args:
        jacobian: A (F, R, n, n) at an odd number of times, ``step`` apart.
        forcing: f (F, R, n, K), a column for each direction.
        begin: initial δx (R, n, K).
        step: time step in s; the method takes two steps at once.

    Returns:
        δx ((F + 1) / 2, R, n, K) at every second time.
    """
    h = 2.0 * step
    out = np.empty((len(jacobian) // 2 + 1, *begin.shape))
    out[0] = d = begin
    for k in range(len(out) - 1):
        a, b, c = jacobian[2 * k : 2 * k + 3]
        f, g, e = forcing[2 * k : 2 * k + 3]
        k1 = a @ d + f
        k2 = b @ (d + 0.5 * h * k1) + g
        k3 = b @ (d + 0.5 * h * k2) + g
        out[k + 1] = d = d + h / 6.0 * (k1 + 2.0 * (k2 + k3) + c @ (d + h * k3) + e)
    return out


@dataclass(frozen=True)
class SystemScene:
    """A plant and its trajectory without hidden effects."""

    plant: Plant
    trial: RunSet
    course: Course

    def state(self, name: str) -> Array:
        """(F, R)."""
        return self.course.states[self.plant.row(name)]

    def typical(self, name: str) -> float:
        """Return the median absolute value of a state."""
        return float(np.median(np.abs(self.state(name))))

    def largest(self, name: str) -> float:
        return float(np.abs(self.state(name)).max())

    def pace(self, name: str) -> float:
        """Return the RMS rate of a state."""
        rates = self.plant.rate(self.course.states, self.course.inputs, self.plant.values)
        return float(np.sqrt(np.square(rates[self.plant.row(name)]).mean()))

    def largest_input(self, name: str) -> float:
        return float(np.abs(self.trial.inputs[self.plant.inputs.index(name)]).max())

    @property
    def length(self) -> float:
        """Of a run, in s."""
        return (self.trial.samples - 1) * self.trial.step
