"""Why a simulation does not fit: reversed signs, delayed or idle inputs, parameters at their bounds."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.first_fit import multiple_shooting_start
from mkc_torch.simulation.dynamics.impossible import at_bounds
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

if TYPE_CHECKING:
    from jaxtyping import Float


_NOUGHT = 1e-3
"""Relative value below which a parameter is nearly 0."""

_AWAY = 30.0
"""Relative value above which a parameter has diverged."""

_FIXES = 0.5
"""Relative residual below which a trial is reported as the reason."""

_MATTERS = 0.97
"""Residual, relative to that without an input, below which the input matters."""

LAGS = (2, 5, 20)
"""Tried delays of an input, in samples."""


@dataclass(frozen=True)
class _Trial:
    """A change of the simulation or of the recording, and its sentence if it fixes the fit."""

    sentence: Callable[[Float[Tensor, " p"]], str]
    prepared: PreparedDynamics
    thorough: bool = False


def at_ends(fit: FittedModel) -> tuple[str, ...]:
    """Return the parameters of the equations that were fitted to a bound."""
    prepared = fit.model.prepared.dynamics
    if prepared is None:
        return ()
    return tuple(dict.fromkeys(name for name, _ in at_bounds(prepared, fit.parameters)))


def reasons_of(fits: Sequence[FittedModel], follows: Sequence[GoodnessOfFit]) -> tuple[str, ...]:
    """Return the reasons in sentences, the most likely first.

    Args:
        fits: of the simulation without findings: the best one-step predictor, and its open-loop fit if any.
        follows: goodness of fit of each output.
    """
    known = fits[0].model.prepared
    if known.faults:
        return known.faults
    if known.dynamics is None:
        return ("Check signs, units and the order of columns: they may be of another quantity.",)
    prepared = known.dynamics.open_loop()
    sentences = _of_trials(prepared, fits, follows)
    ends = at_ends(fits[0])
    sentences += [
        f"`{name}` is fitted to its bound, {_value(fits[0], prepared, name):.4g}: the recording needs a value beyond "
        f"it, "
        "often with the other sign."
        for name in ends
    ]
    sentences += _of_sizes(prepared, fits[-1], ends)
    if not sentences:
        sentences = [
            "No other start, sign or delay of an input improves the fit: compare columns, units and order of the "
            "recording "
            "with those of the simulation, or the simulation is of another system."
        ]
    return tuple(sentences)


def _value(fit: FittedModel, prepared: PreparedDynamics, name: str) -> float:
    return float(fit.parameters[list(prepared.known).index(name)])


def _of_sizes(prepared: PreparedDynamics, fit: FittedModel, ends: Sequence[str]) -> list[str]:
    sentences = []
    for number, (name, known) in enumerate(prepared.known.items()):
        value, begun = abs(float(fit.parameters[number])), abs(known.value)
        if name in ends or begun == 0.0:
            continue
        if value < _NOUGHT * begun:
            sentences.append(f"The open-loop fit is best with `{name}` nearly 0, without its term.")
        elif value > _AWAY * begun:
            sentences.append(f"The open-loop fit is best with `{name}` at {value / begun:.2g} times its start value.")
    return sentences


def _of_trials(prepared: PreparedDynamics, fits: Sequence[FittedModel], follows: Sequence[GoodnessOfFit]) -> list[str]:
    """Return sentences on trials that fix the fit, and on inputs that explain nothing."""
    now = torch.tensor([output.residual for output in follows], dtype=fits[0].parameters.dtype)
    trials = _trials(prepared)
    sizes = run_parallel([partial(_size, trial.prepared, fits, thorough=trial.thorough) for trial in trials], prepared)
    sentences = []
    shares = [float((size / now).max()) if size is not None else torch.inf for size, _ in sizes]
    for number in sorted(range(len(trials)), key=shares.__getitem__):
        size, theta = sizes[number]
        if size is not None and theta is not None and shares[number] < _FIXES:
            parts = zip(follows, size.tolist(), strict=True)
            reach = ", ".join(f"{output.output} {value:.3g} {output.unit}".rstrip() for output, value in parts)
            sentences.append(f"{trials[number].sentence(theta)} the residual is {reach}.")
    if sentences:
        # an input can matter with the other sign only
        return sentences[:3]
    steps = prepared.system.steps
    of_effects = () if steps is None else (*steps.forces, *steps.constants)
    still = [
        (name, _size(_with_inputs(prepared, _still(prepared, number)), fits)[0])
        for number, name in enumerate(prepared.system.inputs)
        if name not in of_effects
    ]
    known = [output.output for output in follows]
    for name, size in still:
        if size is not None and bool((size <= now / _MATTERS).all()):
            sentences.append(
                f"`{name}` explains nothing in this fit: held at its mean, the residual of {', '.join(known)} is at "
                f"most {100.0 * (1.0 / _MATTERS - 1.0):.0f} % larger."
            )
    return sentences[:3]


def _trials(prepared: PreparedDynamics) -> list[_Trial]:
    trials = []
    freed = copy.copy(prepared)
    freed.bounds = tuple(
        torch.full_like(bound, sign) for bound, sign in zip(prepared.bounds, (-torch.inf, torch.inf), strict=True)
    )  # type: ignore[assignment]
    names = list(prepared.known)

    def of_signs(theta: Float[Tensor, " p"]) -> str:
        turned = [
            f"`{name}` = {float(theta[k]):.4g}"
            for k, name in enumerate(names)
            if not float(prepared.bounds[0][k]) <= float(theta[k]) <= float(prepared.bounds[1][k])
        ]
        return f"With {' and '.join(turned) or 'free bounds'}, which the bounds exclude,"

    if bool(torch.cat(prepared.bounds).isfinite().any()):
        trials.append(_Trial(of_signs, freed, thorough=True))
    known = prepared.known_inputs.inputs
    for number, name in enumerate(prepared.system.inputs):
        turned = known.clone()
        turned[:, number] = -turned[:, number]
        trials.append(_Trial(_always(f"With the sign of `{name}` reversed,"), _with_inputs(prepared, turned)))
        step = float(prepared.known_inputs.time.diff().median())
        for lag in (lag for lag in LAGS if lag < len(known) // 10):
            late = known.clone()
            late[lag:, number] = known[:-lag, number]
            text = f"With `{name}` delayed by {lag * step:.3g} s,"
            trials.append(_Trial(_always(text), _with_inputs(prepared, late)))
    return trials


def _always(text: str) -> Callable[[Tensor], str]:
    return lambda _: text


def _still(prepared: PreparedDynamics, number: int) -> Float[Tensor, "R u"]:
    inputs = prepared.known_inputs.inputs.clone()
    inputs[:, number] = inputs[:, number].mean()
    return inputs


def _with_inputs(prepared: PreparedDynamics, inputs: Float[Tensor, "R u"]) -> PreparedDynamics:
    other = copy.copy(prepared)
    other.known_inputs = replace(prepared.known_inputs, inputs=inputs)
    other.inputs_at_rows = inputs[prepared.known_inputs.samples]
    return other.with_input_hold({})


def _size(
    prepared: PreparedDynamics, fits: Sequence[FittedModel], *, thorough: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return the smallest residual of a changed simulation over a few starts, and its parameters."""
    starts = [fits[0].parameters[: len(prepared.parameter_names)]]
    if thorough:
        ends, begun = at_ends(fits[0]), prepared.given.clone()
        for number, name in enumerate(prepared.known):
            begun[number] = -begun[number] if name in ends else begun[number]
        found = [multiple_shooting_start(prepared, start) for start in (prepared.given, begun)]
        starts = [start for start in found if start is not None] or starts
    best: tuple[Tensor | None, Tensor | None] = None, None
    for start in starts:
        try:
            fit = fitted(JointModel(prepared), start, fits[-1].bound)
        except NoFitError:
            continue
        size = size_of(fit.residual)
        if best[0] is None or bool((size < best[0]).all()):
            best = size, fit.parameters
    return best
