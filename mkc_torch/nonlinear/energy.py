"""Minimisation of the energy of a residual over its parameters, at given σ and d."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, checked_whole
from mkc_torch._support.forward_mode import Residual
from mkc_torch.nonlinear._arguments import per_channel, prepare
from mkc_torch.nonlinear._constraints import descend_constrained
from mkc_torch.nonlinear._problem import Constraint, kernel_weights, shaped_jacobian
from mkc_torch.nonlinear._quadratic import quadratic_about
from mkc_torch.nonlinear.prior import GaussianPrior

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Solution:
    """Result of :func:`minimise`.

    Attributes:
        theta: (*, p).
        residual: (*, N, m) at ``theta``; 0 where the weight is 0.
        weights: ``exp(-e² / (2 d² σ²))`` of each residual, (*, N, m).
        objective: sum of the energies and the prior's term, (*,), without penalties of constraints.
        n_iter: number of trial steps.
        converged: whether each problem converged, (*,).
        jacobian: Jacobian of the residual at ``theta``, (*, N, m, p).
        curvature: curvature of the objective at ``theta``, ``Σ w (1 - z²/σ²) JᵀJ / d²`` plus the prior's precision,
            (*, p, p).

    Example:
        >>> y = torch.tensor([1.0, 1.2, 0.8, 50.0], dtype=torch.float64)
        >>> found = minimise(lambda theta: (y - theta).unsqueeze(-1), torch.tensor([0.5]).double(), sigma=1.0)
        >>> found.theta, found.weights.squeeze(-1).round(decimals=2)  # the outlier has weight 0
        (tensor([1.0000], dtype=torch.float64), tensor([1.0000, 0.9800, 0.9800, 0.0000], dtype=torch.float64))
    """

    theta: Float[Tensor, "*batch p"]
    residual: Float[Tensor, "*batch N m"]
    weights: Float[Tensor, "*batch N m"]
    objective: Float[Tensor, " *batch"]
    n_iter: int
    converged: Bool[Tensor, " *batch"]
    jacobian: Float[Tensor, "*batch N m p"]
    curvature: Float[Tensor, "*batch p p"]


@torch.no_grad()
def minimise(
    residual: Residual,
    start: Float[Tensor, "*batch p"],
    *,
    sigma: float | Tensor = math.inf,
    d: float | Tensor = 1.0,
    data: Any = None,
    weight: Tensor | None = None,
    prior: GaussianPrior | None = None,
    lower: Float[Tensor, " p"] | None = None,
    upper: Float[Tensor, " p"] | None = None,
    equality: Constraint | None = None,
    inequality: Constraint | None = None,
    max_iter: int = 50,
    tol: float = 1e-10,
    jacobian: Literal["forward", "reverse", "reverse twice"] = "forward",
) -> Solution:
    """Minimise the MKC energy ``Σ w σ² (1 - exp(-e² / (2 d² σ²)))`` of a residual over its parameters.

    Levenberg-Marquardt. The curvature is that of the objective without the residual's second derivatives,
    ``Σ w exp(-z²/(2σ²)) (1 - z²/σ²) JᵀJ / d²`` with z = e/d, where it is safely positive. Elsewhere it is the positive
    definite curvature of its majoriser (reweighted least squares), without the bracket. The damping is scaled by the
    column norms and adapted to the decrease of the true objective, which never rises. σ and d are fixed; :func:`fit`
    learns them.

    Bounds are kept by an active set: every iterate is within them, and parameters at a bound stay there while the
    gradient points outwards. Equalities and inequalities are met by an augmented Lagrangian, to 1e-9 (float32: 1e-5)
    of ``1 + Σ |∂c/∂θ| |θ|``; iterates before the last may violate them.

    Args:
        residual: function ``residual(theta)`` of (p,) parameters, or ``residual(theta, data)`` with ``data``, that
            returns (N, m); of torch operations that ``torch.func.vmap`` and forward-mode differentiation support.
        start: starting parameters (*, p); problems are independent over the leading dimensions, by
            ``torch.func.vmap``. A start outside the bounds is moved to the nearest point within.
        sigma: bandwidth, dimensionless: a number, (m,) or (*, m); ``inf`` is weighted least squares.
        d: scale in the unit of the residual: a number, (m,) or (*, m).
        data: a tensor, or dicts, tuples and lists of tensors, whose leading dimensions are those of ``start``.
        weight: non-negative weights (N,), (N, m) or (*, N, m); weight 0 excludes a residual, even NaN.
        prior: Gaussian prior, which adds ``½ (θ - mean)ᵀ P (θ - mean)``.
        lower, upper: bounds (p,), infinite for no bound.
        equality: ``equality(theta) = 0``, (k,).
        inequality: ``inequality(theta) >= 0``, (k,).
        max_iter: largest number of trial steps; with constraints, for each of up to 30 updates of the multipliers.
        tol: a problem has converged when predicted and actual decrease of a step are below this share of the
            objective.
        jacobian: "forward" is fast for few parameters, "reverse" for few residuals. "reverse twice" suits few
            parameters and many small operations: half the time of forward mode where many combine constants and
            parameters.

    Raises:
        TypeError: ``start`` is not a floating tensor, the residual has another dtype, or an argument has a wrong type.
        ValueError: wrong shapes, more parameters than residuals (without a prior), a residual or derivative that is
            not finite at ``start``, crossed bounds, or a parameter out of range.

    References:
        Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", SIAM J. Appl. Math. 11 (1963).
        Nielsen, "Damping parameter in Marquardt's method", IMM, Technical University of Denmark (1999).
        Nocedal & Wright, Numerical Optimization (2006), 10.3, 16.7 and 17.3.

    Example:
        >>> t = torch.linspace(0, 4, 50, dtype=torch.float64)
        >>> y = 3.0 * torch.exp(-0.7 * t)
        >>> y[::5] += 2.0
        >>> def decay(theta):
        ...     return (theta[0] * torch.exp(-theta[1] * t) - y).unsqueeze(-1)
        >>> minimise(decay, torch.tensor([2.0, 1.0]).double(), sigma=1.0, d=0.1).theta
        tensor([3.0000, 0.7000], dtype=torch.float64)
    """
    checked_whole("max_iter", max_iter, 1, "50 is usual")
    checked_number("tol", tol, ends="[)", advice="1e-10 suits float64")
    problem, point = prepare(
        residual,
        start,
        data=data,
        weight=weight,
        prior=prior,
        lower=lower,
        upper=upper,
        equality=equality,
        inequality=inequality,
        jacobian=jacobian,
    )
    kappa = per_channel("sigma", sigma, point.residual, problem.batch, infinite=True).pow(-2)
    scale = per_channel("d", d, point.residual, problem.batch, infinite=False)
    found, _ = descend_constrained(problem, point, kappa, scale, max_iter=max_iter, tol=tol)
    point = problem.refreshed(replace(found.point, stale=True))
    quadratic = quadratic_about(problem, point, kappa, scale, None)
    return Solution(
        theta=problem.restore(point.theta),
        residual=problem.restore(point.residual),
        weights=problem.restore(kernel_weights(point.residual, kappa, scale)),
        objective=problem.restore(quadratic.value),
        n_iter=found.n_iter,
        converged=problem.restore(found.converged),
        jacobian=shaped_jacobian(problem, point),
        curvature=problem.restore(quadratic.curvature),
    )
