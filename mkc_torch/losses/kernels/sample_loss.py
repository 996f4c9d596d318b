"""What :class:`mkc_torch.HeteroscedasticMKCLoss` computes by kernels: one launch forward, one backward."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.head import head_quadrature, head_rule_constants
from mkc_torch.density.head_table import head_table
from mkc_torch.losses.kernels.cached import CachedKernel
from mkc_torch.losses.kernels.launch import RESCALED, WARPS, multiprocessors
from mkc_torch.losses.kernels.samples import rescale_samples_kernel, samples_kernel

__all__ = ["EachSample", "ReducedSamples", "SamplePass", "arranged_samples"]

BLOCK = 512
"""Elements of a block; a thread holds four, which are one load."""

ALONE = 1 << 12
"""Elements up to which one program makes the value alone."""

PROGRAMS_EACH = 32
"""Programs for each multiprocessor, five of which run at once: so many that the last ones are a small share."""

SINGLE_NODES = 16
"""Nodes of the quadrature in float32; float64 takes all 32."""

_SAMPLES, _RESCALE = CachedKernel(samples_kernel), CachedKernel(rescale_samples_kernel)


class Samples(NamedTuple):
    """A batch of elements with their own sigma and d, all in the layout of the input, whose memory has no gaps."""

    input: Tensor
    target: Tensor
    sigma: Tensor
    d: Tensor
    weight: Tensor | None
    bound: Tensor
    channels: int
    inner: int
    """Elements from one channel to the next; for a bound of each channel."""

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return computed_dtype(self.input, self.target, self.sigma, self.d)

    @property
    def total_weight(self) -> Tensor | None:
        return None if self.weight is None else self.weight.sum(dtype=self.dtype)


def computed_dtype(*given: Tensor) -> torch.dtype:
    return torch.float64 if any(one.dtype == torch.float64 for one in given) else torch.float32


def arranged_samples(
    input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None, bound: Tensor, axis: int
) -> Samples:
    """A batch as the kernel walks through it; with copies where tensors are laid out otherwise than the input."""
    input = without_gaps(input, axis)
    weight = None if weight is None else alike(weight.expand(input.shape), input)
    channels, inner = 1, 1
    if bound.numel() > 1:
        channels = input.shape[axis]
        inner = input.shape[axis + 1 :].numel() if input.is_contiguous() else 1
    return Samples(input, alike(target, input), alike(sigma, input), alike(d, input), weight, bound, channels, inner)


def without_gaps(input: Tensor, axis: int) -> Tensor:
    """The input, or a copy, with its channels last in memory or in their place."""
    return input if input.is_contiguous() or input.movedim(axis, -1).is_contiguous() else input.contiguous()


def alike(values: Tensor, input: Tensor) -> Tensor:
    """Values in the layout of the input."""
    if values.stride() == input.stride() or (values.is_contiguous() and input.is_contiguous()):
        return values
    return torch.empty_like(input, dtype=values.dtype).copy_(values)


@functools.cache
def _rule(device: torch.device, dtype: torch.dtype) -> Tensor:
    """Nodes and weights of the quadrature."""
    rule = head_rule_constants() if dtype == torch.float64 else head_quadrature(SINGLE_NODES)
    return torch.cat(rule).to(device, dtype)


def pass_over_samples(
    batch: Samples,
    *,
    mean: bool,
    total_weight: Tensor | None = None,
    upstream: Tensor | None = None,
    values: Tensor | None = None,
    slopes: Sequence[Tensor | None] = (None, None, None),
    sums: bool = False,
) -> Tensor | None:
    """One pass over a batch that writes what it is given; the value () where ``sums`` is asked for.

    Args:
        batch: the batch.
        mean: whether sums and gradients are those of the mean.
        total_weight: sum of the weights, for a weighted mean.
        upstream: gradient by the value, one number or one of each element; None for 1.
        values: takes the value of each element.
        slopes: take the gradients by input, sigma and d.
        sums: whether the value is wanted.
    """
    dtype, device, count = batch.dtype, batch.input.device, batch.input.numel()
    blocks = -(-count // BLOCK)
    programs = 1 if count <= ALONE and sums else min(blocks, PROGRAMS_EACH * multiprocessors(device))
    partial = torch.empty(programs, dtype=dtype, device=device) if sums else None
    each = upstream is not None and upstream.dim() > 0
    if each and upstream is not None:
        upstream = alike(upstream, batch.input)
    rule = _rule(device, dtype)
    tensors = (
        *batch[:5], upstream, batch.bound, head_table(device), rule, total_weight, values, *slopes, partial
    )  # fmt: skip
    _SAMPLES.launch(
        (programs, 1, 1),
        [rule if one is None else one for one in tensors],
        (count, batch.inner, programs),
        (
            batch.channels, BLOCK, batch.bound.numel() > 1, batch.weight is not None, mean,
            0 if upstream is None else 2 if each else 1,
            values is not None, *(one is not None for one in slopes), sums, len(rule) // 2, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    if partial is None:
        return None
    return partial.view(()) if programs == 1 else partial.sum()


def empty_slopes(batch: Samples, wanted: Sequence[bool]) -> list[Tensor | None]:
    """Room for the gradients by input, sigma and d, in the layout of the input."""
    given = (batch.input, batch.sigma, batch.d)
    return [
        torch.empty_like(batch.input, dtype=one.dtype) if wants else None
        for one, wants in zip(given, wanted, strict=True)
    ]


def reduce_samples(batch: Samples, mean: bool, wanted: Sequence[bool]) -> tuple[Tensor, list[Tensor | None]]:
    """Value () of a reduced loss, and its gradients by input, sigma and d."""
    slopes = empty_slopes(batch, wanted)
    value = pass_over_samples(batch, mean=mean, total_weight=batch.total_weight, slopes=slopes, sums=True)
    assert value is not None
    return value, slopes


def samples_values(batch: Samples) -> Tensor:
    """The loss of each element."""
    values = torch.empty_like(batch.input, dtype=batch.dtype)
    pass_over_samples(batch, mean=False, values=values)
    return values


def samples_slopes(batch: Samples, mean: bool, wanted: Sequence[bool], upstream: Tensor) -> list[Tensor | None]:
    """Gradients by input, sigma and d, times the upstream gradient before they are rounded."""
    slopes = empty_slopes(batch, wanted)
    pass_over_samples(batch, mean=mean, total_weight=batch.total_weight, upstream=upstream, slopes=slopes)
    return slopes


def rescale_samples(slopes: Sequence[Tensor | None], upstream: Tensor) -> None:
    """Multiply gradients by the upstream gradient, in place; where that is 1 nothing is read."""
    made = [one for one in slopes if one is not None]
    if not made:
        return
    count, most = made[0].numel(), PROGRAMS_EACH * multiprocessors(upstream.device)
    programs = min(-(-count // RESCALED), most)
    _RESCALE.launch(
        (programs, 1, 1),
        [*(upstream if one is None else one for one in slopes), upstream],
        (count, programs),
        (RESCALED, *(one is not None for one in slopes)),
        WARPS,
    )


def has_float16(*given: Tensor) -> bool:
    """Whether the gradients wait for the backward pass: a mean over many elements underflows float16 before a gradient
    scaler multiplies."""
    return any(one.dtype == torch.float16 for one in given)


class SamplePass(NamedTuple):
    """One forward pass: the loss, the batch, and the weights as they were given."""

    loss: Any
    batch: Samples
    weight: Tensor | None


class ReducedSamples(torch.autograd.Function):
    """A sum or mean, whose gradients are made in the forward pass; those of float16 in the backward pass."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, work: SamplePass) -> Tensor:
        wants = ctx.needs_input_grad
        ctx.wanted = (wants[0] or wants[1], wants[2], wants[3])
        ctx.stores = not has_float16(input, sigma, d)
        ctx.save_for_backward(input, target, sigma, d)
        ctx.work = work
        made = ctx.wanted if ctx.stores else (False, False, False)
        value, ctx.found = reduce_samples(work.batch, work.loss.reduction == "mean", made)
        return value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return _by_formulas(ctx, grad)
        work: SamplePass = ctx.work
        found, ctx.found = ctx.found, None
        if found is None or not ctx.stores:  # a second backward pass of one graph, or float16
            found = samples_slopes(work.batch, work.loss.reduction == "mean", ctx.wanted, grad)
        else:
            rescale_samples(found, grad)
        return _handed_out(ctx, found)


class EachSample(torch.autograd.Function):
    """Each element's loss. The gradients are made in the backward pass, which has to read the upstream gradient."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, work: SamplePass) -> Tensor:
        wants = ctx.needs_input_grad
        ctx.wanted = (wants[0] or wants[1], wants[2], wants[3])
        ctx.save_for_backward(input, target, sigma, d)
        ctx.work = work
        return samples_values(work.batch)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return _by_formulas(ctx, grad)
        return _handed_out(ctx, samples_slopes(ctx.work.batch, False, ctx.wanted, grad))


def _handed_out(ctx: Any, slopes: Sequence[Tensor | None]) -> tuple[Tensor | None, ...]:
    """The gradients of input, target, sigma, d and the last argument."""
    by_input, by_sigma, by_d = slopes
    target, wants = ctx.saved_tensors[1], ctx.needs_input_grad
    by_target = -by_input.to(target.dtype) if wants[1] and by_input is not None else None
    return by_input if wants[0] else None, by_target, by_sigma, by_d, None


def _by_formulas(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    """Gradients that are functions of the inputs, for a second derivative."""
    given, work = ctx.saved_tensors, ctx.work
    value = work.loss._computed(*given, work.weight)
    wanted = [one for one, wants in zip(given, ctx.needs_input_grad, strict=False) if wants]
    found = iter(torch.autograd.grad(value, wanted, grad.to(value.dtype), create_graph=True))
    return *(next(found) if wants else None for wants in ctx.needs_input_grad[:4]), None
