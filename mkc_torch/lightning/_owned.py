"""A loss whose sigma and d the callback fits instead of the optimiser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from lightning.pytorch import Trainer
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.lightning._schedule_pace import Guide, set_pace
from mkc_torch.lightning.residual_histogram import ResidualHistogram
from mkc_torch.losses.mkc import MKCLoss
from mkc_torch.losses.residual_scale import FLOOR_IN_SCALE

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

SIGMA_CAP = 1000.0
"""Largest σ that is logged, and that a loss with ``learn_sigma=True`` gets. At an error of two d its energy equals the
Gaussian's to 1e-6."""

_D_MARGIN = 1e-6
"""Relative margin of a learned d to its floor and to the bound, which it must not reach."""


@dataclass
class OwnedLoss:
    """A loss owned by the callback: its name in the module, its hook, and the parameters that were learned before."""

    name: str
    loss: MKCLoss
    handle: RemovableHandle
    learned: list[nn.Parameter]

    @classmethod
    def of(cls, name: str, loss: MKCLoss, hook: Callable[..., None]) -> OwnedLoss:
        learned = [p for p in (loss.raw_kappa, loss.raw_d) if p is not None and p.requires_grad]
        for parameter in learned:
            parameter.requires_grad_(False)
        return cls(name, loss, loss.register_forward_hook(hook, with_kwargs=True), learned)

    def histogram(self) -> ResidualHistogram:
        """An empty histogram, up to the loss's bound if that is fixed."""
        bound = None if self.loss.fixed_bound is None else self.loss.bound
        return ResidualHistogram(bound, num_channels=self.loss.num_channels)

    def restart(self, trainer: Trainer) -> ResidualHistogram:
        """Reset the loss, unless the fit resumes from a checkpoint; return an empty histogram."""
        if trainer.ckpt_path is None:
            self.loss.reset_parameters()
        histogram = self.histogram()
        histogram.to(self.loss.kappa.device)
        return histogram

    def guide(self, guide: Guide | None, trainer: Trainer) -> None:
        """Train the network by a schedule, the guide's or the loss's own, at the pace of this training."""
        own = self.loss.schedule
        if own is not None:
            set_pace(own, trainer)
        if guide is None:
            self.loss.guide(None, None)
        else:
            set_pace(guide.schedule, trainer)
            self.loss.guide(guide.residual_scale, guide.schedule)

    def freeze(self) -> Guide | None:
        """Freeze the loss's running scale before the first E-step; return scale and schedule as a guide."""
        scale, schedule = self.loss.residual_scale, self.loss.schedule
        self.loss.freeze_scale()
        return None if scale is None or schedule is None else Guide(scale, schedule)

    @torch.no_grad()
    def follow_floor(self, error: Float[Tensor, "N m"], weight: Float[Tensor, "N m"]) -> None:
        """Set the floor of d from the scale of the residuals, unless the loss was constructed with one."""
        floor = self.loss.fixed_d_min
        if floor is None or "fixed_d_min" in self.loss._initial:
            return
        scale = torch.where(weight.sum(0) > 0, robust_scale(error, weight), 0.0).to(floor)
        floor.copy_(torch.where(scale > 0, FLOOR_IN_SCALE * scale, floor))

    def release(self) -> None:
        """Release the loss: remove hook and guide, and make its parameters learnable again."""
        self.handle.remove()
        self.loss.guide(None, None)
        for parameter in self.learned:
            parameter.requires_grad_(True)

    def refuse_optimised(self, trainer: Trainer) -> None:
        """Raise ValueError if an optimiser has parameters of the loss."""
        optimised = {id(p) for o in trainer.optimizers for group in o.param_groups for p in group["params"]}
        own = [f"{self.name}.{key}" for key, p in self.loss.named_parameters() if id(p) in optimised]
        if own:
            raise ValueError(
                f"Expected the sigma and d of the loss `{self.name}` in no optimiser but got {', '.join(own)}: "
                "MKCExpectationMaximization fits them. Make that loss with `learn_sigma=False, learn_d=False, "
                "normalize=True`, or leave its parameters out of `configure_optimizers`."
            )

    def assign(self, channels: Bool[Tensor, " m"], kappa: Float[Tensor, " m"], d: Float[Tensor, " m"]) -> None:
        """Set κ and d of the chosen channels; those of the other channels keep every bit."""
        loss = self.loss
        stored = [t for t in (loss.raw_kappa, loss.raw_d, loss.fixed_kappa, loss.fixed_d) if t is not None]
        before = [t.detach().clone() for t in stored]
        if loss.raw_kappa is not None:
            kappa = kappa.clamp(min=SIGMA_CAP**-2)
        if loss.raw_d is not None:
            low, high = loss.d_min.to(d), loss.bound.to(d)
            d = torch.minimum(torch.maximum(d, low * (1.0 + _D_MARGIN)), high * (1.0 - _D_MARGIN))
        loss.sigma = kappa.rsqrt().clamp(min=KAPPA_MAX**-0.5)
        loss.d = d
        for tensor, old in zip(stored, before, strict=True):
            tensor.copy_(torch.where(channels.to(tensor.device), tensor, old))
