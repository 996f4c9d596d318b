"""Shared by the fixed point and MKC-EM: weights, objective and covariance of coefficients under the MKC likelihood."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers
from mkc_torch.density.energy import energy
from mkc_torch.linear._scale_search import relative_precision
from mkc_torch.linear.covariance import CovarianceKind, sandwich

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._problem import LinearProblem


def channel_parameter(name: str, value: float | Tensor, problem: LinearProblem, *, infinite: bool = False) -> Tensor:
    """Return a positive parameter of every channel as a tensor (B, m); accepts a number, (m,) or (*, m)."""
    t = as_numbers(name, value, problem.Y.dtype, problem.Y.device).to(problem.Y)
    m = problem.num_channels
    if t.dim() > 0 and t.shape[-1] not in (1, m):
        raise ValueError(f"Expected argument `{name}` to be a number or of shape ({m},) but got {tuple(t.shape)}.")
    if not bool(((t > 0) & (torch.isfinite(t) | infinite)).all()):
        kind = "positive" if infinite else "positive and finite"
        raise ValueError(f"Expected argument `{name}` to be {kind} but got {value}.")
    most = torch.finfo(t.dtype).max ** 0.4
    if not bool(((t >= 1.0 / most) & ((t <= most) | torch.isinf(t))).all()):
        raise ValueError(
            f"Expected argument `{name}` between {1.0 / most:.0e} and {most:.0e}, beyond which squares vanish or "
            f"overflow, but got {value}; choose another unit."
        )
    try:
        return t.expand(*problem.batch, m).reshape(-1, m)
    except RuntimeError:
        raise ValueError(
            f"Expected argument `{name}` of shape (m,) or (*, m) = {(*problem.batch, m)} but got {tuple(t.shape)}."
        ) from None


def kernel_weight(
    residual: Float[Tensor, "B *S N m"], kappa: Float[Tensor, "B *S m"], d: Float[Tensor, "B *S m"]
) -> Float[Tensor, "B *S N m"]:
    """``exp(-κ z² / 2)`` with z = e / d, the diagonal of W_k in (14) of the paper."""
    rate = (-0.5 * kappa / d.square()).unsqueeze(-2)
    return torch.exp(rate * residual.square())


def fixed_point_step(problem: LinearProblem, residual: Tensor, kappa: Tensor, d: Tensor) -> Float[Tensor, "B *S n"]:
    """Apply (15) of the paper once."""
    return problem.weighted_fit(kernel_weight(residual, kappa, d) * relative_precision(d).unsqueeze(-2))


def mean_energy(problem: LinearProblem, residual: Tensor, kappa: Tensor, d: Tensor) -> Float[Tensor, B * S]:
    """The MKC loss (9): the mean energy over the samples, summed over the channels."""
    e = energy(residual / d.unsqueeze(-2), kappa.unsqueeze(-2))
    if problem.sample_weight is None:
        return e.mean(-2).sum(-1)
    weight = problem.sample_weight if e.dim() == 3 else problem.sample_weight.unsqueeze(1)
    return ((weight * e).sum(-2) / weight.sum(-2)).sum(-1)


def residual_dof(problem: LinearProblem) -> Float[Tensor, " B"]:
    """Degrees of freedom: number of values with positive weight minus number of coefficients."""
    weight = problem.sample_weight
    used = problem.total_weight().sum(-1) if weight is None else (weight > 0).sum((-2, -1)).to(weight.dtype)
    return used - problem.num_coefficients


def coefficient_covariance(
    problem: LinearProblem,
    beta: Float[Tensor, "B n"],
    kappa: Float[Tensor, "B m"],
    d: Float[Tensor, "B m"],
    kind: CovarianceKind,
    bandwidth: float | None,
) -> Float[Tensor, "*batch n n"]:
    """Sandwich covariance of the user's coefficients, with the Hessian of the objective, not of its surrogate."""
    residual = problem.residual(beta)
    z2 = (residual / d.unsqueeze(-2)).square()
    k = kappa.unsqueeze(-2)
    w = torch.exp(-0.5 * k * z2)
    precision = d.pow(-2).unsqueeze(-2)
    curvature, _ = problem.normal_equations(w * (1.0 - k * z2) * precision)
    psi = w * residual * precision
    if problem.sample_weight is not None:
        psi = psi * problem.sample_weight
    score = torch.matmul(psi.unsqueeze(-2), problem.basis).squeeze(-2)
    left = residual_dof(problem)
    dof = (left + problem.num_coefficients) / left.clamp(min=1)
    in_basis = sandwich(curvature, score, dof, kind, bandwidth)
    covariance = torch.matmul(torch.matmul(problem.to_coef, in_basis), problem.to_coef.mT)
    # with as many coefficients as values no residual is left to estimate the errors from
    return problem.restore(torch.where((left > 0)[:, None, None], covariance, torch.inf))
