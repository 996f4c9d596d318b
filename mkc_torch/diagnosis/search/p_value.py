"""The p-value of the strongest candidate: the same search on surrogates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.drift import NoiseFit
from mkc_torch.diagnosis.linearised.linear_search import SearchGains, log_survival
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.search.whittle_gain import own_spectrum_gains
from mkc_torch.diagnosis.settings import NoiseSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["best_rank_p_value", "surrogate_p_value"]


def surrogate_p_value(
    linearised: LinearisedSearch,
    noise: NoiseFit,
    found: SearchGains,
    possible: Bool[Tensor, " tried"],
    count: int,
    generator: torch.Generator,
    settings: NoiseSettings,
) -> tuple[float, float]:
    """Return the p-value of the strongest candidate after the whole search, and its nats beyond the surrogates.

    Coloured noise is drawn where it enters, at a port whose axes may turn against the residual. A drift is drawn only
    if it gains clearly, because half of all white noise fits a small drift. Each candidate's ratios are first divided
    by the factor by which the surrogates exceed their chi-square (Bartlett's correction), so that a candidate with
    excess noise does not set the level for all. Shapes refined beyond the grid are left out, because the surrogates had
    no such choice; so are sizes of a sign that the physics does not allow.

    If surrogates reach the strongest candidate, recording and surrogates are compared a second time, by
    :func:`own_spectrum_gains`; the p-value is that of the smaller of both ranks.
    """
    stationary = linearised.entering(count, generator)
    if stationary is None:
        stationary = linearised.search.white(count, generator)
    if noise.gain > settings.drawn_drift:
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
    gains = own_spectrum_gains(linearised, series, allowed)
    return best_rank_p_value(-torch.cat([own.unsqueeze(0), others]), gains), beyond


def best_rank_p_value(first: Float[Tensor, " B"], second: Float[Tensor, " B"]) -> float:
    """Return the p-value of the first of B series by the better of its ranks in two statistics, large for effects.

    For exchangeable series at most a share p has a p-value of p or less, whatever the dependence of the statistics.
    """
    rank = torch.minimum(*[(values >= values.unsqueeze(-1)).sum(-1) for values in (first, second)])
    return float((rank <= rank[0]).double().mean())
