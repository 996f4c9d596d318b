"""Localised evidence: an effect whose evidence lies in one short stretch, like a burst of outliers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.drift_residuals import explained
from mkc_torch.diagnosis.noise.bursts import crowded
from mkc_torch.diagnosis.settings import Settings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["localised_stretch"]


def localised_stretch(
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    trace: Float[Tensor, "N m"],
    nuisance: Float[Tensor, "N m p"],
    settings: Settings,
) -> tuple[int, int] | None:
    """Return first and end sample of the stretch that holds most of the evidence; None if the evidence is spread.

    None also for a recording without bursts of outliers elsewhere, because then no burst is a likely cause.

    Args:
        pseudo: pseudo-residual without the effect, 0 where masked.
        counts: 0 for a rejected residual, else 1.
        trace: the effect in it, at its most likely size.
        nuisance: tangents of the simulation's own parameters.
        settings: length of a stretch, share of the evidence in it, and definition of a burst.

    Example:
        >>> import torch
        >>> trace = torch.zeros(1000, 1, dtype=torch.float64)
        >>> trace[400:420] = 1.0
        >>> counts = torch.ones_like(trace)
        >>> counts[700:730] = 0.0
        >>> localised_stretch(trace, counts, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
        (380, 420)
        >>> everything = torch.ones_like(trace)
        >>> localised_stretch(trace, everything, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
    """
    N = len(pseudo)
    left = counts * (pseudo - explained(pseudo, counts, nuisance))
    own = counts * (trace - explained(trace, counts, nuisance))
    gain = (own * (left - 0.5 * own)).sum(-1)
    width = max(N // settings.search.stretches, 1)
    total = torch.cat([torch.zeros_like(gain[:1]), gain.cumsum(0)])
    within = total[width:] - total[:-width]
    first = int(within.argmax())
    if not float(within[first]) > settings.search.in_one_stretch * float(gain.sum()) > 0.0:
        return None
    elsewhere = crowded(1.0 - counts, settings.noise).amax(-1)
    elsewhere[max(first - width, 0) : first + 2 * width] = False
    return (first, first + width) if bool(elsewhere.any()) else None
