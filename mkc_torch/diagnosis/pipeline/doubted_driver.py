"""An effect of time alone in place of an effect of a column whose timing the recording does not show."""

from __future__ import annotations

from dataclasses import replace

from mkc_torch.diagnosis.evidence.timing import shifted
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.search.joint_refits import refitted
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

REACH = 2.0
"""Limits of separability within which an effect of time takes the place of an effect of a doubted column.

That of a special case (:mod:`mkc_torch.diagnosis.pipeline.special_case`): the lag of a slow column gives it a choice of
courses that its penalty of one number does not cover.
"""


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
        and rival.gap < REACH * settings.naming.separable
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
