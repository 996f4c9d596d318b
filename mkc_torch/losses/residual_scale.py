"""Running robust scale and half range of each channel's residuals, updated in training like batch normalisation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.distributed
from torch import Tensor, nn

from mkc_torch._support.initial_values import InitialValues, initial_numbers
from mkc_torch._support.numpy_or_torch import at_least
from mkc_torch._support.torch_internals import is_wrapped

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

QUANTILE = 0.4
"""Level of the quantile of |residual| that gives the scale: below 0.5, because half of the targets may be wrong."""

NORMAL_QUANTILE = 0.5244005
"""The ``QUANTILE`` quantile of the absolute value of a standard normal variable."""

MOST_RECENT = 512
"""Most recent residuals kept per channel, at most."""

FEWEST_RECENT = 64
"""Most recent residuals kept per channel, at least, however many channels there are."""

RECENT_IN_ALL = 1 << 16
"""Limit of the residuals kept in all channels together, if it allows ``FEWEST_RECENT`` per channel."""

RANGE_ROWS = 1 << 12
"""Evenly spaced residuals per batch and channel from which the half range is taken, at most."""

RATE = 0.1
"""Share of a new batch in the running scale; the n-th batch has 1 / n as long as that is larger."""

RANGE_DECAY = 0.999
"""Factor on the half range with each batch whose residuals stay within it."""

SCALES_IN_BOUND = 10.0
"""Smallest bound, in scales."""

FLOOR_IN_SCALE = 1e-3
"""Floor of d, in scales: it follows the scale, because a network may learn targets to any share of their spread."""

OTHER_FIT_RATIO = 6.0
"""Growth of the residuals from which they seem to be those of another fit: noise-free fits at a large learning rate
reach 5.8."""

GROWING_RATIO = 1.1
"""Ratio of the recent residuals' scale to the running scale below which residuals are not examined for growth."""

SETTLED_BATCHES = 100
"""Batches that form a state: before, the residuals of a single fit may grow."""

TINY = 1e-30
"""Lower limit of logarithms' arguments and of denominators."""

SMALL_STATE = 64
"""Channels up to which NumPy computes the state on the CPU: its overhead per call is smaller than torch's."""


class ResidualScale(InitialValues):
    """Running robust scale, half range and most recent residuals of each channel, all in buffers.

    ``update`` is the only method that changes the state; it is called in training. The scale is the 0.4 quantile of
    the recent absolute residuals divided by that of a standard normal variable; its logarithm is averaged over the
    batches.
    Residuals of weight 0 and residuals that are not finite are ignored.

    In distributed training, all processes have the same state: the mean of their scales and the widest half range.

    Args:
        num_channels: m.

    Attributes:
        recent: the most recent residuals, their predictions and their weights, (3, m, L); a ring buffer.
        position: index in the last dimension of ``recent`` that the next residual takes, (m,); equal for all channels,
            stored per channel because a kernel has one program per channel.
        batches: number of batches with at least one finite residual of positive weight, (m,).
        log_scale: logarithm of the scale in the unit of the target, (m,).
        half_range: half the range of the residuals, (m,).

    Example:
        >>> scale = ResidualScale(1)
        >>> scale.update(torch.linspace(-3.0, 3.0, 500).unsqueeze(-1), torch.zeros(500, 1))
        >>> scale.scale, scale.half_range
        (tensor([2.2814]), tensor([3.]))
    """

    recent: Tensor
    position: Tensor
    batches: Tensor
    log_scale: Tensor
    half_range: Tensor

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        length = min(MOST_RECENT, max(FEWEST_RECENT, RECENT_IN_ALL // num_channels))
        wide = initial_numbers("scale", 0.0).expand(num_channels)
        counter = torch.zeros(num_channels, dtype=torch.int64, device="cpu")
        self._register("recent", wide.new_zeros(3, num_channels, length))
        self._register("position", counter)
        self._register("batches", counter)
        self._register("log_scale", wide)
        self._register("half_range", wide + 1.0)

    @property
    def scale(self) -> Float[Tensor, " m"]:
        """Robust standard deviation about 0 of the recent residuals, in the unit of the target."""
        return self.log_scale.exp()

    @property
    def bound(self) -> Float[Tensor, " m"]:
        """Half the range of the residuals, and at least ten scales, in the unit of the target."""
        return torch.maximum(self.half_range, SCALES_IN_BOUND * self.scale)

    @property
    def floor(self) -> Float[Tensor, " m"]:
        """Smallest d, a thousandth of the scale, in the unit of the target."""
        return FLOOR_IN_SCALE * self.scale

    @torch.no_grad()
    def update(
        self,
        prediction: Float[Tensor, "*shape"],
        target: Float[Tensor, "*shape"],
        weight: Float[Tensor, "*shape"] | Bool[Tensor, "*shape"] | None = None,
        channel_dim: int = -1,
    ) -> float | None:
        """Update the state by a batch.

        Args:
            prediction: predictions whose dimension ``channel_dim`` has size m.
            target: targets of the same shape.
            weight: non-negative weights or a mask of the same shape; None for 1.
            channel_dim: the dimension of the channels.

        Returns:
            How many times larger the residuals have become since the state was formed, if that is more than
            ``OTHER_FIT_RATIO``; else None. It is computed only where NumPy computes the state.
        """
        growth = None
        rows, spread = self._sampled(prediction, target, weight, channel_dim)
        if len(self.log_scale) <= SMALL_STATE and numpy_may_read(self.log_scale, *rows):
            recent, state = self.recent.numpy(), ScaleState(*(value.numpy() for value in self._state()))
            with np.errstate(over="ignore", invalid="ignore"):
                batch = rows_of_batch(np, recent.dtype, _arrays(rows), None if spread is None else _arrays(spread))
                _insert_in_numpy(recent, self.position, batch.rows)
                state, old = updated(np, recent, state, batch), state
                growth = residual_growth(recent, self.position, old, state)
            if not is_distributed():
                for own, value in zip(old, state, strict=True):
                    own[...] = value
                return growth
            state = ScaleState(*(torch.from_numpy(value) for value in state))
        else:
            batch = rows_of_batch(torch, self.recent.dtype, rows, spread)
            count, length = batch.rows.shape[-1], self.recent.shape[-1]
            slots = (self.position[:1] + torch.arange(count, device=self.recent.device)) % length
            self.recent.index_copy_(-1, slots, batch.rows)
            self.position.copy_((self.position + count) % length)
            state = updated(torch, self.recent, self._state(), batch)
        for old, new in zip(self._state(), synchronized_state(state), strict=True):
            old.copy_(new)
        return growth

    def _sampled(
        self, prediction: Tensor, target: Tensor, weight: Tensor | None, axis: int
    ) -> tuple[list[Tensor], list[Tensor] | None]:
        """Evenly spaced rows to keep and, for a batch larger than the buffer, more rows for the half range."""
        given = [v.detach() for v in (prediction, target, weight) if v is not None]
        length = self.recent.shape[-1]
        rows = [spaced_rows(values, axis, length) for values in given]
        if given[0].numel() <= length * given[0].shape[axis]:
            return rows, None
        return rows, [spaced_rows(values, axis, RANGE_ROWS) for values in given]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        state_dict.pop(prefix + "floor", None)  # earlier states hold it; the scale determines it
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _state(self) -> ScaleState:
        return ScaleState(self.batches, self.log_scale, self.half_range)

    @torch.no_grad()
    def with_batch(self, prediction: Tensor, target: Tensor, weight: Tensor | None, channel_dim: int) -> ScaleState:
        """The state; for a channel without a batch so far, its state after this batch. Changes no buffer."""
        batch = rows_of_batch(torch, self.recent.dtype, *self._sampled(prediction, target, weight, channel_dim))
        state, known = self._state(), self.batches > 0
        new = updated(torch, batch.rows, state, batch)
        return ScaleState(*(torch.where(known, old, value) for old, value in zip(state, new, strict=True)))


class ScaleState(NamedTuple):
    """The buffers of :class:`ResidualScale` with one number per channel, (m,) each."""

    batches: Any
    log_scale: Any
    half_range: Any


class BatchRows(NamedTuple):
    """Residuals, predictions and weights of rows of a batch, (3, m, k), and the half range of the batch, (m,)."""

    rows: Any
    half_range: Any


def rows_of_batch(xp: Any, dtype: Any, rows: Sequence[Any], more: Sequence[Any] | None) -> BatchRows:
    """Residuals of rows, with weight 0 where a residual is not finite, and the half range of ``more`` rows.

    Args:
        xp: ``numpy`` or ``torch``, the library of the other arrays.
        dtype: dtype of the result.
        rows: predictions, targets and, if any, weights, (k, m) each.
        more: the same of more rows, for the half range; None takes ``rows``.
    """
    stacked = xp.stack([value.T for value in _residuals(xp, dtype, *rows)])
    wide, _, counts = stacked if more is None else (value.T for value in _residuals(xp, dtype, *more))
    least = most = wide
    if xp is not np or not counts.all():  # only NumPy may branch on a value
        least, most = (xp.where(counts > 0, wide, bound) for bound in (np.inf, -np.inf))
    half_range = at_least(xp, 0.5 * xp.amax(most, -1) - 0.5 * xp.amin(least, -1), 0.0)  # 0 where all weights are 0
    return BatchRows(stacked, half_range)


def _residuals(xp: Any, dtype: Any, prediction: Any, target: Any, weight: Any = None) -> tuple[Any, Any, Any]:
    prediction, target = _cast(xp, prediction, dtype), _cast(xp, target, dtype)
    residual = prediction - target
    counts = xp.isfinite(residual)
    if xp is np and weight is None and counts.all():
        return residual, prediction, np.ones_like(residual)
    if weight is None:
        weight = _cast(xp, counts, dtype)
    else:
        weight = xp.where(counts, _cast(xp, weight, dtype), 0.0)
        counts = weight > 0
    return xp.where(counts, residual, 0.0), xp.where(counts, prediction, 0.0), weight


def _arrays(values: Sequence[Tensor]) -> list[Any]:
    return [value.numpy() for value in values]


def _cast(xp: Any, values: Any, dtype: Any) -> Any:
    return values.astype(dtype, copy=False) if xp is np else values.to(dtype)


def _insert_in_numpy(recent: Any, position: Tensor, rows: Any) -> None:
    """Overwrite the oldest residuals with the new residuals."""
    count, length, start = rows.shape[-1], recent.shape[-1], position[0].item()
    head = min(count, length - start)
    recent[..., start : start + head] = rows[..., :head]
    recent[..., : count - head] = rows[..., head:]
    position.fill_((start + count) % length)


def updated(xp: Any, recent: Any, old: ScaleState, batch: BatchRows) -> ScaleState:
    """The state after a batch that ``recent`` already contains; a channel without residuals of weight keeps its state.

    Args:
        xp: ``numpy`` or ``torch``, the library of the other arrays.
        recent: the buffer of :class:`ResidualScale`.
        old: the state before the batch.
        batch: rows and half range of this batch.
    """
    residual, weight = recent[0], recent[2]
    size = xp.abs(residual)
    candidate = weighted_quantile(xp, size, weight, QUANTILE) / NORMAL_QUANTILE
    if xp is not np or not (candidate > 0).all():
        # if most residuals are exactly 0, the mean absolute residual replaces the quantile
        share = weight / at_least(xp, weight.sum(-1), TINY)[..., None]
        candidate = xp.where(candidate > 0, candidate, (size * share).sum(-1))
    known = (candidate > 0) & (candidate < xp.inf) & (batch.rows[2].sum(-1) > 0)
    first = (old.batches == 0) & known
    new = xp.where(known, xp.log(at_least(xp, candidate, TINY)), old.log_scale)
    rate = at_least(xp, 1.0 / (_cast(xp, old.batches, recent.dtype) + 1.0), RATE)
    log_scale = xp.where(first, new, old.log_scale + rate * (new - old.log_scale))
    wider = xp.maximum(batch.half_range, RANGE_DECAY * old.half_range)
    return ScaleState(
        batches=old.batches + known,
        log_scale=log_scale,
        half_range=xp.where(first, batch.half_range, xp.where(known, wider, old.half_range)),
    )


def residual_growth(recent: Any, position: Tensor, old: ScaleState, new: ScaleState) -> float | None:
    """How many times larger the residuals have become; None up to ``OTHER_FIT_RATIO``, or if the state is young.

    A large batch replaces all recent residuals, and its scale is compared with the running scale. The running scale
    follows small batches; then the newest quarter of the recent residuals is compared with their oldest half.

    Args:
        recent: the buffer of :class:`ResidualScale` with this batch, an array of NumPy.
        position: index that the next residual takes, equal for all channels.
        old, new: the state before and after this batch.
    """
    change = new.log_scale - old.log_scale
    if not change.max() > RATE * math.log(GROWING_RATIO):
        return None
    growing = (old.batches >= SETTLED_BATCHES) & (change > RATE * math.log(GROWING_RATIO))
    if not growing.any():
        return None
    length = recent.shape[-1]
    ordered = recent[:, :, (int(position[0]) + np.arange(length)) % length]
    parts = (ordered[..., -(length // 4) :], ordered[..., : length // 2])
    newest, oldest = (weighted_quantile(np, np.abs(part[0]), part[2], QUANTILE) for part in parts)
    ratio = np.maximum(np.exp(change / RATE), newest / at_least(np, oldest, TINY))
    largest = float(np.where(growing & (oldest > 0), ratio, 0.0).max())
    return largest if largest > OTHER_FIT_RATIO else None


def weighted_quantile(xp: Any, values: Any, weight: Any, level: float) -> Any:
    """Weighted quantile of each channel: the smallest value up to which a share ``level`` of the weight lies, (m,)."""
    if xp is np:
        if weight.min() == 1.0 == weight.max():
            rank = min(max(math.ceil(level * values.shape[-1]) - 1, 0), values.shape[-1] - 1)
            return np.partition(values, rank, -1)[..., rank]
        equal = weight == (weight > 0)
        if equal.all():  # sorting values alone is several times as fast as sorting weights with them
            ordered = np.sort(np.where(weight > 0, values, np.inf), -1)
            rank = np.ceil(level * weight.sum(-1)).astype(np.int64) - 1
            found = np.take_along_axis(ordered, rank.clip(0)[:, None], -1)[:, 0]
            return np.where(np.isfinite(found), found, 0.0).astype(values.dtype)
        order = np.argsort(values, -1, kind="stable")
        ordered, cumulated = np.take_along_axis(values, order, -1), np.take_along_axis(weight, order, -1).cumsum(-1)
        at = (cumulated < level * cumulated[:, -1:]).sum(-1, keepdims=True).clip(max=values.shape[-1] - 1)
        return np.take_along_axis(ordered, at, -1)[:, 0]
    ordered, order = values.sort(dim=-1, stable=True)
    cumulated = weight.gather(-1, order).cumsum(-1)
    at = (cumulated < level * cumulated[..., -1:]).sum(-1, keepdim=True).clamp(max=values.shape[-1] - 1)
    return ordered.gather(-1, at).squeeze(-1)


def spaced_rows(values: Tensor, axis: int, most: int) -> Float[Tensor, "n m"]:
    """At most ``most`` evenly spaced samples, channels last."""
    moved = values.movedim(axis, -1)
    shape = moved.shape[:-1]
    count = shape.numel()
    if count <= most:
        return moved.reshape(count, moved.shape[-1])
    index = torch.arange(most, device=values.device) * count // most
    if moved.dim() == 2 or moved.is_contiguous():
        return moved.reshape(count, moved.shape[-1])[index]
    # channels are not last in memory: a reshape would copy the whole batch
    places = []
    for size in reversed(shape):
        places.append(index % size)
        index = index // size
    return moved[tuple(reversed(places))]


def numpy_may_read(*values: Tensor) -> bool:
    """Whether NumPy may read and write the tensors' memory: on the CPU, in eager code, outside function transforms."""
    return not torch.compiler.is_compiling() and all(
        type(value) in (Tensor, nn.Parameter) and value.device.type == "cpu" and not is_wrapped(value)
        for value in values
    )


def average_over_processes(values: Sequence[Float[Tensor, " m"]]) -> Sequence[Float[Tensor, " m"]]:
    """Means over the processes of a distributed training."""
    if not is_distributed():
        return values
    means = torch.stack(list(values))
    torch.distributed.all_reduce(means)
    return (means / torch.distributed.get_world_size()).unbind(0)


def is_distributed() -> bool:
    """Whether several processes train together."""
    distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
    return distributed and torch.distributed.get_world_size() > 1


def synchronized_state(state: ScaleState) -> ScaleState:
    """The common state of all processes in distributed training: the mean scales, the widest half range.

    Processes in which a channel has had no batch are left out of that channel's mean.
    """
    if not is_distributed():
        return state
    known = (state.batches > 0).to(state.log_scale)
    share, mean = average_over_processes([known, known * state.log_scale])
    log_scale = torch.where(share > 0, mean / share.clamp(min=TINY), state.log_scale)
    widest = torch.stack([known * state.half_range, state.batches.to(state.half_range)])
    torch.distributed.all_reduce(widest, torch.distributed.ReduceOp.MAX)
    half_range = torch.where(share > 0, widest[0], state.half_range)
    return ScaleState(widest[1].to(state.batches), log_scale, half_range)
