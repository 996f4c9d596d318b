"""Evidence of an effect that lies in one short stretch of the recording, as a burst of outliers does."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.drift_residuals import explained
from mkc_torch.diagnosis.noise.bursts import crowded
from mkc_torch.diagnosis.settings import Settings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["telling_stretch"]


def telling_stretch(
    pseudo: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    trace: Float[Tensor, "N m"],
    nuisance: Float[Tensor, "N m p"],
    settings: Settings,
) -> tuple[int, int] | None:
    """First sample and the one after the last of the stretch that most of the evidence is from; None if it is spread.

    Of a recording without bursts of outliers elsewhere it is None too: there, nothing else could have made the stretch.

    Args:
        pseudo: pseudo-residual without the effect, with 0 where it does not count.
        counts: 0 where a residual is rejected.
        trace: the effect in it, at its likeliest size.
        nuisance: tangents of the simulation's own parameters.
        settings: how long a stretch is, what share of the evidence lies in it, and what a burst of outliers is.

    Example:
        >>> import torch
        >>> trace = torch.zeros(1000, 1, dtype=torch.float64)
        >>> trace[400:420] = 1.0
        >>> counts = torch.ones_like(trace)
        >>> counts[700:730] = 0.0
        >>> telling_stretch(trace, counts, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
        (380, 420)
        >>> everything = torch.ones_like(trace)
        >>> telling_stretch(trace, everything, trace, torch.ones(1000, 1, 1, dtype=torch.float64), Settings())
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
