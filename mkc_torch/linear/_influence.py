"""Influence of each sample on M-estimated coefficients, and the covariance that follows from it.

An estimate solves ``Σ ψ(r / s) x / s = 0`` with a scale s that solves an equation of its own. To first order a sample
moves it by ``A⁻¹ (ψ(z) x / s - Σ_c a_c ι_c)``. A is the Hessian ``Σ ψ'(z) x xᵀ / s²``, ι_c is the sample's influence
on the log scale of channel c, and ``a_c = Σ (ψ'(z) z + ψ(z)) x / s`` is the derivative of the equation by that log
scale. The summed products of these influences are the covariance, for independent samples with any error distribution.

Croux, Dhaene & Hoorelbeke, "Robust standard errors for robust estimators", discussion paper 03.16, K.U. Leuven (2003).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.small_factors import pinv, symmetric_pinv
from mkc_torch.linear.covariance import RobustCovarianceKind, summed_products

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem
    from mkc_torch.linear._psi import Psi


@dataclass(frozen=True)
class Scores:
    """An estimating equation at its solution: ψ and ψ' of the standardised residuals, and their scale."""

    psi: Float[Tensor, "B N m"]
    slope: Float[Tensor, "B N m"]
    z: Float[Tensor, "B N m"]
    scale: Float[Tensor, "B m"]

    def precision(self) -> Float[Tensor, "B 1 m"]:
        """1 / s², relative to the largest, so that the unit does not matter."""
        return (self.scale.amin(-1, keepdim=True) / self.scale).square().unsqueeze(-2)

    def hessian(self, problem: LinearProblem) -> Float[Tensor, "B n n"]:
        """``Σ ψ'(z) x xᵀ / s²``."""
        return problem.normal_equations(self.slope * self.precision())[0]

    def by_scale(self, problem: LinearProblem) -> Float[Tensor, "B m n"]:
        """Negative derivative of the equation by the log scale of each channel."""
        part = weighted(problem, (self.slope * self.z + self.psi) * self.scale.unsqueeze(-2) * self.precision())
        return summed(problem, part)


def summed(problem: LinearProblem, values: Float[Tensor, "B N m"]) -> Float[Tensor, "B m n"]:
    """``Σ value x`` of each channel."""
    return torch.einsum("bkc,bkcn->bcn", values, problem.basis.expand(values.shape[0], -1, -1, -1))


def scores(problem: LinearProblem, beta: Float[Tensor, "B n"], scale: Float[Tensor, "B m"], psi: Psi) -> Scores:
    """Return the estimating equation of ψ at coefficients in the basis."""
    z = problem.residual(beta) / scale.unsqueeze(-2)
    return Scores(psi.value(z), psi.slope(z), z, scale)


def weighted(problem: LinearProblem, values: Float[Tensor, "B N m"]) -> Float[Tensor, "B N m"]:
    return values if problem.sample_weight is None else values * problem.sample_weight


def shares(problem: LinearProblem, *, in_time: bool) -> Float[Tensor, "B N m"] | None:
    """Factor of each sample's influence: its weight in a time series, else the root of the weight.

    With the root, the product of influences of a sample of weight 2 enters twice: weights count samples.
    """
    w = problem.sample_weight
    # sqrt has no derivative at 0
    return w if w is None or in_time else w.clamp(min=torch.finfo(w.dtype).tiny).sqrt()


@dataclass(frozen=True)
class ScaleInfluence:
    """Influence on the log scale of each channel: of each sample, counted once, and of the coefficients if any."""

    of_samples: Float[Tensor, "B N m"]
    of_coefficients: Float[Tensor, "B m n"] | None = None


def m_scale_influence(
    problem: LinearProblem,
    rho: Float[Tensor, "B N m"],
    slope: Float[Tensor, "B N m"],
    z: Float[Tensor, "B N m"],
    scale: Float[Tensor, "B m"] | None = None,
) -> ScaleInfluence:
    """Influence on a scale that solves ``Σ ρ(z) = const``, z = r / s, with ρ and its ``slope`` at z.

    ``scale`` is given where the coefficients move the scale; None is for a scale at its minimum.
    """
    total = problem.total_weight().unsqueeze(-2)
    centre = weighted(problem, rho).sum(-2, keepdim=True) / total
    slope_sum = weighted(problem, slope * z).sum(-2, keepdim=True).clamp(min=torch.finfo(rho.dtype).eps)
    of_samples = (rho - centre) / slope_sum
    if scale is None:
        return ScaleInfluence(of_samples)
    return ScaleInfluence(of_samples, -summed(problem, weighted(problem, slope) / (slope_sum * scale.unsqueeze(-2))))


def influence(
    problem: LinearProblem,
    equation: Scores,
    of_scale: ScaleInfluence | None = None,
    share: Float[Tensor, "B N m"] | None = None,
) -> Float[Tensor, "B N n"]:
    """Influence of each sample, times its ``share``, on the coefficients in the basis; scales are known by default."""
    values = equation.psi * equation.scale.unsqueeze(-2) * equation.precision()
    values = values if share is None else values * share
    moved = torch.matmul(values.unsqueeze(-2), problem.basis).squeeze(-2)
    hessian = equation.hessian(problem)
    if of_scale is not None:
        by_scale = equation.by_scale(problem)
        part = of_scale.of_samples if share is None else of_scale.of_samples * share
        moved = moved - torch.matmul(part, by_scale)
        if of_scale.of_coefficients is not None:
            inverse = pinv(hessian + torch.matmul(by_scale.mT, of_scale.of_coefficients))
            return torch.matmul(moved, inverse.mT)
    return torch.matmul(moved, symmetric_pinv(hessian))


def homoscedastic(problem: LinearProblem, equation: Scores) -> Float[Tensor, "B n n"]:
    """Covariance of the coefficients in the basis for errors of equal distribution at every X: Huber's (6.5) with K.

    The factor of each channel is ``K² Σψ² / (N - p) / mean(ψ')²``; with p = n / m coefficients a channel,
    ``K = 1 + p / N var(ψ') / mean(ψ')²``.

    Huber, Robust Statistics (1981), section 7.6; it is "H1" in statsmodels.
    """
    total = problem.total_weight()
    p = problem.num_coefficients / problem.num_channels
    slope = weighted(problem, equation.slope).sum(-2) / total
    spread = weighted(problem, (equation.slope - slope.unsqueeze(-2)).square()).sum(-2) / total
    tiny = torch.finfo(slope.dtype).tiny
    square = slope.square().clamp(min=tiny)
    correction = (1.0 + p / total * spread / square).square()
    left = (total - p).clamp(min=1.0)
    variance = correction * weighted(problem, equation.psi.square()).sum(-2) / left / square  # of ψ(z) / E ψ'
    precision = equation.precision()
    least = equation.scale.amin(-1, keepdim=True).unsqueeze(-1).square()
    unit_weight = torch.ones_like(equation.psi)
    inverse = symmetric_pinv(problem.normal_equations(unit_weight * precision)[0])
    middle = problem.normal_equations(unit_weight * precision * variance.unsqueeze(-2))[0]
    return least * torch.matmul(torch.matmul(inverse, middle), inverse)


def robust_covariance(
    problem: LinearProblem,
    equation: Scores,
    influence_of: Callable[[Tensor | None], Tensor],
    kind: RobustCovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "*batch n n"]:
    """Covariance of the user's coefficients; ``influence_of`` returns influences in the basis, for given factors.

    "sandwich" and "hac" sum the products of influences, times N / (N - n).
    """
    left = degrees_of_freedom(problem)
    if kind == "homoscedastic":
        in_basis = homoscedastic(problem, equation)
    else:
        moved = influence_of(shares(problem, in_time=kind == "hac"))
        factor = problem.total_weight().sum(-1) / left.clamp(min=1.0)
        in_basis = factor[:, None, None] * summed_products(moved, kind, bandwidth)
    covariance = torch.matmul(torch.matmul(problem.to_coef, in_basis), problem.to_coef.mT)
    # with as many coefficients as values no residual is left to estimate the errors from
    return problem.restore(torch.where((left > 0)[:, None, None], covariance, torch.inf))


def coefficients_a_value(problem: LinearProblem) -> Float[Tensor, " B"]:
    """n / N over all channels, in which corrections for small samples grow."""
    return problem.num_coefficients / problem.total_weight().sum(-1)


def degrees_of_freedom(problem: LinearProblem) -> Float[Tensor, " B"]:
    """Number of values minus number of coefficients; a weight counts how often a value occurs."""
    return problem.total_weight().sum(-1) - problem.num_coefficients
