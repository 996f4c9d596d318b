"""Influence of each sample on M-estimated coefficients, and the covariance that follows from it.

An estimate solves ``Σ ψ(r / s) x / s = 0`` with a scale s that has an equation of its own. To first order a sample
moves it by ``A⁻¹ (ψ(z) x / s - Σ_c a_c ι_c)``, where A is the Hessian ``Σ ψ'(z) x xᵀ / s²``, ι_c what the sample moves
the logarithm of channel c's scale by, and ``a_c = Σ (ψ'(z) z + ψ(z)) x / s`` what the equation feels of that. The
products of these influences, summed, are the covariance: that of independent samples with errors of any kind.

Croux, Dhaene & Hoorelbeke, "Robust standard errors for robust estimators", discussion paper 03.16, K.U. Leuven (2003).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.linear.covariance import RobustCovarianceKind, andrews_bandwidth, long_run_covariance

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem
    from mkc_torch.linear._psi import Psi


@dataclass(frozen=True)
class Scores:
    """An estimating equation at its solution: ψ and ψ' of standardised residuals, and the scale these are over."""

    psi: Float[Tensor, "B N m"]
    slope: Float[Tensor, "B N m"]
    z: Float[Tensor, "B N m"]
    scale: Float[Tensor, "B m"]

    def precision(self) -> Float[Tensor, "B 1 m"]:
        """1 / s², the largest taken for 1 so that no unit matters."""
        return (self.scale.amin(-1, keepdim=True) / self.scale).square().unsqueeze(-2)

    def hessian(self, problem: LinearProblem) -> Float[Tensor, "B n n"]:
        """``Σ ψ'(z) x xᵀ / s²``."""
        return problem.normal_equations(self.slope * self.precision())[0]

    def by_scale(self, problem: LinearProblem) -> Float[Tensor, "B m n"]:
        """What the equation loses when the logarithm of a channel's scale grows."""
        part = weighed(problem, (self.slope * self.z + self.psi) * self.scale.unsqueeze(-2) * self.precision())
        return _summed(problem, part)


def _summed(problem: LinearProblem, values: Float[Tensor, "B N m"]) -> Float[Tensor, "B m n"]:
    """``Σ value x`` of each channel."""
    return torch.einsum("bkc,bkcn->bcn", values, problem.basis.expand(values.shape[0], -1, -1, -1))


def scores(problem: LinearProblem, beta: Float[Tensor, "B n"], scale: Float[Tensor, "B m"], psi: Psi) -> Scores:
    """The estimating equation of ψ at coefficients in the basis."""
    z = problem.residual(beta) / scale.unsqueeze(-2)
    return Scores(psi.value(z), psi.slope(z), z, scale)


def weighed(problem: LinearProblem, values: Float[Tensor, "B N m"]) -> Float[Tensor, "B N m"]:
    return values if problem.sample_weight is None else values * problem.sample_weight


def shares(problem: LinearProblem, *, in_time: bool) -> Float[Tensor, "B N m"] | None:
    """What a sample's influence is multiplied by: the weight in a time series, its root where a weight counts samples.

    The products of influences of a sample of weight 2 then enter twice.
    """
    w = problem.sample_weight
    # the root of 0 has no slope
    return w if w is None or in_time else w.clamp(min=torch.finfo(w.dtype).tiny).sqrt()


@dataclass(frozen=True)
class ScaleInfluence:
    """What moves the logarithm of each channel's scale: each sample, counted once, and the coefficients if they do."""

    of_samples: Float[Tensor, "B N m"]
    of_coefficients: Float[Tensor, "B m n"] | None = None


def m_scale_influence(
    problem: LinearProblem,
    rho: Float[Tensor, "B N m"],
    slope: Float[Tensor, "B N m"],
    z: Float[Tensor, "B N m"],
    scale: Float[Tensor, "B m"] | None = None,
) -> ScaleInfluence:
    """What moves a scale with ``Σ ρ(z) = const``, z = r / s.

    Args:
        problem: the regression.
        rho, slope: ρ and ρ' of the standardised residuals.
        z: standardised residuals.
        scale: where the residuals are those of the coefficients, which then move it too, unless it is at its minimum.
    """
    total = problem.total_weight().unsqueeze(-2)
    centre = weighed(problem, rho).sum(-2, keepdim=True) / total
    pull = weighed(problem, slope * z).sum(-2, keepdim=True).clamp(min=torch.finfo(rho.dtype).eps)
    of_samples = (rho - centre) / pull
    if scale is None:
        return ScaleInfluence(of_samples)
    return ScaleInfluence(of_samples, -_summed(problem, weighed(problem, slope) / (pull * scale.unsqueeze(-2))))


def influence(
    problem: LinearProblem,
    equation: Scores,
    of_scale: ScaleInfluence | None = None,
    share: Float[Tensor, "B N m"] | None = None,
) -> Float[Tensor, "B N n"]:
    """What each sample moves the coefficients in the basis by.

    Args:
        problem: the regression.
        equation: that of the coefficients.
        of_scale: what moves the logarithms of the scales; None for known scales.
        share: what a sample's influence is multiplied by, from :func:`shares`; 1 by default.
    """
    values = equation.psi * equation.scale.unsqueeze(-2) * equation.precision()
    values = values if share is None else values * share
    moved = torch.matmul(values.unsqueeze(-2), problem.basis).squeeze(-2)
    hessian = equation.hessian(problem)
    if of_scale is not None:
        by_scale = equation.by_scale(problem)
        part = of_scale.of_samples if share is None else of_scale.of_samples * share
        moved = moved - torch.matmul(part, by_scale)
        if of_scale.of_coefficients is not None:
            inverse = torch.linalg.pinv(hessian + torch.matmul(by_scale.mT, of_scale.of_coefficients))
            return torch.matmul(moved, inverse.mT)
    return torch.matmul(moved, torch.linalg.pinv(hessian, hermitian=True))


def homoscedastic(problem: LinearProblem, equation: Scores) -> Float[Tensor, "B n n"]:
    """Covariance of the coefficients in the basis where errors are alike at every X: Huber's (6.5), K included.

    Each channel has its own ``K² Σψ² / (N - p) / mean(ψ')²``; with p = n / m coefficients a channel,
    ``K = 1 + p / N var(ψ') / mean(ψ')²``.

    Huber, Robust Statistics (1981), section 7.6; it is "H1" in statsmodels.
    """
    total = problem.total_weight()
    p = problem.num_coefficients / problem.num_channels
    slope = weighed(problem, equation.slope).sum(-2) / total
    spread = weighed(problem, (equation.slope - slope.unsqueeze(-2)).square()).sum(-2) / total
    tiny = torch.finfo(slope.dtype).tiny
    square = slope.square().clamp(min=tiny)
    correction = (1.0 + p / total * spread / square).square()
    left = (total - p).clamp(min=1.0)
    variance = correction * weighed(problem, equation.psi.square()).sum(-2) / left / square  # of ψ(z) / E ψ'
    precision = equation.precision()
    least = equation.scale.amin(-1, keepdim=True).unsqueeze(-1).square()
    ones = torch.ones_like(equation.psi)
    inverse = torch.linalg.pinv(problem.normal_equations(ones * precision)[0], hermitian=True)
    middle = problem.normal_equations(ones * precision * variance.unsqueeze(-2))[0]
    return least * torch.matmul(torch.matmul(inverse, middle), inverse)


def robust_covariance(
    problem: LinearProblem,
    equation: Scores,
    influence_of: Callable[[Tensor | None], Tensor],
    kind: RobustCovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "*batch n n"]:
    """Covariance of the user's coefficients.

    Args:
        problem: the regression.
        equation: that of the coefficients.
        influence_of: what each sample moves the coefficients in the basis by, for shares of the samples.
        kind: "sandwich" and "hac" are sums of the influences' products, times N / (N - n).
        bandwidth: whole lags of "hac"; None for Andrews' rule.
    """
    left = degrees_of_freedom(problem)
    if kind == "homoscedastic":
        in_basis = homoscedastic(problem, equation)
    else:
        moved = influence_of(shares(problem, in_time=kind == "hac"))
        if kind == "hac":
            lags = andrews_bandwidth(moved) if bandwidth is None else moved.new_full(moved.shape[:1], bandwidth)
            in_basis = long_run_covariance(moved, lags)
        else:
            in_basis = torch.matmul(moved.mT, moved)
        total = problem.total_weight().sum(-1)
        in_basis = (total / left.clamp(min=1.0))[:, None, None] * in_basis
    covariance = torch.matmul(torch.matmul(problem.to_coef, in_basis), problem.to_coef.mT)
    # as many coefficients as values leave nothing to tell errors from
    return problem.restore(torch.where((left > 0)[:, None, None], covariance, torch.inf))


def coefficients_a_value(problem: LinearProblem) -> Float[Tensor, " B"]:
    """n / N over all channels: what corrections for small samples grow with."""
    return problem.num_coefficients / problem.total_weight().sum(-1)


def degrees_of_freedom(problem: LinearProblem) -> Float[Tensor, " B"]:
    """Values less coefficients, where a weight counts how often a value occurs."""
    return problem.total_weight().sum(-1) - problem.num_coefficients
