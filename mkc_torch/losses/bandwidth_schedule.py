"""Schedule of the training loss: from a sharp initial loss to Welsch's loss at a selected bandwidth.

The likelihood of σ and d describes the noise. It does not determine the bandwidth at which a network should train: with
half of the targets wrong, a wide Gaussian is as likely as a narrow head, and a network that least squares has biased
stays biased. So the network starts with a loss sharper than the absolute value. It is annealed to Welsch's loss at the
bandwidth that the recent residuals and predictions support, and back if they no longer support it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.initial_values import InitialValues, initial_numbers
from mkc_torch._support.numpy_or_torch import at_least, at_most
from mkc_torch.density.energy import energy
from mkc_torch.losses._bandwidth_selection import select_bandwidth
from mkc_torch.losses._initial_loss import initial_loss
from mkc_torch.losses.residual_scale import RATE, SMALL_STATE, ResidualScale, average_over_processes, numpy_may_read

if TYPE_CHECKING:
    from jaxtyping import Float

WARMUP_STEPS = 100
"""Batches in which only the initial loss is used."""

ANNEAL_STEP = 0.005
"""Change of the annealed loss's share per batch after the warm-up."""

SELECTION_INTERVAL = 4
"""Batches per selection of the bandwidth: a selection costs more than a small batch."""

UNLIMITED = 32.0
"""Bandwidth, in scales, from which it does not limit the likelihood's: half the widest candidate."""


class BandwidthSchedule(InitialValues):
    """Annealing of each channel from the initial loss to Welsch's loss at the selected bandwidth; all state in buffers.

    In the first ``warmup_steps`` batches only the initial loss is used. At every fourth batch the bandwidth is
    selected by the estimated risk of the predictions. The share of the annealed loss grows while its risk is smaller
    than that of the initial loss, and falls while it is larger.

    Args:
        num_channels: m.
        warmup_steps: batches in which only the initial loss is used.
        anneal_step: change of the share per later batch.

    Attributes:
        steps: number of batches, (m,); equal for all channels, stored per channel because a kernel has one program per
            channel.
        log_bandwidth: logarithm of the selected bandwidth in scales, a running mean, (m,).
        share: share of the annealed loss in [0, 1], (m,).

    Example:
        >>> scale, schedule = ResidualScale(1), BandwidthSchedule(1)
        >>> scale.update(torch.linspace(-3.0, 3.0, 500).unsqueeze(-1), torch.zeros(500, 1))
        >>> schedule.update(scale)
        >>> schedule.bandwidth.round(), schedule.share
        (tensor([64.]), tensor([0.]))
        >>> schedule.energy(torch.tensor([[0.0], [1.0], [100.0]])).flatten()
        tensor([0.0000, 0.1006, 1.7089])
    """

    steps: Tensor
    log_bandwidth: Tensor
    share: Tensor

    def __init__(
        self, num_channels: int, *, warmup_steps: int = WARMUP_STEPS, anneal_step: float = ANNEAL_STEP
    ) -> None:
        super().__init__()
        self.warmup_steps, self.anneal_step = warmup_steps, anneal_step
        wide = initial_numbers("share", 0.0).expand(num_channels)
        self._register("steps", torch.zeros(num_channels, dtype=torch.int64, device="cpu"))
        self._register("log_bandwidth", wide)
        self._register("share", wide)

    @property
    def bandwidth(self) -> Float[Tensor, " m"]:
        """The selected bandwidth, in scales."""
        return self.log_bandwidth.exp()

    def energy(self, z: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """The training loss of each residual divided by its scale, (*, m)."""
        share = self.share.to(z.dtype)
        kappa = torch.exp(-2.0 * self.log_bandwidth).to(z.dtype)
        return share * energy(z, kappa) + (1.0 - share) * initial_loss(torch, z)

    @torch.no_grad()
    def update(self, residual_scale: ResidualScale) -> None:
        """Update the schedule by the batch that ``residual_scale`` has just been updated with."""
        state = ScheduleState(self.steps, self.log_bandwidth, self.share)
        recent, log_scale = residual_scale.recent, residual_scale.log_scale
        on_cpu = self.share.device.type == "cpu" and not torch.compiler.is_compiling()
        if on_cpu and self.steps[0].item() % SELECTION_INTERVAL:  # reading a value would wait for another device
            self.steps += 1
            return
        if len(self.share) <= SMALL_STATE and numpy_may_read(self.share, recent):
            arrays = ScheduleState(*(value.numpy() for value in state))
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                new = self._next(np, arrays, recent.numpy(), log_scale.numpy())
            new = ScheduleState(*(torch.as_tensor(value) for value in new))
        else:
            new = self._next(torch, state, recent, log_scale)
        log_bandwidth, share = average_over_processes([new.log_bandwidth, new.share])
        for old, value in zip(state, (new.steps, log_bandwidth, share), strict=True):
            old.copy_(value)

    def _next(self, xp: Any, old: ScheduleState, recent: Any, log_scale: Any) -> ScheduleState:
        """The state after a batch; ``xp`` is ``numpy`` or ``torch``, the library of the other arrays."""
        residual, prediction, weight = recent[0], recent[1], recent[2]
        selected = select_bandwidth(xp, residual / xp.exp(log_scale)[..., None], prediction, weight)
        steps = old.steps.astype(old.share.dtype) if xp is np else old.steps.to(old.share.dtype)
        least_rate = 1.0 - (1.0 - RATE) ** SELECTION_INTERVAL
        rate = at_most(xp, at_least(xp, SELECTION_INTERVAL / (steps + 1.0), least_rate), 1.0)
        up = xp.ones_like(old.share)
        step = SELECTION_INTERVAL * self.anneal_step * xp.where(selected.better, up, -up)
        annealing = (old.steps >= self.warmup_steps) & ((weight * xp.abs(residual)).sum(-1) > 0)
        due = old.steps % SELECTION_INTERVAL == 0
        known = selected.bandwidth > 0  # no bandwidth is selected where residuals overflow
        chosen = xp.log(xp.where(known, selected.bandwidth, 1.0))
        log_bandwidth = xp.where(known, old.log_bandwidth + rate * (chosen - old.log_bandwidth), old.log_bandwidth)
        share = xp.where(annealing, at_most(xp, at_least(xp, old.share + step, 0.0), 1.0), old.share)
        return ScheduleState(
            steps=old.steps + 1,
            log_bandwidth=xp.where(due, log_bandwidth, old.log_bandwidth),
            share=xp.where(due, share, old.share),
        )


class ScheduleState(NamedTuple):
    """The buffers of :class:`BandwidthSchedule`."""

    steps: Any
    log_bandwidth: Any
    share: Any
