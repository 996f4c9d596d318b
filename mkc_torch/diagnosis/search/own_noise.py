"""Joint fits under their own remaining noise: its penalty, backward elimination, and open-loop fits of candidates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted, fitted_with_effect, without_term
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import estimate_noise, noise_of_fit
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.model.term import Key, Term, run_parallel
from mkc_torch.diagnosis.search.moves import linear_gains
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float


def with_own_noise(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Return the joint fit of a candidate, with its shape, under the most likely sizes of the remaining noise."""
    noise = estimate_noise(fit, declared, settings.noise, noise_of_fit(fit, declared))
    if noise is None:
        return shape_fitted(fit)
    model = JointModel(fit.model.prepared.observed(noise.observer), fit.model.terms, fit.model.near)
    try:
        again = fitted(model, fit.parameters, fit.bound, graduate=False, fresh=True)
    except NoFitError:
        return shape_fitted(fit)
    return shape_fitted(again if priced(again, settings) > priced(fit, settings) else fit)


def priced(fit: FittedModel, settings: Settings) -> float:
    """Return the log-likelihood less the penalty of the disturbances in a fit's noise."""
    observer = fit.model.prepared.observer
    return fit.log_likelihood - settings.noise.disturbance_gain * (
        0 if observer is None else len(observer.disturbances)
    )


def number_count(fit: FittedModel, number: int = -1) -> int:
    """Number of sizes and fitted shape numbers of an effect, by default the last."""
    return fit.model.sizes[number] + len(fit.model.terms[number].effect.fitted_shape)


def needless_terms(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> tuple[int, ...]:
    """Return the numbers of an effect, or of a pair, that does not pay its penalty given the others; empty if all do.

    The penalty of an effect is half the logarithm of the number of samples for each of its numbers and each fitted
    number of its shape (Schwarz, Annals of Statistics 6, 1978, 461), plus the limit of separability. Two effects can
    compensate each other, so that each pays its penalty given the other, but not both together. Of an effect and its
    special case at the same place, such as friction that falls with speed and dry friction, the weaker is needless.

    Args:
        fit: with several effects.
        declared: known standard deviations of the outputs' white noise.
        settings: thresholds.
    """
    count = len(fit.model.terms)
    for size in (1, 2) if count > 1 else ():
        sets = list(combinations(range(count), size))
        works = [partial(_loss, fit, numbers, declared, settings) for numbers in sets]
        losses = dict(zip(sets, run_parallel(works, fit.model.prepared, fit.model.terms), strict=True))
        weakest = min(sets, key=losses.__getitem__)
        if losses[weakest] < settings.naming.separable:
            return weakest
        nested = [(n,) for n in range(count) if any(_is_nested(fit.model.terms[n], o) for o in fit.model.terms)]
        if size == 1 and nested:
            return min(nested, key=losses.__getitem__)
    return ()


def _is_nested(term: Term, other: Term) -> bool:
    """Whether one of two effects at the same place is a special case of the other."""
    pairs = ((term.effect, other.effect), (other.effect, term.effect))
    return term.port == other.port and any(
        general.reduces_to is not None and general.reduces_to.id == special.id for general, special in pairs
    )


def _loss(fit: FittedModel, numbers: Sequence[int], declared: Mapping[str, float], settings: Settings) -> float:
    """Nats by which the fit without some effects is less likely, less the effects' penalty."""
    less = without(fit, numbers, declared, settings)
    if less is None:
        return math.inf
    price = 0.5 * math.log(len(fit.residual)) * sum(number_count(fit, number) for number in numbers)
    return priced(fit, settings) - priced(less, settings) - price


def without(
    fit: FittedModel, numbers: Sequence[int], declared: Mapping[str, float], settings: Settings
) -> FittedModel | None:
    """Return the joint fit without some of its effects, under its remaining noise; None if it fails."""
    start = fit
    for number in sorted(numbers, reverse=True):
        start = without_term(start, number)
    try:
        return with_own_noise(fitted(start.model, start.parameters, fit.bound, graduate=False), declared, settings)
    except NoFitError:
        return None


PHYSICS = 8
"""Number of effects that are fitted in open loop."""

FURTHER = 3
"""The same once there are findings: there the linear gains are more reliable. Chosen by judgement."""

SHAPES = 2
"""Number of initial shapes for each effect."""

BEHIND_NATS = 50.0
"""Fits farther behind the largest gain than this many nats are dropped, if also beyond the share below."""

BEHIND_SHARE = 0.5
"""Share of the largest gain by which a dropped fit is behind."""


class FreeRuns(NamedTuple):
    """Open-loop fits of candidates: for each effect the number of its initial term, and its fit.

    ``behind`` are the effects whose fits are too far behind the best.
    """

    fits: list[tuple[int, FittedModel]]
    behind: frozenset[Key] = frozenset()


def free_runs(free: FittedModel, terms: Sequence[Term], settings: Settings) -> FreeRuns:
    """Fit in open loop the candidates that gain most over the open-loop simulation.

    Args:
        free: the open-loop fit without a candidate.
        terms: candidates.
        settings: of the diagnosis.
    """
    gains, sizes = linear_gains(free, terms, settings.noise)
    chosen = _chosen(gains, terms, FURTHER if free.model.terms else PHYSICS)
    if not chosen:
        return FreeRuns([])
    known = free.model.prepared, [terms[number] for number in chosen]
    works = [partial(_fit, free, terms[number], sizes[number]) for number in chosen]
    best: dict[Key, tuple[int, FittedModel]] = {}
    for number, fit in zip(chosen, run_parallel(works, *known), strict=True):
        key = terms[number].key
        if key not in best or fit.log_likelihood > best[key][1].log_likelihood:
            best[key] = number, fit
    kept = _near([fit.log_likelihood - free.log_likelihood for _, fit in best.values()])
    leading = [pair for pair, near in zip(best.values(), kept, strict=True) if near]
    shaped = run_parallel([partial(shape_fitted, fit) for _, fit in leading], *known)
    fits = [(number, fit) for (number, _), fit in zip(leading, shaped, strict=True)]
    return FreeRuns(fits, frozenset(best) - {terms[number].key for number, _ in leading})


def _chosen(gains: Sequence[float], terms: Sequence[Term], most: int) -> list[int]:
    """Return the leading effects, each at its shapes that gain most.

    Far from the solution the linear gains are unreliable, so no leading effect is dropped because of its gain.
    """
    order = sorted(range(len(terms)), key=lambda number: -gains[number])
    able = [number for number in order if gains[number] > 0.0 and not terms[number].effect.is_curve]
    keys = list(dict.fromkeys(terms[number].key for number in able))[:most]
    return [n for key in keys for n in [n for n in able if terms[n].key == key][:SHAPES]]


def _near(gains: Sequence[float]) -> list[bool]:
    """Whether each gain is near enough to the largest."""
    largest = max(gains, default=0.0)
    least = min(largest - BEHIND_NATS, (1.0 - BEHIND_SHARE) * largest)
    return [gain >= least for gain in gains]


def _fit(free: FittedModel, term: Term, size: Float[Tensor, " q"]) -> FittedModel:
    model = free.model.with_term(term)
    starts = (torch.cat([free.parameters, size]), torch.cat([free.parameters, torch.zeros_like(size)]))
    fits = [fitted_with_effect(free, model, start, graduate=False) for start in starts]
    return max(fits, key=lambda fit: fit.log_likelihood)
