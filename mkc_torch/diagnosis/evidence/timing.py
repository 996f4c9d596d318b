"""Timing as evidence: when a step came, whether it was switched, and whether an effect follows its driver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, gain_of
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import DriverShift
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.tangents import Candidates, ModelTangents
from mkc_torch.diagnosis.settings import EvidenceSettings

if TYPE_CHECKING:
    from jaxtyping import Float

_CRITICAL = -2.0 * math.log(1.0 - math.sqrt(0.95))
"""95 % quantile of the likelihood ratio of the onset."""

_RISE = 1
"""Margin in samples: a change takes time, and its middle can differ from the best instantaneous change."""

_GROWTH = 1.3
"""Growth factor of the spacing of the tried samples."""

_BETWEEN = 12
"""Samples tried between the last sample inside the interval and the first sample outside."""


def onset_of_finding(case: EvidenceContext) -> tuple[float, float] | None:
    return onset_interval(case.fits[case.number].model, case.located)


def onset_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the confidence interval of the finding's onset."""
    return onset_result(case.ahead)


def onset_result(interval: tuple[float, float] | None) -> EvidenceResult:
    return EvidenceResult("onset", interval, keys={} if interval is None else {"onset_interval": interval})


def onset_interval(model: JointModel, located: SearchResult) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of an effect's onset, in s.

    The likelihood ratio of a change point is not chi-square distributed: it is the maximum of two exponential
    variables, one per side, with ``P(ratio <= x) = (1 - exp(-x / 2))²``.

    Hansen, "Sample splitting and threshold estimation", Econometrica 68 (2000), theorem 2.

    Args:
        model: the simulation without the effect.
        located: the effect.

    Returns:
        None without an onset, or at a port at which each onset needs its own trajectory.
    """
    term, pointwise = located.fit.model.terms[-1], located.scene.tangents.pointwise
    if "onset" not in term.shape or pointwise[term.port] is None:
        return None
    time = model.prepared.time
    place = int(torch.searchsorted(time, term.shape["onset"]).clamp(1, len(time) - 1))
    parameters = located.fit.parameters[: model.size]

    def ratios(numbers: Sequence[int]) -> Float[Tensor, " n"]:
        """Return the likelihood ratio of an onset at each sample."""
        shapes = [replace(term, shape={**term.shape, "onset": float(time[number])}) for number in numbers]
        tangents = Candidates(model, parameters, shapes, pointwise)
        return located.look.linearised.gains_of(tangents, located.scene.counts).ratio[:, 0]

    tried = _spread(place, len(time))
    found = ratios(tried)
    least = float(found.max()) - _CRITICAL
    within = [number for number, ratio in zip(tried, found.tolist(), strict=True) if ratio >= least or number == place]
    first, last = within[0], within[-1]
    before, after = tried[max(tried.index(first) - 1, 0)], tried[min(tried.index(last) + 1, len(tried) - 1)]
    closer = sorted({*_between(before, first), *_between(last, after)})
    if closer:
        within += [number for number, ratio in zip(closer, ratios(closer).tolist(), strict=True) if ratio >= least]
    # a change seen at a sample happened after the previous sample, and takes time
    return float(time[max(min(within) - 1 - _RISE, 0)]), float(time[min(max(within) + _RISE, len(time) - 1)])


def _spread(place: int, count: int) -> list[int]:
    """Return sample numbers around ``place``, with growing distances, to both ends of the recording.

    Example:
        >>> _spread(3, 9)
        [1, 2, 3, 4, 6, 8]
    """
    away, step = [0], 1.0
    while away[-1] < count:
        away.append(away[-1] + math.ceil(step))
        step *= _GROWTH
    numbers = {place - distance for distance in away} | {place + distance for distance in away}
    return sorted({min(max(number, 1), count - 1) for number in numbers})


def _between(low: int, high: int) -> list[int]:
    """Return up to ``_BETWEEN`` integers between two integers."""
    return sorted({low + (high - low) * k // _BETWEEN for k in range(1, _BETWEEN)} - {low, high})


_FREQUENCIES = 4001
"""Number of frequencies of the spectrum."""


def intermittency_evidence(case: EvidenceContext) -> EvidenceResult:
    """Test whether the finding is an intermittent step."""
    onset = case.term.shape.get("onset")
    if onset is None:
        return intermittency_result(False)
    memory = memory_of(case.final.spectrum.coefficients)
    gain = gain_of(case.final, case.number)
    return intermittency_result(comes_and_goes(gain, case.prepared.time, onset, case.settings.evidence, memory))


def intermittency_result(switched: bool) -> EvidenceResult:
    return EvidenceResult("switched", switched, keys={"comes_and_goes": True} if switched else {})


def comes_and_goes(
    gain: Float[Tensor, " N"],
    time: Float[Tensor, " N"],
    onset: float,
    settings: EvidenceSettings,
    memory: float = 1.0,
) -> bool:
    """Whether the step makes the recording much less likely in some interval after its onset.

    For a permanent step, an interval of independent samples loses c nats with probability below exp(−c); for coloured
    noise in a white-noise model, below exp(−c / memory).

    Args:
        gain: log-likelihood gain of the step per sample, in nats.
        time: of the samples, ascending.
        onset: of the step.
        settings: thresholds of the loss.
        memory: number of samples per independent sample; see :func:`memory_of`.

    Example:
        >>> time = torch.arange(100.0)
        >>> lasts = torch.where(time < 20.0, 0.0, 1.0)
        >>> switched = torch.where(time < 20.0, 0.0, torch.sign(torch.sin(0.1 * (time - 20.0) + 0.01)))
        >>> usual = EvidenceSettings()
        >>> comes_and_goes(lasts, time, 20.0, usual), comes_and_goes(switched, time, 20.0, usual)
        (False, True)
    """
    running = torch.cat([gain.new_zeros(1), gain[time >= onset].cumsum(0)])
    fall = float((running.cummax(0).values - running).max())
    return fall > max(settings.switched * memory, settings.switched_share * float(gain.sum()))


def memory_of(coefficients: Sequence[Float[Tensor, " order"]]) -> float:
    """Return the largest ratio of long-run variance to variance over the channels; at least 1.

    Example:
        >>> round(memory_of([torch.tensor([0.5]), torch.zeros(0)]), 3)
        3.0
    """
    return max([1.0, *(_memory(phi.double()) for phi in coefficients if len(phi))])


def _memory(phi: Float[Tensor, " order"]) -> float:
    omega = torch.linspace(0.0, torch.pi, _FREQUENCIES, dtype=phi.dtype)
    lag = torch.arange(1, len(phi) + 1, dtype=phi.dtype)
    turned = torch.exp(-1j * omega.unsqueeze(-1) * lag) @ phi.to(torch.complex128)
    power = (1.0 - turned).abs().square().reciprocal()
    return float(power[0] / torch.trapezoid(power, omega) * torch.pi)


_COPIES = 19
"""Shifted copies in each direction."""

_AT_ONCE = 19
"""Batch size of the copies."""

_FEWEST = 200
"""Minimum number of samples in the middle of the recording."""

_AS_MUCH = 0.999
"""Share of the gain from which a copy counts as good; shifted ramps differ only by rounding."""


def driver_shift_of_finding(case: EvidenceContext) -> DriverShift | None:
    return shifted(case.fits[case.number].model, case.located)


def driver_shift_evidence(case: EvidenceContext) -> EvidenceResult:
    """Count the shifted copies of the finding's driver with at least its gain."""
    return driver_shift_result(case.ahead)


def driver_shift_result(shift: DriverShift | None) -> EvidenceResult:
    if shift is None:
        return EvidenceResult("driver_shift")
    return EvidenceResult("driver_shift", shift, keys={"driver_shift": shift})


def shifted(model: JointModel, located: SearchResult) -> DriverShift | None:
    """Compare the gain of an effect with its gains for a shifted driver.

    Only the driver is shifted; motion, parameters and noise are unchanged. All shifts are scored on the same samples in
    the middle, so that the driver needs no wrap-around. Errors of the noise model affect all gains alike.

    Harris, "Nonsense correlations in neuroscience", bioRxiv 2020.11.29.402719 (2020), the linear shift.

    Args:
        model: the simulation without the effect.
        located: the effect.

    Returns:
        None without a recorded driver, for a port at which each shift needs its own simulation, or for a short
        recording.
    """
    term = located.term
    pointwise = located.scene.tangents.pointwise[term.port]
    N = len(located.scene.values)
    most = int(located.scene.settings.evidence.shift * N)
    if term.driver is None or pointwise is None:
        return None
    if N - 2 * most < _FEWEST:
        return None
    middle = slice(most, N - most)
    parameters = located.fit.parameters[: model.size]
    counts = located.scene.counts[middle]
    bare = _cut(located.scene.tangents, middle)
    search = linearise(model, parameters, located.scene.values[middle], counts, bare)

    def gains(steps: Sequence[int]) -> Float[Tensor, " steps"]:
        copies = [_moved(term, by) for by in steps]
        moved = Candidates(model, parameters, copies, located.scene.tangents.pointwise)
        return search.gains_of([tangent[middle] for tangent in moved], counts).ratio[:, 0]

    steps = [most * k // _COPIES for k in range(-_COPIES, _COPIES + 1) if k]
    found = torch.cat([gains(steps[k : k + _AT_ONCE]) for k in range(0, len(steps), _AT_ONCE)])
    time = model.prepared.time
    return DriverShift(
        len(steps), int((found >= _AS_MUCH * gains([0])).sum()), most * float(time[-1] - time[0]) / (N - 1)
    )


def _moved(term: Term, by: int) -> Term:
    """Delay the driver by ``by`` samples, constant beyond its ends."""
    assert term.driver is not None
    values = term.driver.values
    rows = (torch.arange(len(values)) - by).clamp(0, len(values) - 1)
    return replace(term, driver=replace(term.driver, values=values[rows]))


def _cut(tangents: ModelTangents, rows: slice) -> ModelTangents:
    slow = tangents.slow
    return ModelTangents(
        tangents.nuisance[rows],
        (),
        {name: None if jacobian is None else jacobian[rows] for name, jacobian in tangents.pointwise.items()},
        None if slow is None else replace(slow, tangents=slow.tangents[rows]),
    )
