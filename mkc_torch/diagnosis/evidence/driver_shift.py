"""Placebo test of a driver: copies of the driver, shifted in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, Row
from mkc_torch.diagnosis.linearised.candidates import Candidates
from mkc_torch.diagnosis.linearised.linearise import linearise
from mkc_torch.diagnosis.linearised.tangents import ModelTangents
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import DriverShift
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import EvidenceSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["as_result", "of_finding", "shifted", "test"]

_COPIES = 19
"""Shifted copies in each direction."""

_AT_ONCE = 19
"""Batch size of the copies."""

_FEWEST = 200
"""Minimum number of samples in the middle of the recording."""

_AS_MUCH = 0.999
"""Share of the gain from which a copy counts as good; shifted ramps differ only by rounding."""


def of_finding(case: EvidenceContext) -> DriverShift | None:
    return shifted(case.fits[case.number].model, case.located)


def test(case: EvidenceContext) -> EvidenceResult:
    """Count the shifted copies of the finding's driver with at least its gain; warn if there are many."""
    return as_result(case.ahead, case.term, case.settings.evidence)


def as_result(shift: DriverShift | None, term: Term, settings: EvidenceSettings) -> EvidenceResult:
    if shift is None:
        return EvidenceResult("driver_shift")
    some = {0: "none", 1: "one"}.get(shift.as_good, str(shift.as_good))
    gain = "gain" if shift.as_good > 1 else "gains"
    row = Row("driven by", f"{some} of {shift.copies} copies shifted by up to {shift.reach:.3g} s {gain} as much")
    columns = ", ".join(term.columns)
    sentence = (
        f"{shift.as_good} of {shift.copies} copies of {columns}, shifted by up to {shift.reach:.3g} s, gain as much "
        f"for {term.effect.id} as the column itself: its timing does not distinguish it from other quantities that "
        f"change "
        "as slowly."
    )
    many = shift.as_good > settings.shift_many * shift.copies
    return EvidenceResult(
        "driver_shift", shift, keys={"driver_shift": shift}, warnings=(sentence,) if many else (), rows=(row,)
    )


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
    if term.driver is None or pointwise is None or model.prepared.ports[term.port].clock is not None:
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
