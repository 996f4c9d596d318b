"""Replacement of a finding by another effect that explains the recording as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out
from mkc_torch.diagnosis.evidence.timing import shifted
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.simpler import simpler_start
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.search.joint_refits import refitted
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NamingSettings, Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    pass


Holds = Callable[[FittedModel, Evidence], bool]

TIME_REACH = 2.0
"""Limits of separability within which an effect of time takes the place of an effect of a doubted column.

That of a special case (:mod:`mkc_torch.diagnosis.pipeline.simpler_form`): the lag of a slow column gives it a choice of
courses that its penalty of one number does not cover. It was chosen by judgement, on one recording of a drift.
"""


def simplified(
    fit: FittedModel, evidence: Evidence, blocks: HeldOutBlocks, holds: Holds, settings: NamingSettings
) -> tuple[FittedModel, Evidence]:
    """Replace each effect by its simpler form or special case unless held-out blocks reject it.

    Returns the fit and its scores.

    Held-out blocks reject a form if it makes them clearly less likely under white noise, and increases the innovations
    under coloured noise.

    All effects are tested again after each finding: a form that was needed without the new effect may not be needed any
    more.

    Args:
        fit: with all findings.
        evidence: scores of the fit on the blocks.
        blocks: held-out blocks.
        holds: whether a fit with these scores still confirms the last finding.
        settings: threshold of "clearly less likely".
    """
    for number in range(len(fit.model.terms)):
        start = simpler_start(fit, number)
        if start is None:
            continue
        try:
            other = shape_fitted(fitted(*start, fit.bound, graduate=False))
        except NoFitError:
            continue
        after = held_out(other, blocks)
        lost = float((evidence.log_likelihood - after.log_likelihood).sum())
        gain = agreed_innovation_gain(after.residual, evidence.residual, fit.recorded)
        as_well = lost <= settings.separable or gain <= 0.0
        if as_well and holds(other, after):
            fit, evidence = other, after
    return fit, evidence


def with_driver_or_time(base: FittedModel, located: SearchResult, settings: Settings) -> SearchResult:
    """Return the search result with the nearest effect of time alone first, if the column's timing is doubted.

    Any slow column follows a slow change of the sensor about as well as its cause does. A driver is doubted if more
    copies of it, shifted in time, gain as much than :attr:`EvidenceSettings.shift_many`. The effect of the column stays
    an alternative that the recording does not distinguish.

    Args:
        base: the simulation without the candidate.
        located: the search result.
        settings: limit of separability, and shifts of the driver.
    """
    terms = located.scene.terms
    near = [
        rival
        for rival in located.ranking
        if terms[rival.number].driver is None
        and terms[rival.number].port == located.term.port
        and not terms[rival.number].effect.is_curve
        and rival.gap < TIME_REACH * settings.naming.separable
    ]
    if located.term.driver is None or not near:
        return located
    shift = shifted(base.model, located)
    if shift is None or shift.as_good <= settings.evidence.shift_many * shift.copies:
        return located
    first = min(near, key=lambda rival: rival.gap)
    try:
        fit = refitted(located.fit, terms[first.number], located.look, first.number)
    except NoFitError:
        return located
    others = tuple(rival for rival in located.ranking if rival is not first)
    return replace(located, term=fit.model.terms[-1], fit=fit, ranking=(replace(first, gap=0.0), *others))
