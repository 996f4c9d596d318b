"""The multi-kernel correntropy (MKC) density as pure, broadcasting functions.

The density of an error ``e`` with bandwidth ``sigma``, scale ``d`` and domain ``[-bound, bound]`` is (17) of
Li et al., "Multi-kernel Correntropy Regression" (2023)::

    p(e) = exp(-energy(e)) / (d Z),    energy(e) = sigma^2 (1 - exp(-e^2 / (2 d^2 sigma^2)))

Everything is computed in ``kappa = 1 / sigma^2`` and ``z = e / d``: ``energy = -expm1(-kappa z^2 / 2) / kappa`` is
smooth at ``kappa = 0``, where it is exactly the Gaussian ``z^2 / 2``. All functions work under autograd (to any
order), forward-mode differentiation, ``vmap`` and ``torch.compile``. Half and bfloat16 are computed in float32.

:func:`mkc_energy`, :func:`mkc_weight`, :func:`log_normalizer` and :func:`mkc_nll` refuse a ``sigma``, ``d`` or
``bound`` out of range: a number always, and a tensor on the CPU, in eager code and outside of ``vmap``, where looking
at it waits for nothing. Elsewhere, and in :func:`energy`, :func:`log_partition` and :func:`inverse_square`, which they
are made of, values go through the formulas as they are. A NaN among the errors comes out as NaN: it is one of many.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch._arguments import as_numbers, refuse_no_tensor, refuse_out_of_range
from mkc_torch.partition_of_few import few, log_partition_and_slopes

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

KAPPA_MAX = 400.0
"""Largest ``1 / sigma^2`` for which the quadrature is specified; it is ``sigma = 0.05``."""

SIGMA_LEAST = KAPPA_MAX**-0.5 * (1.0 - 1e-5)
"""Of the normaliser; what was computed as the least ``sigma`` may round below it."""

_SIGMA_TINY = 1e-18
"""Of the energy: the ``kappa`` of a smaller one is infinite in float32."""

_HEAD_TOLERANCE = 1e-13

_FEW = 4096
"""Elements up to which the number of calls counts more than the memory of six of each."""


def _head_quadrature(count: int) -> tuple[Tensor, Tensor]:
    """Nodes on [0, 1] and weights of an even integrand on [-1, 1]: Gauss-Legendre under sinh(2t), denser near 0."""
    x, w = np.polynomial.legendre.leggauss(count)
    t = 0.5 * (x + 1.0)
    nodes, weights = np.sinh(2.0 * t) / np.sinh(2.0), 2.0 * w * np.cosh(2.0 * t) / np.sinh(2.0)
    return torch.from_numpy(nodes), torch.from_numpy(weights)


_NODES, _WEIGHTS = _head_quadrature(32)


def as_computed(*values: object) -> tuple[Tensor, ...]:
    """Tensors of one floating dtype (float32 at least) and one device, from tensors and numbers."""
    tensors = [v for v in values if isinstance(v, Tensor)]
    dtype = torch.float32 if tensors else torch.get_default_dtype()
    for t in tensors:
        if t.is_complex():
            raise TypeError(f"Expected real values but got a tensor of dtype {t.dtype}; pass real and imaginary parts.")
        if t.is_floating_point():
            dtype = torch.promote_types(dtype, t.dtype)
    device = next((t.device for t in tensors if t.dim() > 0), tensors[0].device if tensors else None)
    return tuple(v.to(dtype) if isinstance(v, Tensor) else _as_tensor(v, dtype, device) for v in values)


def _as_tensor(value: object, dtype: torch.dtype, device: torch.device | None) -> Tensor:
    if isinstance(value, (int, float)):
        return torch.as_tensor(value, dtype=dtype, device=device)
    return as_numbers("value", value, dtype, device)


def _checked(least_sigma: float = _SIGMA_TINY, **given: object) -> tuple[Tensor, ...]:
    """Errors and parameters as :func:`as_computed` gives them, with the parameters in range."""
    for name, value in given.items():
        if name == "sigma":
            refuse_out_of_range(name, value, least_sigma, math.inf, "[]", "inf is the Gaussian")
        elif name != "error":
            refuse_out_of_range(name, value, advice="it is in the unit of the errors")
        elif not isinstance(value, (int, float)):
            refuse_no_tensor(name, value, "a real tensor")
    return as_computed(*given.values())


def inverse_square(sigma: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``kappa = 1 / sigma^2``, with value and gradient 0 at ``sigma = inf``.

    Example:
        >>> inverse_square(torch.tensor([0.5, math.inf]))
        tensor([4., 0.])
    """
    return sigma.pow(-2)


class _Energy(torch.autograd.Function):
    """Value by expm1 and gradient by exp: each is accurate where the other one's autograd is not."""

    generate_vmap_rule = True

    @staticmethod
    def forward(z: Tensor, kappa: Tensor) -> Tensor:
        return energy_value(z, kappa)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:  # noqa: ARG004
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        z, kappa = ctx.saved_tensors
        grad_z = (grad * energy_dz(z, kappa)).sum_to_size(z.shape) if ctx.needs_input_grad[0] else None
        grad_kappa = (grad * energy_dkappa(z, kappa)).sum_to_size(kappa.shape) if ctx.needs_input_grad[1] else None
        return grad_z, grad_kappa


class _EnergyWithTangent(_Energy):
    """The eager form; torch.compile traces only functions without a jvp."""

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
    """:func:`energy` where nothing is differentiated, without an autograd function's own cost."""
    q = 0.5 * z * z
    x = kappa * q
    divisor = torch.where(kappa > 0, kappa, 1.0)
    if not torch.compiler.is_compiling():
        return torch.where(x > 0, -torch.expm1(-x) / divisor, q)
    # compiled code computes expm1 as exp - 1 on some processors, which is 0 for small x
    small = x < 0.5
    near = torch.where(small, x, 0.0)
    series = torch.zeros_like(x)
    for j in range(14, -1, -1):  # sum_j (-x)^j / (j + 1)! in Horner form
        series = 1.0 / math.factorial(j + 1) - near * series
    return torch.where(small, q * series, (1.0 - torch.exp(-x)) / divisor)


def energy_dz(z: Tensor, kappa: Tensor) -> Tensor:
    return z * torch.exp(-0.5 * kappa * z * z)


def energy_dkappa(z: Tensor, kappa: Tensor) -> Tensor:
    """``-(1 - exp(-x) (1 + x)) / kappa^2`` with ``x = kappa z^2 / 2``, smooth at ``kappa = 0`` where it is -z^4/8."""
    q = (0.5 * z * z).clamp(max=torch.finfo(z.dtype).max)  # finite, so that 0 times it is 0
    x = kappa * q
    small = x < 0.5
    near_x = torch.where(small, x, 0.0)
    near = _near(near_x)
    # capped, so that 0 times it stays 0 where kappa = 0 and the square overflows
    near_q = torch.where(small, q, 0.0).clamp(max=math.sqrt(torch.finfo(q.dtype).max))
    direct_x = torch.where(small, 1.0, x).clamp(max=1e4)  # exp(-1e4) is 0 already
    direct = (1.0 - torch.exp(-direct_x) * (1.0 + direct_x)) / torch.where(small, 1.0, kappa).square()
    return -torch.where(small, near_q * near_q * near, direct)


def _near(x: Tensor) -> Tensor:
    """``(1 - exp(-x) (1 + x)) / x^2``, the integral of t exp(-x t) over [0, 1], by Gauss and Legendre's six points."""
    # written out, since the compiler makes variables of a module's numbers
    rule = (
        (0.03376524289842403, 0.0028924065498159403),
        (0.16939530676686776, 0.030555658668093615),
        (0.38069040695840156, 0.08906517308699231),
        (0.6193095930415985, 0.14489179419935322),
        (0.8306046932331322, 0.14982512785597574),
        (0.9662347571015759, 0.0827698396397692),
    )
    if x.numel() <= _FEW and not torch.compiler.is_compiling():
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
        TypeError: an argument is no tensor.

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


def tail_density(kappa: Tensor) -> Tensor:
    """``exp(-1 / kappa)``, the unnormalised density of the flat tail, with value and gradient 0 at ``kappa = 0``."""
    positive = kappa > 1e-3  # exp(-1000) is 0 in float64
    return torch.where(positive, torch.exp(-1.0 / torch.where(positive, kappa, 1.0)), 0.0)


def head_reach(kappa: Tensor) -> Tensor:
    """The ``z`` beyond which the density exceeds its flat tail by less than 1e-13; a constant for autograd."""
    k = kappa.detach().clamp(min=1e-3)
    excess = k * torch.nn.functional.softplus(1.0 / k + math.log(_HEAD_TOLERANCE), threshold=30.0)
    return torch.sqrt(-2.0 * torch.log(excess) / k)


def head_rule(kappa: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Quadrature on the head: nodes ``u`` in [0, min(length, reach)] and weights for both signs, shape (*, nodes).

    A negative length gives negative nodes and weights, so that integrals are odd in it.
    """
    reach = head_reach(kappa)
    end = torch.maximum(torch.minimum(length, reach), -reach).unsqueeze(-1)
    return end * _NODES.to(end), end * _WEIGHTS.to(end)


def integrate(
    values: Float[Tensor, "*batch nodes"],
    tail: Float[Tensor, "*batch"],
    length: Float[Tensor, "*batch"],
    weights: Float[Tensor, "*batch nodes"],
) -> Float[Tensor, "*batch"]:
    """Integral over the domain of a function that is constant on the tail: the tail exactly, the head by quadrature.

    Args:
        values: the function at the nodes of :func:`head_rule`.
        tail: its value on the flat tail.
        length: half-width of the domain.
        weights: those of :func:`head_rule`.
    """
    return 2.0 * length * tail + (weights * (values - tail.unsqueeze(-1))).sum(-1)


def partition(kappa: Float[Tensor, "*batch"], length: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``Z``, the integral of ``exp(-energy(u, kappa))`` over ``|u| <= length``; odd in ``length``.

    Args:
        kappa, length: as in :func:`log_partition`.
    """
    return _partition(kappa, length, energy)


def log_partition_value(kappa: Tensor, length: Tensor) -> Tensor:
    """:func:`log_partition` where nothing is differentiated."""
    return torch.log(_partition(kappa, length, energy_value))


def _partition(kappa: Tensor, length: Tensor, energy: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    kappa, length = torch.broadcast_tensors(kappa, length)
    tail = tail_density(kappa)
    nodes, weights = head_rule(kappa, length)
    return integrate(torch.exp(-energy(nodes, kappa.unsqueeze(-1))), tail, length, weights)


def log_partition(kappa: Float[Tensor, "*batch"], length: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``log Z``, ``Z`` being the integral of ``exp(-energy(u, kappa))`` over ``|u| <= length``.

    The flat tail ``2 length exp(-1 / kappa)`` is taken analytically and a fixed rule of 32 nodes sits on the head,
    whose width it knows, so the relative error of ``Z`` stays below 1e-12 in float64 for ``kappa`` in [0, 400] and
    ``length`` up to 1e7.

    Args:
        kappa: ``1 / sigma^2`` in [0, 400].
        length: half-width of the domain in units of ``d``; broadcast against ``kappa``.

    Raises:
        TypeError: an argument is no tensor.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), (17).

    Example:
        >>> log_partition(torch.tensor(1 / 9.0).double(), torch.tensor(10.0).double()).exp()
        tensor(2.6348, dtype=torch.float64)
    """
    refuse_no_tensor("kappa", kappa, "a tensor")
    refuse_no_tensor("length", length, "a tensor")
    if kappa.shape != length.shape:
        kappa, length = torch.broadcast_tensors(kappa, length)
    if torch.compiler.is_compiling():
        return torch.log(partition(kappa, length))
    value: Tensor = _LogPartition.apply(kappa, length)[0]  # type: ignore[no-untyped-call]
    return value


def _log_partition_and_slopes(
    kappa: Tensor, length: Tensor, energy: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """``log Z`` and its derivatives by kappa and by length, differentiable if the energy is."""
    tail = tail_density(kappa)
    tail_slope = tail / torch.where(tail > 0, kappa, 1.0).square()
    nodes, weights = head_rule(kappa, length)
    own = kappa.unsqueeze(-1)
    density = torch.exp(-energy(nodes, own))
    z = integrate(density, tail, length, weights)
    by_kappa = integrate(-energy_dkappa(nodes, own) * density, tail_slope, length, weights) / z
    by_length = 2.0 * torch.exp(-energy(length, kappa)) / z
    return torch.log(z), by_kappa, by_length


class _LogPartition(torch.autograd.Function):
    """Value and both slopes at once: autograd through the quadrature takes several times as long on a few channels."""

    generate_vmap_rule = True

    @staticmethod
    def forward(kappa: Tensor, length: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if few(kappa, length):
            k, reach = (one.detach().double().numpy() for one in (kappa, length))
            found = log_partition_and_slopes(k, reach, _NODES.numpy(), _WEIGHTS.numpy(), _HEAD_TOLERANCE)
            value, by_kappa, by_length = (torch.as_tensor(one, dtype=kappa.dtype) for one in found)
            return value, by_kappa, by_length
        return _log_partition_and_slopes(kappa, length, energy_value)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs, *output[1:])
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        if grad is None:
            return None, None
        kappa, length, by_kappa, by_length = ctx.saved_tensors
        if torch.is_grad_enabled():
            by_kappa, by_length = _log_partition_and_slopes(kappa, length, energy)[1:]
        wants = ctx.needs_input_grad
        return grad * by_kappa if wants[0] else None, grad * by_length if wants[1] else None

    @staticmethod
    def jvp(ctx: Any, kappa_t: Tensor | None, length_t: Tensor | None) -> tuple[Tensor, None, None]:
        kappa, length = ctx.saved_tensors
        value, by_kappa, by_length = _log_partition_and_slopes(kappa, length, energy)
        change = torch.zeros_like(value)
        if kappa_t is not None:
            change = change + by_kappa * kappa_t
        if length_t is not None:
            change = change + by_length * length_t
        return change, None, None


def mkc_energy(
    error: Float[Tensor, "*batch"], sigma: Float[Tensor, "*batch"] | float, d: Float[Tensor, "*batch"] | float
) -> Float[Tensor, "*batch"]:
    """The MKC loss of each error, ``sigma^2 (1 - exp(-e^2 / (2 d^2 sigma^2)))``, a term of (9) of the paper.

    Args:
        error: errors ``e``, any shape, in the unit of ``d``.
        sigma: bandwidth in [1e-18, inf], dimensionless, ``inf`` for the Gaussian ``e^2 / (2 d^2)``; broadcast (per
            sample too).
        d: scale > 0 in the unit of ``error``; broadcast.

    Returns:
        The energy, of the broadcast shape.

    Raises:
        TypeError: complex values, or an argument that is no number and no tensor.
        ValueError: ``sigma`` or ``d`` out of range, where it can be seen; the module says where.

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
    z = error / d
    return torch.exp(-0.5 * inverse_square(sigma) * z * z)


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
    return torch.log(d) + log_partition(inverse_square(sigma), bound / d)


def mkc_nll(
    error: Float[Tensor, "*batch"],
    sigma: Float[Tensor, "*batch"] | float,
    d: Float[Tensor, "*batch"] | float,
    bound: Float[Tensor, "*batch"] | float,
) -> Float[Tensor, "*batch"]:
    """The negative log-density of each error, ``mkc_energy + log_normalizer``.

    Beyond ``bound`` the density is 0; the formula is continued there, so that a stray error keeps a finite value and
    gradient. :meth:`mkc_torch.MKCDistribution.log_prob` is the strict one.

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
    return energy(error / d, kappa) + (torch.log(d) + log_partition(kappa, bound / d))
