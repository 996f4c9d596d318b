"""Whether a finding holds beyond what it was fitted to: fitted where its driver is low, judged where it is high."""

from __future__ import annotations

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.held_out import gain_interval, scored
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import Extrapolation, Finding

__all__ = ["extrapolated", "extrapolation_warning"]

SHARE = 0.7
"""Of the samples, those with the lowest values of the driver, that the fits are to."""

_BLOCKS, _FEWEST = 25, 5
_SPREAD = 0.25
"""Share of the driver's range that the lowest values must cover for a fit to them to say anything."""


def extrapolated(without: FittedModel, fit: FittedModel, term: Term, seed: int) -> Extrapolation | None:
    """Fit with and without an effect to the low values of its driver, and compare on the high ones.

    A driver of several columns is high where it is far from its mean. The shapes of effects stay as they are, and so
    does the bound.

    Args:
        without: the model without the effect.
        fit: the same with it.
        term: the effect.
        seed: of the bootstrap of blocks.

    Returns:
        None where the driver was not recorded, or where its low values hardly vary, as those of a switch, or the high
        ones are all in one place in time.
    """
    reach = _reach(term)
    if reach is None:
        return None
    low = reach <= torch.quantile(reach, SHARE)
    high = ~low
    block = (torch.arange(len(reach)) * _BLOCKS).div(len(reach), rounding_mode="floor")[high]
    seen, block = block.unique_consecutive(return_inverse=True)
    spread = float(reach[low].max() - reach[low].min())
    if spread < _SPREAD * float(reach.max() - reach.min()) or len(seen) < _FEWEST:
        return None
    before, after = (_score(model, low)[high] for model in (without, fit))
    gain, interval = gain_interval(after - before, block, torch.Generator().manual_seed(seed))
    return Extrapolation(gain, interval)


def _reach(term: Term) -> Tensor | None:
    if term.driver is None:
        return None
    values = term.driver.values
    return values[:, 0] if values.shape[1] == 1 else torch.linalg.vector_norm(values, dim=-1)


def _score(fit: FittedModel, rows: Tensor) -> Tensor:
    found = fitted(fit.model, fit.parameters, fit.bound, rows=rows.to(fit.residual.dtype), graduate=False)
    return scored(found.residual, found.sigma, found.d, found.bound)


def extrapolation_warning(finding: Finding) -> tuple[str, ...]:
    """A sentence where the effect makes it clearly worse."""
    found = finding.extrapolation
    if found is None or found.confidence_interval[1] >= 0.0:
        return ()
    columns = ", ".join(finding.drivers)
    return (
        f"{finding.effect} does not extrapolate: fitted to the {100.0 * SHARE:.0f} % of samples where {columns} is "
        "lowest, it predicts the others worse than the model without it. Do not use it beyond the range recorded.",
    )
