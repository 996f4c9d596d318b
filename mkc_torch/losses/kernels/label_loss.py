"""What :class:`mkc_torch.GeneralizedCrossEntropyLoss` computes of integer labels by kernels.

A few labels take one launch forward, many three; backward there is one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch.losses._checks import at_least_float32
from mkc_torch.losses.kernels.cached import CachedKernel
from mkc_torch.losses.kernels.labels import count_kernel, labels_kernel
from mkc_torch.losses.kernels.launch import WARPS, multiprocessors, rescale

__all__ = [
    "EachLabel",
    "LabelPass",
    "ReducedLabels",
    "arranged_labels",
    "label_slopes",
    "label_values",
    "reduce_labels",
]

TILE = 1024
"""Logits of a tile of several rows."""

WIDEST = 4096
"""Classes of a row that a program holds; rows of more classes are read twice, the second time from the cache."""

BLOCK_OF_ROW = 2048
"""Logits of a block of a wider row."""

ALONE = 1 << 12
"""Logits up to which one program makes the value alone."""

COUNTED_BY_EACH = 2048
"""Labels whose weights each program adds up itself."""

COUNTERS = 128
"""Programs that add up the weights of more labels, a thousand at a time."""

PROGRAMS_EACH = 32
"""Programs for each multiprocessor."""

_INT32 = 2**31

_COUNT, _LABELS = CachedKernel(count_kernel), CachedKernel(labels_kernel)


class Labels(NamedTuple):
    """A batch of logits without gaps, its labels, and the numbers of the loss."""

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
    """A batch as the kernel walks through it; with copies where memory has gaps."""
    return Labels(input.contiguous(), target.contiguous(), kappa, weight, ignore_index)


def _power(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _counted(batch: Labels) -> Tensor | None:
    """Sums of the weights of the labels, a few that the kernel adds up; None for few labels, of which it does all."""
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
    """One pass over a batch that writes what it is given; the value () where ``sums`` is asked for.

    Args:
        batch: the batch.
        mean: whether sums and gradients are those of the mean.
        upstream: gradient by the value, one number or one of each row; None for 1.
        values: takes the value of each row.
        slopes: takes the gradient by the logits.
        sums: whether the value is wanted.
    """
    rows, classes = batch.input.shape
    device, dtype = batch.input.device, batch.dtype
    whole = classes <= WIDEST
    block_class = _power(classes) if whole else BLOCK_OF_ROW
    block_row = min(max(TILE // block_class, 1), _power(rows)) if whole else 1
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
        [batch.kappa if one is None else one for one in tensors],
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
    """Value () of a reduced loss, and its gradient by the logits."""
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
    """The gradient by the logits, times the upstream gradient before it is rounded."""
    slopes = torch.empty_like(batch.input)
    pass_over_labels(batch, mean=mean, upstream=upstream, slopes=slopes)
    return slopes


class LabelPass(NamedTuple):
    """One forward pass: the loss, and the batch."""

    loss: Any
    batch: Labels


class ReducedLabels(torch.autograd.Function):
    """A sum or mean, whose gradient is made in the forward pass. That of float16, which a mean over many rows
    underflows before a gradient scaler multiplies, is made in the backward pass."""

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
        if found is None:  # a second backward pass of one graph, or float16
            return _slopes(ctx, grad), None, None
        rescale(found, None, None, grad)
        return found, None, None


class EachLabel(torch.autograd.Function):
    """The loss of each row. The gradient is made in the backward pass, which has to read the upstream gradient."""

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
    _ = ctx.saved_tensors  # torch refuses what was changed in place since
    return label_slopes(ctx.work.batch, ctx.work.loss.reduction == "mean", grad)


def _by_formulas(ctx: Any, grad: Tensor) -> Tensor:
    """A gradient that is a function of the logits, for a second derivative."""
    input, target, _ = ctx.saved_tensors
    value = ctx.work.loss._computed(input, target)
    (found,) = torch.autograd.grad(value, input, grad.to(value.dtype), create_graph=True)
    return found
