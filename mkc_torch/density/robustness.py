"""Robustness of the MKC loss: bound on the error that outliers cause, efficiency and breakdown point.

Theorem 3, Propositions 1 and 2 and Corollary 2 of Li et al., "Multi-kernel Correntropy Regression" (2023), treat a
single coefficient, ``y_k = x_k θ° + v_k``. Of N samples, M have noise ``|v_k| <= ε d`` and regressors ``|x_k| >= ζ``;
the others are arbitrary. Efficiency and breakdown point are those of an M-estimator with the fixed kernel width
``h = σ d``. All arguments broadcast.

Corrections of the printed text: ``I(ε)`` is defined by ``v_k <= ε``, but (24) and Remark 4 need ``|v_k| <= ε``; φ is
defined on q < p < 1, so its limits are ``φ(q₊) = ∞`` and ``φ(1₋) = 0``, not ``φ(0₊)``; and the index of the last sum of
(26) is k. The formulas (22), (27) and (28) are right as printed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers, checked_whole
from mkc_torch.density.energy import as_computed, inverse_square, kernel_weight

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def _refuse(name: str, wanted: str, value: object, right: Tensor, advice: str) -> None:
    if not bool(right.all()):
        raise ValueError(f"Expected argument `{name}` to be {wanted} but got {value}; {advice}.")


def _positive(name: str, value: Tensor, *, zero: bool = False, infinite: bool = False) -> None:
    right = ((value > 0) | ((value == 0) & zero)) & (torch.isfinite(value) | infinite)
    wanted = ("not negative" if zero else "positive") + ("" if infinite else " and finite")
    # a NaN is refused too, because it compares False
    _refuse(name, wanted, value.tolist(), right, "check its sign and its unit")


def _numbers(**given: Tensor | float) -> tuple[Tensor, ...]:
    """Tensors of a common dtype from numbers and tensors; TypeError names an argument that is neither."""
    for name, value in given.items():
        as_numbers(name, value, torch.float64)
    return as_computed(*given.values())


def _shares(num_samples: Tensor | int, num_inliers: Tensor | int, *, outliers: bool = False) -> tuple[Tensor, Tensor]:
    """q = (N - M) / M and 1 - q, each to rounding, in float64."""
    N = as_numbers("num_samples", num_samples, torch.float64).double()
    M = as_numbers("num_inliers", num_inliers, torch.float64).double()
    most = M < N if outliers else M <= N
    wanted = f"more than half of the samples and {'fewer than' if outliers else 'at most'} all of them"
    advice = "the bound of Theorem 3 needs Assumption 1"
    if outliers:
        advice = "without outliers every bandwidth gives the same bound"
    right = (2 * M > N) & most & torch.isfinite(N)
    _refuse("num_inliers", wanted, f"{M.tolist()} of {N.tolist()}", right, advice)
    return (N - M) / M, (2 * M - N) / M


def _log_gap(a: Tensor, q: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """log(p - q) for ``p = exp(-a)`` and ``r = 1 - q``, 0 where p <= q; and whether p exceeds q."""
    lost = -torch.expm1(-a)
    gap = r - lost
    valid = gap > 0
    near_one = torch.log1p(-torch.where(gap > 0.5, q + lost, 0.0))
    return torch.where(gap > 0.5, near_one, torch.log(torch.where(valid, gap, 1.0))), valid


def phi(p: Float[Tensor, "*batch"] | float, q: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch"]:
    """``φ(p) = p log p / ((p - q) log(p - q))`` of (28); φ = 1 at the optimal bandwidth.

    φ decreases from infinity at p = q to 0 at p = 1. The paper calls this obvious. Proof: the logarithmic derivative of
    ``x log x`` is ``(1 + u) / x`` with ``u = 1 / log x``, and decreases for x in (0, 1) because its derivative is
    ``-(1 + u + u²) / x²``.

    Args:
        p: ``exp(-ε² / (2 σ²))``, in (q, 1].
        q: ``(N - M) / M``, in [0, 1).

    Returns:
        φ, of the broadcast shape; 1 for every p if q is 0.

    Raises:
        ValueError: q outside [0, 1), or p outside (q, 1].

    Example:
        >>> phi(torch.tensor([0.3, 0.5, 0.9]), 0.25)
        tensor([2.4114, 1.0000, 0.3386])
    """
    p, q = _numbers(p=p, q=q)
    _refuse("q", "in [0, 1)", q.tolist(), (q >= 0) & (q < 1), "it is the ratio of outliers to inliers, (N - M) / M")
    _refuse("p", "in (q, 1]", p.tolist(), (p > q) & (p <= 1), "raise the bandwidth above `least_bandwidth`")
    gap = p - q
    divisor = torch.where(q > 0, gap * torch.log(gap), 1.0)
    return torch.where(q > 0, p * torch.log(p) / divisor, 1.0)


def least_bandwidth(
    epsilon: Float[Tensor, "*batch"] | float,
    num_samples: Int[Tensor, "*batch"] | int,
    num_inliers: Int[Tensor, "*batch"] | int,
) -> Float[Tensor, "*batch"]:
    """The bandwidth that σ must exceed in Theorem 3, ``ε / sqrt(2 log(M / (N - M)))``.

    Args:
        epsilon: largest ``|v| / d`` of the inliers, >= 0.
        num_samples, num_inliers: N and M, with N/2 < M <= N.

    Returns:
        The bandwidth, of the broadcast shape; 0 where ε is 0 or there are no outliers.

    Raises:
        ValueError: ε negative or not finite, or M not more than half of N.

    Example:
        >>> least_bandwidth(2.0, 100, torch.tensor([60, 80, 99]))
        tensor([2.2209, 1.2011, 0.6597])
    """
    (epsilon,) = _numbers(epsilon=epsilon)
    _positive("epsilon", epsilon, zero=True)
    q, _ = _shares(num_samples, num_inliers)
    return (epsilon * torch.rsqrt(-2.0 * torch.log(q))).to(epsilon.dtype)


def _checked(
    sigma: Tensor | float,
    d: Tensor | float,
    epsilon: Tensor | float,
    zeta: Tensor | float,
    num_samples: Tensor | int,
    num_inliers: Tensor | int,
) -> tuple[Tensor, ...]:
    sigma, d, epsilon, zeta = _numbers(sigma=sigma, d=d, epsilon=epsilon, zeta=zeta)
    _positive("sigma", sigma, infinite=True)
    _positive("d", d)
    _positive("epsilon", epsilon, zero=True)
    _positive("zeta", zeta)
    q, r = (v.to(sigma) for v in _shares(num_samples, num_inliers))
    return tuple(torch.broadcast_tensors(sigma, d / zeta, epsilon, q, r))


def error_bound(
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    epsilon: Float[Tensor, "*batch"] | float,
    zeta: Float[Tensor, "*batch"] | float,
    num_samples: Int[Tensor, "*batch"] | int,
    num_inliers: Int[Tensor, "*batch"] | int,
) -> Float[Tensor, "*batch"]:
    """ξ of Theorem 3, (22): largest distance of the minimiser of (21) from θ° that outliers can cause.

    It holds for the global minimiser and for arbitrary outliers and regressors of outliers. It holds for a single
    coefficient; the paper has no bound for several.

    Args:
        sigma: bandwidth > 0; ``inf`` is least squares.
        d: scale > 0, in the unit of y.
        epsilon: largest ``|v_k| / d`` of the inliers, >= 0.
        zeta: smallest ``|x_k|`` of the inliers, > 0 (Assumption 2; inputs that pass through 0, as in example 1 of
            the paper, violate it).
        num_samples, num_inliers: N and M, with N/2 < M <= N (Assumption 1; M = N is its limit, with ξ = 2 ε d / ζ).

    Returns:
        ξ in the unit of θ, of the broadcast shape; ``inf`` where the theorem gives no bound: at or below
        :func:`least_bandwidth`, and at ``sigma = inf`` with outliers (Proposition 2).

    Raises:
        ValueError: an argument out of its range.

    Example:
        >>> error_bound(torch.tensor([1.2, 2.0, 20.0, math.inf]), 0.5, 2.0, 1.0, 100, 80)
        tensor([   inf, 2.4362, 8.6727,    inf])
    """
    sigma, unit, epsilon, q, r = _checked(sigma, d, epsilon, zeta, num_samples, num_inliers)
    gap, valid = _log_gap(0.5 * (epsilon / sigma).square(), q, r)
    finite = torch.where(torch.isfinite(sigma), sigma, 1.0)
    reach = finite * torch.sqrt(torch.where(q > 0, -2.0 * gap, 1.0))
    # sqrt(-2 σ² log p) is ε
    reach = torch.where(q > 0, torch.where(valid & torch.isfinite(sigma), reach, math.inf), epsilon)
    return unit * (reach + epsilon)


def error_bound_slope(
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    epsilon: Float[Tensor, "*batch"] | float,
    zeta: Float[Tensor, "*batch"] | float,
    num_samples: Int[Tensor, "*batch"] | int,
    num_inliers: Int[Tensor, "*batch"] | int,
) -> Float[Tensor, "*batch"]:
    """dξ/dσ, (27) and (28): negative, then positive (Proposition 1), and constant in the limit (Proposition 2).

    Args:
        sigma, d, epsilon, zeta, num_samples, num_inliers: as in :func:`error_bound`.

    Returns:
        The derivative, of the broadcast shape. At ``sigma = inf`` its limit ``d sqrt(-2 log(1 - q)) / ζ``, although the
        bound of least squares is infinite; ``-inf`` at or below :func:`least_bandwidth`; 0 where M = N.

    Raises:
        ValueError: an argument out of its range.

    Example:
        >>> error_bound_slope(torch.tensor([1.5, 2.0, 20.0, math.inf]), 0.5, 2.0, 1.0, 100, 80)
        tensor([-0.2316,  0.1258,  0.3749,  0.3793])
    """
    sigma, unit, epsilon, q, r = _checked(sigma, d, epsilon, zeta, num_samples, num_inliers)
    a = 0.5 * (epsilon / sigma).square()
    gap, valid = _log_gap(a, q, r)
    gap = torch.where(valid & (q > 0), gap, -1.0)
    ratio = a * torch.exp(-a) / (torch.exp(gap) * -gap)
    slope = unit * torch.sqrt(-2.0 * gap) * (1.0 - ratio)
    return torch.where(q > 0, torch.where(valid, slope, -math.inf), 0.0)


@torch.no_grad()
def _optimal_gap(r: Tensor) -> Tensor:
    """p - q at the root of φ(p) = 1, for r = 1 - q, by bisection: φ - 1 has a single change of sign."""
    low, high = torch.zeros_like(r), r
    for _ in range(1100):  # bisection down to 0 takes as many steps as float64 has exponents
        middle = 0.5 * (low + high)
        if bool(((middle == low) | (middle == high)).all()):
            break
        lost = r - middle
        above = torch.xlogy(middle, middle) > (1.0 - lost) * torch.log1p(-lost)
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    return 0.5 * (low + high)


def optimal_bandwidth(
    epsilon: Float[Tensor, "*batch"] | float,
    num_samples: Int[Tensor, "*batch"] | int,
    num_inliers: Int[Tensor, "*batch"] | int,
) -> Float[Tensor, "*batch"]:
    """The σ of the smallest :func:`error_bound`, Corollary 2: where ``φ(exp(-ε² / (2 σ²))) = 1``.

    φ depends on M / N alone, so the bandwidth is proportional to ε: from ``ε / sqrt(2)`` for a single outlier among
    many samples to infinity for 50 % outliers. It protects from the worst outliers; a wider bandwidth is more
    efficient.

    Args:
        epsilon: largest ``|v_k| / d`` of the inliers, > 0.
        num_samples, num_inliers: N and M, with N/2 < M < N.

    Returns:
        The bandwidth, of the broadcast shape, without derivatives.

    Raises:
        ValueError: ε not positive and finite; or M not between half of N and N.

    Example:
        >>> optimal_bandwidth(2.0, 100, torch.tensor([60, 80, 99]))
        tensor([2.6614, 1.6986, 1.4240])
    """
    (epsilon,) = _numbers(epsilon=epsilon)
    _positive("epsilon", epsilon)
    _, r = _shares(num_samples, num_inliers, outliers=True)
    lost = r - _optimal_gap(r)
    return (epsilon.detach() * torch.rsqrt(-2.0 * torch.log1p(-lost))).to(epsilon.dtype)


def least_error_bound(
    d: Float[Tensor, "*batch"] | float,
    epsilon: Float[Tensor, "*batch"] | float,
    zeta: Float[Tensor, "*batch"] | float,
    num_samples: Int[Tensor, "*batch"] | int,
    num_inliers: Int[Tensor, "*batch"] | int,
) -> Float[Tensor, "*batch"]:
    """ξ at :func:`optimal_bandwidth`; in closed form ``(ε d / ζ) (1 + sqrt(p / (p - q)))``, because φ(p) = 1 there.

    Args:
        d, epsilon, zeta, num_samples, num_inliers: as in :func:`error_bound`, with ε > 0 and M < N.

    Returns:
        The smallest bound over all bandwidths, of the broadcast shape, without derivatives.

    Raises:
        ValueError: an argument out of its range.

    Example:
        >>> least_error_bound(0.5, 2.0, 1.0, 100, torch.tensor([60, 80, 99]))
        tensor([3.9384, 2.4142, 2.0138])
    """
    d, epsilon, zeta = _numbers(d=d, epsilon=epsilon, zeta=zeta)
    _positive("d", d)
    _positive("epsilon", epsilon)
    _positive("zeta", zeta)
    q, r = _shares(num_samples, num_inliers, outliers=True)
    gap = _optimal_gap(r)
    return ((epsilon * d / zeta).detach() * (1.0 + torch.sqrt((q + gap) / gap))).to(d.dtype)


def _relative_width(sigma: Tensor | float, d: Tensor | float, noise: Tensor | float) -> Tensor:
    """h = σ d in units of the noise's standard deviation."""
    sigma, d, noise = _numbers(sigma=sigma, d=d, noise=noise)
    _positive("sigma", sigma, infinite=True)
    _positive("d", d)
    _positive("noise", noise)
    return sigma * d / noise


def gaussian_efficiency(
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float = 1.0,
    noise: Float[Tensor, "*batch"] | float = 1.0,
) -> Float[Tensor, "*batch"]:
    """Asymptotic efficiency at Gaussian noise: the variance of least squares over that of the fit at this σ and d.

    ``(E ψ')² / E ψ²`` for ``ψ(z) = z exp(-z² / (2 h²))`` is ``(1 - 1 / (1 + h²)²)^(3/2)`` with ``h = σ d / noise``. It
    holds for a fixed bandwidth; a learned bandwidth, as by MKC-EM, goes to infinity on Gaussian data.

    Args:
        sigma: bandwidth > 0; ``inf`` is least squares.
        d: scale > 0.
        noise: standard deviation > 0 of the noise, in the unit of d.

    Returns:
        The efficiency in (0, 1], of the broadcast shape.

    Raises:
        ValueError: an argument out of its range.

    References:
        Huber & Ronchetti, Robust Statistics (2009), section 3.2, for the variance of an M-estimator.

    Example:
        >>> gaussian_efficiency(torch.tensor([0.5, 1.0, 2.0, math.inf]))
        tensor([0.2160, 0.6495, 0.9406, 1.0000])
    """
    h = _relative_width(sigma, d, noise)
    # 1 - 1 / (1 + h²)² factored, accurate for small h
    share = 1.0 / (1.0 + h.pow(-2))
    return (share * (2.0 - share)).pow(1.5)


def bandwidth_for_efficiency(efficiency: Float[Tensor, "*batch"] | float) -> Float[Tensor, "*batch"]:
    """The ``h = σ d`` at which :func:`gaussian_efficiency` has a value, in standard deviations of the noise.

    Args:
        efficiency: in (0, 1]; 1 gives ``inf``.

    Returns:
        h, of the shape of ``efficiency``.

    Raises:
        ValueError: an efficiency outside (0, 1].

    Example:
        >>> bandwidth_for_efficiency(torch.tensor([0.64, 0.95, 0.99, 1.0]))
        tensor([0.9855, 2.1105, 3.3522,    inf])
    """
    (efficiency,) = _numbers(efficiency=efficiency)
    inside = (efficiency > 0) & (efficiency <= 1)
    _refuse("efficiency", "in (0, 1]", efficiency.tolist(), inside, "0.95 is usual")
    # share = 1 - sqrt(1 - e^(2/3)) and h² = share / (1 - share)
    root = torch.sqrt(torch.expm1(torch.log(efficiency) * (2.0 / 3.0)).abs())
    share = efficiency.pow(2.0 / 3.0) / (1.0 + root)
    return torch.sqrt(share / root)


def gaussian_breakdown(
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float = 1.0,
    noise: Float[Tensor, "*batch"] | float = 1.0,
) -> Float[Tensor, "*batch"]:
    """Breakdown point with Gaussian noise of the inliers, in the limit N → ∞: a share of outliers.

    ``w / (1 + w)`` with the inliers' mean weight ``w = E exp(-e² / (2 σ² d²)) = h / sqrt(1 + h²)``; see
    :func:`breakdown_point`. Below it the error is bounded, but the bound grows with the bandwidth
    (:func:`error_bound`): a wide bandwidth has a high breakdown point and a large error before it.

    Args:
        sigma, d, noise: as in :func:`gaussian_efficiency`.

    Returns:
        The breakdown point in [0, 1/2), of the broadcast shape; 0 at ``sigma = inf``, which is least squares.

    Raises:
        ValueError: an argument out of its range.

    Example:
        >>> gaussian_breakdown(torch.tensor([0.5, 1.0, 2.0, math.inf]))
        tensor([0.3090, 0.4142, 0.4721, 0.0000])
    """
    h = _relative_width(sigma, d, noise)
    w = torch.rsqrt(1.0 + h.pow(-2))
    return torch.where(torch.isfinite(h), w / (1.0 + w), 0.0)


def breakdown_point(
    error: Float[Tensor, "*batch N"],
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    num_coefficients: int = 1,
) -> Float[Tensor, "*batch"]:
    """Finite-sample breakdown point of a fit of a channel: the share of added outliers that it withstands.

    Fewer than ``Σ w_k - (n - 1)`` added samples, wherever they are, keep the global minimiser of (13) bounded: a
    hyperplane with infinite coefficients passes at most n - 1 of the samples, so that these and the added samples have
    less kernel weight than the fit. More samples at a single far place than the largest ``Σ w_k`` of any coefficients
    move it without limit.

    Args:
        error: residuals (*, N) of samples in general position, at the fit.
        sigma: bandwidth > 0, of the batch's shape; ``inf`` is least squares, which a single outlier breaks down.
        d: scale > 0, in the unit of ``error``, of the batch's shape.
        num_coefficients: number n of coefficients.

    Returns:
        ``m / (N + m)``, (*,), with m the smallest number of added samples that may break the fit down.

    Raises:
        ValueError: an error that is not finite, no samples, or a parameter out of range.

    References:
        Huber, "Finite sample breakdown of M- and P-estimators", Annals of Statistics 12 (1984) 119-126, for a location;
        the n - 1 samples extend it to regression.

    Example:
        >>> breakdown_point(torch.linspace(-2, 2, 21), torch.tensor([0.5, 2.0, math.inf]), 1.0, num_coefficients=2)
        tensor([0.2222, 0.4474, 0.0000])
    """
    error, sigma, d = _numbers(error=error, sigma=sigma, d=d)
    if error.dim() < 1 or error.shape[-1] == 0:
        raise ValueError(f"Expected argument `error` of shape (*, N >= 1) but got {tuple(error.shape)}.")
    finite = torch.isfinite(error)
    _refuse("error", "finite", f"{int((~finite).sum())} values that are not", finite, "leave those samples out")
    _positive("sigma", sigma, infinite=True)
    _positive("d", d)
    num_coefficients = checked_whole("num_coefficients", num_coefficients, 1, "count the columns of X")
    num_coefficients = min(num_coefficients, error.shape[-1] + 1)  # more coefficients leave no sample
    total = kernel_weight(error / d.unsqueeze(-1), inverse_square(sigma.unsqueeze(-1))).sum(-1)
    fewest = torch.ceil(total - (num_coefficients - 1)).clamp(min=0.0)
    return torch.where(torch.isfinite(sigma), fewest / (error.shape[-1] + fewest), 0.0)
