"""Warnings that a loss issues once during a training, from what its eager forward passes see."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor, nn

from mkc_torch._support.torch_internals import is_transformed

WATCHED_STEPS = 100
"""Backward passes after which learned parameters that have not changed are reported."""

NAMES = {"raw_kappa": "sigma", "raw_d": "d"}
"""Names of the learned parameters for the user."""

OTHER_FIT = (
    "The residuals have become at least {ratio} times as large as those that the scale and the schedule of this loss "
    "come from. If this is a new fit, call loss.reset_parameters() before it, or make a loss for each fit: a loss that "
    "has adapted to another network can keep this one from learning. If it is the same fit, the network is diverging: "
    "lower the learning rate."
)

NOT_OPTIMISED = (
    "In {steps} training steps {names} of the loss got gradients but did not change: the optimizer does not have them. "
    "Add `*loss.param_groups()` to its parameter groups, or make the loss with `learn_sigma=False, learn_d=False`. "
    "The network learns all the same, but the likelihood, intervals and inlier weights are those of the initial values."
)


class TrainingWatch:
    """Counts the backward passes of a loss, and reports each problem once."""

    def __init__(self) -> None:
        self.backward_passes = 0
        self.start: dict[str, Tensor] = {}
        self.is_done = False
        self.reported_other_fit = False

    def after_forward(self, loss: nn.Module, value: Tensor) -> None:
        """Count a training pass; after ``WATCHED_STEPS`` backward passes, warn of parameters that have not changed."""
        if not value.requires_grad or not loss.training or value.is_meta or is_transformed(value):
            return
        if value.is_cuda and torch.cuda.is_current_stream_capturing():
            return
        learned = {name: p for name in NAMES if (p := getattr(loss, name)) is not None and p.requires_grad}
        if not learned:
            return
        if self.backward_passes < WATCHED_STEPS:
            for name in learned.keys() - self.start.keys():
                self.start[name] = learned[name].detach().clone()
            value.register_hook(self._count)
            return
        self.is_done = True
        names = [NAMES[name] for name, p in learned.items() if self._is_forgotten(name, p)]
        if names:
            text = NOT_OPTIMISED.format(steps=WATCHED_STEPS, names=" and ".join(names))
            warnings.warn(text, UserWarning, stacklevel=5)

    def warn_of_other_fit(self, ratio: float) -> None:
        """Warn, the first time, that the residuals do not belong to the loss's state."""
        if not self.reported_other_fit:
            self.reported_other_fit = True
            warnings.warn(OTHER_FIT.format(ratio=f"{ratio:.2g}"), UserWarning, stacklevel=8)

    def _count(self, _gradient: Any) -> None:
        self.backward_passes += 1

    def _is_forgotten(self, name: str, parameter: Tensor) -> bool:
        start = self.start.get(name)
        if start is None or parameter.device != start.device or not torch.equal(parameter.detach(), start):
            return False
        # an optimiser does not change a parameter whose gradients are exactly 0
        return parameter.grad is None or bool(parameter.grad.any())
