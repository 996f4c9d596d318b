"""Start values of a fit: the user's, or a collocation fit to the measured states."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.nonlinear import NoFitError, fit
from mkc_torch.simulation.dynamics.trajectory import Grid, defect

if TYPE_CHECKING:
    from jaxtyping import Float

_WINDOW = 4
"""Intervals over which defects are summed, so that noise of the states mostly cancels."""


def first_parameters(
    given: Float[Tensor, " p"],
    bounds: tuple[Float[Tensor, " p"], Float[Tensor, " p"]],
    own: int,
    rate: Callable[[Float[Tensor, " p"]], Callable[[Tensor], Tensor]],
    guess: Float[Tensor, "G n"],
    grid: Grid,
    residual: Callable[[Float[Tensor, " p"]], Float[Tensor, "N m"]],
) -> Float[Tensor, " p"]:
    """The user's values, or those that minimise the defects of the guessed states, whichever has the smaller residual.

    Args:
        given: (p,), the user's values, then a guess of the initial states.
        bounds: lower and upper bounds of all parameters.
        own: number of parameters before the initial states.
        rate: from the parameters to the function for the states' rates of change.
        guess: (G, n), of the states at all grid times.
        grid: the G grid times.
        residual: recording minus simulation, (N, m), by the parameters.
    """
    starts = [given]
    if own:
        values, begin = given[:own], given[own:]
        typical = guess.abs().median(0).values.clamp(min=1e-12)

        def summed_defects(values: Tensor) -> Tensor:
            left = defect(rate(torch.cat([values, begin])), guess, grid) / typical
            total = torch.cat([torch.zeros_like(left[:1]), left.cumsum(0)])
            return total[_WINDOW:] - total[:-_WINDOW]

        low, high = (bound[:own] for bound in bounds)
        with suppress(NoFitError):  # the equations are not finite there
            found = fit(summed_defects, values, lower=low, upper=high, covariance=None, max_iter=60).theta
            starts.append(torch.cat([found, begin]))
    spread = [robust_scale(residual(start).nan_to_num(torch.inf, torch.inf, torch.inf)) for start in starts]
    return starts[0] if bool((spread[0] <= spread[-1]).all()) else starts[-1]
