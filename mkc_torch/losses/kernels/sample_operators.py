"""Operators of ``torch.library`` for :class:`mkc_torch.HeteroscedasticMKCLoss`, for compiled code and for tensors
without memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mkc_torch.losses.kernels.sample_loss import (
    Samples,
    arranged_samples,
    computed_dtype,
    has_float16,
    reduce_samples,
    samples_slopes,
    samples_values,
    without_gaps,
)


@torch.library.custom_op("mkc_torch::sample_loss", mutates_args=())
def reduced_sample_loss(
    input: Tensor,
    target: Tensor,
    sigma: Tensor,
    d: Tensor,
    weight: Tensor | None,
    bound: Tensor,
    axis: int,
    mean: bool,
    wanted: Sequence[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value, and gradients with respect to input, sigma and d; empty where not needed, or in float16."""
    batch = arranged_samples(input, target, sigma, d, weight, bound, axis)
    made = [wants and not has_float16(input, sigma, d) for wants in wanted]
    value, slopes = reduce_samples(batch, mean, made)
    return value, *_without_none(batch, slopes)


def _without_none(batch: Samples, slopes: Sequence[Tensor | None]) -> tuple[Tensor, Tensor, Tensor]:
    own = (batch.input, batch.sigma, batch.d)
    by_input, by_sigma, by_d = (
        like.new_empty(0) if value is None else value for value, like in zip(slopes, own, strict=True)
    )
    return by_input, by_sigma, by_d


def _fake_slopes(
    input: Tensor, sigma: Tensor, d: Tensor, axis: int, wanted: Sequence[bool]
) -> tuple[Tensor, Tensor, Tensor]:
    layout = without_gaps(input, axis)
    by_input, by_sigma, by_d = (
        torch.empty_like(layout, dtype=value.dtype) if wants else value.new_empty(0)
        for value, wants in zip((input, sigma, d), wanted, strict=True)
    )
    return by_input, by_sigma, by_d


@reduced_sample_loss.register_fake
def _(
    input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Any, bound: Tensor, axis: int, mean: bool,
    wanted: Sequence[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    made = [wants and not has_float16(input, sigma, d) for wants in wanted]
    value = input.new_empty((), dtype=computed_dtype(input, target, sigma, d))
    return value, *_fake_slopes(input, sigma, d, axis, made)


@torch.library.custom_op("mkc_torch::sample_slopes", mutates_args=())
def sample_slopes(
    input: Tensor,
    target: Tensor,
    sigma: Tensor,
    d: Tensor,
    weight: Tensor | None,
    bound: Tensor,
    axis: int,
    mean: bool,
    wanted: Sequence[bool],
    grad: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to input, sigma and d, multiplied by the upstream gradient; empty where not needed."""
    batch = arranged_samples(input, target, sigma, d, weight, bound, axis)
    return _without_none(batch, samples_slopes(batch, mean, wanted, grad))


@sample_slopes.register_fake
def _(
    input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Any, bound: Tensor, axis: int, mean: bool,
    wanted: Sequence[bool], grad: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    return _fake_slopes(input, sigma, d, axis, wanted)


@torch.library.custom_op("mkc_torch::sample_values", mutates_args=())
def sample_values(
    input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None, bound: Tensor, axis: int
) -> Tensor:
    """The loss of each element."""
    return samples_values(arranged_samples(input, target, sigma, d, weight, bound, axis))


@sample_values.register_fake
def _(input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Any, bound: Tensor, axis: int) -> Tensor:
    return torch.empty_like(without_gaps(input, axis), dtype=computed_dtype(input, target, sigma, d))


def _save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    input, target, sigma, d, weight, bound, ctx.axis, *rest = inputs
    ctx.mean, slopes = False, (None, None, None)
    if rest:
        ctx.mean, slopes = rest[0], output[1:]
        ctx.set_materialize_grads(False)
    ctx.stores = bool(rest) and not has_float16(input, sigma, d)
    ctx.target_dtype = target.dtype
    batch = (None,) * 6 if ctx.stores else (input, target, sigma, d, weight, bound)
    ctx.save_for_backward(*batch, *slopes)


def _backward(ctx: Any, grad: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
    wants = ctx.needs_input_grad
    if grad is None:
        return (None,) * len(wants)
    wanted = [wants[0] or wants[1], wants[2], wants[3]]
    *batch, first, second, third = ctx.saved_tensors
    if ctx.stores:
        slopes = [(value * grad).to(value.dtype) for value in (first, second, third)]
    else:
        slopes = torch.ops.mkc_torch.sample_slopes(*batch, ctx.axis, ctx.mean, wanted, grad)
    by_input, by_sigma, by_d = (value if wants else None for value, wants in zip(slopes, wanted, strict=True))
    by_target = -by_input.to(ctx.target_dtype) if wants[1] and by_input is not None else None
    own = (by_input if wants[0] else None, by_target, by_sigma, by_d)
    return *own, *[None] * (len(wants) - 4)


reduced_sample_loss.register_autograd(_backward, setup_context=_save)
sample_values.register_autograd(_backward, setup_context=_save)


def operator_sample_loss(
    loss: Any, input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None, axis: int
) -> Tensor:
    """Forward pass of a loss through the operators."""
    given = (input, target, sigma, d, weight, loss.bound, axis)
    if loss.reduction == "none":
        return sample_values(*given)
    learns = torch.is_grad_enabled()
    wanted = [
        learns and (input.requires_grad or target.requires_grad),
        learns and sigma.requires_grad,
        learns and d.requires_grad,
    ]
    value: Tensor = reduced_sample_loss(*given, loss.reduction == "mean", wanted)[0]
    return value
