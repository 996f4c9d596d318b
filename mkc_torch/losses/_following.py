"""Scale, domain and bandwidth that a loss takes from the residuals it sees, and that follow the network in training.

The likelihood of σ and d describes the noise. It does not say by which bandwidth a network gets to it: with half of
the targets wrong a wide Gaussian is as likely as a narrow head, and a network that least squares has drawn away stays
there. So the network begins with a loss sharper than the absolute value, and goes over to Welsch's of the bandwidth
that the recent residuals and predictions speak for, as long as they do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.distributed
from torch import Tensor, nn

from mkc_torch.losses._bandwidth import choice

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["BEFORE", "SEARCH_EVERY", "Followed", "Following", "bound_of", "scale_of"]

_QUANTILE, _NORMAL = 0.4, 0.5244005
"""Of the absolute residuals, and what it is of a standard normal variable. Below one half it stays among the right
targets where half of them are wrong."""

_RECENT, _FEWEST, _IN_ALL = 1024, 64, 1 << 16
"""Residuals of a channel that are remembered, at least so many, and of all channels together."""

_RATE, _FADES = 0.1, 0.999
"""Share of what is new in each batch, and what stays of the widest residual."""

_ROWS = 1 << 16
"""Residuals of a batch and channel that its range is taken from, evenly chosen."""

SEARCH_EVERY = 4
"""Batches after which the bandwidth is looked for again: a search costs more than a small batch."""

_OF_SEARCH = 512
"""The latest residuals of a channel, so many at most, that a search looks at."""

BEFORE, _STEP = 100, 0.005
"""Batches that the first loss is used alone for, and by how much less of it each later batch has where another one is
better; and by how much more where none is."""

_TEN_SCALES, _FLOOR, _TINY = 10.0, 1e-3, 1e-30


class Followed(NamedTuple):
    """After a batch: (m, L) residuals, predictions beside them and weights, the batches seen, (m,) of each channel."""

    recent: Float[Tensor, "m L"]
    predicted: Float[Tensor, "m L"]
    counts: Float[Tensor, "m L"]
    seen: Float[Tensor, ""]
    log_scale: Float[Tensor, " m"]
    log_bandwidth: Float[Tensor, " m"]
    turned: Float[Tensor, " m"]
    far: Float[Tensor, " m"]
    floor: Float[Tensor, " m"]


def scale_of(state: Followed) -> Float[Tensor, " m"]:
    """Robust standard deviation about 0 of the recent residuals."""
    return state.log_scale.exp()


def bound_of(state: Followed) -> Float[Tensor, " m"]:
    """Half the range of the residuals, and no less than ten scales."""
    return torch.maximum(state.far, _TEN_SCALES * scale_of(state))


class Following(nn.Module):
    """The state of :class:`Followed` as buffers.

    Args:
        channels: m.
        alone: batches that the first loss is used alone for.
        step: by how much less of it each later batch has.
    """

    recent: Tensor
    predicted: Tensor
    counts: Tensor
    seen: Tensor
    log_scale: Tensor
    log_bandwidth: Tensor
    turned: Tensor
    far: Tensor
    floor: Tensor

    def __init__(self, channels: int, *, alone: int = BEFORE, step: float = _STEP) -> None:
        super().__init__()
        self.alone, self.step = alone, step
        length = min(_RECENT, max(_FEWEST, _IN_ALL // channels))
        nothing = torch.zeros(channels)
        start = Followed(
            recent=torch.zeros(channels, length),
            predicted=torch.zeros(channels, length),
            counts=torch.zeros(channels, length),
            seen=torch.zeros(()),
            log_scale=nothing,
            log_bandwidth=nothing.clone(),
            turned=nothing.clone(),
            far=torch.ones(channels),
            floor=torch.full((channels,), _FLOOR),
        )
        for name, value in start._asdict().items():
            self.register_buffer(name, value)

    @property
    def state(self) -> Followed:
        """What is known; of its own memory where a gradient may need it, for the next batch changes the buffers."""
        # each by its name, which compiled code of older torch can follow
        return Followed(
            recent=self.recent,
            predicted=self.predicted,
            counts=self.counts,
            seen=self.seen,
            log_scale=self.log_scale.clone(),
            log_bandwidth=self.log_bandwidth.clone(),
            turned=self.turned.clone(),
            far=self.far.clone(),
            floor=self.floor.clone(),
        )

    @torch.no_grad()
    def keep(self, state: Followed) -> None:
        for name, value in zip(Followed._fields, state, strict=True):
            getattr(self, name).copy_(value)

    @torch.no_grad()
    def after(
        self,
        input: Tensor,
        target: Tensor,
        weight: Tensor | None,
        axis: int,
        *,
        error: Tensor | None = None,
        search: bool = True,
    ) -> Followed:
        """The state after a batch, with nothing kept of it.

        Args:
            input: predictions, finite where they count.
            target: what the predictions should be.
            weight: of each element; None for 1.
            axis: of the channels.
            error: input less target, 0 where it does not count; needed beside a weight.
            search: look for the bandwidth as well.
        """
        old, first = self.state, self.seen == 0
        predicted = self._rows(input, axis)
        rows = predicted - self._rows(target, axis) if error is None else self._rows(error, axis)
        told = torch.ones_like(rows) if weight is None else self._rows(weight, axis)
        recent, counts = self._remembered("recent", rows), self._remembered("counts", told)
        predicted = self._remembered("predicted", torch.where(told > 0, predicted, 0.0))
        size, total = recent.abs(), counts.sum(-1, keepdim=True).clamp(min=_TINY)
        share = counts / total
        at = _quantile(size, share, _QUANTILE) / _NORMAL
        # of targets that most residuals hit exactly
        at = torch.where(at > 0, at, (size * share).sum(-1))
        known = at > 0
        rate = torch.clamp(1.0 / (old.seen + 1.0), min=_RATE)
        new = torch.where(known, at.clamp(min=_TINY).log(), old.log_scale)
        log_scale = torch.where(first, new, old.log_scale + rate * (new - old.log_scale))
        far = 0.5 * (rows.amax(0) - rows.amin(0))
        middle = (recent * share).sum(-1, keepdim=True)
        spread = ((recent - middle).abs() * share).sum(-1)
        # an offset widens the scale, targets that are wrong by far the spread
        floor = _FLOOR * torch.where(spread > 0, torch.minimum(spread, log_scale.exp()), log_scale.exp())
        state = Followed(
            recent=recent,
            predicted=predicted,
            counts=counts,
            seen=old.seen + 1.0,
            log_scale=log_scale,
            log_bandwidth=old.log_bandwidth,
            turned=old.turned,
            far=torch.where(first, far, torch.maximum(far, _FADES * old.far)),
            floor=torch.where(first, floor, old.floor),
        )
        return _alike(self._turning(state, old, known) if search else state)

    def _rows(self, values: Tensor, axis: int) -> Float[Tensor, "n m"]:
        """Samples by channels, evenly chosen."""
        rows = values.detach().movedim(axis, -1)
        rows = rows.reshape(-1, rows.shape[-1])
        return rows[:: max(1, len(rows) // _ROWS)].to(self.recent.dtype)

    def _remembered(self, name: str, rows: Float[Tensor, "n m"]) -> Float[Tensor, "m L"]:
        """What is remembered under a name, with those of a batch, evenly chosen, at the end."""
        known: Tensor = getattr(self, name)
        length = known.shape[-1]
        chosen = rows[:: max(1, len(rows) // length)][:length].mT
        return torch.cat([known[:, chosen.shape[-1] :], chosen], -1)

    def _turning(self, state: Followed, old: Followed, known: Tensor) -> Followed:
        """The state with the bandwidth looked for; less of the first loss where another is better, more where not."""
        scaled = state.recent / scale_of(state).unsqueeze(-1)
        found = choice(*(values[:, -_OF_SEARCH:] for values in (scaled, state.predicted, state.counts)))
        rate = torch.clamp(SEARCH_EVERY / (old.seen + 1.0), min=1.0 - (1.0 - _RATE) ** SEARCH_EVERY, max=1.0)
        step = torch.where(found.better, SEARCH_EVERY * self.step, -SEARCH_EVERY * self.step)
        late = (old.seen >= self.alone) & known
        return Followed(
            recent=state.recent,
            predicted=state.predicted,
            counts=state.counts,
            seen=state.seen,
            log_scale=state.log_scale,
            log_bandwidth=old.log_bandwidth + rate * (found.bandwidth.log() - old.log_bandwidth),
            turned=torch.where(late, old.turned + step, old.turned).clamp(0.0, 1.0),
            far=state.far,
            floor=state.floor,
        )


def _quantile(values: Float[Tensor, "m L"], counts: Float[Tensor, "m L"], share: float) -> Float[Tensor, " m"]:
    """Weighted, of the samples that count."""
    ordered, order = values.sort(-1)
    below = counts.gather(-1, order).cumsum(-1)
    at = (below < share * below[:, -1:]).sum(-1, keepdim=True).clamp(max=values.shape[-1] - 1)
    return ordered.gather(-1, at).squeeze(-1)


def _alike(state: Followed) -> Followed:
    """The same in all processes of a distributed training: means over them, and the widest residual of all."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return state
    processes = torch.distributed.get_world_size()
    if processes == 1:
        return state
    means = torch.stack([state.log_scale, state.log_bandwidth, state.turned, state.floor])
    torch.distributed.all_reduce(means)
    far = state.far.clone()
    torch.distributed.all_reduce(far, torch.distributed.ReduceOp.MAX)
    log_scale, log_bandwidth, turned, floor = (means / processes).unbind(0)
    return state._replace(log_scale=log_scale, log_bandwidth=log_bandwidth, turned=turned, floor=floor, far=far)
