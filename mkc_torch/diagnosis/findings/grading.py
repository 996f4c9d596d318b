"""Grade of a finding: confirmation on held-out blocks, and size relative to the noise."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import GoodnessOfFit, Grade, ShapeCheck
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.result import Finding, HeldOut
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.first_fit import multiple_shooting_start
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

if TYPE_CHECKING:
    from jaxtyping import Float


Confirmation = Literal["surely", "probably", "not shown", "worse"]

SMALL = 0.05
"""Relative reduction of the residual below which a finding is small."""

_NORMAL_95 = 1.96
"""Half-width of a 95 % interval in standard errors."""

_NOUGHT = 1e-3
"""Relative value below which a parameter is nearly 0."""

_AWAY = 30.0
"""Relative value above which a parameter has diverged."""

_AT_END = 1e-6
"""Relative distance within which a parameter is at a bound."""

_FIXES = 0.5
"""Relative residual below which a trial is reported as the reason."""

_MATTERS = 0.97
"""Residual, relative to that without an input, below which the input matters."""

_LAGS = (2, 5, 20)
"""Tried delays of an input, in samples."""


def confirmation(gain: float, interval: tuple[float, float]) -> Confirmation:
    """Classify a gain on held-out blocks by its 95 % interval.

    "probably": a gain above its standard error whose interval contains 0.

    Example:
        >>> confirmation(0.3, (0.2, 0.4)), confirmation(0.13, (-0.02, 0.28)), confirmation(0.01, (-0.1, 0.1))
        ('surely', 'probably', 'not shown')
        >>> confirmation(-0.3, (-0.4, -0.2)), confirmation(0.3, (float("nan"), float("nan")))
        ('worse', 'not shown')
    """
    low, high = interval
    if low > 0.0:
        return "surely"
    if high < 0.0:
        return "worse"
    error = (high - low) / (2.0 * _NORMAL_95)
    return "probably" if math.isfinite(error) and gain > error else "not shown"


def confirmed(finding: Finding) -> bool:
    """Whether held-out blocks confirm a finding; the search confirms an event that cannot be held out.

    A finding of size 0 is unconfirmed whatever the blocks show: another change, such as of the noise model, made the
    difference. A finding of impossible size is a proxy of other physics. Blocks confirm by a surely larger likelihood,
    or by a larger one with a residual smaller by :data:`SMALL`: the surrogates have shown that the finding is no
    chance. Where blocks can only reject, because process noise predicts one step ahead as well, the open loop has to
    gain somewhere: its likelihood, or its residual on the blocks; a reduction there below :data:`SMALL` counts only
    with a larger likelihood.
    """
    if is_zero_within_error(finding) or finding.cannot_be:
        return False
    held = finding.held_out
    if held is None:
        return True
    kind = confirmation(held.log_likelihood_gain, held.confidence_interval)
    if held.decides:
        return kind == "surely" or better_on_average(held)
    least = 1.0 if kind == "surely" else 1.0 - SMALL
    return not vetoed(held) and (finding.clearly_better or mean_ratio(held) <= least)


def better_on_average(held_out: HeldOut) -> bool:
    """Whether likelihood and residual on held-out blocks are better in the mean, whatever the interval of the gain."""
    return held_out.log_likelihood_gain > 0.0 and mean_ratio(held_out) <= 1.0 - SMALL


def vetoed(held_out: HeldOut) -> bool:
    """Whether held-out blocks reject a finding: a larger open-loop residual, or a smaller likelihood without gain.

    Several outputs are combined by the geometric mean of their residual ratios.

    Example:
        >>> from mkc_torch.diagnosis.result import ResidualSizes
        >>> each = {"angle": ResidualSizes(2.0, 1.8, "rad"), "speed": ResidualSizes(2.0, 3.0, "rad/s")}
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.8, "", each))
        True
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.0, "m")), vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 2.2, "m"))
        (False, True)
    """
    less = 1.0 - mean_ratio(held_out)
    worse = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval) == "worse"
    return less < -SMALL or (worse and less < SMALL)


def mean_ratio(held_out: HeldOut) -> float:
    """Return the geometric mean over the outputs of the ratio of residuals with and without the finding."""
    ratios = [_ratio(*pair) for pair in _sizes(held_out)]
    return math.exp(sum(map(math.log, ratios)) / len(ratios))


def is_zero_within_error(finding: Finding) -> bool:
    """Whether all sizes are within a standard error of 0; False without standard errors.

    Numbers of the shape, such as a period, do not count: they exist at any size. A size that ended at a bound of 0 has
    a standard error of 0. Otherwise False as well if the open-loop fit without the finding is clearly less likely, and
    the residual on held-out blocks clearly smaller with it. Far from 0 the likelihood can be flat, as for the capacity
    of a large second store, and the standard error larger than the size (Hauck & Donner, Journal of the American
    Statistical Association 72 (1977), 851).
    """
    held = finding.held_out
    better = finding.clearly_better and (held is None or mean_ratio(held) <= 1.0 - SMALL)
    known = [
        (torch.as_tensor(parameter.value), torch.as_tensor(parameter.standard_error))
        for parameter in finding.parameters
        if parameter.standard_error is not None and not parameter.of_shape
    ]
    if known and not any(bool(value.any()) for value, _ in known):
        return True
    return bool(known) and not better and all(bool((value.abs() < error).all()) for value, error in known)


def change(held_out: HeldOut) -> float:
    """Return the largest relative reduction of an output's residual; 0 if unknown.

    Example:
        >>> round(change(HeldOut(0.3, (0.2, 0.4), 2.0, 1.5, "µT")), 3)
        0.25
        >>> from mkc_torch.diagnosis.result import ResidualSizes
        >>> each = {"angle": ResidualSizes(0.2, 0.1, "rad"), "speed": ResidualSizes(3.0, 3.0, "rad/s")}
        >>> change(HeldOut(0.3, (0.2, 0.4), 3.0, 3.0, "", each))
        0.5
    """
    return 1.0 - min(_ratio(*pair) for pair in _sizes(held_out))


def _sizes(held_out: HeldOut) -> list[tuple[float, float]]:
    """Return residual before and after of each output."""
    each = [(output.before, output.after) for output in held_out.outputs.values()]
    return each or [(held_out.rmse_before, held_out.rmse_after)]


def _ratio(before: float, after: float) -> float:
    """Return the ratio of residuals after and before; 1 if unknown."""
    return after / before if before > 0.0 and 0.0 < after / before < math.inf else 1.0


def small(finding: Finding) -> bool:
    """Whether a finding hardly reduces the residual; only means over many samples show it."""
    return finding.held_out is not None and change(finding.held_out) < SMALL


def grade_of(finding: Finding) -> Grade:
    """Return the grade of a finding by its evidence, without the test of its shape.

    Example:
        >>> from mkc_torch.diagnosis.result import EvidenceResult
        >>> held = HeldOut(0.02, (0.01, 0.03), 2.0, 1.96, "µT")
        >>> seen = (EvidenceResult("held_out", (held, "")),)
        >>> grade_of(Finding("time_lag", (), (), (), None, "", "", (), 0.01, (), True, "", evidence=seen))
        'small'
    """
    if not confirmed(finding):
        return "unconfirmed"
    return "small" if small(finding) else "left_out"


def with_shape(grade: Grade, shape: ShapeCheck | None) -> Grade:
    """Return the grade after the test of the shape: a confirmed finding of another shape has only the nearest name.

    An unconfirmed finding stays unconfirmed: held-out blocks do not show that its place lacks anything.

    Args:
        grade: by the other evidence.
        shape: result of the test of the shape; None if it was not tested.

    Example:
        >>> with_shape("small", ShapeCheck(1.2, 0.4))
        'small'
    """
    other = shape is not None and shape.curve is not None
    return "nearest" if other and grade != "unconfirmed" else grade


def grade_in_short(finding: Finding) -> Grade:
    """Return the grade without surrogates and without the test of the shape: only held-out blocks can confirm.

    They have to do so surely, and blocks that can only reject a finding, as with process noise, do not confirm it.
    """
    held = finding.held_out
    if held is None or not held.decides:
        return "unconfirmed"
    if confirmation(held.log_likelihood_gain, held.confidence_interval) != "surely":
        return "unconfirmed"
    return grade_of(finding)


def worth_correcting(finding: Finding) -> bool:
    """Whether the finding clearly improves the simulation."""
    return finding.grade == "left_out"


def transfers(finding: Finding) -> bool:
    """Whether a finding can be applied to another recording.

    Location-specific and intermittent findings cannot.
    """
    return worth_correcting(finding) and finding.plausible and not (finding.location_specific or finding.comes_and_goes)


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
    """Return sentences on trials that fix the fit, and on inputs that do not matter."""
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
    still = [
        (name, _size(_with_inputs(prepared, _still(prepared, number)), fits)[0])
        for number, name in enumerate(prepared.system.inputs)
    ]
    known = [output.output for output in follows]
    for name, size in still:
        if size is not None and bool((size <= now / _MATTERS).all()):
            sentences.append(
                f"`{name}` does not matter: held at its mean, the simulation fits {', '.join(known)} equally well."
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
    for number, name in enumerate(prepared.system.inputs):
        turned = prepared.inputs_at_rows.clone()
        turned[:, number] = -turned[:, number]
        trials.append(_Trial(_always(f"With the sign of `{name}` reversed,"), _with_inputs(prepared, turned)))
        step = float(prepared.time.diff().median())
        for lag in (lag for lag in _LAGS if lag < len(prepared.time) // 10):
            late = prepared.inputs_at_rows.clone()
            late[lag:, number] = prepared.inputs_at_rows[:-lag, number]
            text = f"With `{name}` delayed by {lag * step:.3g} s,"
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
