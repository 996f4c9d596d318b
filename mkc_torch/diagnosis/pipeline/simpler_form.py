"""Replacement of a finding by another effect that explains the recording as well."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval, held_out
from mkc_torch.diagnosis.evidence.timing import shifted
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.simpler import simpler_start
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.search.joint_refits import refitted
from mkc_torch.diagnosis.search.own_noise import priced, with_own_noise
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NamingSettings, Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from mkc_torch.diagnosis.model.term import Term


Holds = Callable[[FittedModel, Evidence], bool]

REACH = 2.0
"""Limits of separability within which a special case is compared on held-out blocks: a Bayes factor of 8,000.

The likelihoods are those under each fit's own noise, whose sizes and correlation times are estimated too. Beyond this
distance that estimate cannot account for the difference. Judgement, checked on recordings of a sled
(`python -m tests.thresholds.open_loop --systems sled`, seeds 0 to 3): with a drag of exponent 1.5 the quadratic drag is
19 to 49 nats behind the power law, twice this distance at least, and blocks prefer the power law, in 4 of 4. With
quadratic drag in thinning air the quadratic drag is most likely itself in 3 of 4, and not compared in the fourth.
"""

Scores = Callable[[FittedModel], Evidence]
"""A fit's evidence on held-out blocks."""

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
        as_well = lost <= settings.separable or agreed_innovation_gain(after.residual, evidence.residual) <= 0.0
        if as_well and holds(other, after):
            fit, evidence = other, after
    return fit, evidence


def simpler_by_price(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Replace each effect by its simpler form if the recording does not distinguish them.

    Each form has its own noise fit. The recording distinguishes two forms by more nats than their Schwarz penalty, and
    than the threshold for rivals.

    Args:
        fit: with all findings.
        declared: known standard deviations of the outputs' white noise.
        settings: thresholds.
    """
    for number in range(len(fit.model.terms)):
        start = simpler_start(fit, number)
        if start is None:
            continue
        model, parameters = start
        try:
            other = with_own_noise(fitted(model, parameters, fit.bound, graduate=False), declared, settings)
        except NoFitError:
            continue
        price = 0.5 * (fit.model.size - model.size) * math.log(len(fit.residual))
        if priced(fit, settings) - priced(other, settings) < max(price, settings.naming.separable):
            fit = other
    return fit


def with_special_case(
    located: SearchResult, scores: Scores, blocks: HeldOutBlocks, seed: int, settings: NamingSettings
) -> SearchResult:
    """Return the search result with the most likely special case first, unless held-out blocks prefer the general form.

    A general form, such as a power of the speed with any exponent, follows the errors of a nearly right special case,
    such as drag in air whose density falls. Both remain candidates that the recording does not distinguish.

    Args:
        located: the search result, of a general form or not.
        scores: evidence of a fit on the held-out blocks.
        blocks: the held-out blocks.
        seed: of the interval's bootstrap.
        settings: limit of separability.
    """
    if not located.term.effect.is_generalisation:
        return located
    terms = located.scene.terms
    gaps = {terms[rival.number].key: rival.gap for rival in located.ranking}
    near = [
        fit
        for fit in located.compared
        if fit.model.terms[-1].port == located.term.port
        and not (fit.model.terms[-1].effect.is_generalisation or fit.model.terms[-1].effect.is_curve)
        and gaps.get(fit.model.terms[-1].key, torch.inf) < REACH * settings.separable
    ]
    if not near:
        return located
    special = min(near, key=lambda fit: gaps[fit.model.terms[-1].key])
    try:
        difference = scores(located.fit).log_likelihood - scores(special).log_likelihood
    except NoFitError:
        return located
    _, (low, _) = gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))
    if low > 0.0:
        return located
    alike = {special.model.terms[-1].key, located.term.key}
    moved = [replace(rival, gap=0.0) if terms[rival.number].key in alike else rival for rival in located.ranking]
    key = special.model.terms[-1].key
    ranking = tuple(sorted(moved, key=lambda rival: (rival.gap, terms[rival.number].key != key)))
    return replace(located, fit=special, term=special.model.terms[-1], ranking=ranking)


def in_better_order(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Return the fit, or the fit with lag and static effect of a port exchanged if that is clearly more likely.

    A driver's dead zone comes before the lag of its motor, the square law of a propeller behind it.

    Args:
        fit: with any effects.
        declared: known standard deviations of the outputs' white noise.
        settings: of the diagnosis; the order changes beyond the limit of separability.
    """
    model = fit.model
    lagging = {term.port for term in model.terms if term.effect.remembers and not _commutes(term)}
    moved = [
        not term.effect.remembers and term.port in lagging and model.prepared.ports[term.port].in_series(term.port)
        for term in model.terms
    ]
    if not any(moved):
        return fit
    terms = tuple(
        replace(term, first=not term.first) if other else term for term, other in zip(model.terms, moved, strict=True)
    )
    try:
        other = fitted(JointModel(model.prepared, terms, model.near), fit.parameters, fit.bound, graduate=False)
    except NoFitError:
        return fit
    other = with_own_noise(other, declared, settings) if has_process_noise(fit) else shape_fitted(other)
    return other if priced(other, settings) > priced(fit, settings) + settings.naming.separable else fit


def _commutes(term: Term) -> bool:
    """Whether an effect with memory commutes with every static effect: a pure delay does."""
    return "delay" in term.shape


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
