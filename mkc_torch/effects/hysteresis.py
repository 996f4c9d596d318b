"""The internal state of Bouc and Wen's hysteresis along a known path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.effects.runs import first_of_runs, linear_recurrence

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_ROUNDS = 3
"""Fixed-point iterations on the signs along a known path."""

_SHORT = 1e-12
"""Path length over the yield deflection below which its exponential is replaced by its limit."""


def hysteretic_path(position: Float[Tensor, " N"], yields: float, run: Int[Tensor, " N"]) -> Float[Tensor, " N"]:
    """The internal state z along a known path of the position, from 0 at the first sample of each run.

    Between samples z depends on the distance travelled only, and linearly while z keeps its sign. The signs are those
    of the previous iterate; the first iterate relaxes at half the rate in both directions.

    Args:
        position: positions at the samples.
        yields: the deflection z₀ at which z yields, in the position's unit; positive.
        run: number of each sample's run.

    Example:
        Loading to 2 z₀, then unloading by 0.5 z₀: 1 − e⁻² − 0.5, because unloading is elastic:

        >>> path = torch.cat([torch.linspace(0, 2, 2001), torch.linspace(2, 1.5, 501)]).double()
        >>> float(hysteretic_path(path, 1.0, torch.zeros(2502, dtype=torch.long))[-1])
        0.364...
    """
    travel = torch.cat([torch.zeros_like(position[:1]), position.diff()])
    travel = torch.where(first_of_runs(run), 0.0, travel)
    relaxing = torch.full_like(travel, 0.5)
    for _ in range(_ROUNDS):
        # it is elastic while |z| decreases
        slope = relaxing * travel.abs() / yields
        factor = torch.where(first_of_runs(run), 0.0, torch.exp(-slope))
        gain = torch.where(slope > _SHORT, -torch.expm1(-slope) / slope.clamp(min=_SHORT), 1.0)
        z = linear_recurrence(factor, travel * gain)
        relaxing = (travel * z > 0.0).to(travel.dtype)
    return z
