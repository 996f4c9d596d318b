"""Forward and backward pass of :class:`mkc_torch.GeneralizedCrossEntropyLoss` on integer labels by kernels.

The forward pass takes a single launch for few labels and three for many, the backward pass a single launch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch.losses._checks import at_least_float32
from mkc_torch.losses.kernels.cached import CachedKernel
from mkc_torch.losses.kernels.labels import count_kernel, labels_kernel
from mkc_torch.losses.kernels.launch import WARPS, multiprocessors, power_of_two, rescale

TILE = 1024
"""Logits per tile of several rows."""

WIDEST = 4096
"""Classes per row that a program holds; longer rows are read twice, the second time from the cache."""

BLOCK_OF_ROW = 2048
"""Logits per block of a longer row."""

ALONE = 1 << 12
"""Logits up to which a single program computes the value."""

COUNTED_BY_EACH = 2048
"""Labels up to which each program adds up the weights itself."""

COUNTERS = 128
"""Programs that add up the weights of more labels, in blocks of 1024."""

PROGRAMS_EACH = 32
"""Programs per multiprocessor."""

_COUNT, _LABELS = CachedKernel(count_kernel), CachedKernel(labels_kernel)


class Labels(NamedTuple):
    """Contiguous logits, their labels, and the parameters of the loss."""

    input: Tensor
    target: Tensor
    kappa: Tensor
    weight: Tensor | None
    ignore_index: int

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return at_least_float32(self.input)


def arranged_labels(input: Tensor, target: Tensor, kappa: Tensor, weight: Tensor | None, ignore_index: int) -> Labels:
    """A batch in the kernel's memory layout; copied where it is not contiguous."""
    return Labels(input.contiguous(), target.contiguous(), kappa, weight, ignore_index)


def _counted(batch: Labels) -> Tensor | None:
    """Partial sums of the labels' weights, for the kernel to add up; None for few labels, which it adds up itself."""
    rows, classes = batch.input.shape
    if rows <= COUNTED_BY_EACH:
        return None
    programs = min(COUNTERS, -(-rows // 1024))
    counted = torch.empty(programs, dtype=batch.dtype, device=batch.input.device)
    _COUNT.launch(
        (programs, 1, 1),
        [batch.target, counted if batch.weight is None else batch.weight, counted],
        (rows, batch.ignore_index, programs),
        (classes, 1024, batch.weight is not None, batch.dtype == torch.float64),
        WARPS,
    )
    return counted


def pass_over_labels(
    batch: Labels,
    *,
    mean: bool,
    upstream: Tensor | None = None,
    values: Tensor | None = None,
    slopes: Tensor | None = None,
    sums: bool = False,
) -> Tensor | None:
    """Run the kernel over a batch, and fill the given outputs. Returns the value () with ``sums``, else None.

    Args:
        batch: the batch.
        mean: whether sums and gradients are those of the mean.
        upstream: gradient with respect to the value, a number or one per row; None means 1.
        values: output, the value of each row.
        slopes: output, the gradient with respect to the logits.
        sums: whether to compute the value.
    """
    rows, classes = batch.input.shape
    device, dtype = batch.input.device, batch.dtype
    whole = classes <= WIDEST
    block_class = power_of_two(classes) if whole else BLOCK_OF_ROW
    block_row = min(max(TILE // block_class, 1), power_of_two(rows)) if whole else 1
    tiles = -(-rows // block_row)
    alone = sums and rows * classes <= ALONE
    programs = 1 if alone else min(tiles, PROGRAMS_EACH * multiprocessors(device))
    partial = torch.empty(programs, dtype=dtype, device=device) if sums else None
    counted = _counted(batch) if mean else None
    each = upstream is not None and upstream.dim() > 0
    if each and upstream is not None:
        upstream = upstream.contiguous()
    tensors = (batch.input, batch.target, batch.weight, upstream, batch.kappa, counted, values, slopes, partial)
    _LABELS.launch(
        (programs, 1, 1),
        [batch.kappa if tensor is None else tensor for tensor in tensors],
        (rows, batch.ignore_index, 0 if counted is None else len(counted), programs),
        (
            classes, block_row, block_class, 0 if counted is None else COUNTERS,
            batch.weight is not None, mean, 0 if upstream is None else 2 if each else 1,
            values is not None, slopes is not None, sums, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    if partial is None:
        return None
    return partial.view(()) if programs == 1 else partial.sum()


def reduce_labels(batch: Labels, mean: bool, wants_input: bool) -> tuple[Tensor, Tensor | None]:
    """Value () of a reduced loss, and its gradient with respect to the logits."""
    slopes = torch.empty_like(batch.input) if wants_input else None
    value = pass_over_labels(batch, mean=mean, slopes=slopes, sums=True)
    assert value is not None
    return value, slopes


def label_values(batch: Labels) -> Tensor:
    """The loss of each row."""
    values = torch.empty(len(batch.input), dtype=batch.dtype, device=batch.input.device)
    pass_over_labels(batch, mean=False, values=values)
    return values


def label_slopes(batch: Labels, mean: bool, upstream: Tensor) -> Tensor:
    """The gradient with respect to the logits, multiplied by the upstream gradient before rounding."""
    slopes = torch.empty_like(batch.input)
    pass_over_labels(batch, mean=mean, upstream=upstream, slopes=slopes)
    return slopes


class LabelPass(NamedTuple):
    """Loss and batch of a forward pass."""

    loss: Any
    batch: Labels


class ReducedLabels(torch.autograd.Function):
    """A sum or mean, with the gradient computed in the forward pass.

    In float16 the backward pass computes it: the gradient of a mean over many rows would underflow before a gradient
    scaler multiplies it.
    """

    @staticmethod
    def forward(ctx: Any, input: Tensor, target: Tensor, work: LabelPass) -> Tensor:
        ctx.stores = ctx.needs_input_grad[0] and input.dtype != torch.float16
        ctx.save_for_backward(input, target, work.batch.kappa)
        ctx.work = work
        value, ctx.found = reduce_labels(work.batch, work.loss.reduction == "mean", ctx.stores)
        return value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, None]:
        if torch.is_grad_enabled():
            return _by_formulas(ctx, grad), None, None
        found, ctx.found = ctx.found, None
        if found is None:  # a second backward pass of the same graph, or float16
            return _slopes(ctx, grad), None, None
        rescale(found, None, None, grad)
        return found, None, None


class EachLabel(torch.autograd.Function):
    """The loss of each row. The backward pass computes the gradient, because it needs the upstream gradient."""

    @staticmethod
    def forward(ctx: Any, input: Tensor, target: Tensor, work: LabelPass) -> Tensor:
        ctx.save_for_backward(input, target, work.batch.kappa)
        ctx.work = work
        return label_values(work.batch)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, None]:
        if torch.is_grad_enabled():
            return _by_formulas(ctx, grad), None, None
        return _slopes(ctx, grad), None, None


def _slopes(ctx: Any, grad: Tensor) -> Tensor:
    _ = ctx.saved_tensors  # torch raises if a saved tensor was changed in place
    return label_slopes(ctx.work.batch, ctx.work.loss.reduction == "mean", grad)


def _by_formulas(ctx: Any, grad: Tensor) -> Tensor:
    """Differentiable gradient with respect to the logits, for second derivatives."""
    input, target, _ = ctx.saved_tensors
    value = ctx.work.loss._computed(input, target)
    (found,) = torch.autograd.grad(value, input, grad.to(value.dtype), create_graph=True)
    return found
