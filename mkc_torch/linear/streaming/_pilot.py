"""Start of a streamed fit: the fit of a sample of its rows, in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.likelihood import normaliser_derivatives
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.linear.em import MKCRegression
from mkc_torch.linear.streaming._blocks import Shape
from mkc_torch.linear.streaming._reservoir import Drawn
from mkc_torch.linear.streaming._sums import StreamPoint, StreamSums, slopes_pass

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["PilotFit", "fit_pilot"]

_LEAST_D = 0.1
"""Least d of all rows, in d of the sample; a sample of a few hundred rows knows its scale to a tenth."""

_HELD = 1e-3
"""Slope of the mean log-likelihood by log d above which d ended at its least; at convergence it is below 1e-5."""


@dataclass(frozen=True)
class PilotFit:
    """Fit of a sample, as the start of the fit to all rows.

    Attributes:
        coef, kappa, log_d: the sample's maximum, (n,), (m,), (m,).
        log_bound, log_d_min: log half-width of the sample's domain and least log d, (m,).
        free_kappa, free_d: whether 1/σ² and d are learned.
        exact: whether most values lie on the fit to rounding.
        rows: number of rows of the sample.
        weight: sum of its weights, (m,).
        sums: :class:`StreamSums` over the sample at its maximum, flat.
    """

    coef: Float64[Tensor, " n"]
    kappa: Float64[Tensor, " m"]
    log_d: Float64[Tensor, " m"]
    log_bound: Float64[Tensor, " m"]
    log_d_min: Float64[Tensor, " m"]
    free_kappa: bool
    free_d: bool
    exact: bool
    rows: int
    weight: Float64[Tensor, " m"]
    sums: Float64[Tensor, " k"]


def fit_pilot(
    drawn: Drawn, shape: Shape, estimator: MKCRegression, to_basis: Float64[Tensor, "n n"] | None = None
) -> PilotFit:
    """Fit :class:`MKCRegression` to a sample.

    Args:
        drawn: the sample.
        shape: shape of the batches.
        estimator: estimator with the parameters of the fit.
        to_basis: change of basis of the columns for the sums, or None.

    Raises:
        RankDeficientError: the sample's columns are linearly dependent.
        ValueError: a parameter of the estimator does not suit the data.
    """
    x, y, weight = _columns(drawn, shape)
    try:
        fit = estimator.fit(x, y, weight)
    except RankDeficientError as error:
        raise RankDeficientError(
            f"In the sample of {len(x)} rows from which the fit starts: {error} If few rows distinguish these columns, "
            "raise `pilot`."
        ) from None
    coef, kappa, log_d, log_bound = fit.coef_, fit.sigma_.pow(-2), torch.log(fit.d_), torch.log(fit.bound_)
    transformed = coef if to_basis is None else torch.linalg.solve(to_basis, coef.unsqueeze(-1)).squeeze(-1)
    point = StreamPoint(
        transformed.numpy(), kappa.numpy(), fit.d_.numpy(), None if to_basis is None else to_basis.numpy()
    )
    flat = slopes_pass([(x, y) if weight is None else (x, y, weight)], shape, point, curvature=True)
    total = _total_weight(weight, len(x), shape.m)
    exact = bool(fit.exact_fit_)
    slope = normaliser_derivatives(kappa, log_d, log_bound).log_d - 2.0 * StreamSums.of(flat, shape).qw / total
    return PilotFit(
        coef=coef,
        kappa=kappa,
        log_d=log_d,
        log_bound=log_bound,
        log_d_min=torch.where(slope > _HELD, log_d, torch.log(_LEAST_D * fit.d_)) if not exact else log_d,
        free_kappa=estimator.sigma is None,
        free_d=estimator.d is None,
        exact=exact,
        rows=len(x),
        weight=total,
        sums=flat,
    )


def _total_weight(weight: Tensor | None, rows: int, m: int) -> Float64[Tensor, " m"]:
    return torch.full((m,), float(rows), dtype=torch.float64) if weight is None else weight.reshape(rows, m).sum(0)


def _columns(drawn: Drawn, shape: Shape) -> tuple[Tensor, Tensor, Tensor | None]:
    m, n = shape.m, shape.n
    rows = torch.from_numpy(drawn.rows)
    x, y = rows[:, : m * n].unflatten(1, (m, n)), rows[:, m * n : m * n + m]
    weight = rows[:, m * n + m :] if shape.weighted else None
    if not shape.single_channel:
        return x, y, weight
    return x.squeeze(1), y.squeeze(1), None if weight is None else weight.squeeze(1)
