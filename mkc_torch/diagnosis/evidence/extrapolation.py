"""Whether a finding holds beyond what it was fitted to: fitted where its driver is low, judged where it is high."""

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

__all__ = ["extrapolated", "of_finding", "said", "test"]

_BLOCKS, _FEWEST = 25, 5
"""Blocks of the recording for the interval of the gain, and how many of them the high values have to be in."""


def of_finding(case: EvidenceContext) -> Extrapolation | None:
    return extrapolated(*case.without_and_with, case.term, case.seed, case.settings.evidence)


def test(case: EvidenceContext) -> EvidenceResult:
    """What the finding is worth where its driver is high, and a warning where it makes it clearly worse."""
    return said(case.ahead, case.term, case.settings.evidence)


def said(extrapolation: Extrapolation | None, term: Term, settings: EvidenceSettings) -> EvidenceResult:
    if extrapolation is None:
        return EvidenceResult("extrapolation")
    low, high = extrapolation.confidence_interval
    verb = "predicts" if low > 0.0 else "misleads" if high < 0.0 else "says nothing"
    gain = _in_words(extrapolation)
    row = Row("beyond its range", f"fitted where its driver is low, it {verb} where that is high: {gain}", False)
    sentence = (
        f"{term.effect.id} does not extrapolate: fitted to the {100.0 * settings.low_share:.0f} % of samples where "
        f"{', '.join(term.columns)} is lowest, it predicts the others worse than the model without it. Do not use it "
        "beyond the range recorded."
    )
    return EvidenceResult("extrapolation", extrapolation, warnings=(sentence,) if high < 0.0 else (), rows=(row,))


def _in_words(extrapolation: Extrapolation) -> str:
    """The gain with its interval, to two digits of its standard error.

    Example:
        >>> _in_words(Extrapolation(-0.0212, (-0.12, 0.09)))
        '-0.021 nats a sample (95 %: -0.120 to 0.090)'
    """
    low, high = extrapolation.confidence_interval
    places = max(1 - math.floor(math.log10(0.25 * (high - low))), 0) if high > low else 3
    gain, low, high = (round(value, places) + 0.0 for value in (extrapolation.log_likelihood_gain, low, high))
    return f"{gain:+.{places}f} nats a sample (95 %: {low:.{places}f} to {high:.{places}f})"


def extrapolated(
    without: FittedModel, fit: FittedModel, term: Term, seed: int, settings: EvidenceSettings
) -> Extrapolation | None:
    """Fit with and without an effect to the low values of its driver, and compare on the high ones.

    A driver of several columns is high where it is far from its mean. The shapes of effects stay as they are, and so
    does the bound.

    Args:
        without: the model without the effect.
        fit: the same with it.
        term: the effect.
        seed: of the bootstrap of blocks.
        settings: which values are low.

    Returns:
        None where the driver was not recorded, or where its low values hardly vary, as those of a switch, or the high
        ones are all in one place in time.
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
