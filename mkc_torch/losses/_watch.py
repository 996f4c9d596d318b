"""What a loss is watched for in training, and warned of once each."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["NEAR_FLOOR", "WATCH_EVERY", "Watch"]

WATCH_EVERY = 64
"""Forward passes in training after which is looked; a look waits for an accelerator."""

NEAR_FLOOR = 2.0
"""Times the floor below which a scale counts as collapsed."""

BEYOND = 0.01
"""Share of the errors of a batch beyond the bound that is warned of."""


class Watch:
    """Counts forward passes, and remembers what it has told."""

    def __init__(self) -> None:
        self._forwards = 0
        self._told: set[str] = set()
        self._before: list[Tensor] = []

    def is_due(self) -> bool:
        """Whether this pass, which is counted, is one to look at."""
        self._forwards += 1
        return self._forwards % WATCH_EVERY == 0

    def floor(self, d: Float[Tensor, " m"], d_min: Float[Tensor, " m"]) -> None:
        """Warn of scales next to their floor."""
        channels = self._where("floor", d < NEAR_FLOOR * d_min)
        if channels:
            self._tell(
                "floor",
                f"The scale d of channel {', '.join(map(str, channels))} fell to {d[channels].tolist()}, next to its "
                f"floor {d_min[channels].tolist()}. The network may fit every point, noise included, and the "
                "likelihood grows without limit as d -> 0: watch a validation set, regularise, or raise `d_min` to the "
                "precision of the targets. If the targets are that precise, start with a smaller `d`.",
            )

    def bound(self, error: Tensor, bound: Float[Tensor, " m"], axis: int) -> None:
        """Warn of errors beyond a bound that was given."""
        rows = error.detach().movedim(axis, -1).reshape(-1, len(bound))
        share = (rows.abs() > bound).float().mean(0)
        channels = self._where("bound", share > BEYOND)
        if channels:
            told = ", ".join(f"{100.0 * float(share[k]):.2g} %" for k in channels)
            self._tell(
                "bound",
                f"Of the errors of channel {', '.join(map(str, channels))} {told} lie beyond the bound "
                f"{bound[channels].tolist()}: the likelihood does not allow them, and they pull at next to nothing. "
                "Give the largest error that is possible as `bound`, in the unit of the targets, or leave `d` and "
                "`bound` out: they are taken from the residuals then.",
            )

    def optimiser(self, parameters: Iterable[nn.Parameter | None]) -> None:
        """Warn of parameters that have gradients and do not move from one look to the next."""
        learned = [p for p in parameters if p is not None and p.requires_grad]
        now = [p.detach().clone() for p in learned if p.grad is not None and bool((p.grad != 0).any())]
        if now and len(now) == len(self._before) and all(map(torch.equal, now, self._before)):
            self._tell(
                "optimiser",
                f"sigma and d have had gradients and have not moved in {WATCH_EVERY} steps: no optimiser seems to have "
                "them. Give it `loss.param_groups(lr=1e-2)` beside the network's parameters, or make the loss with "
                "`learn_sigma=False, learn_d=False`.",
            )
        self._before = now

    def _where(self, what: str, found: Tensor) -> list[int]:
        if what in self._told:
            return []
        return [int(k) for k in found.nonzero().flatten()]

    def _tell(self, what: str, sentence: str) -> None:
        if what not in self._told:
            self._told.add(what)
            warnings.warn(sentence, stacklevel=5)
