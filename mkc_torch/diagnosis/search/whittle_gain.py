"""Likelihood gain of a candidate if the noise has its own spectrum with the candidate, and without it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.noise.spectrum import whittle

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["own_spectrum_gains"]


def own_spectrum_gains(
    linearised: LinearisedSearch, series: Float[Tensor, "M B"], possible: Bool[Tensor, " C"]
) -> Float[Tensor, " B"]:
    """Return the gain of each series' best candidate in nats, less 1 nat per parameter, (B,).

    The search fixes the spectrum of the residuals with the effect in them, and a slow effect in quiet noise has
    coloured it. Here the spectrum is estimated again both with and without the candidate: a ratio of two likelihoods,
    each maximised over spectra (Whittle's).

    Args:
        linearised: the search; its candidates are tried.
        series: whitened by its spectrum.
        possible: candidates that may be chosen.
    """
    root = linearised.spectrum.root
    K, m = root.shape
    plain = (root / root.square().mean(0).sqrt()).flatten()
    # scale every channel by its noise, without whitening over frequencies
    without, with_candidate, dof = linearised.search.weighted(plain).residuals_of_best(
        plain.unsqueeze(-1) * series[: K * m], possible
    )
    return _evidence(with_candidate, m) - _evidence(without, m) - dof


def _evidence(series: Float[Tensor, "Km B"], m: int) -> Float[Tensor, " B"]:
    power = series.square().unflatten(0, (-1, m))
    return torch.stack([whittle(channel) for channel in power.unbind(1)]).sum(0)
