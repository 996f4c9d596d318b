"""Fits of simulations that step, by steps that are affine near the last fit, in rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.functional import mkc_nll
from mkc_torch.nonlinear import NoFitError, NonlinearFit
from mkc_torch.simulation.continuation import Continuation

if TYPE_CHECKING:
    from jaxtyping import Float

_ROUNDS = 8
"""Most rounds; a fit that needs more goes on with the simulation's own steps."""

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
) -> tuple[NonlinearFit | None, Float[Tensor, " p"]]:
    """Return a fit by affine steps, and its parameters; None in place of a fit that must go on from the latter.

    A round fits with the steps that are affine near the last parameters, and then runs the simulation itself; where
    that is worse, over a shorter way. The rounds end where both agree, or where nothing is gained: the affine steps
    have the simulation's own values and derivatives at the last parameters.

    Args:
        way: the residual.
        start: the parameters to start from.
        fit: fits a residual from a start.
        weight: weights of the samples, (N,) or (N, m); None for 1.
        tolerance: gain in nats per sample below which a fit ends.
    """
    best, value = None, -torch.inf
    for _ in range(_ROUNDS):
        affine = way.affine(start)
        if affine is None:
            break
        try:
            found = fit(affine, start)
        except NoFitError:
            break
        agreed = _AGREED * tolerance * len(found.weights)
        predicted, own = (_log_likelihood(residual(found.theta), found, weight) for residual in (affine, way))
        for share in _SHARES if own < value - agreed else ():
            if own < value:
                found = replace(found, theta=torch.lerp(start, found.theta, share))
                own = _log_likelihood(way(found.theta), found, weight)
        gain = own - value
        if gain > 0.0:
            best, value, start = found, own, found.theta
        if gain <= agreed or abs(predicted - own) <= agreed:
            return best, start
    return None, start


def _log_likelihood(residual: Float[Tensor, "N m"], found: NonlinearFit, weight: Tensor | None) -> float:
    """The log-likelihood at the σ and d of a fit, in nats; -inf where the residual is not finite."""
    if not bool(residual.isfinite().all()):
        return -torch.inf
    nats = mkc_nll(residual, found.sigma, found.d, found.bound)
    return -float((nats if weight is None else weight.reshape(len(residual), -1) * nats).sum())
