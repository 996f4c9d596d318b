"""Operators of ``torch.library`` for the kernels, for compiled code and for tensors without memory.

The operators are opaque to the compiler: the tiling depends on the size of the batch, and traced code would be compiled
again for each size. The operator that updates the running state mutates its arguments; the differentiable operator is
separate and mutates nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mkc_torch.losses.kernels.channels import TABLE
from mkc_torch.losses.kernels.launch import Options, Running, arranged, pass_over, reduce_batch, weight_sums
from mkc_torch.losses.kernels.loss import KernelRequest, gradients_of_each, options_of, request_of, updated_table

_STATE = ("recent", "position", "batches", "log_scale", "half_range", "steps", "log_bandwidth", "share")


@torch.library.custom_op("mkc_torch::channel_table", mutates_args=(*_STATE, "table"))
def channel_table(
    table: Tensor,
    input: Tensor,
    target: Tensor,
    weight: Tensor | None,
    axis: int,
    kappa: Tensor,
    d: Tensor | None,
    bound: Tensor | None,
    least: Tensor | None,
    recent: Tensor | None,
    position: Tensor | None,
    batches: Tensor | None,
    log_scale: Tensor | None,
    half_range: Tensor | None,
    steps: Tensor | None,
    log_bandwidth: Tensor | None,
    share: Tensor | None,
    options: Sequence[bool],
    updates: bool,
    warmup_steps: int,
    anneal_step: float,
) -> None:
    """Update the running state and fill the table of the numbers of each channel, (14, m)."""
    running = Running(recent, position, batches, log_scale, half_range, steps, log_bandwidth, share)
    request = KernelRequest(kappa, d, bound, least, running, updates, warmup_steps, anneal_step)
    table.copy_(updated_table(arranged(input, target, weight, axis), request, Options(*options), updates=updates))


@channel_table.register_fake
def _(*_: Any) -> None:
    return None


@torch.library.custom_op("mkc_torch::reduced_loss", mutates_args=())
def reduced_loss(
    input: Tensor,
    target: Tensor,
    weight: Tensor | None,
    axis: int,
    raw_kappa: Tensor | None,
    raw_d: Tensor | None,
    table: Tensor,
    options: Sequence[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value, and gradients with respect to the input, raw_kappa and raw_d; empty where not computed."""
    batch, stores = arranged(input, target, weight, axis), input.dtype != torch.float16
    value, *slopes = reduce_batch(batch, table, Options(*options), wants_input=stores)
    by_input, by_kappa, by_d = (table.new_empty(0) if slope is None else slope for slope in slopes)
    return value, by_input, by_kappa, by_d


@reduced_loss.register_fake
def _(
    input: Tensor, target: Tensor, weight: Any, axis: int, raw_kappa: Any, raw_d: Any, table: Tensor, options: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    slopes = table.new_empty(0) if input.dtype == torch.float16 else _like(input, axis)
    empty = table.new_empty
    by_kappa, by_d = (empty(0) if value is None else table.new_empty(table.shape[1]) for value in (raw_kappa, raw_d))
    return empty(()), slopes, by_kappa, by_d


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    input, target, weight, axis, raw_kappa, raw_d, table, options = inputs
    _, slopes, by_kappa, by_d = output
    ctx.axis, ctx.options = axis, options
    ctx.wanted = (raw_kappa is not None, raw_d is not None)
    half = input.dtype == torch.float16
    ctx.target_dtype = target.dtype
    ctx.save_for_backward(
        *((input, target, weight, table) if half else (None, None, None, None)), slopes, by_kappa, by_d
    )
    ctx.set_materialize_grads(False)


def _backward(ctx: Any, grad: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
    if grad is None:
        return (None,) * 8
    input, target, weight, table, slopes, by_kappa, by_d = ctx.saved_tensors
    if input is not None:
        slopes = torch.ops.mkc_torch.slopes(input, target, weight, ctx.axis, table, grad, ctx.options)
    else:
        slopes = (slopes * grad).to(slopes.dtype)
    of_target = -slopes.to(ctx.target_dtype) if ctx.needs_input_grad[1] else None
    of_kappa, of_d = (
        value * grad if wanted else None for value, wanted in zip((by_kappa, by_d), ctx.wanted, strict=True)
    )
    return slopes, of_target, None, None, of_kappa, of_d, None, None


reduced_loss.register_autograd(_backward, setup_context=_setup)


@torch.library.custom_op("mkc_torch::slopes", mutates_args=())
def slopes(
    input: Tensor,
    target: Tensor,
    weight: Tensor | None,
    axis: int,
    table: Tensor,
    grad: Tensor,
    options: Sequence[bool],
) -> Tensor:
    """The gradient of a reduced loss with respect to the input, multiplied by the upstream gradient before rounding."""
    batch = arranged(input, target, weight, axis)
    found = torch.empty_like(batch.input)
    weights, total = weight_sums(batch, table.dtype)
    pass_over(
        batch, table, Options(*options), weights=weights, total_weight=total, upstream=grad,
        slopes=found,
    )  # fmt: skip
    return found


@slopes.register_fake
def _(input: Tensor, target: Tensor, weight: Any, axis: int, *_: Any) -> Tensor:
    return _like(input, axis)


@torch.library.custom_op("mkc_torch::each_loss", mutates_args=())
def each_loss(
    input: Tensor,
    target: Tensor,
    weight: Tensor | None,
    axis: int,
    raw_kappa: Tensor | None,
    raw_d: Tensor | None,
    table: Tensor,
    options: Sequence[bool],
) -> Tensor:
    """The loss of each element."""
    batch = arranged(input, target, weight, axis)
    values = torch.empty_like(batch.input, dtype=table.dtype)
    pass_over(batch, table, Options(*options), values=values)
    return values


@each_loss.register_fake
def _(
    input: Tensor, target: Tensor, weight: Any, axis: int, raw_kappa: Any, raw_d: Any, table: Tensor, options: Any
) -> Tensor:
    return _like(input, axis, table.dtype)


@torch.library.custom_op("mkc_torch::each_gradients", mutates_args=())
def each_gradients(
    input: Tensor,
    target: Tensor,
    weight: Tensor | None,
    axis: int,
    table: Tensor,
    grad: Tensor,
    options: Sequence[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to the input, raw_kappa and raw_d, with an upstream gradient per element."""
    found = gradients_of_each(arranged(input, target, weight, axis), table, Options(*options), grad)
    by_input, by_kappa, by_d = (table.new_empty(0) if value is None else value for value in found)
    return by_input, by_kappa, by_d


@each_gradients.register_fake
def _(
    input: Tensor, target: Tensor, weight: Any, axis: int, table: Tensor, grad: Tensor, options: Sequence[bool]
) -> tuple[Tensor, Tensor, Tensor]:
    own = Options(*options)
    by_kappa, by_d = (
        table.new_empty(table.shape[1]) if learned else table.new_empty(0) for learned in (own.learn_kappa, own.learn_d)
    )
    return _like(input, axis), by_kappa, by_d


def _each_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    input, target, weight, ctx.axis, raw_kappa, raw_d, table, ctx.options = inputs
    ctx.wanted, ctx.target_dtype = (raw_kappa is not None, raw_d is not None), target.dtype
    ctx.save_for_backward(input, target, weight, table)


def _each_backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    input, target, weight, table = ctx.saved_tensors
    found = torch.ops.mkc_torch.each_gradients(input, target, weight, ctx.axis, table, grad, ctx.options)
    of_target = -found[0].to(ctx.target_dtype) if ctx.needs_input_grad[1] else None
    of_kappa, of_d = (value if wanted else None for value, wanted in zip(found[1:], ctx.wanted, strict=True))
    return found[0], of_target, None, None, of_kappa, of_d, None, None


each_loss.register_autograd(_each_backward, setup_context=_each_setup)


def _dtype(input: Tensor, target: Tensor, kappa: Tensor) -> torch.dtype:
    wide = torch.float64 in (input.dtype, target.dtype)
    return torch.float64 if wide else kappa.dtype


def _like(input: Tensor, axis: int, dtype: torch.dtype | None = None) -> Tensor:
    dense = input.is_contiguous() or input.movedim(axis, -1).is_contiguous()
    return torch.empty_like(input if dense else input.contiguous(), dtype=dtype)


def operator_loss(loss: Any, input: Tensor, target: Tensor, weight: Tensor | None, axis: int) -> Tensor:
    """Forward pass of a loss through the operators."""
    request, options = request_of(loss, input.device), list(options_of(loss))
    given = (input.detach(), target.detach(), weight, axis)
    numbers = (None if entry is None else entry.detach() for entry in request[:4])
    shape, dtype = (len(TABLE), loss.num_channels), _dtype(input, target, request.kappa)
    table = torch.empty(shape, dtype=dtype, device=input.device)
    channel_table(
        table, *given, *numbers, *request.running, options, request.updates, request.warmup_steps, request.anneal_step
    )
    operator = each_loss if loss.reduction == "none" else reduced_loss
    found = operator(input, target, weight, axis, loss.raw_kappa, loss.raw_d, table, options)
    value: Tensor = found if loss.reduction == "none" else found[0]
    return value
