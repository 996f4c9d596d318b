"""The maximum of the MKC likelihood over many rows of any source: passes over the source, from a pilot's fit.

A source is rows in memory or on a GPU, or batches that one process or several read again in every pass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from mkc_torch.density.normalizer import log_partition_value
from mkc_torch.linear._blocks import CurvatureSums, PassResult
from mkc_torch.linear._descent import Descent
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear._problem import solve_gram
from mkc_torch.linear._scale_search import relative_precision

if TYPE_CHECKING:
    from jaxtyping import Float64


class Source(Protocol):
    """Rows of a regression."""

    def evaluate(self, descent: Descent, *, with_range: bool = False) -> PassResult:
        """Make one pass at the point of a descent."""
        ...

    def after(self, descent: Descent, result: PassResult) -> Descent:
        """State of the descent after this pass."""
        ...


def run_descent(
    source: Source, descent: Descent, passes: int, first: PassResult | None = None, *, with_range: bool = False
) -> Descent:
    """Make passes until the descent is done, at most ``passes``; ``first`` is the result of the first, if known."""
    for _ in range(passes):
        if first is None:
            first = source.evaluate(descent, with_range=with_range)
        descent, first = source.after(descent, first), None
        if descent.done:
            break
    return descent


@dataclass(frozen=True)
class RowsMaximum:
    """Maximum of the likelihood of all rows, for the columns of X; only ``fit_state`` is a batch, of size 1."""

    fit_state: FitState
    log_likelihood: Float64[Tensor, ""]
    covariance: Float64[Tensor, "n n"]
    dof: Float64[Tensor, ""]
    history: Float64[Tensor, " k"]
    light: int

    def attributes(self) -> dict[str, Tensor]:
        """Results of an estimator by name, without batch dimensions."""
        state = self.fit_state
        return {
            "coef_": state.beta[0],
            "sigma_": state.kappa[0].rsqrt(),
            "d_": torch.exp(state.log_d[0]),
            "bound_": torch.exp(state.limits[1][0]),
            "log_likelihood_": self.log_likelihood,
            "covariance_": self.covariance,
            "dof_": self.dof,
        }


def maximum_of(end: Descent, used: int, frame: Float64[Tensor, "n n"] | None, *, with_last_step: bool) -> RowsMaximum:
    """The maximum at the end of a descent, from ``used`` values of positive weight.

    ``with_last_step`` makes the step at which the descent ended.
    """
    best, sums = end.end
    point = end.stepped() if with_last_step else best.point
    beta, left = point.beta, used - point.beta.shape[-1]
    covariance = sandwich_of(sums, used, left)
    if frame is not None:
        beta, covariance = beta @ frame.mT, frame @ covariance @ frame.mT
    return RowsMaximum(
        fit_state=replace(end.fit_state, beta=beta, kappa=point.kappa, log_d=point.log_d),
        log_likelihood=-(best.result.total.weight * best.by_channel.value).sum(),
        covariance=covariance,
        dof=beta.new_tensor(float(left)),
        history=beta.new_tensor(end.history),
        light=int(sums.light),
    )


def sandwich_of(found: CurvatureSums, used: int, left: int) -> Float64[Tensor, "n n"]:
    """Sandwich covariance of the coefficients for independent samples: ``used`` values, ``left`` degrees of freedom."""
    # no residual is left to estimate the errors from
    if left <= 0:
        return torch.full_like(found.curvature, torch.inf)
    root = found.curvature.diagonal().rsqrt()
    outer = root.unsqueeze(-1) * root
    inverse = outer * torch.linalg.pinv(outer * found.curvature, hermitian=True)
    return used / left * inverse @ found.spread @ inverse


def more_likely_gaussian(end: Descent, grams: Float64[Tensor, "m n n"], slack: float = 1.0) -> FitState | None:
    """Gaussian density at weighted least squares if its likelihood is higher than at the end of a descent, else None.

    With the products ``G = Σ x xᵀ`` and moments ``g = Σ e x`` of the columns, least squares is ``G⁻¹ g`` away.

    Args:
        end: the descent, whose sums include the moments.
        grams: G of each channel, per unit of weight.
        slack: factor on the gain of least squares, where ``grams`` are approximate.
    """
    state, (best, found) = end.fit_state, end.end
    weight, (log_least, log_bound) = best.result.total.weight, state.limits
    if not (state.free_kappa and state.free_d and bool((end.point.kappa > 0).any())):
        return None
    root = grams.diagonal(dim1=-2, dim2=-1).sum(0).clamp(min=torch.finfo(grams.dtype).tiny).rsqrt()
    gram = weight.sum() * root.unsqueeze(-1) * grams * root
    moment, least = found.moment * root, torch.exp(log_least[0])
    # weights of the channels, from their scales of the step before
    precision = torch.ones_like(weight)
    for _ in range(3 if len(weight) > 1 else 1):
        move = solve_gram((precision[:, None, None] * gram).sum(0), precision @ moment)
        gain = 2.0 * moment @ move - ((gram @ move) @ move)
        mean_square = ((found.square - gain - (slack - 1.0) * gain.abs()) / weight).clamp(min=0.0)
        d = torch.maximum(mean_square.sqrt(), least)
        precision = relative_precision(d)
    norm = torch.log(d) + log_partition_value(torch.zeros_like(d), torch.exp(log_bound[0]) / d)
    if float((0.5 * mean_square / d.square() + norm).sum()) >= end.history[-1]:
        return None
    beta = end.point.beta + root * move
    return replace(state, beta=beta, kappa=torch.zeros_like(state.kappa), log_d=torch.log(d).unsqueeze(0))
