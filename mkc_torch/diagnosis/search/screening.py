"""Screening of all candidates at a fit of differential equations: gains with each one's own noise, and p-value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Key, Term, continuous
from mkc_torch.diagnosis.search.joint_likelihood import JointLikelihood, joint_likelihood
from mkc_torch.diagnosis.search.problem import SearchProblem
from mkc_torch.diagnosis.search.ranking import ModelPrior, Ranked, in_order
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError


def screened(
    base: FittedModel,
    terms: Sequence[Term],
    *,
    level: float,
    surrogates: int,
    generator: torch.Generator,
    declared: Mapping[str, float],
    settings: Settings,
    quick: bool = False,
) -> SearchResult:
    """Screen the candidates at a fit, and test the strongest against the same screening of surrogates.

    Args:
        base: the fit, under its most likely noise.
        terms: candidates.
        level: rate of false alarms.
        surrogates: number of surrogates for each kind of noise.
        generator: of the surrogates.
        declared: known standard deviations of the outputs' white noise.
        settings: thresholds.
        quick: draw no surrogates; the strongest candidate counts if it gains more than its penalty.

    Raises:
        NoFitError: the fit's trajectory is lost.
    """
    terms = tuple(terms)
    tangents = tangents_of(base.model, base.parameters, settings.noise, terms)
    values, counts = base.pseudo(settings.noise)
    channels = base.model.prepared.channels
    found = joint_likelihood(
        base,
        terms,
        tangents,
        counts,
        surrogates,
        generator,
        level=level,
        declared=[name in declared for name in channels],
        quick=quick,
        price=settings.noise.disturbance_gain,
    )
    if found is None:
        raise NoFitError("The simulation has no finite trajectory at the fitted values.")
    look = SearchProblem(base, base, terms, tangents, values, counts, settings).under()
    ranking = _ranked(found, terms, ModelPrior(terms, base.model.prepared, settings.naming))
    best = _fit_of(base, terms[ranking[0].number], found, ranking[0].number)
    return SearchResult(
        best.model.terms[-1],
        best,
        found.p_value,
        found.beyond,
        ranking,
        look.noise,
        look,
        look.linearised,
        longer=found.longer,
        with_noise=True,
    )


def _ranked(found: JointLikelihood, terms: tuple[Term, ...], prefer: ModelPrior) -> tuple[Ranked, ...]:
    """Rank the effects at their best shapes by gain less Akaike's penalty of their numbers and their own penalties."""
    numbers = found.gain.new_tensor([float(len(continuous(term))) for term in terms])
    penalty = [prefer.penalty(term, float(nats)) for term, nats in zip(terms, found.gain, strict=True)]
    score = found.gain - found.dof - numbers - found.gain.new_tensor(penalty)
    score = torch.where(found.dof > 0, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in in_order(score.tolist(), terms):
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(n, float(found.gain[n]), float(score.max() - score[n])) for n in best.values())


def _fit_of(base: FittedModel, term: Term, found: JointLikelihood, number: int) -> FittedModel:
    """Return the joint fit of a candidate, under its remaining process noise by the screening."""
    begin = found.start(number)
    free = term.effect.open_loop_only or base.model.open_loop_only
    smaller = base.model.prepared.observed(None if free else begin.observer)
    start = torch.cat([_inside(base, base.parameters + begin.shift), begin.gamma])
    model = JointModel(smaller, (*base.model.terms, term), base.model.near)
    size_zero = torch.cat([base.parameters, torch.zeros_like(begin.gamma)])
    # far along the tangents there may be no finite trajectory
    for parameters in (start, size_zero):
        there = fitted_with_effect(base, model, parameters, graduate=False)
        if there.model.prepared is smaller:
            return there
    return fitted_with_effect(base, base.model.with_term(term), start, graduate=False)


def _inside(base: FittedModel, parameters: Tensor) -> Tensor:
    """Clip parameters to their bounds; keep a parameter that would more than double, beyond the linear range."""
    bounds = base.model.bounds
    if bounds is not None:
        parameters = parameters.clamp(*bounds)
    own = base.model.base
    far = (parameters - base.parameters).abs() > base.parameters.abs().clamp(min=1e-12)
    return torch.where(far & (torch.arange(len(parameters)) < own), base.parameters, parameters)
