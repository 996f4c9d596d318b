"""How much likelier a candidate makes the noise when the noise has its own colour with it, and without it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.noise.spectrum import whittle

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["own_colour_gains"]


def own_colour_gains(
    linearised: LinearisedSearch, series: Float[Tensor, "M B"], possible: Bool[Tensor, " C"]
) -> Float[Tensor, " B"]:
    """Gain in nats, less one for each parameter, of the candidate that each series has most of.

    The search itself holds the colour that the residuals have with the effect in them, and a slow effect in quiet
    noise has coloured it. Here the spectrum of what is left beside the candidate is estimated anew, and that of the
    whole too: the ratio of two likelihoods, each the largest over colours (Whittle's).

    Args:
        linearised: the search; its candidates are tried.
        series: whitened by its colour, as its own is.
        possible: candidates that may be chosen.
    """
    root = linearised.spectrum.root
    K, m = root.shape
    plain = (root / root.square().mean(0).sqrt()).flatten()
    # every channel on the scale of its noise, and no frequency above another
    left, beside, dof = linearised.search.coloured(plain).beside_likeliest(
        plain.unsqueeze(-1) * series[: K * m], possible
    )
    return _evidence(beside, m) - _evidence(left, m) - dof


def _evidence(series: Float[Tensor, "Km B"], m: int) -> Float[Tensor, " B"]:
    power = series.square().unflatten(0, (-1, m))
    return torch.stack([whittle(one) for one in power.unbind(1)]).sum(0)
