"""Forward and backward pass of :class:`mkc_torch.HeteroscedasticMKCLoss` by kernels, a single launch each."""

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

BLOCK = 512
"""Elements per block; a thread holds four, a single load."""

ALONE = 1 << 12
"""Elements up to which a single program computes the value."""

PROGRAMS_EACH = 32
"""Programs per multiprocessor, of which five run at once: many, so that the last round is a small share."""

SINGLE_NODES = 16
"""Quadrature nodes in float32; float64 uses all 32."""

_SAMPLES, _RESCALE = CachedKernel(samples_kernel), CachedKernel(rescale_samples_kernel)


class Samples(NamedTuple):
    """A batch with sigma and d per element, all contiguous and in the layout of the input."""

    input: Tensor
    target: Tensor
    sigma: Tensor
    d: Tensor
    weight: Tensor | None
    bound: Tensor
    channels: int
    inner: int
    """Elements from a channel to the next; for a bound per channel."""

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return computed_dtype(self.input, self.target, self.sigma, self.d)

    @property
    def total_weight(self) -> Tensor | None:
        return None if self.weight is None else self.weight.sum(dtype=self.dtype)


def computed_dtype(*given: Tensor) -> torch.dtype:
    return torch.float64 if any(value.dtype == torch.float64 for value in given) else torch.float32


def arranged_samples(
    input: Tensor, target: Tensor, sigma: Tensor, d: Tensor, weight: Tensor | None, bound: Tensor, axis: int
) -> Samples:
    """A batch in the kernel's memory layout; tensors in another layout than the input are copied."""
    input = without_gaps(input, axis)
    weight = None if weight is None else alike(weight.expand(input.shape), input)
    channels, inner = 1, 1
    if bound.numel() > 1:
        channels = input.shape[axis]
        inner = input.shape[axis + 1 :].numel() if input.is_contiguous() else 1
    return Samples(input, alike(target, input), alike(sigma, input), alike(d, input), weight, bound, channels, inner)


def without_gaps(input: Tensor, axis: int) -> Tensor:
    """The input, or a contiguous copy: channels last in memory, or in order."""
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
    """Run the kernel over a batch, and fill the given outputs. Returns the value () with ``sums``, else None.

    Args:
        batch: the batch.
        mean: whether sums and gradients are those of the mean.
        total_weight: sum of the weights, for a weighted mean.
        upstream: gradient with respect to the value, a number or one per element; None means 1.
        values: output, the value of each element.
        slopes: outputs, the gradients with respect to input, sigma and d.
        sums: whether to compute the value.
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
        [rule if tensor is None else tensor for tensor in tensors],
        (count, batch.inner, programs),
        (
            batch.channels, BLOCK, batch.bound.numel() > 1, batch.weight is not None, mean,
            0 if upstream is None else 2 if each else 1,
            values is not None, *(slope is not None for slope in slopes), sums, len(rule) // 2, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    if partial is None:
        return None
    return partial.view(()) if programs == 1 else partial.sum()


def empty_slopes(batch: Samples, wanted: Sequence[bool]) -> list[Tensor | None]:
    """Empty tensors for the gradients with respect to input, sigma and d, in the layout of the input."""
    given = (batch.input, batch.sigma, batch.d)
    return [
        torch.empty_like(batch.input, dtype=value.dtype) if wants else None
        for value, wants in zip(given, wanted, strict=True)
    ]


def reduce_samples(batch: Samples, mean: bool, wanted: Sequence[bool]) -> tuple[Tensor, list[Tensor | None]]:
    """Value () of a reduced loss, and its gradients with respect to input, sigma and d."""
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
    """Gradients with respect to input, sigma and d, multiplied by the upstream gradient before rounding."""
    slopes = empty_slopes(batch, wanted)
    pass_over_samples(batch, mean=mean, total_weight=batch.total_weight, upstream=upstream, slopes=slopes)
    return slopes


def rescale_samples(slopes: Sequence[Tensor | None], upstream: Tensor) -> None:
    """Multiply gradients by the upstream gradient, in place; nothing is read if that is 1."""
    made = [slope for slope in slopes if slope is not None]
    if not made:
        return
    count, most = made[0].numel(), PROGRAMS_EACH * multiprocessors(upstream.device)
    programs = min(-(-count // RESCALED), most)
    _RESCALE.launch(
        (programs, 1, 1),
        [*(upstream if slope is None else slope for slope in slopes), upstream],
        (count, programs),
        (RESCALED, *(slope is not None for slope in slopes)),
        WARPS,
    )


def has_float16(*given: Tensor) -> bool:
    """Whether a tensor is float16, so that the backward pass computes the gradients: those of a mean over many elements
    would underflow before a gradient scaler multiplies them."""
    return any(value.dtype == torch.float16 for value in given)


class SamplePass(NamedTuple):
    """Loss, batch and original weights of a forward pass."""

    loss: Any
    batch: Samples
    weight: Tensor | None


class ReducedSamples(torch.autograd.Function):
    """A sum or mean. The forward pass computes the gradients; in float16 the backward pass does."""

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
        if found is None or not ctx.stores:  # a second backward pass of the same graph, or float16
            found = samples_slopes(work.batch, work.loss.reduction == "mean", ctx.wanted, grad)
        else:
            rescale_samples(found, grad)
        return _handed_out(ctx, found)


class EachSample(torch.autograd.Function):
    """The loss of each element. The backward pass computes the gradients, because it needs the upstream gradient."""

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
    """Differentiable gradients, for second derivatives."""
    given, work = ctx.saved_tensors, ctx.work
    value = work.loss._computed(*given, work.weight)
    wanted = [entry for entry, wants in zip(given, ctx.needs_input_grad, strict=False) if wants]
    found = iter(torch.autograd.grad(value, wanted, grad.to(value.dtype), create_graph=True))
    return *(next(found) if wants else None for wants in ctx.needs_input_grad[:4]), None
