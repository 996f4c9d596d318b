"""Start of a streamed fit: the fit of a sample of its rows, in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.likelihood import normaliser_derivatives
from mkc_torch.linear._blocks import Density
from mkc_torch.linear._descent import PassDerivatives
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.linear._rows import Rows
from mkc_torch.linear.em import MKCRegression
from mkc_torch.linear.streaming._batches import Shape
from mkc_torch.linear.streaming._reservoir import Drawn
from mkc_torch.linear.streaming._survey import Survey

if TYPE_CHECKING:
    from jaxtyping import Float64

_LEAST_D = 0.1
"""Least d of all rows, in d of the sample; a sample of a few hundred rows knows its scale to a tenth."""

_HELD = 1e-3
"""Slope of the mean log-likelihood by log d above which d ended at its least; at convergence it is below 1e-5."""


@dataclass(frozen=True)
class PilotFit:
    """Fit of a sample of ``rows`` rows, as the start of the fit to all rows.

    Attributes:
        fit_state: the sample's maximum with its domain and the least d, in the basis of the passes, a batch of 1.
        slopes: derivatives of the sample at its maximum, and the products of the columns of all rows.
        exact: whether most values lie on the fit to rounding.
    """

    fit_state: FitState
    slopes: PassDerivatives
    exact: bool
    rows: int


def fit_pilot(drawn: Drawn, survey: Survey, estimator: MKCRegression) -> PilotFit:
    """Fit a sample by an estimator with the parameters of the fit.

    Raises:
        RankDeficientError: the sample's columns are linearly dependent.
        ValueError: a parameter of the estimator does not suit the data.
    """
    shape, frame = survey.shape, survey.frame()
    x, y, weight = _columns(drawn, shape)
    given = [x, y] if weight is None else [x, y, weight]
    try:
        fit = estimator.fit(*(values.squeeze(1) if shape.single_channel else values for values in given))
    except RankDeficientError as error:
        raise RankDeficientError(
            f"In the sample of {len(x)} rows from which the fit starts: {error} If few rows distinguish these columns, "
            "raise `pilot`."
        ) from None
    kappa, log_d, log_bound = fit.sigma_.pow(-2), torch.log(fit.d_), torch.log(fit.bound_)
    beta = fit.coef_ if frame is None else torch.linalg.solve(frame, fit.coef_.unsqueeze(-1)).squeeze(-1)
    result = Rows(x, y, weight, frame).evaluate(beta, Density(kappa, fit.d_), with_curvature=True)
    total = result.total
    exact = bool(fit.exact_fit_)
    slope = normaliser_derivatives(kappa, log_d, log_bound).log_d - 2.0 * total.terms[3] / total.weight
    held = log_d if exact else torch.where(slope > _HELD, log_d, torch.log(_LEAST_D * fit.d_))
    beta, kappa, log_d, log_bound, held = (v.unsqueeze(0) for v in (beta, kappa, log_d, log_bound, held))
    free = estimator.sigma is None, estimator.d is None
    fit_state = FitState(beta, kappa, log_d, torch.zeros(1, dtype=torch.bool), log_bound, held, *free)
    return PilotFit(fit_state, PassDerivatives.of(result, survey.grams()), exact, len(x))


def _columns(drawn: Drawn, shape: Shape) -> tuple[Tensor, Tensor, Float64[Tensor, "k m"] | None]:
    m, n = shape.m, shape.n
    rows = torch.from_numpy(drawn.rows)
    weight = rows[:, m * n + m :] if shape.weighted else None
    return rows[:, : m * n].unflatten(1, (m, n)), rows[:, m * n : m * n + m], weight
