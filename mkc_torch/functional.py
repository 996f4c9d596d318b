"""The multi-kernel correntropy (MKC) density as pure, broadcasting functions.

The density of an error ``e`` with bandwidth ``sigma``, scale ``d`` and domain ``[-bound, bound]`` is (17) of
Li et al., "Multi-kernel Correntropy Regression" (2023)::

    p(e) = exp(-energy(e)) / (d Z),    energy(e) = sigma^2 (1 - exp(-e^2 / (2 d^2 sigma^2)))

Everything is computed in ``kappa = 1 / sigma^2`` and ``z = e / d``: ``energy = -expm1(-kappa z^2 / 2) / kappa`` is
smooth at ``kappa = 0``, where it is exactly the Gaussian ``z^2 / 2``. All functions work under autograd (to any
order), forward-mode differentiation, ``vmap`` and ``torch.compile``. Half and bfloat16 are computed in float32.

:func:`mkc_energy`, :func:`mkc_weight`, :func:`log_normalizer` and :func:`mkc_nll` refuse a ``sigma``, ``d`` or
``bound`` out of range. Numbers are always checked. Tensors are checked on the CPU in eager code outside ``vmap``, where
reading a value does not wait for a device. Elsewhere values are not checked, nor are they in the building blocks
:func:`energy`, :func:`log_partition` and :func:`inverse_square`. A NaN error gives a NaN result.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_no_tensor, refuse_other_shapes, refuse_out_of_range
from mkc_torch.density.energy import KAPPA_MAX, SIGMA_LEAST, as_computed, energy, inverse_square, kernel_weight
from mkc_torch.density.normalizer import log_partition, refuse_bad_ratio

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "KAPPA_MAX",
    "energy",
    "inverse_square",
    "log_normalizer",
    "log_partition",
    "mkc_energy",
    "mkc_nll",
    "mkc_weight",
]

_SIGMA_TINY = 1e-18
"""Smallest ``sigma`` that the energy accepts: ``kappa`` of a smaller value is infinite in float32."""


def _checked(least_sigma: float = _SIGMA_TINY, **given: object) -> tuple[Tensor, ...]:
    """Errors and parameters converted by :func:`as_computed`, after a range check of the parameters."""
    for name, value in given.items():
        if name == "sigma":
            refuse_out_of_range(name, value, least_sigma, math.inf, "[]", "inf is the Gaussian")
        elif name != "error":
            refuse_out_of_range(name, value, advice="it is in the unit of the errors")
        elif not isinstance(value, (int, float)):
            refuse_no_tensor(name, value, "a real tensor")
    values = as_computed(*given.values())
    refuse_other_shapes(**dict(zip(given, values, strict=True)))
    return values


def mkc_energy(
    error: Float[Tensor, "*batch"], sigma: Float[Tensor, "*batch"] | float, d: Float[Tensor, "*batch"] | float
) -> Float[Tensor, "*batch"]:
    """The MKC loss of each error, ``sigma^2 (1 - exp(-e^2 / (2 d^2 sigma^2)))``: a term of (9) of the paper.

    Args:
        error: errors ``e``, any shape, in the unit of ``d``.
        sigma: bandwidth in [1e-18, inf], dimensionless, ``inf`` for the Gaussian ``e^2 / (2 d^2)``; broadcast (per
            sample too).
        d: scale > 0 in the unit of ``error``; broadcast.

    Returns:
        The energy, of the broadcast shape.

    Raises:
        TypeError: complex values, or an argument that is neither a number nor a tensor.
        ValueError: ``sigma`` or ``d`` out of range, where values are checked (see the module's docstring); shapes that
            do not broadcast.

    Example:
        >>> mkc_energy(torch.tensor([0.0, 1.0, 100.0]), sigma=2.0, d=1.0)
        tensor([0.0000, 0.4700, 4.0000])
    """
    error, sigma, d = _checked(error=error, sigma=sigma, d=d)
    return energy(error / d, inverse_square(sigma))


def mkc_weight(
    error: Float[Tensor, "*batch"], sigma: Float[Tensor, "*batch"] | float, d: Float[Tensor, "*batch"] | float
) -> Float[Tensor, "*batch"]:
    """The weight of each error in the fixed point (15), ``exp(-e^2 / (2 d^2 sigma^2))``, without ``1/d^2``.

    Args:
        error, sigma, d: as in :func:`mkc_energy`.

    Returns:
        Weights in [0, 1]; 1 for every error at ``sigma = inf``.

    Raises:
        TypeError, ValueError: as :func:`mkc_energy`.

    Example:
        >>> mkc_weight(torch.tensor([0.0, 1.0, 100.0]), sigma=1.0, d=1.0)
        tensor([1.0000, 0.6065, 0.0000])
    """
    error, sigma, d = _checked(error=error, sigma=sigma, d=d)
    return kernel_weight(error / d, inverse_square(sigma))


def log_normalizer(
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    bound: Float[Tensor, "*batch"] | float,
) -> Float[Tensor, "*batch"]:
    """``log(d Z(sigma, bound / d))``, so that ``mkc_energy + log_normalizer`` is the negative log-density.

    This is ``-log(c / d)`` of (17) of the paper; the ``log(c - d)`` printed in (29)-(31) is a misprint.

    Args:
        sigma: bandwidth in [0.05, inf].
        d: scale > 0.
        bound: half-width ``a`` > 0 of the domain ``[-a, a]``, in the unit of ``d``.

    Returns:
        The log-normaliser, of the broadcast shape, differentiable in all three arguments.

    Raises:
        TypeError, ValueError: as :func:`mkc_energy`, for ``bound`` too.

    Example:
        >>> log_normalizer(math.inf, 1.0, 100.0)  # log(sqrt(2 pi))
        tensor(0.9189)
    """
    sigma, d, bound = _checked(SIGMA_LEAST, sigma=sigma, d=d, bound=bound)
    refuse_bad_ratio(bound / d)
    return torch.log(d) + log_partition(inverse_square(sigma), bound / d)


def mkc_nll(
    error: Float[Tensor, "*batch"],
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    bound: Float[Tensor, "*batch"] | float,
) -> Float[Tensor, "*batch"]:
    """The negative log-density of each error, ``mkc_energy + log_normalizer``.

    Beyond ``bound`` the density is 0. This function continues the formula there, so that an error out of bounds has a
    finite value and gradient. :meth:`mkc_torch.MKCDistribution.log_prob` returns -inf there.

    Args:
        error, d: as in :func:`mkc_energy`.
        sigma, bound: bandwidth and half-width of the domain, as in :func:`log_normalizer`.

    Returns:
        Nats, of the broadcast shape.

    Raises:
        TypeError, ValueError: as :func:`mkc_energy`, for ``bound`` too.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> mkc_nll(torch.tensor([0.0, 1.0]), sigma=math.inf, d=1.0, bound=100.0)
        tensor([0.9189, 1.4189])
    """
    error, sigma, d, bound = _checked(SIGMA_LEAST, error=error, sigma=sigma, d=d, bound=bound)
    kappa = inverse_square(sigma)
    refuse_bad_ratio(bound / d)
    return energy(error / d, kappa) + (torch.log(d) + log_partition(kappa, bound / d))
