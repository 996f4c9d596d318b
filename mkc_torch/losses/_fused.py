"""The reduced loss, with gradients computed in the forward pass by NumPy or torch.

Autograd on the formulas of :mod:`mkc_torch.losses._terms` keeps a dozen arrays of the size of the batch. This forward
pass keeps a single array, the gradient with respect to the input, and returns it in the first backward pass. A second
backward pass of the same graph computes the gradient again. Second derivatives use the formulas.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.density.closed_form import element_energy
from mkc_torch.losses._fixed_pieces import fixed_sums, pieces
from mkc_torch.losses._initial_loss import initial_influence, initial_loss
from mkc_torch.losses._parameters import ChannelState, ChannelTable, channel_table
from mkc_torch.losses._terms import Batch, LossSettings, loss_value
from mkc_torch.losses.residual_scale import SMALL_STATE, numpy_may_read

if TYPE_CHECKING:
    pass

SMALL_BATCH = 1 << 14
"""Elements up to which NumPy computes a batch on the CPU: its overhead per call is smaller than torch's."""

LARGE_BATCH = 1 << 19
"""Elements from which a batch on the CPU is processed in pieces that fit the cache."""

SMALL_KAPPA = 0.05
"""Kappa below which its derivative is summed over elements: a difference of two sums would lose digits."""


class ReducedLoss(NamedTuple):
    """Value and gradients of a reduced loss; None for gradients that are not needed."""

    value: Tensor
    by_input: Tensor | None
    by_raw_kappa: Tensor | None
    by_raw_d: Tensor | None


class ChannelSums(NamedTuple):
    """Sums over the elements of each channel, (m,): both terms, and derivatives of the density's energy."""

    network: Any
    energy: Any
    by_kappa: Any
    by_d: Any


def fused_loss(batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings) -> Tensor:
    """The reduced sum of the terms, (), for plain tensors, without function transforms and gradients of the weight."""
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
    """Whether the upstream gradient is known to be 1; only read on the CPU, where reading does not wait."""
    return type(grad) is Tensor and grad.device.type == "cpu" and not is_wrapped(grad) and grad.item() == 1.0


def _by_formulas(ctx: Any, grad: Tensor) -> list[Tensor | None]:
    """Differentiable gradients, for second derivatives."""
    input, target, raw_kappa, raw_d = ctx.saved_tensors
    value = loss_value(Batch(input, target, *ctx.rest), raw_kappa, raw_d, ctx.settings)
    given = (input, target, raw_kappa, raw_d)
    wanted = [entry for entry, wants in zip(given, ctx.needs_input_grad, strict=False) if wants]
    slopes = iter(torch.autograd.grad(value, wanted, grad.to(value.dtype), create_graph=True))
    return [next(slopes) if wants else None for wants in ctx.needs_input_grad[:4]]


def reduced_loss(
    batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings, *, wants_input: bool
) -> ReducedLoss:
    """Value and gradients of the reduced loss in closed form."""
    dtype = batch.input.dtype
    raw = (raw_kappa, settings.fixed_kappa, raw_d, settings.fixed_d)
    given = [entry for entry in (*raw, settings.state.bound) if entry is not None]
    xp: Any = np if batch.input.shape[batch.axis] <= SMALL_STATE and numpy_may_read(*given) else torch
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        table = channel_table(
            xp,
            _own_array(xp, raw_kappa),
            _array(xp, settings.fixed_kappa),
            _own_array(xp, raw_d),
            _array(xp, settings.fixed_d),
            ChannelState(*(_array(xp, entry) for entry in settings.state)),
            follows=settings.follows,
            normalize=settings.normalize,
        )
        if xp is np and not (batch.input.numel() <= SMALL_BATCH and numpy_may_read(batch.input, batch.target)):
            xp, table = torch, ChannelTable(*(None if entry is None else torch.from_numpy(entry) for entry in table))
        work = Elements(
            _array(xp, batch.input),
            _array(xp, batch.target),
            _array(xp, batch.weight),
            _array(xp, batch.counts),
            batch.axis,
            can_read=batch.input.device.type == "cpu",
        )
        divisor = _divisor(xp, work, settings)
        if xp is torch and _is_large(batch):
            sums, by_input = _in_pieces(work, table, divisor, wants_input=wants_input)
        else:
            sums, by_input = _whole_batch(xp, work, table, divisor, wants_input=wants_input)
        value, by_raw_kappa, by_raw_d = _value_and_gradients(xp, work, sums, table, divisor)
    return ReducedLoss(
        torch.scalar_tensor(value, dtype=dtype) if xp is np else value.to(dtype),
        by_input,
        None if raw_kappa is None else _tensor(xp, by_raw_kappa, raw_kappa.dtype),
        None if raw_d is None else _tensor(xp, by_raw_d, raw_d.dtype),
    )


def _tensor(xp: Any, values: Any, dtype: torch.dtype) -> Tensor:
    return (torch.from_numpy(values) if xp is np else values).to(dtype)


class Elements(NamedTuple):
    """A batch as arrays of NumPy or torch; ``can_read``: whether values can be read without waiting for a device."""

    input: Any
    target: Any
    weight: Any
    counts: Any
    axis: int
    can_read: bool

    @property
    def others(self) -> tuple[int, ...]:
        return tuple(i for i in range(self.input.ndim) if i != self.axis)


def _array(xp: Any, value: Tensor | None) -> Any:
    if value is None:
        return None
    value = value.detach()
    return value.numpy() if xp is np else value


def _own_array(xp: Any, value: Tensor | None) -> Any:
    """A copy for NumPy: memory that NumPy has seen cannot be freed, as sharded trainings do with parameters."""
    return _array(xp, value.detach().clone() if xp is np and value is not None else value)


def _divisor(xp: Any, batch: Elements, settings: LossSettings) -> Any:
    """Divisor of the sums: the total weight for a mean, else 1."""
    if settings.reduction == "sum":
        return 1.0
    if batch.weight is None:
        return float(math.prod(batch.input.shape))
    total = _summed(xp, batch.weight, None)
    return xp.where(total > 0, total, 1.0)


def _summed(xp: Any, values: Any, dims: tuple[int, ...] | None) -> Any:
    """Sums over dimensions, None for all; NumPy sums in float64, because it adds row by row."""
    if dims == ():
        return values
    if xp is np:
        return values.sum(dims, dtype=np.float64)
    return values.sum() if dims is None else values.sum(dims)


def _whole_batch(
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

    shaped = ChannelTable(*(along(value) for value in table))
    values, by_input = _element_values(xp, error, batch.weight, shaped, divisor, can_read=batch.can_read)
    sums = ChannelSums(*(None if value is None else _summed(xp, value, batch.others) for value in values))
    if not wants_input:
        return sums, None
    return sums, torch.from_numpy(by_input) if xp is np else by_input


def _element_values(
    xp: Any, error: Any, weight: Any, table: ChannelTable, divisor: Any, *, can_read: bool
) -> tuple[ChannelSums, Any]:
    """Summands of each element, and the gradient with respect to the input; the table must broadcast with ``error``."""
    z = error / table.d
    learns_kappa, learns_d = table.kappa_by_raw is not None, table.d_by_raw is not None
    has_gaussian = not can_read or bool((table.kappa == 0).any())
    each_kappa = learns_kappa and (not can_read or bool((table.kappa < SMALL_KAPPA).any()))
    density = element_energy(xp, z, table.kappa, with_kappa=each_kappa, has_gaussian=has_gaussian)
    by_d = -z * density.by_z if learns_kappa or learns_d else None
    if table.share is None:
        network, by_input = None, density.by_z * (1.0 / (table.d * divisor))
    else:
        network, by_input = _network(xp, error, table, divisor, can_read=can_read)
    if weight is not None:
        by_input = by_input * weight
    values = (network, density.value, density.by_kappa, by_d)
    sums = (None if value is None else value if weight is None else value * weight for value in values)
    return ChannelSums(*sums), by_input


def _network(xp: Any, error: Any, table: ChannelTable, divisor: Any, *, can_read: bool) -> tuple[Any, Any]:
    """The network term of each element, and its derivative with respect to the error, divided by the divisor."""
    share = table.share
    parts = []
    if not can_read or bool((share > 0).any()):
        own = element_energy(xp, error / table.annealed_d, table.annealed_kappa, with_kappa=False)
        parts.append((share * own.value, own.by_z * (share / (table.annealed_d * divisor))))
    if not can_read or bool((share < 1).any()):
        z = error / table.scale
        influence = initial_influence(xp, z)[0]
        parts.append(((1.0 - share) * initial_loss(xp, z), influence * ((1.0 - share) / (table.scale * divisor))))
    value, slope = parts[0]
    return (value, slope) if len(parts) == 1 else (value + parts[1][0], slope + parts[1][1])


def _is_large(batch: Batch) -> bool:
    """Whether the batch is on the CPU, contiguous with channels last, and too large for the cache."""
    given = [value for value in batch[:3] if value is not None]
    return (
        numpy_may_read(*given)
        and batch.input.numel() >= LARGE_BATCH
        and batch.axis == batch.input.dim() - 1
        and all(value.is_contiguous() for value in given)
    )


def _in_pieces(
    batch: Elements, table: ChannelTable, divisor: Any, *, wants_input: bool
) -> tuple[ChannelSums, Tensor | None]:
    """Sums and gradient computed piece by piece; the gradient is the only array of the size of the batch."""
    m = batch.input.shape[-1]
    flat: list[Any] = [None if value is None else value.reshape(-1, m) for value in batch[:4]]
    rows, dtype = len(flat[0]), batch.input.dtype
    learned = table.kappa_by_raw is not None or table.d_by_raw is not None
    if not (learned or table.share is not None or batch.weight is not None) and bool((table.kappa > 0).all()):
        kappa, d = table.kappa.to(dtype), table.d.to(dtype)
        energy, by_input = fixed_sums(flat[0], flat[1], kappa, d, divisor, wants_input=wants_input)
        return ChannelSums(None, energy, None, None), None if by_input is None else by_input.view_as(batch.input)
    by_input = torch.empty_like(flat[0]) if wants_input else None
    sums: list[Any] = [None] * 4
    tiled, tiles = table, 0
    for first, last, r in pieces(rows, m):
        if r != tiles:
            tiled = ChannelTable(*(None if value is None else value.to(dtype).repeat(r) for value in table))
            tiles = r
        given: list[Any] = [None if value is None else value[first:last].view(-1, r * m) for value in flat]
        error = given[0] - given[1]
        if given[3] is not None:
            error = torch.where(given[3], error, 0.0)
        values, slope = _element_values(torch, error, given[2], tiled, divisor, can_read=True)
        if by_input is not None:
            by_input[first:last].view(-1, r * m).copy_(slope)
        for i, value in enumerate(values):
            if value is not None:
                added = value.sum(0).double().view(r, m).sum(0)
                sums[i] = added if sums[i] is None else sums[i] + added
    return ChannelSums(*sums), None if by_input is None else by_input.view_as(batch.input)


def _value_and_gradients(
    xp: Any, batch: Elements, sums: ChannelSums, table: ChannelTable, divisor: Any
) -> tuple[Any, Any, Any]:
    """Value and gradients with respect to the raw parameters, from the sums of each channel."""
    total = sums.energy if sums.network is None else sums.energy + sums.network
    by_kappa = sums.by_kappa
    if by_kappa is None and table.kappa_by_raw is not None:  # (sum of z² exp(-x) / 2 - energy) / kappa
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
