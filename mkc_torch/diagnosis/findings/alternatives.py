"""Fitted parameters of the alternatives that a recording cannot distinguish from a finding."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import torch

from mkc_torch.diagnosis.evidence.prediction import open_loop_at
from mkc_torch.diagnosis.findings.finding import all_parameters
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_only_drift, has_process_noise, refit_open_loop
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.result import Alternative, EffectParameter
from mkc_torch.diagnosis.search.estimate import FinalEstimate, estimate
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError

MOST_FITTED = 3
"""Number of alternatives that are fitted; the terminal names as many."""

_Place = tuple[str, tuple[str, ...], str]
"""Effect, columns and port of an alternative."""


def with_parameters(
    alternatives: tuple[Alternative, ...],
    located: SearchResult,
    final: FinalEstimate,
    number: int,
    settings: NoiseSettings,
) -> tuple[Alternative, ...]:
    """Fit the nearest inseparable alternatives in place of a finding; return all, these with their parameters.

    Args:
        alternatives: of the finding, nearest first.
        located: its search result.
        final: the final parameters with all findings.
        number: of the finding among the model's effects.
        settings: of the noise that standard errors are of.

    Returns:
        The alternatives in their order. Fits that lose the recording leave an alternative without parameters. A more
        general form of the finding that adds nothing to it is left out.
    """
    terms = {_place(located.scene.terms[rival.number]): located.scene.terms[rival.number] for rival in located.ranking}
    near = [rival for rival in alternatives if not rival.separable and _named(rival) in terms][:MOST_FITTED]
    if not near:
        return alternatives
    works = [partial(_parameters, located, final, number, terms[_named(rival)], settings) for rival in near]
    found = run_parallel(works, final.fit.model.prepared, list(terms.values()))
    known: Mapping[_Place, tuple[EffectParameter, ...]] = {
        _named(rival): parameters for rival, parameters in zip(near, found, strict=True)
    }
    own = {parameter.name for parameter in all_parameters(final, number)}
    general = {place for place, term in terms.items() if _special_case(term) == located.term.effect.id}
    return tuple(
        replace(rival, parameters=known.get(_named(rival), ()))
        for rival in alternatives
        if not (_named(rival) in general and adds_nothing(own, known.get(_named(rival), ())))
    )


def adds_nothing(own: Collection[str], parameters: Sequence[EffectParameter]) -> bool:
    """Whether all sizes of a general form, other than those of its special case, are within a standard error of 0.

    Args:
        own: names of the special case's parameters.
        parameters: of the general form.

    Example:
        >>> share = EffectParameter("share_of_load", 0.0001, 0.0002, "")
        >>> adds_nothing({"friction"}, [EffectParameter("friction", 0.4, 0.01, "m/s2"), share])
        True
    """
    more = [parameter for parameter in parameters if parameter.name not in own and not parameter.of_shape]
    return bool(more) and all(
        isinstance(parameter.value, float)
        and isinstance(parameter.standard_error, float)
        and abs(parameter.value) <= parameter.standard_error
        for parameter in more
    )


def _special_case(term: Term) -> str | None:
    special = term.effect.reduces_to
    return None if special is None else special.id


def _place(term: Term) -> _Place:
    return term.effect.form_id, term.columns, term.at


def _named(rival: Alternative) -> _Place:
    return rival.effect, rival.drivers, rival.port


def _parameters(
    located: SearchResult, final: FinalEstimate, number: int, term: Term, settings: NoiseSettings
) -> tuple[EffectParameter, ...]:
    """Return the parameters of a candidate in place of a finding; none if its fit fails."""
    try:
        fit = _in_place(located, final.fit, number, term)
        return () if fit is None else all_parameters(estimate(fit, settings), number)
    except NoFitError:
        return ()


def _in_place(located: SearchResult, final: FittedModel, number: int, term: Term) -> FittedModel | None:
    """Fit a candidate in place of an effect, in open loop if the finding is.

    The fit of the search is continued if it has the same other effects. As for a finding, parameters next to a sensor's
    drift are those of the fit with the drift.
    """
    others = [other.key for place, other in enumerate(final.model.terms) if place != number]
    compared = [
        fit
        for fit in located.compared
        if fit.model.terms[-1].key == term.key and [other.key for other in fit.model.terms[:-1]] == others
    ]
    if compared and number == len(final.model.terms) - 1:
        known = compared[0]
        if has_process_noise(final):
            return known
        return open_loop_at(known) if has_only_drift(known) else refit_open_loop(known)
    terms = (*final.model.terms[:number], term, *final.model.terms[number + 1 :])
    model = JointModel(final.model.prepared, terms, final.model.near)
    parts = list(final.model.gammas(final.parameters))
    parts[number] = final.parameters.new_zeros(model.sizes[number])
    start = torch.cat([final.parameters[: model.base], *parts])
    return shape_fitted(fitted(model, start, final.bound))
