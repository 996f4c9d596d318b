"""The schedule that trains the network under the callback, and its pace."""

from __future__ import annotations

from lightning.pytorch import Trainer
from torch import nn

from mkc_torch.losses.bandwidth_schedule import WARMUP_STEPS, BandwidthSchedule
from mkc_torch.losses.residual_scale import ResidualScale

WARMUP_EPOCHS = 3
"""Epochs in which only the initial loss is used, if they have fewer batches than ``WARMUP_STEPS``. Annealing takes
twice as many. This leaves most of thirty epochs to the likelihood."""


class Guide(nn.Module):
    """Running scale and schedule of a loss, outside of its state; saved with the callback."""

    def __init__(self, residual_scale: ResidualScale, schedule: BandwidthSchedule) -> None:
        super().__init__()
        self.residual_scale, self.schedule = residual_scale, schedule

    @classmethod
    def of_channels(cls, num_channels: int) -> Guide:
        """A guide in its initial state."""
        return cls(ResidualScale(num_channels), BandwidthSchedule(num_channels))


def set_pace(schedule: BandwidthSchedule, trainer: Trainer) -> None:
    """Set the warm-up by the length of an epoch: a resumed training gets the same warm-up."""
    schedule.warmup_steps = max(1, int(min(WARMUP_STEPS, WARMUP_EPOCHS * trainer.num_training_batches)))
    schedule.anneal_step = 0.5 / schedule.warmup_steps
