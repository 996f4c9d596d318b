"""Smooth trend test: whether a smooth correction by recorded columns improves the final model."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, SmoothCorrection
from mkc_torch.diagnosis.evidence.ceiling import Ceiling, ceiling
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.settings import EvidenceSettings

__all__ = ["as_result", "nameless", "remaining", "remaining_warning", "test", "within_reach"]

_RUNS_AWAY = 100.0
"""Residual, in half-widths of the density's domain, beyond which a simulation has diverged."""


def within_reach(case: EvidenceContext) -> tuple[Ceiling, tuple[str, ...]]:
    """Return the ceiling, and the columns along which the residual has a smooth trend."""
    base, fit = case.base, case.fit
    reach = ceiling(base.model, _answerable(base, fit), case.drivers, case.blocks)
    if nameless(fit):
        return reach, ()
    return reach, remaining(reach, case.held_out[-1], fit, case.drivers, case.blocks, case.seed, case.settings.evidence)


def test(case: EvidenceContext) -> EvidenceResult:
    """Return the score of a smooth correction, and a warning with the columns of a smooth trend."""
    reach, columns = case.ahead
    return as_result(SmoothCorrection(case.spread(reach.evidence), columns))


def as_result(smooth: SmoothCorrection) -> EvidenceResult:
    return EvidenceResult(
        "remaining", smooth, keys={"ceiling": smooth.reached}, warnings=remaining_warning(smooth.columns)
    )


def nameless(fit: FittedModel) -> bool:
    """Whether a finding is an unnamed curve."""
    return any(term.effect.is_curve for term in fit.model.terms)


def _answerable(base: FittedModel, final: FittedModel) -> FittedModel:
    """Return the final fit; the fit without findings if the simulation diverges at the final parameters."""
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
    """Return the columns along which the residual of the final model has a smooth trend.

    A ceiling above the model is no evidence by itself: any slow course follows a drift longer than a block, on held-out
    blocks too. Therefore most folds must select the columns in a correction of the final model, and the columns must
    improve on courses of time alone. A trend that time describes as well is not reported; a column that drifts like the
    noise by chance can still pass.

    Args:
        alone: the ceiling for the simulation without findings.
        corrected: score of the model on held-out blocks.
        fit: the model.
        drivers: the columns.
        blocks: held-out blocks.
        seed: of the bootstraps.
        settings: confidence and minimum gain of the correction.
    """

    def gain(better: Evidence, worse: Evidence, coverage: float) -> tuple[float, float]:
        difference = better.log_likelihood - worse.log_likelihood
        generator = torch.Generator().manual_seed(seed)
        mean, (low, _) = gain_interval(difference, blocks.block, generator, coverage=coverage)
        return mean, low

    if gain(alone.evidence, corrected, 0.95)[1] <= 0.0:
        return ()
    sure = settings.remaining_coverage
    smooth = ceiling(fit.model, fit, drivers, blocks) if fit.model.terms else alone
    mean, low = gain(smooth.evidence, corrected, sure)
    if not smooth.columns or mean < settings.remaining_gain or low <= 0.0:
        return ()
    time = ceiling(fit.model, fit, (), blocks)
    return smooth.columns if gain(smooth.evidence, time.evidence, sure)[1] > 0.0 else ()


def remaining_warning(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the warning of a smooth trend.

    Example:
        >>> remaining_warning(["temperature"])
        ('The residual has a smooth trend along temperature that no effect of the catalogue explains: ...',)
        >>> remaining_warning([])
        ()
    """
    if not columns:
        return ()
    return (
        f"The residual has a smooth trend along {', '.join(columns)} that no effect of the catalogue explains: a "
        f"smooth "
        "correction by recorded columns is clearly better on held-out blocks.",
    )
