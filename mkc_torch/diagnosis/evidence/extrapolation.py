"""Extrapolation test: fit a finding at low values of its driver, and score it at high values."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, Row
from mkc_torch.diagnosis.evidence.held_out import gain_interval, scored
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.result import Extrapolation
from mkc_torch.diagnosis.settings import EvidenceSettings

__all__ = ["as_result", "extrapolated", "of_finding", "test"]

_BLOCKS, _FEWEST = 25, 5
"""Blocks of the bootstrap, and the minimum number of blocks with high values."""


def of_finding(case: EvidenceContext) -> Extrapolation | None:
    return extrapolated(*case.without_and_with, case.term, case.seed, case.settings.evidence)


def test(case: EvidenceContext) -> EvidenceResult:
    """Score the finding at high values of its driver; warn if it makes the prediction clearly worse."""
    return as_result(case.ahead, case.term, case.settings.evidence)


def as_result(extrapolation: Extrapolation | None, term: Term, settings: EvidenceSettings) -> EvidenceResult:
    if extrapolation is None:
        return EvidenceResult("extrapolation")
    low, high = extrapolation.confidence_interval
    verb = "improves the prediction" if low > 0.0 else "degrades the prediction" if high < 0.0 else "is not significant"
    gain = _in_words(extrapolation)
    row = Row("beyond its range", f"fitted at low values of its driver, it {verb} at high values: {gain}", False)
    sentence = (
        f"{term.effect.id} does not extrapolate: fitted to the {100.0 * settings.low_share:.0f} % of samples where "
        f"{', '.join(term.columns)} is lowest, it predicts the others worse than the model without it. Do not use it "
        "beyond the range recorded."
    )
    return EvidenceResult("extrapolation", extrapolation, warnings=(sentence,) if high < 0.0 else (), rows=(row,))


def _in_words(extrapolation: Extrapolation) -> str:
    """Format the gain with its interval, to two digits of its standard error.

    Example:
        >>> _in_words(Extrapolation(-0.0212, (-0.12, 0.09)))
        '-0.021 nats per sample (95 %: -0.120 to 0.090)'
    """
    low, high = extrapolation.confidence_interval
    places = max(1 - math.floor(math.log10(0.25 * (high - low))), 0) if high > low else 3
    gain, low, high = (round(value, places) + 0.0 for value in (extrapolation.log_likelihood_gain, low, high))
    return f"{gain:+.{places}f} nats per sample (95 %: {low:.{places}f} to {high:.{places}f})"


def extrapolated(
    without: FittedModel, fit: FittedModel, term: Term, seed: int, settings: EvidenceSettings
) -> Extrapolation | None:
    """Fit with and without an effect to low values of its driver, and compare the scores at high values.

    A driver of several columns is high if it is far from its mean. The shapes of effects and the bound are fixed.

    Args:
        without: the model without the effect.
        fit: the model with the effect.
        term: the effect.
        seed: of the block bootstrap.
        settings: definition of low values.

    Returns:
        None without a recorded driver, if its low values hardly vary (a switch), or if the high values are in too few
        blocks.
    """
    reach = _reach(term)
    if reach is None:
        return None
    low = reach <= torch.quantile(reach, settings.low_share)
    high = ~low
    block = (torch.arange(len(reach)) * _BLOCKS).div(len(reach), rounding_mode="floor")[high]
    seen, block = block.unique_consecutive(return_inverse=True)
    spread = float(reach[low].max() - reach[low].min())
    if spread < settings.low_spread * float(reach.max() - reach.min()) or len(seen) < _FEWEST:
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
