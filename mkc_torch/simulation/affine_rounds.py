"""Fits of simulations that step, by steps that are affine near the last fit, in rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.functional import mkc_nll
from mkc_torch.nonlinear import NoFitError, NonlinearFit
from mkc_torch.simulation.continuation import Continuation

if TYPE_CHECKING:
    from jaxtyping import Float

_AGREED = 30.0
"""Gain of a round, and difference of the likelihoods by affine and by own steps, that end the rounds, in tolerances."""

_SHARES = (0.5, 0.5, 0.4)
"""Shares of a round's step, one after the other, where it is worse by the simulation's own steps."""


def fitted_in_rounds(
    way: Continuation,
    start: Float[Tensor, " p"],
    fit: Callable[[Continuation, Tensor], NonlinearFit],
    weight: Tensor | None,
    tolerance: float,
    rounds: int,
    reference: Float[Tensor, " p"] | None = None,
    log_prior: Callable[[Tensor], float] = lambda _: 0.0,
) -> NonlinearFit | None:
    """Return a fit by affine steps; None for a simulation without steps, or where the first round fails.

    A round fits with the steps that are affine near the last parameters, and then runs the simulation itself; where
    that is worse than before, over a shorter way. The rounds end where both agree, or where nothing is gained: the
    affine steps have the simulation's own values and derivatives at the last parameters.

    Args:
        way: the residual.
        start: the parameters to start from.
        fit: fits a residual from a start.
        weight: weights of the samples, (N,) or (N, m); None for 1.
        tolerance: gain in nats per sample below which a fit ends.
        rounds: number of rounds at most.
        reference: parameters at whose trajectory the steps of the first round are affine; default those of the start.
        log_prior: logarithm of the parameters' prior density, as in the fit.
    """

    def value_of(residual: Continuation, found: NonlinearFit) -> float:
        return _log_likelihood(residual(found.theta), found, weight) + log_prior(found.theta)

    best, value, at = None, -torch.inf, start
    affine = way.affine(start if reference is None else reference, given=reference is not None)
    found = _fitted(affine, start, fit)
    if found is None and affine is not None and reference is not None:
        affine = way.affine(start)
        found = _fitted(affine, start, fit)
    for _ in range(rounds):
        if found is None or affine is None:
            break
        agreed = _AGREED * tolerance * len(found.weights)
        predicted, own = value_of(affine, found), value_of(way, found)
        if best is None and not abs(predicted - own) <= agreed:
            begun = replace(found, theta=start)
            value = value_of(way, begun)
            best = begun if isfinite(value) else None
        for share in _SHARES if own < value - agreed or not isfinite(own) else ():
            if own < value or not isfinite(own):
                found = replace(found, theta=torch.lerp(at, found.theta, share))
                own = value_of(way, found)
        gain = own - value
        if gain > 0.0:
            best, value, at = found, own, found.theta
        if not gain > agreed or abs(predicted - own) <= agreed:
            break
        affine = way.affine(at)
        found = _fitted(affine, at, fit)
    return best


def _fitted(
    affine: Continuation | None, start: Tensor, fit: Callable[[Continuation, Tensor], NonlinearFit]
) -> NonlinearFit | None:
    try:
        return None if affine is None else fit(affine, start)
    except (NoFitError, ArithmeticError):  # affine steps can diverge where the simulation is nearly unstable
        return None


def _log_likelihood(residual: Float[Tensor, "N m"], found: NonlinearFit, weight: Tensor | None) -> float:
    """The log-likelihood at the σ and d of a fit, in nats; -inf where the residual is not finite."""
    if not bool(residual.isfinite().all()):
        return -torch.inf
    nats = mkc_nll(residual, found.sigma, found.d, found.bound)
    return -float((nats if weight is None else weight.reshape(len(residual), -1) * nats).sum())
