"""The sums that a loss is made of, with gradients that are ready when the value is.

Autograd on a formula of a dozen operations keeps and reads a dozen arrays of the size of the batch. The derivatives of
the summed energy are known in closed form, so one function finds them with the value and keeps one array. Wherever more
than a first gradient is asked for, the same derivatives are differentiable functions of what was put in.
"""

from __future__ import annotations

from itertools import repeat
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.density.energy import energy, energy_dkappa, energy_dz

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["energy_sums"]

_SERIES_BELOW = {torch.float32: 0.02, torch.float64: 1e-3}
"""Of x = kappa z^2 / 2: below, three terms of the series lose fewer digits than a difference of exponentials."""

_LEAST = {torch.float32: 2.0**-100, torch.float64: 2.0**-800}
"""The kappa that a smaller one counts as, for x of common z has its digits there; 0 alone is exact."""

_LARGE, _PIECE, _ROW = 1 << 19, 1 << 18, 256
"""Elements from which a batch is worked through in pieces that stay in the cache, how many a piece has, and about how
many channels, repeated, make a row: operations on short rows take twice as long."""

_NEARLY_GAUSSIAN = 1e-2
"""Below this kappa the sums by which it moves the energy are nearly equal."""


def energy_sums(
    input: Float[Tensor, "*shape"],
    kappa: Float[Tensor, " m"],
    d: Float[Tensor, " m"],
    weight: Float[Tensor, "*shape"] | None = None,
    axis: int = -1,
    *,
    target: Float[Tensor, "*shape"] | None = None,
) -> Float[Tensor, " m"]:
    """The energy of each channel, summed over all other dimensions.

    Args:
        input: predictions, or errors where there is no target; float32 or float64; dimension ``axis`` has the m
            channels.
        kappa: ``1 / sigma^2 >= 0`` of each channel, of the same dtype.
        d: scale > 0 of each channel.
        weight: non-negative, of the shape of ``input``.
        axis: dimension of the channels.
        target: what the predictions should be, of the shape and dtype of ``input``. A large batch of errors is then
            never laid out.

    Returns:
        ``sum(weight * energy((input - target) / d, kappa))`` of each channel, differentiable to any order, under
        forward mode, ``vmap`` and ``torch.compile``.

    Example:
        >>> energy_sums(torch.tensor([[1.0, 0.0], [3.0, 2.0]]), torch.zeros(2), torch.ones(2))
        tensor([5., 2.])
    """
    axis = axis % input.dim()
    if torch.compiler.is_compiling() or not torch.is_grad_enabled():
        # compiled code fuses what it is given, and without a gradient there is nothing to keep
        return _plain(_error(input, target), kappa, d, weight, axis)
    wanted = (kappa.requires_grad, d.requires_grad)
    sums: Tensor = _EnergySums.apply(input, target, kappa, d, weight, axis, *wanted)[0]  # type: ignore[no-untyped-call]
    return sums


def _error(input: Tensor, target: Tensor | None) -> Tensor:
    return input if target is None else input - target


def _shaped(values: Tensor, dim: int, axis: int) -> Tensor:
    return values.view([-1 if i == axis else 1 for i in range(dim)])


def _summed(values: Tensor, axis: int) -> Tensor:
    others = [i for i in range(values.dim()) if i != axis]
    return values.sum(others) if others else values


def _plain(error: Tensor, kappa: Tensor, d: Tensor, weight: Tensor | None, axis: int) -> Tensor:
    values = energy(error / _shaped(d, error.dim(), axis), _shaped(kappa, error.dim(), axis))
    return _summed(values if weight is None else weight * values, axis)


class _EnergySums(torch.autograd.Function):
    """Sums, and what their gradients are made of: z exp(-x), and the sums by kappa and by d."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        input: Tensor,
        target: Tensor | None,
        kappa: Tensor,
        d: Tensor,
        weight: Tensor | None,
        axis: int,
        by_kappa: bool,
        by_d: bool,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        positive = kappa.clamp(min=_LEAST[input.dtype])
        own = torch.where(kappa > 0, positive, 0.0)
        plain = weight is None and _large(input, axis) and (target is None or _large(target, axis))
        if plain and not (by_kappa and _nearly_gaussian(kappa)):
            sums, pull, stretch = _in_pieces(input, target, own, d, stretched=by_kappa or by_d)
            return sums, pull, (0.5 * stretch - sums) / positive, -stretch / d
        error = _error(input, target)
        z = error / _shaped(d, error.dim(), axis)
        minus_x = (z * _shaped(-0.5 * own, error.dim(), axis)) * z  # 0 times a square that overflows is no number
        if by_kappa:
            minus_x = minus_x.clamp(min=-1e4)  # exp(-1e4) is 0 already, and no product with it is NaN
        inlier = torch.exp(minus_x)
        pull, value = z * inlier, torch.expm1(minus_x)
        if weight is not None:
            pull, value = pull * weight, value * weight
        if _nearly_gaussian(kappa):
            half = -0.5 * z * z if weight is None else -0.5 * z * z * weight
            sums = -_summed(torch.where(_shaped(own == 0, z.dim(), axis), half, value), axis) / _divisor(own)
        else:
            sums = -_summed(value, axis) / positive
        stretch = _summed(z * pull, axis) if by_d or by_kappa else torch.zeros_like(sums)
        curve = torch.zeros_like(sums)
        if by_kappa:
            # sum(z^2 exp(-x) / 2 - energy) / kappa, digit by digit where little of the difference would be left
            curve = (0.5 * stretch - sums) / positive
            if _nearly_gaussian(kappa):
                curve = _curve(z * z, minus_x, value, kappa, weight, axis)
        return sums, pull, curve, -stretch / d

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        input, target, kappa, d, weight, axis, _, _ = inputs
        _, pull, curve, stretch = output
        ctx.axis = axis
        ctx.mark_non_differentiable(pull, curve, stretch)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(input, target, kappa, d, weight, pull, curve, stretch)
        ctx.save_for_forward(input, target, kappa, d, weight)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, *_: Tensor | None) -> tuple[Tensor | None, ...]:
        input, target, kappa, d, weight, pull, curve, stretch = ctx.saved_tensors
        of_input, of_target, of_kappa, of_d, of_weight, *_ = ctx.needs_input_grad
        if grad is None:
            return (None,) * 8
        if torch.is_grad_enabled() or of_weight:
            error = _error(input, target)
            own, scale = _shaped(kappa, error.dim(), ctx.axis), _shaped(d, error.dim(), ctx.axis)
            z, share = error / scale, _shaped(grad, error.dim(), ctx.axis)
            if weight is not None:
                share = share * weight
            slope = share * energy_dz(z, own)
            toward = slope / scale if of_input or of_target else None
            return (
                toward,
                -toward if of_target and toward is not None else None,
                _summed(share * energy_dkappa(z, own), ctx.axis) if of_kappa else None,
                -_summed(slope * z, ctx.axis) / d if of_d else None,
                _shaped(grad, error.dim(), ctx.axis) * energy(z, own) if of_weight else None,
                None,
                None,
                None,
            )
        toward = _times(pull, grad / d, ctx.axis) if of_input or of_target else None
        return (
            toward,
            -toward if of_target and toward is not None else None,
            curve * grad if of_kappa else None,
            stretch * grad if of_d else None,
            None,
            None,
            None,
            None,
        )

    @staticmethod
    def jvp(ctx: Any, input_t: Any, target_t: Any, kappa_t: Any, d_t: Any, weight_t: Any, *_: Any) -> tuple[Any, ...]:
        input, target, kappa, d, weight = ctx.saved_tensors
        error = _error(input, target)
        own, scale = _shaped(kappa, error.dim(), ctx.axis), _shaped(d, error.dim(), ctx.axis)
        z = error / scale
        change = torch.zeros_like(z)
        if input_t is not None:
            change = change + energy_dz(z, own) * input_t / scale
        if target_t is not None:
            change = change - energy_dz(z, own) * target_t / scale
        if kappa_t is not None:
            change = change + energy_dkappa(z, own) * _shaped(kappa_t, error.dim(), ctx.axis)
        if d_t is not None:
            change = change - energy_dz(z, own) * z / scale * _shaped(d_t, error.dim(), ctx.axis)
        if weight is not None:
            change = change * weight
        if weight_t is not None:
            change = change + energy(z, own) * weight_t
        return _summed(change, ctx.axis), None, None, None


def _divisor(kappa: Tensor) -> Tensor:
    """Kappa, and 1 where it is 0 and the sums are those of z^2 / 2."""
    return torch.where(kappa > 0, kappa, 1.0)


def _large(values: Tensor, axis: int) -> bool:
    """Whether this is a plain tensor in the memory of the CPU, rows of channels, too large for the cache."""
    return (
        type(values) is Tensor
        and values.device.type == "cpu"
        and values.numel() >= _LARGE
        and axis == values.dim() - 1
        and not torch._C._functorch.is_functorch_wrapped_tensor(values)
        and values.is_contiguous()
    )


def _times(values: Float[Tensor, "*shape"], channels: Float[Tensor, " m"], axis: int) -> Float[Tensor, "*shape"]:
    """Each channel times its number; on long rows where there are many."""
    m, repeats = len(channels), max(_ROW // len(channels), 1)
    if not _large(values, axis) or values.numel() % (repeats * m):
        return values * _shaped(channels, values.dim(), axis)
    return (values.view(-1, repeats * m) * channels.repeat(repeats)).view_as(values)


def _in_pieces(
    input: Float[Tensor, "*shape"],
    target: Float[Tensor, "*shape"] | None,
    kappa: Float[Tensor, " m"],
    d: Float[Tensor, " m"],
    *,
    stretched: bool,
) -> tuple[Float[Tensor, " m"], Float[Tensor, "*shape"], Float[Tensor, " m"]]:
    """Sums of the energy, ``z exp(-x)``, and if asked the sums of its products with z; no batch of anything else."""
    m, repeats = len(d), max(_ROW // len(d), 1)
    pull = torch.empty_like(input)
    whole = len(input.view(-1, m)) // repeats * repeats
    value, stretch = kappa.new_zeros(m, dtype=torch.float64), kappa.new_zeros(m, dtype=torch.float64)
    exact = bool((kappa == 0).any())
    for r, rows in ((repeats, slice(whole)), (1, slice(whole, None))):
        scale, half, size = d.repeat(r), (-0.5 * kappa).repeat(r), max(_PIECE // (r * m), 1)

        def pieces(values: Tensor, rows: slice = rows, r: int = r, size: int = size) -> tuple[Tensor, ...]:
            return values.view(-1, m)[rows].view(-1, r * m).split(size)

        wanted = repeat(None) if target is None else pieces(target)
        for piece, other, pulled in zip(pieces(input), wanted, pieces(pull), strict=False):
            z = piece / scale if other is None else (piece - other).div_(scale)
            minus = (z * half).mul_(z).expm1_()
            worth = torch.where(half < 0, minus, -0.5 * z * z) if exact else minus
            value += worth.sum(0).double().view(r, m).sum(0)
            torch.mul(z, minus.add_(1.0), out=pulled)
            if stretched:
                stretch += z.mul_(pulled).sum(0).double().view(r, m).sum(0)
    return (-value / _divisor(kappa)).to(kappa.dtype), pull, stretch.to(kappa.dtype)


def _nearly_gaussian(kappa: Tensor) -> bool:
    """Whether a channel may have so small a kappa; true where looking would wait, or where there is no one value."""
    if kappa.device.type != "cpu":
        return True
    try:
        return bool((kappa < _NEARLY_GAUSSIAN).any())
    except RuntimeError:  # under vmap
        return True


def _curve(square: Tensor, minus_x: Tensor, value: Tensor, kappa: Tensor, weight: Tensor | None, axis: int) -> Tensor:
    """``-sum (1 - exp(-x) (1 + x)) / kappa^2``, at ``kappa = 0`` the sum of ``-z^4 / 8``.

    ``value`` is ``expm1(-x)``, times the weight.
    """
    near = square * square * (minus_x * (-1.0 / 12.0 - minus_x / 32.0) - 0.125)
    own = torch.expm1(minus_x) if weight is not None else value
    far = (own - minus_x - minus_x * own) * _shaped(kappa.pow(-2), minus_x.dim(), axis)
    values = torch.where(minus_x > -_SERIES_BELOW[minus_x.dtype], near, far)
    return _summed(values if weight is None else values * weight, axis)
