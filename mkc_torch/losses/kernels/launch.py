"""Launching the kernels: memory layout of a batch, block sizes, and one function for each kernel."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import torch
import triton
from torch import Tensor

from mkc_torch.density.normalizer import head_rule_constants
from mkc_torch.losses._bandwidth_selection import BANDWIDTHS
from mkc_torch.losses.kernels.channels import TABLE, channel_kernel
from mkc_torch.losses.kernels.elements import elements_kernel, finish_kernel, rescale_kernel
from mkc_torch.losses.residual_scale import RANGE_ROWS

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = [
    "Arranged",
    "Options",
    "Running",
    "arranged",
    "kernels_are_interpreted",
    "make_table",
    "pass_over",
    "reduce_batch",
    "rescale",
    "view_as_arranged",
    "weight_sums",
]

TILE = 1024
"""Elements of a tile of a large batch."""

MOST_COLUMNS = 64
"""Channels of a tile, where they are last in memory."""

ALONE = 1 << 14
"""Elements up to which one program finishes a batch alone."""

PROGRAMS_EACH = 8
"""Programs for each multiprocessor of a device in a pass over a large batch."""

PARTIAL_SUMS = 1 << 20
"""Sums of programs and channels that are kept at most."""

RESCALED = 4096
"""Gradients of a block that are rescaled."""

WARPS = 4
"""Warps of a program."""


class Options(NamedTuple):
    """What a loss computes, known before the values are."""

    follows: bool
    robust: bool
    has_scale: bool
    learn_kappa: bool
    learn_d: bool
    own_bound: bool
    own_floor: bool
    normalize: bool
    mean: bool


class Running(NamedTuple):
    """Buffers of a running scale and a schedule; None where a loss has none."""

    recent: Tensor | None = None
    position: Tensor | None = None
    batches: Tensor | None = None
    log_scale: Tensor | None = None
    half_range: Tensor | None = None
    floor: Tensor | None = None
    steps: Tensor | None = None
    log_bandwidth: Tensor | None = None
    share: Tensor | None = None


class Arranged(NamedTuple):
    """A batch as (outer, m, inner) views whose strides input and target share; the weight has its own."""

    input: Tensor
    target: Tensor
    weight: Tensor | None
    like: Tensor
    """The input itself, or a copy whose memory has no gaps: gradients have its layout."""
    axis: int

    @property
    def channels(self) -> int:
        return self.input.shape[1]

    @property
    def wide(self) -> bool:
        return self.input.dtype == torch.float64 or self.target.dtype == torch.float64


def arranged(input: Tensor, target: Tensor, weight: Tensor | None, axis: int) -> Arranged:
    """Views of a batch that the kernels walk through; copies where its memory has gaps."""
    if not (input.is_contiguous() or input.movedim(axis, -1).is_contiguous()):
        input = input.contiguous()
    if target.stride() != input.stride():
        target = torch.empty_like(input, dtype=target.dtype).copy_(target)
    given = [input, target] if weight is None else [input, target, weight.expand(input.shape)]
    views = [_view(one, axis, channels_last=not input.is_contiguous()) for one in given]
    return Arranged(views[0], views[1], None if weight is None else views[2], input, axis)


def view_as_arranged(values: Tensor, batch: Arranged) -> Tensor:
    """A tensor of the shape of the batch as the batch is viewed."""
    return _view(values, batch.axis, channels_last=not batch.like.is_contiguous())


def _view(values: Tensor, axis: int, *, channels_last: bool) -> Tensor:
    shape = values.shape
    if channels_last:
        return values.movedim(axis, -1).reshape(-1, shape[axis], 1)
    outer, inner = shape[:axis].numel(), shape[axis + 1 :].numel()
    if shape[axis] == 1:  # one channel: all of it is one row
        return values.reshape(1, 1, -1)
    return values.reshape(outer, shape[axis], inner)


@functools.cache
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """The rule of the normaliser and the candidate bandwidths."""
    rule = torch.cat(head_rule_constants()).to(device, torch.float64)
    return rule, torch.tensor(BANDWIDTHS, dtype=torch.float32, device=device)


@functools.cache
def _multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2


def _power(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def make_table(
    batch: Arranged,
    running: Running,
    kappa: Tensor,
    d: Tensor | None,
    bound: Tensor | None,
    floor: Tensor | None,
    options: Options,
    *,
    scale: bool = False,
    peek: bool = False,
    schedule: bool = False,
    table: bool = True,
    pace: tuple[int, float] = (0, 0.0),
) -> Float[Tensor, "14 m"]:
    """Update what is asked for, and make the table of the numbers of each channel.

    Args:
        batch: the batch.
        running: buffers, changed in place where ``scale`` or ``schedule`` is asked for.
        kappa, d: raw parameters where they are learned, else the numbers; None for a d that is the scale.
        bound, floor: given ones, or None.
        options: what the loss computes.
        scale, schedule, table: what is to be done.
        peek: whether channels without a batch so far take their scale from this one, for the table alone.
        pace: ``warmup_steps`` and ``anneal_step`` of the schedule.
    """
    x, t, w = batch.input, batch.target, batch.weight
    outer, m, inner = x.shape
    dtype = torch.float64 if batch.wide else kappa.dtype
    numbers = torch.empty((len(TABLE), m), dtype=dtype, device=x.device)
    rows = outer * inner
    step = max(1, rows // RANGE_ROWS)
    rule, widths = _constants(x.device)
    dummy = numbers
    recent = dummy if running.recent is None else running.recent
    length = 1 if running.recent is None else running.recent.shape[-1]
    buffers = [dummy if one is None else one for one in running[1:]]
    given = [dummy if one is None else one for one in (d, bound, floor)]
    channel_kernel[(m,)](
        x, t, dummy if w is None else w, recent, *buffers, kappa, *given, numbers, rule, widths,
        rows, m, inner, *x.stride(), *((0, 0, 0) if w is None else w.stride()),
        -(-rows // step), step, *pace,
        LENGTH=length, LENGTH_PAD=max(_power(length), 16), RANGE_BLOCK=min(max(_power(-(-rows // step)), 16), 1024),
        SCALE=scale, PEEK=peek, SCHEDULE=schedule, MAKE_TABLE=table, HAS_WEIGHT=w is not None,
        HAS_SCALE=options.has_scale, ROBUST=options.robust, FOLLOWS=options.follows,
        LEARN_KAPPA=options.learn_kappa, LEARN_D=options.learn_d,
        OWN_BOUND=options.own_bound, OWN_FLOOR=options.own_floor, NORMALIZE=options.normalize,
        WIDTHS=len(BANDWIDTHS), WIDTHS_PAD=16, NODES=32, WIDE=dtype == torch.float64,
        num_warps=WARPS,
    )  # fmt: skip
    return numbers


class Tiles(NamedTuple):
    """How a pass over a batch is cut: block sizes, programs along the batch and along the channels."""

    block_row: int
    block_col: int
    channels_last: bool
    programs: int
    columns: int


def _tiles(batch: Arranged) -> Tiles:
    outer, m, inner = batch.input.shape
    channels_last = inner == 1 and m > 1
    alone = outer * m * inner <= ALONE
    if channels_last:
        block_col = min(_power(m), MOST_COLUMNS)
        block_row = min(max(TILE // block_col, 1), _power(outer))
        blocks, columns = -(-outer // block_row), -(-m // block_col)
    else:
        block_col = min(_power(inner), TILE)
        block_row = min(max(TILE // block_col, 1), _power(outer))
        blocks, columns = -(-outer // block_row) * -(-inner // block_col), m
    most = max(1, min(PROGRAMS_EACH * _multiprocessors(batch.input.device) // min(columns, 8), PARTIAL_SUMS // m))
    return Tiles(block_row, block_col, channels_last, 1 if alone and columns == 1 else min(blocks, most), columns)


def pass_over(
    batch: Arranged,
    table: Tensor,
    options: Options,
    *,
    weights: Tensor | None = None,
    total_weight: Tensor | None = None,
    upstream: Tensor | None = None,
    values: Tensor | None = None,
    slopes: Tensor | None = None,
    by_kappa: Tensor | None = None,
    by_d: Tensor | None = None,
    sums: bool = False,
) -> Tensor | None:
    """One pass over a batch that writes what it is given; the value where ``sums`` is asked for.

    Args:
        batch: the batch.
        table: of :func:`make_table`.
        options: what the loss computes.
        weights, total_weight: sums of the weights of each channel, (m,), and of all; where there are weights.
        upstream: gradient by the value, one number or one a element, of any strides; None for 1.
        values: takes the value of each element.
        slopes: takes the gradient by the input.
        by_kappa, by_d: take the gradients by the raw parameters, (m,); with ``sums``.
        sums: whether the sums of each channel are wanted.
    """
    x, t, w = batch.input, batch.target, batch.weight
    outer, m, inner = x.shape
    tiles = _tiles(batch)
    each = upstream is not None and upstream.dim() > 0
    finish = sums and tiles.programs == 1 and tiles.columns == 1
    value = torch.empty(1 if finish else tiles.columns, dtype=table.dtype, device=x.device) if sums else None
    partial = None
    if sums and not finish:
        partial = torch.empty((5, tiles.programs, m), dtype=table.dtype, device=x.device)
    given = view_as_arranged(upstream, batch) if each and upstream is not None else upstream
    count = outer * m * inner if options.mean else 1
    learn_kappa, learn_d = options.learn_kappa and by_kappa is not None, options.learn_d and by_d is not None
    dummy = table

    def pointer(one: Tensor | None) -> Tensor:
        return dummy if one is None else one

    elements_kernel[(tiles.programs, tiles.columns)](
        x, t, pointer(w), pointer(given), table, pointer(weights), pointer(total_weight),
        pointer(values), pointer(slopes), pointer(partial), pointer(value), pointer(by_kappa), pointer(by_d),
        outer, m, inner, *x.stride(), *((0, 0, 0) if w is None else w.stride()),
        *(given.stride() if each and given is not None else (0, 0, 0)), tiles.programs, count,
        SO=x.stride(0) if tiles.channels_last else 1,
        BLOCK_ROW=tiles.block_row, BLOCK_COL=tiles.block_col, CHANNELS_LAST=tiles.channels_last,
        HAS_WEIGHT=w is not None, MEAN=options.mean, UPSTREAM=0 if given is None else 2 if each else 1,
        ROBUST=options.robust, LEARN_KAPPA=learn_kappa, LEARN_D=learn_d, NORMALIZE=options.normalize,
        WRITE_VALUES=values is not None, WRITE_SLOPES=slopes is not None, SUMS=sums, FINISH=finish,
        WIDE=table.dtype == torch.float64,
        num_warps=WARPS,
    )  # fmt: skip
    if partial is None or value is None:
        return value
    block_col = min(tiles.block_col, 64) if tiles.channels_last else min(_power(m), 64)
    columns = -(-m // block_col)
    if columns != len(value):
        value = torch.empty(columns, dtype=table.dtype, device=x.device)
    finish_kernel[(columns,)](
        partial, table, pointer(weights), pointer(total_weight), value, pointer(by_kappa), pointer(by_d),
        m, tiles.programs, outer * inner, count,
        BLOCK_ROW=min(_power(tiles.programs), max(1024 // block_col, 1)), BLOCK_COL=block_col,
        HAS_WEIGHT=w is not None, MEAN=options.mean, ROBUST=options.robust, LEARN_KAPPA=learn_kappa, LEARN_D=learn_d,
        NORMALIZE=options.normalize, GIVEN=each, WIDE=table.dtype == torch.float64,
        num_warps=WARPS,
    )  # fmt: skip
    return value if columns == 1 else value.sum(0, keepdim=True)


def rescale(slopes: Tensor | None, by_kappa: Tensor | None, by_d: Tensor | None, upstream: Tensor) -> None:
    """Multiply gradients by the upstream gradient, in place; where that is 1 nothing is read."""
    count = 0 if slopes is None else slopes.numel()
    m = max(0 if one is None else len(one) for one in (by_kappa, by_d))
    programs = max(1, min(-(-count // RESCALED), PROGRAMS_EACH * _multiprocessors(upstream.device)))
    dummy = upstream
    rescale_kernel[(programs,)](
        dummy if slopes is None else slopes, dummy if by_kappa is None else by_kappa, dummy if by_d is None else by_d,
        upstream, count, m, programs,
        BLOCK=RESCALED, HAS_SLOPES=slopes is not None, LEARN_KAPPA=by_kappa is not None, LEARN_D=by_d is not None,
        num_warps=WARPS,
    )  # fmt: skip


def reduce_batch(
    batch: Arranged, table: Tensor, options: Options, *, wants_input: bool
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Value () of a reduced loss, and its gradients by the input and by the raw parameters."""
    weights, total = weight_sums(batch, table.dtype)
    m = batch.channels
    slopes = torch.empty_like(batch.like) if wants_input else None
    by_kappa = table.new_empty(m) if options.learn_kappa else None
    by_d = table.new_empty(m) if options.learn_d else None
    written = None if slopes is None else view_as_arranged(slopes, batch)
    value = pass_over(
        batch, table, options, weights=weights, total_weight=total, slopes=written, by_kappa=by_kappa, by_d=by_d, sums=True
    )
    assert value is not None
    return value.view(()), slopes, by_kappa, by_d


def weight_sums(batch: Arranged, dtype: torch.dtype) -> tuple[Tensor | None, Tensor | None]:
    """Sums of the weights of each channel (m,) and of all (), or None twice."""
    if batch.weight is None:
        return None, None
    weights = batch.weight.sum((0, 2), dtype=dtype)
    return weights, weights.sum()


def kernels_are_interpreted() -> bool:
    """Whether Triton's interpreter runs the kernels, as on a machine without a GPU."""
    return not isinstance(elements_kernel, triton.JITFunction)

