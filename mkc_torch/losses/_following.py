"""Scale, domain and bandwidth that a loss takes from the residuals it sees, and that follow the network in training.

The likelihood of σ and d describes the noise. It does not say by which bandwidth a network gets to it: with half of
the targets wrong a wide Gaussian is as likely as a narrow head, and a network that least squares has drawn away stays
there. So the network learns by Welsch's loss of the bandwidth h at which the variance of an M-estimate from the recent
residuals is within a tenth of the smallest, the largest such h; and begins with a loss sharper than the absolute value.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.distributed
from torch import Tensor, nn

from mkc_torch.losses._energy_sums import energy_sums

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["SEARCH_EVERY", "Followed", "Following", "steered", "steered_each"]

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

_BANDWIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 16.0, 64.0)
_TOLERANCE = 1.1
"""Times the smallest variance up to which a wider bandwidth is taken."""

_SHARP, _BEFORE, _STEP = 0.2, 100, 0.005
"""Where the first loss bends in scales, batches that it is used alone for, and by how much less of it each later batch
has: where the other one's variance is smaller."""

_TEN_SCALES, _FLOOR, _TINY = 10.0, 1e-3, 1e-30


class Followed(NamedTuple):
    """What is known after a batch: (m, L) residuals and their weights, the batches seen, and (m,) of each channel."""

    recent: Float[Tensor, "m L"]
    counts: Float[Tensor, "m L"]
    seen: Float[Tensor, ""]
    log_scale: Float[Tensor, " m"]
    log_bandwidth: Float[Tensor, " m"]
    turned: Float[Tensor, " m"]
    far: Float[Tensor, " m"]
    floor: Float[Tensor, " m"]

    @property
    def scale(self) -> Float[Tensor, " m"]:
        """Robust standard deviation about 0 of the recent residuals."""
        return self.log_scale.exp()

    @property
    def bound(self) -> Float[Tensor, " m"]:
        """Half the range of the residuals, and no less than ten scales."""
        return torch.maximum(self.far, _TEN_SCALES * self.scale)


class Following(nn.Module):
    """The state of :class:`Followed` as buffers.

    Args:
        channels: m.
    """

    recent: Tensor
    counts: Tensor
    seen: Tensor
    log_scale: Tensor
    log_bandwidth: Tensor
    turned: Tensor
    far: Tensor
    floor: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        length = min(_RECENT, max(_FEWEST, _IN_ALL // channels))
        nothing = torch.zeros(channels)
        start = Followed(
            recent=torch.zeros(channels, length),
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
        known = Followed(*(getattr(self, name) for name in Followed._fields))
        return Followed(*known[:3], *(value.clone() for value in known[3:]))

    @torch.no_grad()
    def keep(self, state: Followed) -> None:
        for name, value in state._asdict().items():
            getattr(self, name).copy_(value)

    @torch.no_grad()
    def after(
        self, input: Tensor, target: Tensor | None, weight: Tensor | None, axis: int, *, search: bool = True
    ) -> Followed:
        """The state after a batch, with nothing kept of it.

        Args:
            input: predictions, or where there is no target errors, which are 0 where they do not count; finite.
            target: what the predictions should be.
            weight: of each element; None for 1.
            axis: of the channels.
            search: look for the bandwidth as well.
        """
        old, first = self.state, self.seen == 0
        rows = self._rows(input, axis) if target is None else self._rows(input, axis) - self._rows(target, axis)
        recent, counts = self._remembered(rows, None if weight is None else self._rows(weight, axis))
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
        state = old._replace(
            recent=recent,
            counts=counts,
            seen=old.seen + 1.0,
            log_scale=log_scale,
            far=torch.where(first, far, torch.maximum(far, _FADES * old.far)),
            floor=torch.where(first, floor, old.floor),
        )
        return _alike(_turning(state, old, known) if search else state)

    def _rows(self, values: Tensor, axis: int) -> Float[Tensor, "n m"]:
        """Samples by channels, evenly chosen."""
        rows = values.detach().movedim(axis, -1)
        rows = rows.reshape(-1, rows.shape[-1])
        return rows[:: max(1, len(rows) // _ROWS)].to(self.recent.dtype)

    def _remembered(
        self, rows: Float[Tensor, "n m"], weight: Float[Tensor, "n m"] | None
    ) -> tuple[Float[Tensor, "m L"], Float[Tensor, "m L"]]:
        """The recent residuals with those of a batch, evenly chosen, at the end."""
        length = self.recent.shape[-1]
        step = max(1, len(rows) // length)
        chosen = rows[::step][:length].mT
        told = torch.ones_like(chosen) if weight is None else weight[::step][:length].mT
        count = chosen.shape[-1]
        return torch.cat([self.recent[:, count:], chosen], -1), torch.cat([self.counts[:, count:], told], -1)


def _turning(state: Followed, old: Followed, known: Tensor) -> Followed:
    """The state with the bandwidth looked for, and with less of the first loss where the other one is better."""
    scaled = (state.recent / state.scale.unsqueeze(-1))[:, ::2]
    bandwidth, better = _least_variance(scaled, state.counts[:, ::2])
    rate = torch.clamp(SEARCH_EVERY / (old.seen + 1.0), min=1.0 - (1.0 - _RATE) ** SEARCH_EVERY, max=1.0)
    late = (old.seen >= _BEFORE) & better & known
    return state._replace(
        log_bandwidth=old.log_bandwidth + rate * (bandwidth.log() - old.log_bandwidth),
        turned=torch.where(late, old.turned + SEARCH_EVERY * _STEP, old.turned).clamp(max=1.0),
    )


def steered(
    input: Float[Tensor, "*shape"],
    target: Float[Tensor, "*shape"] | None,
    weight: Tensor | None,
    axis: int,
    state: Followed,
    *,
    turned: bool,
) -> Float[Tensor, " m"]:
    """The sums, of each channel, of the loss by which a network learns; its gradient is that of a likelihood in size.

    Args:
        input: predictions, or errors where there is no target.
        target: what the predictions should be.
        weight: of each element; None for 1.
        axis: of the channels.
        state: after this batch.
        turned: whether the first loss has no part any more.
    """
    dtype = input.dtype
    scale, bandwidth = state.scale.to(dtype), state.log_bandwidth.exp().to(dtype)
    late = energy_sums(input, bandwidth.pow(-2), scale, weight, axis, target=target)
    if turned:
        return late
    error = input if target is None else input - target
    shape = [1] * error.dim()
    shape[axis] = -1
    early = _first_loss(error / scale.view(shape))
    others = [i for i in range(error.dim()) if i != axis]
    early = early if weight is None else weight * early
    share = state.turned.to(dtype)
    return share * late + (1.0 - share) * (early.sum(others) if others else early)


def steered_each(error: Tensor, axis: int, state: Followed) -> Tensor:
    """The same for each element, without weights."""
    shape = [1] * error.dim()
    shape[axis] = -1
    scale, bandwidth, share = (
        one.to(error.dtype).view(shape) for one in (state.scale, state.log_bandwidth.exp(), state.turned)
    )
    z = error / scale
    late = -bandwidth.square() * torch.expm1(-0.5 * (z / bandwidth).square())
    return share * late + (1.0 - share) * _first_loss(z)


def _first_loss(z: Tensor) -> Tensor:
    """``2 c² ((1 + (z / c)²)^(1/4) - 1)``: z² / 2 near 0, and the root of the residual far away."""
    return 2.0 * _SHARP**2 * ((1.0 + (z / _SHARP).square()).sqrt().sqrt() - 1.0)


def _quantile(values: Float[Tensor, "m L"], counts: Float[Tensor, "m L"], share: float) -> Float[Tensor, " m"]:
    """Weighted, of the samples that count."""
    ordered, order = values.sort(-1)
    below = counts.gather(-1, order).cumsum(-1)
    at = (below < share * below[:, -1:]).sum(-1, keepdim=True).clamp(max=values.shape[-1] - 1)
    return ordered.gather(-1, at).squeeze(-1)


def _least_variance(z: Float[Tensor, "m L"], counts: Float[Tensor, "m L"]) -> tuple[Tensor, Tensor]:
    """The widest bandwidth, in scales, of nearly the smallest variance; whether it is smaller than the first loss's.

    The variance of an M-estimate with influence ψ is E ψ² / (E ψ')² (Huber, "Robust Statistics" (1981), 3.2).
    """
    total = counts.sum(-1, keepdim=True).clamp(min=_TINY)
    share = counts / total

    def variance(influence: Tensor, slope: Tensor) -> Tensor:
        means = torch.stack([influence.square(), slope])
        square, mean = torch.einsum("kmgl,ml->kmg", means, share)
        return square / mean.clamp(min=1e-3).square()

    widths = z.new_tensor(_BANDWIDTHS)
    each = z.unsqueeze(-2)
    square = (each / widths.unsqueeze(-1)).square()
    inlier = torch.exp(-0.5 * square)
    by_width = variance(each * inlier, (1.0 - square) * inlier)
    least = by_width.amin(-1, keepdim=True)
    chosen = torch.where(by_width <= _TOLERANCE * least, widths, 0.0).amax(-1)
    square = (each / _SHARP).square()
    bent = (1.0 + square).pow(-0.75)
    first = variance(each * bent, bent * (1.0 - 1.5 * square / (1.0 + square)))
    return chosen, (_TOLERANCE * least < first).squeeze(-1)


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
