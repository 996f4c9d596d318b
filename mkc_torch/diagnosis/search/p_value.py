"""How sure it is that there is an effect: the same search on draws of noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.drift import NoiseFit
from mkc_torch.diagnosis.linearised.linear_search import SearchGains, log_survival
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.search.whittle_gain import own_colour_gains
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["either", "judged"]


def judged(
    linearised: LinearisedSearch,
    noise: NoiseFit,
    found: SearchGains,
    possible: Bool[Tensor, " tried"],
    count: int,
    generator: torch.Generator,
    settings: NoiseSettings,
) -> tuple[float, float]:
    """The p-value of the strongest candidate after the whole search, and how far it is beyond draws of fitted noise.

    Coloured noise is drawn where it enters, at a port whose axes may turn against the residual. A wander that chance
    makes likely is not drawn: half of all white noise fits one. Each candidate's ratios are first divided by how much
    the draws exceed their chi-square (Bartlett's correction), so that one whose noise is larger than the model's does
    not set the level for all. A shape that was closed in on, beyond those that were tried, is left out: the draws had
    no such choice. So is an amplitude of a sign that the physics does not allow.

    Where draws come up to the strongest candidate, recording and draws are compared a second time, by
    :func:`own_colour_gains`; the p-value is that of the smaller of both ranks.
    """
    stationary = linearised.entering(count, generator)
    if stationary is None:
        stationary = linearised.search.white(count, generator)
    if noise.gain > settings.wander_drawn:
        stationary = stationary + linearised.search.drift(count, noise, generator)
    drawn = linearised.search.gains(stationary)
    dof = found.dof.clamp(min=1.0)
    excess = (drawn.ratio.mean(-1) / dof).clamp(min=1.0).unsqueeze(-1)
    tried = len(possible)
    own = log_survival(found.ratio / excess, dof.unsqueeze(-1))[:tried, 0]
    own = torch.where(possible, own, 0.0).amin()
    others = log_survival(drawn.ratio / excess, dof.unsqueeze(-1))[:tried].amin(0)
    beyond = float(others.min() - own)
    if beyond > 0 or not bool(possible.any()):
        return (1 + int((others <= own).sum())) / (1 + count), beyond
    series = torch.cat([linearised.series.unsqueeze(-1), stationary], -1)
    allowed = torch.cat([possible, possible.new_zeros(len(found.dof) - tried)])
    gains = own_colour_gains(linearised, series, allowed)
    return either(-torch.cat([own.unsqueeze(0), others]), gains), beyond


def either(one: Float[Tensor, " B"], other: Float[Tensor, " B"]) -> float:
    """The p-value of the first of B series, by the better of its ranks in two statistics that are large for effects.

    Of series that could change places no more than a share p has a p-value of p or less, however the statistics hang
    together.
    """
    rank = torch.minimum(*[(values >= values.unsqueeze(-1)).sum(-1) for values in (one, other)])
    return float((rank <= rank[0]).double().mean())
