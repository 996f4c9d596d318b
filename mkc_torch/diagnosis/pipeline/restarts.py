"""Segments with initial states of their own, for a simulation whose free run leaves the recording."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._parallel.deadline import Stopped, limited
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.pipeline.prepare import Problem, prepare
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.thresholds import DISTURBANCE, RESTARTED
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics import Dynamics
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_SHORTEST = 20
"""Samples of the shortest segment that is tried."""

_PER_STATE = 6
"""Samples for each initial state of the shortest segment, so that segments do not follow everything."""

_SHIFTS = (0.11, 0.23, 0.37, 0.53, 0.71)
"""Shares of the recording by which inputs are shifted: no multiples of one another, for inputs that repeat."""

_HALVINGS = 8
"""Segment lengths that are tried at most."""


def restarted_problem(
    problem: Problem, recording: Recording | Sequence[Recording], limit: float, begin: float
) -> Problem | None:
    """Return the problem with a simulation whose restarts make it follow the recording.

    The longest run is halved again and again. For each length the simulation is fitted with initial states of its own
    for each segment, and compared with polynomials in time with as many numbers for each segment. The length at which
    the simulation explains most of what the polynomials leave, of the output of which it explains least, is chosen. It
    has to explain most of it, and better with the recorded inputs than with constant inputs.

    Args:
        problem: the input of the diagnosis.
        recording: as given by the user.
        limit: time limit of the diagnosis in s.
        begin: start of the diagnosis by :func:`time.monotonic`.

    Returns:
        None if the user chose the restarts, for a simulation without differential equations, if no length follows, and
        if the time limit is over.
    """
    simulation, options = problem.simulation, problem.options
    if not isinstance(simulation, Dynamics) or simulation.restart_after is not None:
        return None
    problem.progress("fitting the simulation in segments")
    try:
        with limited(limit, begin=begin):
            seconds = _best_length(simulation, problem.prepared)
    except Stopped:
        return None
    if seconds is None:
        return None
    system = simulation.with_restarts(seconds)
    # texts of suspected effects and holds are checked again for the restarted simulation
    return prepare(system, recording, problem.effects, options, None, problem.progress)


def with_restarts_stated(result: Diagnosis, problem: Problem, *, found: bool) -> Diagnosis:
    """Return a diagnosis that states its restarts: in its first warning, and in its environment.

    Args:
        result: of the restarted simulation.
        problem: with the restarted simulation.
        found: whether a fit of the free run was found.
    """
    assert isinstance(problem.simulation, Dynamics)
    seconds = problem.simulation.restart_after
    reason = "its free run does not follow the recording" if found else "no fit of its free run is found"
    sentence = (
        f"The simulation is restarted every {seconds:.4g} s, because {reason}: findings are tested within these "
        "segments, and longer predictions are untested."
    )
    environment = replace(result.environment, restart_after=seconds)
    return replace(result, warnings=(sentence, *result.warnings), environment=environment)


def without_restarts_stated(result: Diagnosis, problem: Problem, again: Problem | None) -> Diagnosis:
    """Return the diagnosis of a free run that is unfit, with a note on the segments that were tried.

    Args:
        result: of the free run.
        problem: with the simulation as given.
        again: the problem with restarts that do not explain the recording; None if no length follows it.
    """
    if not isinstance(problem.simulation, Dynamics) or problem.simulation.restart_after is not None:
        return result
    if again is None:
        note = "Segments with initial states of their own do not follow the recording by its inputs either."
    else:
        assert isinstance(again.simulation, Dynamics)
        seconds = again.simulation.restart_after
        note = (
            f"The simulation follows segments of {seconds:.4g} s, but no physics in the catalogue explains them: give "
            f"it `restart_after = {seconds!r}` for a diagnosis of the segments."
        )
    return replace(result, notes=(*result.notes, note))


def segment_lengths(time: Float[Tensor, " N"], begins: Bool[Tensor, " N"], states: int) -> tuple[float, ...]:
    """Return the lengths in s to try: the longest run, halved until a segment has few samples.

    Example:
        >>> time = 0.1 * torch.arange(101.0)
        >>> segment_lengths(time, torch.arange(101) == 0, 2)
        (5.0, 2.5)
    """
    first = begins.nonzero().squeeze(-1)
    last = torch.cat([first[1:], first.new_tensor([len(time)])]) - 1
    longest = float((time[last] - time[first]).max())
    steps = time.diff()[~begins[1:]]
    fewest = max(_SHORTEST, _PER_STATE * states) * float(steps.median())
    # times in s to four digits, so that they can be repeated by hand
    halves = [float(f"{longest / 2.0 ** (k + 1):.4g}") for k in range(_HALVINGS)]
    return tuple(seconds for seconds in halves if seconds >= fewest)


def segment_polynomials(
    values: Float[Tensor, "N m"], time: Float[Tensor, " N"], begins: Bool[Tensor, " N"], numbers: int
) -> Float[Tensor, "N m"]:
    """Return the residual of a polynomial in time with ``numbers`` coefficients for each segment and output.

    Example:
        >>> line = torch.tensor([[0.0], [1.0], [2.0], [5.0], [4.0], [3.0]], dtype=torch.float64)
        >>> begins = torch.tensor([True, False, False, True, False, False])
        >>> left = segment_polynomials(line, torch.arange(6.0, dtype=torch.float64), begins, 2)
        >>> bool(left.abs().max() < 1e-12)
        True
    """
    rows = [*begins.nonzero().squeeze(-1).tolist(), len(time)]
    left = torch.empty_like(values)
    for start, end in itertools.pairwise(rows):
        within = time[start:end]
        centred = (within - within.mean()) / (within[-1] - within[0])
        basis = torch.stack([centred**power for power in range(numbers)], -1)
        left[start:end] = values[start:end] - basis @ torch.linalg.lstsq(basis, values[start:end]).solution
    return left


def _best_length(simulation: Dynamics, whole: PreparedSimulation) -> float | None:
    """Return the length in s at which the least explained share is largest; None if the simulation does not follow.

    It follows if that share is large, and if the recorded inputs are more likely than constant inputs and than inputs
    shifted in time: segments of a simulation with wrong or unrelated inputs can follow by their initial states alone,
    and an unrelated oscillation can resemble the right one in another phase.
    """
    assert whole.dynamics is not None
    found: dict[float, tuple[float, FittedModel]] = {}
    for seconds in segment_lengths(whole.time, whole.dynamics.begins, len(simulation.states)):
        fit = _fitted(simulation.with_restarts(seconds), whole, whole.recording)
        share = None if fit is None else _explained_share(fit)
        if fit is not None and share is not None and share >= RESTARTED:
            found[seconds] = share, fit
    best = max(found, key=lambda seconds: found[seconds][0], default=None)
    if best is None:
        return None
    changing = [name for name in simulation.inputs if bool((whole.recording[name] != whole.recording[name][0]).any())]
    if not changing:
        return best
    rivals = [_with_constant(whole.recording, changing), *(_shifted(whole.recording, changing, by) for by in _SHIFTS)]
    fits = [_fitted(simulation.with_restarts(best), whole, rival) for rival in rivals]
    least = found[best][1].log_likelihood - DISTURBANCE
    return best if all(fit is None or fit.log_likelihood < least for fit in fits) else None


def _fitted(simulation: Dynamics, whole: PreparedSimulation, recording: Recording) -> FittedModel | None:
    try:
        prepared = simulation.prepare(recording).with_input_hold(whole.input_hold)
        return fitted(JointModel(prepared), prepared.start())
    except (NoFitError, SimulationError):
        return None


def _explained_share(fit: FittedModel) -> float | None:
    """Return the least share over the outputs that a restarted simulation explains of the polynomials' residual."""
    prepared = fit.model.prepared.dynamics
    assert prepared is not None
    # equal numbers of free values in both models, rounded up for the polynomials
    numbers = -(-len(prepared.system.states) // len(prepared.channels))
    rival = size_of(segment_polynomials(prepared.measured, prepared.time, prepared.begins, numbers))
    share = 1.0 - (size_of(fit.residual) / rival).square()
    return float(share.min()) if bool(share.isfinite().all()) else None


def _shifted(recording: Recording, names: Sequence[str], share: float) -> Recording:
    """Return a recording with columns shifted in time by a share of its length, their end before their start."""
    by = int(share * len(recording))
    columns = {name: recording[name].roll(by) if name in names else recording[name] for name in recording.names}
    return Recording(columns, name=recording.name, units=recording.units, labels=recording.labels)


def _with_constant(recording: Recording, names: Sequence[str]) -> Recording:
    """Return a recording with constant columns, at their medians."""
    columns = {
        name: recording[name].median().expand(len(recording)) if name in names else recording[name]
        for name in recording.names
    }
    return Recording(columns, name=recording.name, units=recording.units, labels=recording.labels)
