"""Whether a column of unknown role is a proxy of an unrecorded cause: the residual drift has the same direction."""

from __future__ import annotations

import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.evidence.common_cause import common_cause
from mkc_torch.diagnosis.linearised.drift_residuals import drift_residuals
from mkc_torch.diagnosis.linearised.tangents import tangents_of
from mkc_torch.diagnosis.model.drivers import ANY
from mkc_torch.effects.sensor.unrecorded import Unrecorded

__all__ = ["goes_on", "test"]


def test(case: EvidenceContext) -> EvidenceResult:
    """Warn if the column of the last finding may be a proxy of an unrecorded cause."""
    if not case.ahead:
        return EvidenceResult("stand_in", False)
    name = ", ".join(case.fit.model.terms[-1].columns)
    sentence = (
        f"With {name} as driver, the offset still drifts along the same direction: {name} may be a proxy of an "
        "unrecorded cause. Find the cause and record it."
    )
    return EvidenceResult("stand_in", True, warnings=(sentence,))


def goes_on(case: EvidenceContext) -> bool:
    """Whether the residual drift has the direction of the last finding."""
    fit, settings = case.fit, case.settings
    last = fit.model.terms[-1] if fit.model.terms else None
    if last is None or last.driver is None or last.driver.role != ANY or last.port != Unrecorded.port:
        return False
    tangents = tangents_of(fit.model, fit.parameters, settings.noise)
    left = drift_residuals(fit, fit.model, fit.parameters, tangents, settings.noise)
    cause = common_cause(left.noise, left.slow)
    gamma = fit.model.gammas(fit.parameters)[-1]
    if cause is None or cause.p_value > settings.evidence.stand_in or len(gamma) != len(cause.direction):
        return False
    cosine = torch.nn.functional.cosine_similarity(gamma, cause.direction, dim=0)
    return float(cosine.abs()) >= settings.evidence.stand_in_along
