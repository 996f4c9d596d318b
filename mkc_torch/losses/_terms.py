"""The terms of the loss in differentiable torch operations: the reference for every faster implementation.

In training a robust loss is the sum of two terms. ``network`` trains the network and has no gradient with respect to σ
and d. ``density`` is the negative log-likelihood at detached residuals and trains σ and d. The likelihood is a single
term.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX, energy
from mkc_torch.density.normalizer import log_partition
from mkc_torch.losses._checks import Reduction
from mkc_torch.losses._initial_loss import initial_loss
from mkc_torch.losses._parameters import ChannelState, annealed_kappa, logistic, to_d

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Batch(NamedTuple):
    """A checked batch in the dtype of the computation; ``weight`` and the mask ``counts`` have the input's shape."""

    input: Float[Tensor, "*shape"]
    target: Float[Tensor, "*shape"]
    weight: Float[Tensor, "*shape"] | None
    counts: Bool[Tensor, "*shape"] | None
    axis: int

    def error(self) -> Float[Tensor, "*shape"]:
        """Input - target, 0 where masked."""
        error = self.input - self.target
        return error if self.counts is None else torch.where(self.counts, error, 0.0)


@dataclass(frozen=True)
class LossSettings:
    """Fixed numbers, state and options of a loss.

    Attributes:
        fixed_kappa, fixed_d: 1/σ² and d if they are not learned, (m,); None if they are.
        state: scale, bound and schedule of each channel.
        follows: whether d follows the scale of the residuals.
        normalize: whether the density term has its log-normaliser.
        reduction: of the values: "mean", "sum" or "none".
    """

    fixed_kappa: Tensor | None
    fixed_d: Tensor | None
    state: ChannelState
    follows: bool
    normalize: bool
    reduction: Reduction


class LossTerms(NamedTuple):
    """The two terms of a robust loss in training; ``network`` is 0 if the likelihood is the objective."""

    network: Tensor
    density: Tensor


def loss_terms(batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings) -> LossTerms:
    """Both reduced terms; differentiable to any order, and under forward mode, ``vmap`` and ``torch.compile``."""
    state, dtype = settings.state, batch.input.dtype
    kappa = settings.fixed_kappa if raw_kappa is None else KAPPA_MAX * logistic(raw_kappa)
    d = to_d(raw_d, state, follows=settings.follows) if settings.fixed_d is None else settings.fixed_d
    assert kappa is not None
    kappa, d = kappa.to(dtype), d.to(dtype)
    state = ChannelState(*(None if value is None else value.to(dtype) for value in state))
    shape = [-1 if i == batch.axis else 1 for i in range(batch.input.dim())]

    def along(values: Tensor) -> Tensor:
        return values.view(shape)

    error = batch.error()
    network = None
    if state.is_robust:
        own = annealed_kappa(torch, kappa.detach(), d.detach(), state, follows=settings.follows)
        share = along(state.share)
        annealed = energy(error / along(state.scale if settings.follows else d.detach()), along(own))
        network = share * annealed + (1.0 - share) * initial_loss(torch, error / along(state.scale))
        error = error.detach()
    density = energy(error / along(d), along(kappa))
    if settings.normalize:
        density = density + along(torch.log(d) + log_partition(kappa, state.bound / d))
    network = torch.zeros_like(density) if network is None else network
    return LossTerms(*(_reduced(term, batch.weight, settings.reduction) for term in (network, density)))


def loss_value(batch: Batch, raw_kappa: Tensor | None, raw_d: Tensor | None, settings: LossSettings) -> Tensor:
    """The sum of the terms."""
    network, density = loss_terms(batch, raw_kappa, raw_d, settings)
    return network + density if settings.state.is_robust else density


def _reduced(values: Tensor, weight: Tensor | None, reduction: Reduction) -> Tensor:
    if weight is not None:
        values = weight * values
    if reduction == "none":
        return values
    if reduction == "sum":
        return values.sum()
    if weight is None:
        return values.sum() / values.numel()
    total = weight.sum()
    return values.sum() / torch.where(total > 0, total, 1.0)
