"""Progress of the callback: histogram, history of the E-steps, and issued warnings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from mkc_torch.lightning._owned import OwnedLoss
from mkc_torch.lightning._schedule_pace import Guide
from mkc_torch.lightning.residual_histogram import ResidualHistogram
from mkc_torch.losses.mkc import MKCLoss

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

MIN_RESIDUALS = 30
"""Minimum number of residuals of a channel for an E-step; with fewer, the channel keeps its σ and d."""

_WARNINGS = {
    "silent": (
        "No residual of the loss `{name}` was collected since the last E-step, so its sigma and d are unchanged. Call "
        "the module in `training_step`, `self.criterion(input, target)`, not its `forward`; if the loss is compiled, "
        "compile the network instead; or pass MKCExpectationMaximization(residuals=...)."
    ),
    "few": (
        "Fewer than {least} residuals of positive weight were collected since the last E-step in channel {channels} of "
        "the loss `{name}`, which keeps its sigma and d. Raise `every_n_steps`, or pass positive weights for that "
        "channel."
    ),
    "narrow": (
        "The bound of the loss `{name}` is less than twice the typical residual in channel {channels}: least squares "
        "is used there until the residuals are smaller. Make MKCLoss with a `bound` as large as the largest possible "
        "error."
    ),
    "beyond": (
        "More than 1 % of the residuals of the loss `{name}` lie beyond its bound in channel {channels}; they get the "
        "density of the flat tail. Make MKCLoss with a `bound` as large as the largest possible error."
    ),
    "collapsed": (
        "The d of the loss `{name}` collapses in channel {channels}: it reached its floor `d_min`, or a hundredth of "
        "its first value while the likelihood grows. Either the noise is that small, or the network interpolates its "
        "targets. Check the errors on a validation set. If they are as small, lower a given `d_min`; if they are "
        "larger, stop early, use weight decay or a smaller network."
    ),
}


@dataclass
class Progress:
    """State of the callback that a checkpoint saves: residuals not yet used, and the results of each channel.

    ``start_d``, ``log_likelihood`` and ``share_beyond`` are NaN before the first E-step.
    """

    histogram: ResidualHistogram
    start_d: Float[Tensor, " m"] = field(init=False)
    log_likelihood: Float[Tensor, " m"] = field(init=False)
    share_beyond: Float[Tensor, " m"] = field(init=False)
    last_epoch: int = -1
    warned: set[tuple[str, int]] = field(default_factory=set)
    guide: Guide | None = None

    def __post_init__(self) -> None:
        unknown = torch.full(self.histogram.bound.shape, torch.nan, dtype=torch.float64)
        self.start_d, self.log_likelihood, self.share_beyond = unknown.clone(), unknown.clone(), unknown.clone()

    def record(
        self, loss: MKCLoss, usable: Bool[Tensor, " m"], log_likelihood: Float[Tensor, " m"]
    ) -> Bool[Tensor, " m"]:
        """Record the result of an E-step; return the mask of channels whose log-likelihood increased."""
        seen = (self.histogram.weight() > 0).cpu()
        first = usable.cpu() & torch.isnan(self.start_d)
        found = log_likelihood.cpu()
        improved = seen & (found > self.log_likelihood)
        self.start_d = torch.where(first, loss.d.detach().cpu().double(), self.start_d)
        self.log_likelihood = torch.where(seen, found, self.log_likelihood)
        self.share_beyond = torch.where(seen, self.histogram.share_beyond().cpu(), self.share_beyond)
        return improved

    def warn(
        self, owned: OwnedLoss, *, usable: Bool[Tensor, " m"], narrow: Bool[Tensor, " m"], improved: Bool[Tensor, " m"]
    ) -> None:
        """Issue each warning once per channel."""
        d, d_min = (t.detach().cpu().double() for t in (owned.loss.d, owned.loss.d_min))
        collapsed = (d <= d_min * (1.0 + 1e-3)) | ((d < 0.01 * self.start_d) & improved)
        self.warn_once("few", owned.name, ~usable)
        self.warn_once("narrow", owned.name, narrow)
        if owned.loss._bound_was_given:
            self.warn_once("beyond", owned.name, usable & ~narrow & (self.share_beyond > 0.01))
        self.warn_once("collapsed", owned.name, usable & collapsed)

    def warn_once(self, kind: str, name: str, channels: Bool[Tensor, " m"]) -> None:
        """Issue a warning for the channels without an earlier warning of this kind."""
        new = [i for i in channels.nonzero().flatten().tolist() if (kind, i) not in self.warned]
        if new:
            self.warned.update((kind, i) for i in new)
            rank_zero_warn(_WARNINGS[kind].format(name=name, channels=", ".join(map(str, new)), least=MIN_RESIDUALS))

    def state_dict(self) -> dict[str, Any]:
        return {
            "histogram": self.histogram.state_dict(),
            "start_d": self.start_d,
            "log_likelihood": self.log_likelihood,
            "share_beyond": self.share_beyond,
            "last_epoch": self.last_epoch,
            "guide": None if self.guide is None else self.guide.state_dict(),
            "warned": [[kind, channel] for kind, channel in sorted(self.warned)],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state["start_d"].shape != self.start_d.shape:
            raise ValueError(
                f"Expected a checkpoint of {self.start_d.shape[0]} channels but got {state['start_d'].shape[0]}; "
                "load it into a module whose loss has that many."
            )
        self.histogram.load_state_dict(state["histogram"])
        self.start_d, self.log_likelihood = state["start_d"], state["log_likelihood"]
        self.share_beyond = state["share_beyond"]
        self.last_epoch = state["last_epoch"]
        if state.get("guide") is not None:
            self.guide = Guide.of_channels(len(self.start_d))
            self.guide.load_state_dict(state["guide"])
        self.warned = {(kind, channel) for kind, channel in state["warned"]}
