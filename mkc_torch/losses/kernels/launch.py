"""Kernel launches: memory layout of a batch, block sizes, and a function for each kernel."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.head import head_rule_constants
from mkc_torch.losses._bandwidth_selection import BANDWIDTHS
from mkc_torch.losses.kernels.cached import CachedKernel
from mkc_torch.losses.kernels.channels import TABLE, channel_kernel
from mkc_torch.losses.kernels.elements import elements_kernel, finish_kernel, rescale_kernel
from mkc_torch.losses.residual_scale import RANGE_ROWS

if TYPE_CHECKING:
    from jaxtyping import Float

TILE = 512
"""Elements of a tile of a large batch; of half precision where registers are few, twice as many."""

MOST_COLUMNS = 64
"""Channels per tile, at most, if they are last in memory."""

LINE_COLUMNS = 128
"""Elements per row of a tile with LINE layout."""

ALONE = 1 << 14
"""Elements up to which a single program processes and finishes a batch."""

PROGRAMS_EACH = 8
"""Programs per multiprocessor in a pass over a large batch."""

PARTIAL_SUMS = 1 << 20
"""Partial sums (programs times channels), at most."""

FINISHED = 4096
"""Partial sums per block of the finishing kernel."""

RESCALED = 4096
"""Gradients per block of the rescaling kernel."""

WARPS = 4
"""Warps per program."""

_CHANNELS, _ELEMENTS = CachedKernel(channel_kernel), CachedKernel(elements_kernel)
_FINISH, _RESCALE = CachedKernel(finish_kernel), CachedKernel(rescale_kernel)


class Options(NamedTuple):
    """Options of a loss that select the compiled form of a kernel."""

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
    """Buffers of a running scale and a schedule; None if the loss lacks them."""

    recent: Tensor | None = None
    position: Tensor | None = None
    batches: Tensor | None = None
    log_scale: Tensor | None = None
    half_range: Tensor | None = None
    steps: Tensor | None = None
    log_bandwidth: Tensor | None = None
    share: Tensor | None = None


class Arranged(NamedTuple):
    """A batch viewed as (outer, m, inner): tensors, sizes, and the common strides of input and target."""

    input: Tensor
    """The input, or a contiguous copy; gradients have its layout."""
    target: Tensor
    weight: Tensor | None
    axis: int
    size: tuple[int, int, int]
    strides: tuple[int, int, int]
    weight_strides: tuple[int, int, int]

    @property
    def channels(self) -> int:
        return self.size[1]

    @property
    def wide(self) -> bool:
        return self.input.dtype == torch.float64 or self.target.dtype == torch.float64


def arranged(input: Tensor, target: Tensor, weight: Tensor | None, axis: int) -> Arranged:
    """A batch in the kernels' memory layout; copied where it is not contiguous."""
    shape = input.shape
    m = shape[axis]
    contiguous = input.is_contiguous()
    if not (contiguous or input.movedim(axis, -1).is_contiguous()):
        input, contiguous = input.contiguous(), True
    if not (contiguous and target.is_contiguous()) and target.stride() != input.stride():
        target = torch.empty_like(input, dtype=target.dtype).copy_(target)
    outer, inner = shape[:axis].numel(), shape[axis + 1 :].numel()
    if not contiguous or m == 1:  # channels are last in memory; a single channel is contiguous
        outer, inner = outer * inner, 1
    strides_of_weight = (0, 0, 0)
    if weight is not None:
        weight = _view(weight.expand(shape), axis, (outer, m, inner))
        strides_of_weight = weight.stride()  # type: ignore[assignment]
    return Arranged(input, target, weight, axis, (outer, m, inner), (m * inner, inner, 1), strides_of_weight)


def _view(values: Tensor, axis: int, size: tuple[int, int, int]) -> Tensor:
    """A tensor of the batch's shape viewed as (outer, m, inner)."""
    return (values.movedim(axis, -1) if size[2] == 1 else values).reshape(size)


@functools.cache
def _constants(device: torch.device) -> tuple[Tensor, Tensor]:
    """The normaliser's quadrature rule and the candidate bandwidths."""
    rule = torch.cat(head_rule_constants()).to(device, torch.float64)
    return rule, torch.tensor(BANDWIDTHS, dtype=torch.float32, device=device)


@functools.cache
def multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2


def power_of_two(count: int) -> int:
    """Return the least power of 2 that is at least ``count``."""
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
    """Run the channel kernel: update the running state, and fill the table of the numbers of each channel.

    Args:
        batch: the batch.
        running: buffers, changed in place by ``scale`` and ``schedule``.
        kappa, d: raw parameters if learned, else the numbers; None for a d that is the scale.
        bound, floor: given values, or None.
        options: options of the loss.
        scale, schedule, table: whether to update the scale, update the schedule, fill the table.
        peek: whether channels without a batch so far take their scale from this batch, for the table alone.
        pace: ``warmup_steps`` and ``anneal_step`` of the schedule.
    """
    outer, m, inner = batch.size
    device = batch.input.device
    dtype = torch.float64 if batch.wide else kappa.dtype
    numbers = torch.empty((len(TABLE), m), dtype=dtype, device=device)
    rows = outer * inner
    rule, widths = _constants(device)
    length = 1 if running.recent is None else running.recent.shape[-1]
    tensors = (batch.input, batch.target, batch.weight, *running, kappa, d, bound, floor, numbers, rule, widths)
    range_rows = min(rows, RANGE_ROWS)
    _CHANNELS.launch(
        (m, 1, 1),
        [numbers if tensor is None else tensor for tensor in tensors],
        (rows, m, inner, *batch.strides, *batch.weight_strides, range_rows, *pace),
        (
            length, max(power_of_two(length), 16), min(max(power_of_two(range_rows), 16), 1024),
            scale, peek, schedule, table, batch.weight is not None,
            options.has_scale, options.robust, options.follows, options.learn_kappa, options.learn_d,
            options.own_bound, options.own_floor, options.normalize,
            len(BANDWIDTHS), 16, 32, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    return numbers


class Tiles(NamedTuple):
    """Tiling of a pass over a batch: block sizes, the layout of columns, programs along the batch and the channels."""

    block_row: int
    block_col: int
    layout: int
    programs: int
    columns: int
    outer: int


PLACES, CHANNELS, LINE = 0, 1, 2
"""Layouts of a tile's columns: places within a channel; channels; channels of successive rows, contiguous."""


def _tiles(batch: Arranged, *, robust: bool) -> Tiles:
    outer, m, inner = batch.size
    elements = outer * m * inner
    tile = TILE if robust or batch.input.element_size() > 2 else 2 * TILE
    if inner == 1 and power_of_two(m) == m and m <= LINE_COLUMNS:
        layout, columns = LINE, 1
        block_col = LINE_COLUMNS if elements >= LINE_COLUMNS else max(power_of_two(elements), m)
        outer = -(-elements // block_col)
        block_row = min(max(tile // block_col, 1), power_of_two(outer))
        blocks = -(-outer // block_row)
    elif inner == 1:
        layout = CHANNELS
        block_col = min(power_of_two(m), MOST_COLUMNS)
        block_row = min(max(tile // block_col, 1), power_of_two(outer))
        blocks, columns = -(-outer // block_row), -(-m // block_col)
    else:
        layout = PLACES
        block_col = min(power_of_two(inner), tile)
        block_row = min(max(tile // block_col, 1), power_of_two(outer))
        blocks, columns = -(-outer // block_row) * -(-inner // block_col), m
    most = max(1, min(PROGRAMS_EACH * multiprocessors(batch.input.device) // min(columns, 8), PARTIAL_SUMS // m))
    programs = 1 if elements <= ALONE and columns == 1 else min(blocks, most)
    return Tiles(block_row, block_col, layout, programs, columns, outer)


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
    """Run the elements kernel over a batch, and fill the given outputs. Returns the value with ``sums``, else None.

    Args:
        batch: the batch.
        table: result of :func:`make_table`.
        options: options of the loss.
        weights, total_weight: sums of the weights of each channel, (m,), and of all; None without weights.
        upstream: gradient with respect to the value, a number or one per element, of any strides; None means 1.
        values: output, the value of each element; in the layout of the input, like ``slopes``.
        slopes: output, the gradient with respect to the input.
        by_kappa, by_d: outputs, the gradients with respect to the raw parameters, (m,); with ``sums``.
        sums: whether to compute the sums of each channel.
    """
    outer, m, inner = batch.size
    device, dtype = table.device, table.dtype
    tiles = _tiles(batch, robust=options.robust)
    each = upstream is not None and upstream.dim() > 0
    finish = sums and tiles.programs == 1 and tiles.columns == 1
    value = torch.empty(1 if finish else -(-m // MOST_COLUMNS), dtype=dtype, device=device) if sums else None
    partial = torch.empty((5, tiles.programs, m), dtype=dtype, device=device) if sums and not finish else None
    strides = (0, 0, 0)
    if each and upstream is not None:
        upstream = _view(upstream, batch.axis, batch.size)
        strides = upstream.stride()  # type: ignore[assignment]
    elements = outer * m * inner
    count = elements if options.mean else 1
    learns = (options.learn_kappa and by_kappa is not None, options.learn_d and by_d is not None)
    tensors = (
        batch.input, batch.target, batch.weight, upstream, table, weights, total_weight,
        values, slopes, partial, value, by_kappa, by_d,
    )  # fmt: skip
    _ELEMENTS.launch(
        (tiles.programs, tiles.columns, 1),
        [table if tensor is None else tensor for tensor in tensors],
        (tiles.outer, inner, *batch.strides, *batch.weight_strides, *strides, tiles.programs, count, elements),
        (
            m, tiles.block_row, tiles.block_col, tiles.layout,
            batch.weight is not None, options.mean, 0 if upstream is None else 2 if each else 1,
            options.robust, *learns, options.normalize,
            values is not None, slopes is not None, sums, finish, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    if partial is None or value is None:
        return value
    block_col = min(power_of_two(m), MOST_COLUMNS)
    sums_of = (partial, table, weights, total_weight, value, by_kappa, by_d)
    _FINISH.launch(
        (len(value), 1, 1),
        [table if entry is None else entry for entry in sums_of],
        (m, tiles.programs, outer * inner, count),
        (
            min(power_of_two(tiles.programs), max(FINISHED // block_col, 1)), block_col, batch.weight is not None,
            options.mean, options.robust, *learns, options.normalize, each, dtype == torch.float64,
        ),
        WARPS,
    )  # fmt: skip
    return value if len(value) == 1 else value.sum(0, keepdim=True)


def rescale(slopes: Tensor | None, by_kappa: Tensor | None, by_d: Tensor | None, upstream: Tensor) -> None:
    """Multiply gradients by the upstream gradient, in place; nothing is read if that is 1."""
    count = 0 if slopes is None else slopes.numel()
    m = max(0 if value is None else len(value) for value in (by_kappa, by_d))
    programs = max(1, min(-(-count // RESCALED), PROGRAMS_EACH * multiprocessors(upstream.device)))
    given = (slopes, by_kappa, by_d, upstream)
    _RESCALE.launch(
        (programs, 1, 1),
        [upstream if value is None else value for value in given],
        (count, m, programs),
        (RESCALED, *(value is not None for value in given[:3])),
        WARPS,
    )


def reduce_batch(
    batch: Arranged, table: Tensor, options: Options, *, wants_input: bool
) -> tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]:
    """Value () of a reduced loss, and its gradients with respect to the input and the raw parameters."""
    weights, total = weight_sums(batch, table.dtype)
    m = batch.channels
    slopes = torch.empty_like(batch.input) if wants_input else None
    by_kappa = table.new_empty(m) if options.learn_kappa else None
    by_d = table.new_empty(m) if options.learn_d else None
    value = pass_over(
        batch,
        table,
        options,
        weights=weights,
        total_weight=total,
        slopes=slopes,
        by_kappa=by_kappa,
        by_d=by_d,
        sums=True,
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
    return _ELEMENTS.is_interpreted
