"""How long the first loss has a part in a training: by its epochs, so that a run that is resumed goes on as it was."""

from __future__ import annotations

from lightning.pytorch import Trainer

from mkc_torch.losses.bandwidth_schedule import WARMUP_STEPS as BEFORE, BandwidthSchedule as Following

__all__ = ["set_pace"]

_EPOCHS = 3
"""That the first loss is used alone for, where they have no more batches than are usual; to go over takes twice as
many. Few enough to leave most of thirty epochs to the likelihood."""


def set_pace(guide: Following, trainer: Trainer) -> None:
    guide.alone = max(1, int(min(BEFORE, _EPOCHS * trainer.num_training_batches)))
    guide.step = 0.5 / guide.alone
