"""A partner for a finding whose size is not determined: two effects that gain only together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import torch

from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.search.estimate import estimate
from mkc_torch.diagnosis.search.own_noise import number_count, priced
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NoiseSettings, Settings

_LEADING = 3
"""Number of leading other effects of the search that are tried as partners; chosen by judgement."""


def is_undetermined(fit: FittedModel, settings: NoiseSettings) -> bool:
    """Whether all sizes of the last effect are within a standard error of 0 in the open-loop fit."""
    found = estimate(fit.open_loop or fit, settings)
    size = fit.model.sizes[-1]
    return bool((found.fit.parameters[-size:].abs() <= found.standard_error[-size:]).all())


def with_partner(
    found: SearchResult, free: FittedModel, declared: Mapping[str, float], settings: Settings
) -> FittedModel | None:
    """Return the joint fit of a finding with the partner that gains most, under its own noise; None if none pays.

    Process noise that a finding alone leaves over hides its partner, so the pairs are fitted in open loop, with the
    simulation's parameters free. Partners are the same effect at other places, such as the overflow of the next vessel,
    and the leading other effects.

    Args:
        found: the finding, the last effect of its fit.
        free: the open-loop fit without the finding.
        declared: known standard deviations of the outputs' white noise.
        settings: a partner pays if it gains more than Schwarz's penalty and the limit of separability.
    """
    terms = found.scene.terms
    own = [term for term in terms if term.key == found.term.key]
    common = free.model.prepared, terms
    alone = max(run_parallel([partial(_with_effect, free, term) for term in own], *common), key=_likelihood)
    pairs = run_parallel([partial(_with_effect, alone, term) for term in _partners(found)], *common)
    if not pairs:
        return None
    # the shapes stay: with process noise many shapes follow the recording
    pair = fit_with_process_noise(max(pairs, key=_likelihood), declared, settings.noise).fit
    price = 0.5 * math.log(len(pair.residual)) * number_count(pair) + settings.naming.separable
    return pair if priced(pair, settings) > priced(found.fit, settings) + price else None


def _partners(found: SearchResult) -> list[Term]:
    """Return the same effect at other places, and the leading other effects, each at the best shape of the search."""
    ranked = [found.scene.terms[rival.number] for rival in found.ranking]
    others = [term for term in ranked if term.key != found.term.key and not term.effect.is_curve]
    same = [term for term in others if term.effect.id == found.term.effect.id]
    return [*same, *[term for term in others if term not in same][:_LEADING]]


def _with_effect(fit: FittedModel, term: Term) -> FittedModel:
    """Return the joint fit with one more effect, from its size 0, with its shape."""
    model = fit.model.with_term(term)
    start = torch.cat([fit.parameters, fit.parameters.new_zeros(model.size - fit.model.size)])
    return shape_fitted(fitted_with_effect(fit, model, start, graduate=False))


def _likelihood(fit: FittedModel) -> float:
    """Log-likelihood less Schwarz's penalty of the last effect."""
    return fit.log_likelihood - 0.5 * math.log(len(fit.residual)) * number_count(fit)
