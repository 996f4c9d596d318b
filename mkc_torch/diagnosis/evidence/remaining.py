"""Whether a smooth correction by recorded columns finds what no effect accounts for."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, SmoothCorrection
from mkc_torch.diagnosis.evidence.ceiling import Ceiling, ceiling
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.settings import EvidenceSettings

__all__ = ["nameless", "remaining", "remaining_warning", "said", "test", "within_reach"]

_RUNS_AWAY = 100.0
"""Half-widths of the domain of residuals beyond which a simulation is lost."""


def within_reach(case: EvidenceContext) -> tuple[Ceiling, tuple[str, ...]]:
    """The ceiling of any fit, and the columns along which something smooth remains."""
    base, fit = case.base, case.fit
    reach = ceiling(base.model, _answerable(base, fit), case.drivers, case.blocks)
    if nameless(fit):
        return reach, ()
    return reach, remaining(reach, case.held_out[-1], fit, case.drivers, case.blocks, case.seed, case.settings.evidence)


def test(case: EvidenceContext) -> EvidenceResult:
    """How far a smooth correction comes, and a warning of the columns along which something remains."""
    reach, columns = case.ahead
    return said(SmoothCorrection(case.spread(reach.evidence), columns))


def said(smooth: SmoothCorrection) -> EvidenceResult:
    return EvidenceResult(
        "remaining", smooth, keys={"ceiling": smooth.reached}, warnings=remaining_warning(smooth.columns)
    )


def nameless(fit: FittedModel) -> bool:
    """Whether an effect is a curve over a driver that no physics of the catalogue accounts for."""
    return any(term.effect.is_curve for term in fit.model.terms)


def _answerable(base: FittedModel, final: FittedModel) -> FittedModel:
    """The final fit; that of the simulation alone, if it has none at the other's parameters, or runs away."""
    alone = base.model.residual(final.parameters[: base.model.size])
    return final if bool((alone.abs() < _RUNS_AWAY * final.bound).all()) else base


def remaining(
    alone: Ceiling,
    corrected: Evidence,
    fit: FittedModel,
    drivers: Sequence[Driver],
    blocks: HeldOutBlocks,
    seed: int,
    settings: EvidenceSettings,
) -> tuple[str, ...]:
    """The columns along which something smooth remains in a model that passed for complete.

    A ceiling above the model is no evidence by itself: noise that wanders for longer than a block is tracked by any
    slow course, on unseen blocks too. So, beside the whole model, columns have to be taken up without most of the
    folds, and to add to what courses of time reach alone. What goes so slowly that time does as well is not told of; a
    column that happens to wander as the noise does can still pass.

    Args:
        alone: the ceiling beside the simulation alone.
        corrected: the model on held-out blocks.
        fit: the model.
        drivers: the columns.
        blocks: to predict.
        seed: of the bootstraps.
        settings: how surely, and by how much, the correction has to be better.
    """

    def gain(better: Evidence, worse: Evidence, coverage: float) -> tuple[float, float]:
        difference = better.log_likelihood - worse.log_likelihood
        generator = torch.Generator().manual_seed(seed)
        mean, (low, _) = gain_interval(difference, blocks.block, generator, coverage=coverage)
        return mean, low

    if gain(alone.evidence, corrected, 0.95)[1] <= 0.0:
        return ()
    sure = settings.remaining_coverage
    beside = ceiling(fit.model, fit, drivers, blocks) if fit.model.terms else alone
    mean, low = gain(beside.evidence, corrected, sure)
    if not beside.columns or mean < settings.remaining_gain or low <= 0.0:
        return ()
    time = ceiling(fit.model, fit, (), blocks)
    return beside.columns if gain(beside.evidence, time.evidence, sure)[1] > 0.0 else ()


def remaining_warning(columns: Sequence[str]) -> tuple[str, ...]:
    """The sentence that says so.

    Example:
        >>> remaining_warning(["temperature"])
        ('Something smooth remains along temperature that no effect of the catalogue accounts for: ...',)
        >>> remaining_warning([])
        ()
    """
    if not columns:
        return ()
    return (
        f"Something smooth remains along {', '.join(columns)} that no effect of the catalogue accounts for: a smooth "
        "correction by recorded columns is clearly better on blocks that it has not seen.",
    )
