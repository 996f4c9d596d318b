"""The MKC energy in ``z = e / d`` and ``kappa = 1 / sigma^2``, and its derivatives of every order."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import as_numbers, refuse_no_tensor

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

KAPPA_MAX = 400.0
"""Largest ``1 / sigma^2`` for which the quadrature is accurate: ``sigma = 0.05``."""

SIGMA_LEAST = KAPPA_MAX**-0.5 * (1.0 - 1e-5)
"""Smallest ``sigma`` that the normaliser accepts: 0.05 less a tolerance for rounding."""

NEAR = 0.5
"""``x = kappa z^2 / 2`` below which differences of exponentials lose digits, and series are used."""

_FEW = 4096
"""Elements up to which fewer calls are worth six times the memory."""


def as_computed(*values: object) -> tuple[Tensor, ...]:
    """Tensors of a common floating dtype (float32 at least) and device, from tensors and numbers."""
    tensors = [v for v in values if isinstance(v, Tensor)]
    dtype = torch.float32 if tensors else torch.get_default_dtype()
    for t in tensors:
        if t.is_complex():
            raise TypeError(f"Expected real values but got a tensor of dtype {t.dtype}; pass real and imaginary parts.")
        if t.is_floating_point():
            dtype = torch.promote_types(dtype, t.dtype)
    # a scalar tensor moves to the others' device; in a form that every supported torch.compile traces
    leading = [t for t in tensors if t.dim() > 0] or tensors
    device = leading[0].device if leading else None
    return tuple(v.to(dtype) if isinstance(v, Tensor) else _as_tensor(v, dtype, device) for v in values)


def _as_tensor(value: object, dtype: torch.dtype, device: torch.device | None) -> Tensor:
    if isinstance(value, (int, float)):
        return torch.as_tensor(value, dtype=dtype, device=device)
    return as_numbers("value", value, dtype, device)


def inverse_square(sigma: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``kappa = 1 / sigma^2``, with value and gradient 0 at ``sigma = inf``.

    Example:
        >>> inverse_square(torch.tensor([0.5, math.inf]))
        tensor([4., 0.])
    """
    return sigma.pow(-2)


class _Energy(torch.autograd.Function):
    """Value by expm1 and gradient by exp: autograd of either formula alone would lose accuracy."""

    generate_vmap_rule = True

    @staticmethod
    def forward(z: Tensor, kappa: Tensor) -> Tensor:
        return energy_value(z, kappa)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:  # noqa: ARG004 - signature of torch.autograd.Function
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        z, kappa = ctx.saved_tensors
        grad_z = (grad * energy_dz(z, kappa)).sum_to_size(z.shape) if ctx.needs_input_grad[0] else None
        grad_kappa = (grad * energy_dkappa(z, kappa)).sum_to_size(kappa.shape) if ctx.needs_input_grad[1] else None
        return grad_z, grad_kappa


class _EnergyWithTangent(_Energy):
    """The eager version; torch.compile traces only functions without a jvp."""

    @staticmethod
    def jvp(ctx: Any, tangent_z: Tensor | None, tangent_kappa: Tensor | None) -> Tensor:
        z, kappa = ctx.saved_tensors
        out = torch.zeros_like(z * kappa)
        if tangent_z is not None:
            out = out + tangent_z * energy_dz(z, kappa)
        if tangent_kappa is not None:
            out = out + tangent_kappa * energy_dkappa(z, kappa)
        return out


def energy_value(z: Tensor, kappa: Tensor) -> Tensor:
    """:func:`energy` without gradients, and without the overhead of an autograd function."""
    q = 0.5 * z * z
    x = 0.5 * kappa * z * z  # in this order, because 0 times z² is NaN where z² overflows
    divisor = torch.where(kappa > 0, kappa, 1.0)
    if not torch.compiler.is_compiling():
        return torch.where(x > 0, -torch.expm1(-x) / divisor, q)
    # compiled code computes expm1 as exp - 1 on some processors, which is 0 for small x
    small = x < 0.5  # NEAR as a literal: a compiler makes a global number an input, which nested functions refuse
    series = relative_series(torch.where(small, x, 0.0))
    return torch.where(small, q * series, (1.0 - torch.exp(-x)) / divisor)


def relative_series(x: Tensor) -> Tensor:
    """``(1 - exp(-x)) / x`` for x below ``NEAR``, by its series."""
    series = torch.zeros_like(x)
    for j in range(14, -1, -1):  # sum_j (-x)^j / (j + 1)! in Horner form
        series = 1.0 / math.factorial(j + 1) - x * series
    return series


def energy_dz(z: Tensor, kappa: Tensor) -> Tensor:
    return z * torch.exp(-0.5 * kappa * z * z)


def energy_dkappa(z: Tensor, kappa: Tensor) -> Tensor:
    """``-(1 - exp(-x) (1 + x)) / kappa^2`` with ``x = kappa z^2 / 2``, smooth at ``kappa = 0`` where it is -z^4/8."""
    q = (0.5 * z * z).clamp(max=torch.finfo(z.dtype).max)  # finite, so that 0 times it is 0
    x = kappa * q
    small = x < 0.5
    near_x = torch.where(small, x, 0.0)
    near = _near(near_x)
    # capped, so that 0 times it stays 0 where kappa = 0 and z² overflows
    near_q = torch.where(small, q, 0.0).clamp(max=math.sqrt(torch.finfo(q.dtype).max))
    direct_x = torch.where(small, 1.0, x).clamp(max=1e4)  # exp(-1e4) is 0
    direct = (1.0 - torch.exp(-direct_x) * (1.0 + direct_x)) / torch.where(small, 1.0, kappa).square()
    return -torch.where(small, near_q * near_q * near, direct)


def _near(x: Tensor) -> Tensor:
    """``(1 - exp(-x) (1 + x)) / x^2``, the integral of t exp(-x t) over [0, 1], by six Gauss-Legendre nodes."""
    # literals, because the compiler turns a module's numbers into variables
    rule = (
        (0.03376524289842403, 0.0028924065498159403),
        (0.16939530676686776, 0.030555658668093615),
        (0.38069040695840156, 0.08906517308699231),
        (0.6193095930415985, 0.14489179419935322),
        (0.8306046932331322, 0.14982512785597574),
        (0.9662347571015759, 0.0827698396397692),
    )
    # copying a list of numbers to a GPU would wait for it
    if x.numel() <= _FEW and x.device.type == "cpu" and not torch.compiler.is_compiling():
        nodes, weights = x.new_tensor(rule).unbind(-1)
        return (weights * torch.exp(-x.unsqueeze(-1) * nodes)).sum(-1)
    near = torch.zeros_like(x)
    for node, weight in rule:
        near = near + weight * torch.exp(-node * x)
    return near


def energy(z: Float[Tensor, "*batch"], kappa: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The MKC energy of standardised errors, ``(1 - exp(-kappa z^2 / 2)) / kappa``.

    Args:
        z: standardised errors ``e / d``, any shape.
        kappa: ``1 / sigma^2 >= 0``, broadcast against ``z``.

    Returns:
        The energy, of the broadcast shape; ``z^2 / 2`` exactly where ``kappa`` is 0.

    Raises:
        TypeError: an argument is not a tensor.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (9).

    Example:
        >>> energy(torch.tensor([1.0, 3.0]), torch.tensor(0.0))
        tensor([0.5000, 4.5000])
    """
    refuse_no_tensor("z", z, "a tensor")
    refuse_no_tensor("kappa", kappa, "a tensor")
    function = _Energy if torch.compiler.is_compiling() else _EnergyWithTangent
    result: Tensor = function.apply(z, kappa)  # type: ignore[no-untyped-call]
    return result


def kernel_weight(z: Float[Tensor, "*batch"], kappa: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``exp(-kappa z^2 / 2)``: the weight of an error in the fixed point, 1 at ``kappa = 0``."""
    return torch.exp(-0.5 * kappa * z * z)


def energy_terms(q: Tensor, kappa: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """exp(-x), E, -∂E/∂κ and ∂²E/∂κ² at q = z²/2, x = κ q."""
    x = kappa * q
    w = torch.exp(-x)
    divisor = torch.where(kappa > 0, kappa, 1.0)
    qw = q * w
    e = -torch.expm1(-x) / divisor
    first = (e - qw) / divisor
    second = (2.0 * first - q * qw) / divisor
    # below this x the differences lose more digits than a series of two terms
    small = x < (1e-5 if q.dtype == torch.float64 else 1e-2)
    q2 = q * q
    e = torch.where(small, q - 0.5 * q * x, e)
    first = torch.where(small, q2 * (0.5 - x / 3.0), first)
    second = torch.where(small, q * q2 * (1.0 / 3.0 - 0.25 * x), second)
    return w, e, first, second


_CURVE_SERIES = tuple((-1) ** n / (math.factorial(n) * (n + 2)) for n in range(8))
"""Coefficients of ``(1 - exp(-x) (1 + x)) / x²``, accurate to all digits for x below 0.05."""


def energy_array(q: ndarray, x: ndarray, kappa: ndarray) -> ndarray:
    """``(1 - exp(-x)) / kappa`` in NumPy with ``x = kappa q``; q where x is 0."""
    return np.where(x > 0, -np.expm1(-x) / np.where(kappa > 0, kappa, 1.0), q)


def curve_array(x: ndarray) -> ndarray:
    """``(1 - exp(-x) (1 + x)) / x²`` in NumPy, 1/2 at x = 0."""
    small = x < 0.05
    direct = np.where(small, 1.0, x)
    curve = (1.0 - np.exp(-direct) * (1.0 + direct)) / direct**2
    if small.any():
        near = np.where(small, x, 0.0)
        series = _CURVE_SERIES[-1]
        for coefficient in _CURVE_SERIES[-2::-1]:
            series = coefficient + near * series
        curve = np.where(small, series, curve)
    return curve
