"""Finding of an unrecorded cause, from the common drift of several channels."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.common_cause import common_cause
from mkc_torch.diagnosis.linearised.linearise import linearise
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.effects.context import Shape
from mkc_torch.effects.sensor.unrecorded import Unrecorded

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["course_without", "located_cause"]


def located_cause(base: FittedModel, located: SearchResult, level: float, surrogates: int) -> SearchResult | None:
    """Return the search result with a common cause of the channels' drifts; None without a common cause.

    Args:
        base: fit without findings.
        located: result of a search without a significant candidate.
        level: rate of false alarms.
        surrogates: number of surrogates of the other p-values, which limits the smallest p-value.
    """
    slow, share = located.scene.tangents.slow, located.scene.settings.confirmation.unrecorded
    cause = common_cause(located.tested_search, slow)
    if cause is None or slow is None or slow.port != Unrecorded.port or cause.p_value > share * level:
        return None
    model, start = _with_cause(base, cause.direction, cause.shape)
    term = model.terms[-1]
    fit = fitted_with_effect(base, model, start, graduate=False)
    others = [replace(ranked, gap=max(cause.gain - ranked.gain, 0.0)) for ranked in located.ranking]
    return replace(
        located,
        term=term,
        fit=fit,
        p_value=max(cause.p_value / share, 1.0 / (1 + surrogates)),
        beyond=0.0,
        stretch=None,
        ranking=(Ranked(len(located.scene.terms), cause.gain, 0.0), *others),
        look=located.look.with_more([term]),
    )


def course_without(
    base: FittedModel, located: SearchResult, train: Bool[Tensor, " N"]
) -> tuple[JointModel, Float[Tensor, " p"]]:
    """Return the model with the course estimated from training samples only, and a start.

    Args:
        base: fit without findings.
        located: result of :func:`located_cause`.
        train: mask of the training samples.
    """
    counts = located.scene.counts * train.unsqueeze(-1)
    known = linearise(
        base.model,
        base.parameters,
        counts * located.scene.values,
        counts,
        located.scene.tangents.bare,
        spectrum=located.look.linearised.spectrum,
    )
    direction = -located.fit.model.gammas(located.fit.parameters)[-1]
    cause = common_cause(known, located.scene.tangents.slow)
    if cause is None:
        return _with_cause(base, torch.zeros_like(direction), located.term.shape)
    cause = cause.towards(direction)
    return _with_cause(base, cause.direction, cause.shape)


def _with_cause(
    base: FittedModel, direction: Float[Tensor, " c"], shape: Shape
) -> tuple[JointModel, Float[Tensor, " p"]]:
    # the residual is recording minus prediction
    return base.model.with_term(Term(Unrecorded(), None, shape)), torch.cat([base.parameters, -direction])
