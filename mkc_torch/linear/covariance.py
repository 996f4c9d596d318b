"""Covariance of M-estimated coefficients: sandwich, and its form for autocorrelated samples."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeVar, get_args

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number
from mkc_torch._support.small_factors import symmetric_pinv

if TYPE_CHECKING:
    from jaxtyping import Float

CovarianceKind = Literal["sandwich", "hac"]
RobustCovarianceKind = Literal["sandwich", "hac", "homoscedastic"]
Kind = TypeVar("Kind", bound=str)


def checked_kind(kind: Kind, kinds: tuple[str, ...] = get_args(CovarianceKind)) -> Kind:
    """Return ``kind`` if it is one of ``kinds``, else raise."""
    if kind not in kinds:
        *others, last = map(repr, kinds)
        raise ValueError(f"Expected argument `covariance` to be {', '.join(others)} or {last} but got {kind!r}.")
    return kind


def checked_bandwidth(bandwidth: float | None) -> float | None:
    """Return ``bandwidth`` if it is valid, else raise."""
    if bandwidth is None:
        return None
    return checked_number("bandwidth", bandwidth, ends="[)", advice="it counts lags; None takes Andrews' rule")


def andrews_bandwidth(score: Float[Tensor, "*batch N n"]) -> Float[Tensor, " *batch"]:
    """Bandwidth in samples of the Bartlett kernel by Andrews' AR(1) rule, 1.1447 (α N)^(1/3), at most N / 4.

    Andrews, "Heteroskedasticity and autocorrelation consistent covariance matrix estimation", Econometrica 59 (1991),
    (6.2) and (6.4).
    """
    N = score.shape[-2]
    centred = score - score.mean(-2, keepdim=True)
    power = centred.square().sum(-2)
    tiny = torch.finfo(score.dtype).tiny
    rho = ((centred[..., 1:, :] * centred[..., :-1, :]).sum(-2) / power.clamp(min=tiny)).clamp(-0.97, 0.97)
    share = (power / power.amax(-1, keepdim=True).clamp(min=tiny)).square()
    top = (4.0 * rho.square() / ((1 - rho).pow(6) * (1 + rho).square()) * share).sum(-1)
    bottom = (share / (1 - rho).pow(4)).sum(-1).clamp(min=tiny)
    return (1.1447 * (top / bottom * N).pow(1 / 3)).clamp(max=N / 4)


def long_run_covariance(
    score: Float[Tensor, "*batch N n"], bandwidth: Float[Tensor, " *batch"]
) -> Float[Tensor, "*batch n n"]:
    """Sum over lags of the scores' cross-products under the Bartlett kernel; positive semi-definite.

    With b whole lags the kernel ``1 - lag / (b + 1)`` is the mean product of sums over b + 1 samples in a row.

    Newey & West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
    matrix", Econometrica 55 (1987).
    """
    N, n = score.shape[-2:]
    flat = score.reshape(-1, N, n).double()
    lags = bandwidth.reshape(-1, 1).floor().clamp(min=0, max=N - 1).long()
    total = torch.nn.functional.pad(flat.cumsum(-2), (0, 0, 1, 0))
    start = torch.arange(-int(lags.max()), N, device=score.device).expand(flat.shape[0], -1)
    # a window that ends before the first sample is empty
    low, high = start.clamp(min=0), (start + lags + 1).clamp(min=0, max=N)
    batch = torch.arange(flat.shape[0], device=score.device).unsqueeze(-1)
    sums = total[batch, high] - total[batch, low]
    products = torch.matmul(sums.mT, sums) / (lags + 1).unsqueeze(-1)
    return products.to(score.dtype).reshape(*score.shape[:-2], n, n)


def sandwich(
    curvature: Float[Tensor, "*batch n n"],
    score: Float[Tensor, "*batch N n"],
    dof: Float[Tensor, " *batch"],
    kind: CovarianceKind = "sandwich",
    bandwidth: float | None = None,
) -> Float[Tensor, "*batch n n"]:
    """``A⁻¹ B A⁻¹`` with the curvature A of the objective and the covariance B of its scores, times N / (N - n).

    Args:
        curvature: Hessian of the summed loss with respect to the coefficients.
        score: gradient of each sample's loss, in the order of time when ``kind`` is "hac".
        dof: factor for the degrees of freedom used, ``N / (N - n)``.
        kind: "sandwich" for independent samples, "hac" for a time series.
        bandwidth: whole lags in samples that "hac" reaches over; default by :func:`andrews_bandwidth`.
    """
    inverse = symmetric_pinv(curvature)
    return dof[..., None, None] * torch.matmul(torch.matmul(inverse, summed_products(score, kind, bandwidth)), inverse)


def summed_products(
    score: Float[Tensor, "*batch N n"], kind: RobustCovarianceKind, bandwidth: float | None
) -> Float[Tensor, "*batch n n"]:
    """Sum of the products of the scores of each sample and, for "hac", of those within ``bandwidth`` of it."""
    if kind != "hac":
        return torch.matmul(score.mT, score)
    lags = andrews_bandwidth(score) if bandwidth is None else score.new_full(score.shape[:-2], bandwidth)
    return long_run_covariance(score, lags)
