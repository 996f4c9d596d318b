"""The reduced loss with its gradients made in the forward pass, in NumPy, torch or a kernel.

A step by autograd on the formulas of :mod:`mkc_torch.losses._terms` keeps a dozen arrays of the size of the batch.
Here the forward pass keeps one, the gradient by the input, and hands it out in the first backward pass. A second
backward pass of one graph makes it anew; a second derivative goes through the formulas.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.density.closed_form import element_energy
from mkc_torch.losses._initial_loss import initial_influence, initial_loss
from mkc_torch.losses._parameters import ChannelState, ChannelTable, channel_table
from mkc_torch.losses._terms import Batch, LossSettings, loss_value
from mkc_torch.losses.residual_scale import SMALL_STATE, numpy_may_read

if TYPE_CHECKING:
    pass

__all__ = ["fused_loss"]

SMALL_BATCH = 1 << 14
"""Elements up to which NumPy, which costs less a call than torch, computes a batch on the CPU."""

LARGE_BATCH = 1 << 19
"""Elements from which a batch on the CPU is worked through in pieces that stay in the cache."""

SMALL_KAPPA = 0.05
"""Below it the derivative by kappa is summed element by element: a difference of two sums would lose its digits."""

PIECE = 1 << 17
"""Elements of a piece."""

ROW = 256
"""About how many channels, repeated, make a row of a piece: operations on short rows take twice as long."""


class ReducedLoss(NamedTuple):
    """Value and gradients of a reduced loss; a gradient that is not wanted is None."""

    value: Tensor
    by_input: Tensor | None
    by_raw_kappa: Tensor | None
    by_raw_d: Tensor | None


class ChannelSums(NamedTuple):
    """Sums over the elements of each channel, (m,): both terms, and the derivatives of the density's energy."""

    network: Any
    energy: Any
    by_kappa: Any
    by_d: Any


def fused_loss(batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings) -> Tensor:
    """The sum of the terms, reduced to a number, of plain tensors: no transforms, no gradient by the weight."""
    value: Tensor = _Fused.apply(batch.input, batch.target, raw_kappa, raw_d, batch, settings)  # type: ignore[no-untyped-call]
    return value


class _Fused(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        input: Tensor,
        target: Tensor,
        raw_kappa: Tensor | None,
        raw_d: Tensor | None,
        batch: Batch,
        settings: LossSettings,
    ) -> Tensor:
        wants = ctx.needs_input_grad
        found = reduced_loss(batch, raw_kappa, raw_d, settings, wants_input=wants[0] or wants[1])
        ctx.found, ctx.settings = found, settings
        ctx.rest = batch[2:]  # input and target are saved, and freed with the graph
        ctx.save_for_backward(input, target, raw_kappa, raw_d)
        return found.value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return (*_by_formulas(ctx, grad), None, None)
        found, ctx.found = ctx.found, None
        if found is None:
            input, target, raw_kappa, raw_d = ctx.saved_tensors
            batch = Batch(input, target, *ctx.rest)
            wants = ctx.needs_input_grad
            found = reduced_loss(batch, raw_kappa, raw_d, ctx.settings, wants_input=wants[0] or wants[1])
        of_input, of_target, of_kappa, of_d, *_ = ctx.needs_input_grad
        by_input = found.by_input
        if (of_input or of_target) and not _is_one(grad):
            by_input = by_input * grad.to(by_input.dtype)
        return (
            by_input if of_input else None,
            -by_input if of_target else None,
            found.by_raw_kappa * grad.to(found.by_raw_kappa.dtype) if of_kappa else None,
            found.by_raw_d * grad.to(found.by_raw_d.dtype) if of_d else None,
            None,
            None,
        )


def _is_one(grad: Tensor) -> bool:
    """Whether the upstream gradient is 1, where looking at it does not wait for an accelerator."""
    return type(grad) is Tensor and grad.device.type == "cpu" and not is_wrapped(grad) and grad.item() == 1.0


def _by_formulas(ctx: Any, grad: Tensor) -> list[Tensor | None]:
    """Gradients that are functions of the inputs, for a second derivative."""
    input, target, raw_kappa, raw_d = ctx.saved_tensors
    value = loss_value(Batch(input, target, *ctx.rest), raw_kappa, raw_d, ctx.settings)
    given = (input, target, raw_kappa, raw_d)
    wanted = [one for one, wants in zip(given, ctx.needs_input_grad, strict=False) if wants]
    slopes = iter(torch.autograd.grad(value, wanted, grad.to(value.dtype), create_graph=True))
    return [next(slopes) if wants else None for wants in ctx.needs_input_grad[:4]]


def reduced_loss(
    batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings, *, wants_input: bool
) -> ReducedLoss:
    """Value and gradients of the reduced loss in closed form."""
    dtype = batch.input.dtype
    raw = (raw_kappa, settings.fixed_kappa, raw_d, settings.fixed_d)
    given = [one for one in (*raw, settings.state.bound) if one is not None]
    xp: Any = np if batch.input.shape[batch.axis] <= SMALL_STATE and numpy_may_read(*given) else torch
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        table = channel_table(
            xp,
            _array(xp, raw_kappa),
            _array(xp, settings.fixed_kappa),
            _array(xp, raw_d),
            _array(xp, settings.fixed_d),
            ChannelState(*(_array(xp, one) for one in settings.state)),
            follows=settings.follows,
            normalize=settings.normalize,
        )
        if xp is np and not (batch.input.numel() <= SMALL_BATCH and numpy_may_read(batch.input, batch.target)):
            xp, table = torch, ChannelTable(*(None if one is None else torch.from_numpy(one) for one in table))
        work = Elements(
            _array(xp, batch.input),
            _array(xp, batch.target),
            _array(xp, batch.weight),
            _array(xp, batch.counts),
            batch.axis,
            looks=batch.input.device.type == "cpu",
        )
        divisor = _divisor(xp, work, settings)
        if xp is torch and _is_large(batch):
            sums, by_input = _in_pieces(work, table, divisor, wants_input=wants_input)
        else:
            sums, by_input = _at_once(xp, work, table, divisor, wants_input=wants_input)
        value, by_raw_kappa, by_raw_d = _assembled(xp, work, sums, table, divisor)
    return ReducedLoss(
        torch.scalar_tensor(value, dtype=dtype) if xp is np else value.to(dtype),
        by_input,
        None if raw_kappa is None else _tensor(xp, by_raw_kappa, raw_kappa.dtype),
        None if raw_d is None else _tensor(xp, by_raw_d, raw_d.dtype),
    )


def _tensor(xp: Any, values: Any, dtype: torch.dtype) -> Tensor:
    return (torch.from_numpy(values) if xp is np else values).to(dtype)


class Elements(NamedTuple):
    """A batch as arrays of NumPy or torch; ``looks`` says whether a look at a value does not have to wait."""

    input: Any
    target: Any
    weight: Any
    counts: Any
    axis: int
    looks: bool

    @property
    def others(self) -> tuple[int, ...]:
        return tuple(i for i in range(self.input.ndim) if i != self.axis)


def _array(xp: Any, value: Tensor | None) -> Any:
    if value is None:
        return None
    value = value.detach()
    return value.numpy() if xp is np else value


def _divisor(xp: Any, batch: Elements, settings: LossSettings) -> Any:
    """What the sums are divided by: the weight of all elements for a mean, else 1."""
    if settings.reduction == "sum":
        return 1.0
    if batch.weight is None:
        return float(math.prod(batch.input.shape))
    total = _summed(xp, batch.weight, None)
    return xp.where(total > 0, total, 1.0)


def _summed(xp: Any, values: Any, dims: tuple[int, ...] | None) -> Any:
    """Sums over dimensions, None for all; in float64 by NumPy, which adds up row after row."""
    if dims == ():
        return values
    if xp is np:
        return values.sum(dims, dtype=np.float64)
    return values.sum() if dims is None else values.sum(dims)


def _at_once(
    xp: Any, batch: Elements, table: ChannelTable, divisor: Any, *, wants_input: bool
) -> tuple[ChannelSums, Tensor | None]:
    error = batch.input - batch.target
    if batch.counts is not None:
        error = xp.where(batch.counts, error, 0.0)
    shape = [-1 if i == batch.axis else 1 for i in range(error.ndim)]
    dtype = error.dtype

    def along(values: Any) -> Any:
        if values is None:
            return None
        return (values.astype(dtype) if xp is np else values.to(dtype)).reshape(shape)

    shaped = ChannelTable(*(along(one) for one in table))
    values, by_input = _element_values(xp, error, batch.weight, shaped, divisor, looks=batch.looks)
    sums = ChannelSums(*(None if one is None else _summed(xp, one, batch.others) for one in values))
    if not wants_input:
        return sums, None
    return sums, torch.from_numpy(by_input) if xp is np else by_input


def _element_values(
    xp: Any, error: Any, weight: Any, table: ChannelTable, divisor: Any, *, looks: bool
) -> tuple[ChannelSums, Any]:
    """What is to be summed of each element, and the gradient by the input; the table's numbers broadcast."""
    z = error / table.d
    learns_kappa, learns_d = table.kappa_by_raw is not None, table.d_by_raw is not None
    has_gaussian = not looks or bool((table.kappa == 0).any())
    each_kappa = learns_kappa and (not looks or bool((table.kappa < SMALL_KAPPA).any()))
    density = element_energy(xp, z, table.kappa, wants_kappa=each_kappa, has_gaussian=has_gaussian)
    by_d = -z * density.by_z if learns_kappa or learns_d else None
    if table.share is None:
        network, by_input = None, density.by_z * (1.0 / (table.d * divisor))
    else:
        network, by_input = _network(xp, error, table, divisor, looks=looks)
    if weight is not None:
        by_input = by_input * weight
    values = (network, density.value, density.by_kappa, by_d)
    return ChannelSums(*(None if one is None else one if weight is None else one * weight for one in values)), by_input


def _network(xp: Any, error: Any, table: ChannelTable, divisor: Any, *, looks: bool) -> tuple[Any, Any]:
    """The term that moves the network, and its derivative by the error over the divisor."""
    share = table.share
    parts = []
    if not looks or bool((share > 0).any()):
        own = element_energy(xp, error / table.annealed_d, table.annealed_kappa, wants_kappa=False)
        parts.append((share * own.value, own.by_z * (share / (table.annealed_d * divisor))))
    if not looks or bool((share < 1).any()):
        z = error / table.scale
        influence = initial_influence(xp, z)[0]
        parts.append(((1.0 - share) * initial_loss(xp, z), influence * ((1.0 - share) / (table.scale * divisor))))
    value, slope = parts[0]
    return (value, slope) if len(parts) == 1 else (value + parts[1][0], slope + parts[1][1])


def _is_large(batch: Batch) -> bool:
    """Whether this is a batch in the memory of the CPU, rows of channels, too large for the cache."""
    given = [one for one in batch[:3] if one is not None]
    return (
        numpy_may_read(*given)
        and batch.input.numel() >= LARGE_BATCH
        and batch.axis == batch.input.dim() - 1
        and all(one.is_contiguous() for one in given)
    )


def _in_pieces(
    batch: Elements, table: ChannelTable, divisor: Any, *, wants_input: bool
) -> tuple[ChannelSums, Tensor | None]:
    """The sums and the gradient, piece by piece; the gradient is the only array of the size of the batch."""
    m = batch.input.shape[-1]
    flat: list[Any] = [None if one is None else one.reshape(-1, m) for one in batch[:4]]
    rows, dtype = len(flat[0]), batch.input.dtype
    repeats = max(ROW // m, 1)
    by_input = torch.empty_like(flat[0]) if wants_input else None
    sums: list[Any] = [None] * 4
    whole = rows // repeats * repeats
    for r, start, end in ((repeats, 0, whole), (1, whole, rows)):
        tiled = ChannelTable(*(None if one is None else one.to(dtype).repeat(r) for one in table))
        size = max(PIECE // (r * m), 1) * r
        for first in range(start, end, size):
            last = min(first + size, end)
            given: list[Any] = [None if one is None else one[first:last].view(-1, r * m) for one in flat]
            error = given[0] - given[1]
            if given[3] is not None:
                error = torch.where(given[3], error, 0.0)
            values, slope = _element_values(torch, error, given[2], tiled, divisor, looks=True)
            if by_input is not None:
                by_input[first:last].view(-1, r * m).copy_(slope)
            for i, one in enumerate(values):
                if one is not None:
                    added = one.sum(0).double().view(r, m).sum(0)
                    sums[i] = added if sums[i] is None else sums[i] + added
    return ChannelSums(*sums), None if by_input is None else by_input.view_as(batch.input)


def _assembled(xp: Any, batch: Elements, sums: ChannelSums, table: ChannelTable, divisor: Any) -> tuple[Any, Any, Any]:
    """Value and gradients by the raw parameters from the sums of each channel."""
    total = sums.energy if sums.network is None else sums.energy + sums.network
    by_kappa = sums.by_kappa
    if by_kappa is None and table.kappa_by_raw is not None:  # the sum of z² exp(-x) / 2 less the energy, over kappa
        by_kappa = (-0.5 * sums.by_d - sums.energy) / table.kappa
    by_d = None if table.d_by_raw is None else sums.by_d / table.d
    if table.log_normalizer is not None:
        if batch.weight is None:
            weight = math.prod(batch.input.shape) / batch.input.shape[batch.axis]
        else:
            weight = _summed(xp, batch.weight, batch.others)
        total = total + weight * table.log_normalizer
        by_kappa = None if by_kappa is None else by_kappa + weight * table.log_normalizer_by_kappa
        by_d = None if by_d is None else by_d + weight * table.log_normalizer_by_d
    return (
        total.sum() / divisor,
        None if by_kappa is None else by_kappa * table.kappa_by_raw / divisor,
        None if by_d is None else by_d * table.d_by_raw / divisor,
    )
