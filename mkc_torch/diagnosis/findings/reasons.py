"""Why a simulation does not follow its recording: what is sought first, and told as sentences."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.first_fit import multiple_shooting_start
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["at_ends", "reasons_of", "wrong_turns"]

_NOUGHT, _AWAY, _AT_END = 1e-3, 30.0, 1e-6
"""Times its first value at which a parameter is nearly 0, has run away, and is at an end of its range."""

_MENDS = 0.5
"""Share of the residual to which a trial has to bring it to be told as the reason."""

_MATTERS = 0.97
"""Share of the residual without an input below which the input matters."""

_LAGS = (2, 5, 20)
"""Samples by which an input is tried late."""


@dataclass(frozen=True)
class _Trial:
    """A change of the simulation or the recording, and the sentence where it mends the fit, from a start of its own."""

    told: Callable[[Float[Tensor, " p"]], str]
    prepared: PreparedDynamics
    thorough: bool = False


def at_ends(fit: FittedModel) -> tuple[str, ...]:
    """Parameters of the equations that ended at an end of their range, where they did not begin."""
    prepared = fit.model.prepared
    if not isinstance(prepared, PreparedDynamics):
        return ()
    found = []
    for number, (name, known) in enumerate(prepared.known.items()):
        value = float(fit.parameters[number])
        size = max(abs(known.value), 1e-300)
        low, high = (float(bound[number]) for bound in prepared.bounds)
        at_low = value - low <= _AT_END * size and known.value - low > _NOUGHT * size
        at_high = high - value <= _AT_END * size and high - known.value > _NOUGHT * size
        if at_low or at_high:
            found.append(name)
    return tuple(found)


def wrong_turns(prepared: PreparedSimulation) -> str:
    """What is wrong with the recorded turns that a sensor is compared by; empty where nothing is."""
    return getattr(prepared, "wrong_turns", "")


def reasons_of(fits: Sequence[FittedModel], follows: Sequence[GoodnessOfFit]) -> tuple[str, ...]:
    """Sentences, the most likely reason first.

    Args:
        fits: of the simulation alone: the one that predicts best from sample to sample, and its free run if any.
        follows: how it follows each output.
    """
    prepared = fits[0].model.prepared
    if turns := wrong_turns(prepared):
        return (turns,)
    if not isinstance(prepared, PreparedDynamics):
        return ("Look at signs, units and the order of columns: what is compared may be another quantity.",)
    prepared = prepared.observed(None)
    sentences = _of_trials(prepared, fits, follows)
    ends = at_ends(fits[0])
    sentences += [
        f"The fit drives `{name}` to the end of its range, {_value(fits[0], prepared, name):.4g}: the recording asks "
        "for more than the range allows, often for the other sign of its term."
        for name in ends
    ]
    sentences += _of_sizes(prepared, fits[-1], ends)
    if not sentences:
        sentences = [
            "No other start, sign or delay of an input mends it: compare the recording's columns, their units and "
            "order with what the simulation means by them, or the simulation is of another system."
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
            sentences.append(f"The free run follows best with `{name}` nearly 0, as if its term was not there.")
        elif value > _AWAY * begun:
            sentences.append(
                f"The free run follows best with `{name}` at {value / begun:.2g} times the value it began with."
            )
    return sentences


def _of_trials(prepared: PreparedDynamics, fits: Sequence[FittedModel], follows: Sequence[GoodnessOfFit]) -> list[str]:
    """What each trial brings, where it mends the fit; and the inputs that do not matter."""
    now = torch.tensor([model_fit.residual for model_fit in follows], dtype=fits[0].parameters.dtype)
    trials = _trials(prepared)
    sizes = run_parallel([partial(_size, trial.prepared, fits, thorough=trial.thorough) for trial in trials], prepared)
    sentences = []
    shares = [float((size / now).max()) if size is not None else torch.inf for size, _ in sizes]
    for number in sorted(range(len(trials)), key=shares.__getitem__):
        size, theta = sizes[number]
        if size is not None and theta is not None and shares[number] < _MENDS:
            parts = zip(follows, size.tolist(), strict=True)
            reach = ", ".join(f"{item.output} to {value:.3g} {item.unit}".rstrip() for item, value in parts)
            sentences.append(f"{trials[number].told(theta)} it follows {reach}.")
    if sentences:
        # with its sign turned round, say, an input matters that did not before
        return sentences[:3]
    still = [
        (name, _size(_with_inputs(prepared, _still(prepared, number)), fits)[0])
        for number, name in enumerate(prepared.system.inputs)
    ]
    known = [fit.output for fit in follows]
    for name, size in still:
        if size is not None and bool((size <= now / _MATTERS).all()):
            sentences.append(
                f"`{name}` does not matter: held at its mean the simulation follows {', '.join(known)} as well."
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
        return f"With {' and '.join(turned) or 'free ranges'}, which its range forbids,"

    if bool(torch.cat(prepared.bounds).isfinite().any()):
        trials.append(_Trial(of_signs, freed, thorough=True))
    for number, name in enumerate(prepared.system.inputs):
        turned = prepared.inputs_at_rows.clone()
        turned[:, number] = -turned[:, number]
        trials.append(_Trial(_always(f"With the sign of `{name}` turned round"), _with_inputs(prepared, turned)))
        step = float(prepared.time.diff().median())
        for lag in (lag for lag in _LAGS if lag < len(prepared.time) // 10):
            late = prepared.inputs_at_rows.clone()
            late[lag:, number] = prepared.inputs_at_rows[:-lag, number]
            text = f"With `{name}` late by {lag * step:.3g} s"
            trials.append(_Trial(_always(text), _with_inputs(prepared, late)))
    return trials


def _always(text: str) -> Callable[[Tensor], str]:
    return lambda _: text


def _still(prepared: PreparedDynamics, number: int) -> Float[Tensor, "N u"]:
    inputs = prepared.inputs_at_rows.clone()
    inputs[:, number] = inputs[:, number].mean()
    return inputs


def _with_inputs(prepared: PreparedDynamics, inputs: Float[Tensor, "N u"]) -> PreparedDynamics:
    other = copy.copy(prepared)
    other.inputs_at_rows = inputs
    return other.with_input_hold({})


def _size(
    prepared: PreparedDynamics, fits: Sequence[FittedModel], *, thorough: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """The smallest residual of a changed simulation from a few starts, and its parameters."""
    starts = [fits[0].parameters[: len(prepared.parameter_names)]]
    if thorough:
        ends, begun = at_ends(fits[0]), prepared.given.clone()
        for number, name in enumerate(prepared.known):
            begun[number] = -begun[number] if name in ends else begun[number]
        found = [multiple_shooting_start(prepared, element) for element in (prepared.given, begun)]
        starts = [item for item in found if item is not None] or starts
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
