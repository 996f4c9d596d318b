"""The order in which an effect with memory and an effect without act on the same signal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.own_noise import priced, with_own_noise
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError


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
