"""The schedule by which a network learns under the callback, at the pace of its training."""

from __future__ import annotations

from lightning.pytorch import Trainer
from torch import nn

from mkc_torch.losses.bandwidth_schedule import WARMUP_STEPS, BandwidthSchedule
from mkc_torch.losses.residual_scale import ResidualScale

__all__ = ["Guide", "set_pace"]

WARMUP_EPOCHS = 3
"""Epochs for which the initial loss is used alone, where they have fewer than the usual batches. Annealing takes twice
as many. Few enough to leave most of thirty epochs to the likelihood."""


class Guide(nn.Module):
    """A running scale and a schedule that are no part of the loss they guide, and are saved with the callback."""

    def __init__(self, residual_scale: ResidualScale, schedule: BandwidthSchedule) -> None:
        super().__init__()
        self.residual_scale, self.schedule = residual_scale, schedule

    @classmethod
    def of_channels(cls, num_channels: int) -> Guide:
        """A guide that has seen nothing."""
        return cls(ResidualScale(num_channels), BandwidthSchedule(num_channels))


def set_pace(schedule: BandwidthSchedule, trainer: Trainer) -> None:
    """Set the warm-up by the epochs of a training, so that a run that is resumed goes on as it was."""
    schedule.warmup_steps = max(1, int(min(WARMUP_STEPS, WARMUP_EPOCHS * trainer.num_training_batches)))
    schedule.anneal_step = 0.5 / schedule.warmup_steps
