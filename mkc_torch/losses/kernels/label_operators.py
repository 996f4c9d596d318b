"""Operators of ``torch.library`` for :class:`mkc_torch.GeneralizedCrossEntropyLoss`, for compiled code and for tensors
without memory."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mkc_torch.losses._checks import at_least_float32
from mkc_torch.losses.kernels.label_loss import arranged_labels, label_slopes, label_values, reduce_labels


@torch.library.custom_op("mkc_torch::label_loss", mutates_args=())
def reduced_label_loss(
    input: Tensor, target: Tensor, kappa: Tensor, weight: Tensor | None, ignore_index: int, mean: bool, wanted: bool
) -> tuple[Tensor, Tensor]:
    """Value, and the gradient with respect to the logits; empty if not needed, or in float16."""
    batch = arranged_labels(input, target, kappa, weight, ignore_index)
    value, slopes = reduce_labels(batch, mean, wanted and input.dtype != torch.float16)
    return value, input.new_empty(0) if slopes is None else slopes


@reduced_label_loss.register_fake
def _(
    input: Tensor, target: Tensor, kappa: Tensor, weight: Any, ignore_index: int, mean: bool, wanted: bool
) -> tuple[Tensor, Tensor]:
    value, made = input.new_empty((), dtype=at_least_float32(input)), wanted and input.dtype != torch.float16
    return value, _without_gaps(input) if made else input.new_empty(0)


def _without_gaps(input: Tensor) -> Tensor:
    return input.new_empty(input.shape)


@torch.library.custom_op("mkc_torch::label_slopes", mutates_args=())
def slopes_of_labels(
    input: Tensor, target: Tensor, kappa: Tensor, weight: Tensor | None, ignore_index: int, mean: bool, grad: Tensor
) -> Tensor:
    """The gradient with respect to the logits, multiplied by the upstream gradient."""
    return label_slopes(arranged_labels(input, target, kappa, weight, ignore_index), mean, grad)


@slopes_of_labels.register_fake
def _(input: Tensor, target: Tensor, kappa: Tensor, weight: Any, ignore_index: int, mean: bool, grad: Tensor) -> Tensor:
    return _without_gaps(input)


@torch.library.custom_op("mkc_torch::label_values", mutates_args=())
def values_of_labels(input: Tensor, target: Tensor, kappa: Tensor, weight: Tensor | None, ignore_index: int) -> Tensor:
    """The loss of each row."""
    return label_values(arranged_labels(input, target, kappa, weight, ignore_index))


@values_of_labels.register_fake
def _(input: Tensor, target: Tensor, kappa: Tensor, weight: Any, ignore_index: int) -> Tensor:
    return input.new_empty(len(input), dtype=at_least_float32(input))


def _save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, target, kappa, weight, ctx.ignore_index, *rest = inputs
    ctx.mean, slopes = False, None
    if rest:
        ctx.mean, slopes = rest[0], output[1]
        ctx.set_materialize_grads(False)
    ctx.stores = bool(rest) and input.dtype != torch.float16
    batch = (None,) * 4 if ctx.stores else (input, target, kappa, weight)
    ctx.save_for_backward(*batch, slopes)


def _backward(ctx: Any, grad: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
    nothing = (None,) * (len(ctx.needs_input_grad) - 1)
    if grad is None:
        return None, *nothing
    *batch, slopes = ctx.saved_tensors
    if ctx.stores:
        return (slopes * grad).to(slopes.dtype), *nothing
    return torch.ops.mkc_torch.label_slopes(*batch, ctx.ignore_index, ctx.mean, grad), *nothing


reduced_label_loss.register_autograd(_backward, setup_context=_save)
values_of_labels.register_autograd(_backward, setup_context=_save)


def operator_label_loss(loss: Any, input: Tensor, target: Tensor) -> Tensor:
    """Forward pass of a loss through the operators."""
    given = (input, target, loss.kappa, loss.weight, loss.ignore_index)
    if loss.reduction == "none":
        return values_of_labels(*given)
    wanted = torch.is_grad_enabled() and input.requires_grad
    value: Tensor = reduced_label_loss(*given, loss.reduction == "mean", wanted)[0]
    return value
