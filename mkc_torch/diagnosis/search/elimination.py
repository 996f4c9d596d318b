"""Backward elimination: drop findings that later findings make needless."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

from mkc_torch.diagnosis.model.fit import FittedModel, fitted, without_term
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.diagnosis.search.own_noise import priced, with_own_noise
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

__all__ = ["needless_term", "without"]


def needless_term(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> int | None:
    """Return the number of an effect that does not pay its penalty given the others; None if all do.

    The penalty of an effect is half the logarithm of the number of samples for each of its numbers and each fitted
    number of its shape (Schwarz, Annals of Statistics 6, 1978, 461), plus the limit of separability.

    Args:
        fit: with several effects.
        declared: known standard deviations of the outputs' white noise.
        settings: thresholds.
    """
    count = len(fit.model.terms)
    if count < 2:
        return None
    works = [partial(_loss, fit, number, declared, settings) for number in range(count)]
    losses = run_parallel(works, fit.model.prepared, fit.model.terms)
    weakest = min(range(count), key=losses.__getitem__)
    return weakest if losses[weakest] < settings.naming.separable else None


def _loss(fit: FittedModel, number: int, declared: Mapping[str, float], settings: Settings) -> float:
    """Nats by which the fit without an effect is less likely, less the effect's penalty."""
    less = without(fit, number, declared, settings)
    if less is None:
        return math.inf
    numbers = fit.model.sizes[number] + len(fit.model.terms[number].effect.fitted_shape)
    price = 0.5 * numbers * math.log(len(fit.residual))
    return priced(fit, settings) - priced(less, settings) - price


def without(fit: FittedModel, number: int, declared: Mapping[str, float], settings: Settings) -> FittedModel | None:
    """Return the joint fit without one of its effects, under its remaining noise; None if it fails."""
    start = without_term(fit, number)
    try:
        return with_own_noise(fitted(start.model, start.parameters, fit.bound, graduate=False), declared, settings)
    except NoFitError:
        return None
