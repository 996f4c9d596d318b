"""Where a streamed fit begins: the fit of a sample of its rows, in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear._problem import RankDeficientError, linear_problem
from mkc_torch.linear.em import MKCRegression, _alternate, _Known
from mkc_torch.linear.streaming._blocks import Shape
from mkc_torch.linear.streaming._reservoir import Drawn
from mkc_torch.linear.streaming._sums import Point, slopes_pass

if TYPE_CHECKING:
    from jaxtyping import Float64

__all__ = ["Begun", "begun_from"]


@dataclass(frozen=True)
class Begun:
    """What a sample says of where the maximum is sought.

    Attributes:
        rough: coefficients of the rough fit, whose residuals the domain is taken from, (n,).
        coef, kappa, log_d: the sample's maximum on the sample's domain, (n,), (m,), (m,).
        log_bound, log_d_min: of the sample's domain, and the least log d, (m,).
        free_kappa, free_d: whether 1/σ² and d are learned.
        exact: most values lie on the fit to rounding.
        rows: of the sample.
        weight: sums of its weights, (m,).
        sums: of :class:`Slopes` over it at its maximum, flat.
    """

    rough: Float64[Tensor, " n"]
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


def begun_from(
    drawn: Drawn, shape: Shape, estimator: MKCRegression, to_basis: Float64[Tensor, "n n"] | None = None
) -> Begun:
    """The start, rough fit and maximum of :class:`MKCRegression` on a sample.

    Args:
        drawn: the sample.
        shape: of the batches.
        estimator: with the parameters of the fit.
        to_basis: turns the columns for the sums, where it is to be.

    Raises:
        RankDeficientError: the sample's columns are linearly dependent.
        ValueError: a parameter of the estimator does not suit the data.
    """
    x, y, weight = _columns(drawn, shape)
    with torch.no_grad():
        try:
            problem = linear_problem(x, y, weight)
        except RankDeficientError as error:
            raise RankDeficientError(
                f"In the sample of {len(x)} rows that the fit begins from: {error} Or raise `pilot`, where the rows "
                "that tell these columns apart are few."
            ) from None
        known = _Known(estimator.sigma, estimator.d, estimator.bound, estimator.start)
        begin, beta, state = estimator._begin(problem, known)
        found = _alternate(problem, beta, state, max_iter=estimator.max_iter, tol=estimator.tol)
    coef, kappa, log_d = problem.coefficients(found.beta), found.state.kappa[0], found.state.log_d[0]
    turned = coef if to_basis is None else torch.linalg.solve(to_basis, coef.unsqueeze(-1)).squeeze(-1)
    point = Point(
        turned.numpy(), kappa.numpy(), torch.exp(log_d).numpy(), None if to_basis is None else to_basis.numpy()
    )
    batch = (x, y) if weight is None else (x, y, weight)
    return Begun(
        rough=problem.coefficients(beta),
        coef=coef,
        kappa=kappa,
        log_d=log_d,
        log_bound=found.state.log_bound[0],
        log_d_min=found.state.log_d_min[0],
        free_kappa=found.state.free_kappa,
        free_d=found.state.free_d,
        exact=bool(begin.exact[0]),
        rows=len(x),
        weight=problem.total_weight()[0],
        sums=slopes_pass([batch], shape, point, curvature=True),
    )


def _columns(drawn: Drawn, shape: Shape) -> tuple[Tensor, Tensor, Tensor | None]:
    m, n = shape.m, shape.n
    rows = torch.from_numpy(drawn.rows)
    x, y = rows[:, : m * n].unflatten(1, (m, n)), rows[:, m * n : m * n + m]
    weight = rows[:, m * n + m :] if shape.weighted else None
    if not shape.single_channel:
        return x, y, weight
    return x.squeeze(1), y.squeeze(1), None if weight is None else weight.squeeze(1)
