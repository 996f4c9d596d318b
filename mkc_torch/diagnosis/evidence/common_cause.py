"""A cause that was not recorded: drift of all axes along one direction, and columns that only stand for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.model.fit import FittedModel, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import ANY, Term
from mkc_torch.diagnosis.noise.drift import DriftStatistics
from mkc_torch.diagnosis.noise.spectrum import course_of
from mkc_torch.diagnosis.search.estimate import drift_residuals
from mkc_torch.diagnosis.search.linear_search import log_survival
from mkc_torch.diagnosis.search.linearise import LinearisedSearch, linearise
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.tangents import SlowBasis, tangents_of
from mkc_torch.effects.context import Shape
from mkc_torch.effects.sensor.unrecorded import COURSE, Unrecorded

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_ROUNDS, _SETTLED = 40, 1e-2
"""Maximum number of MM iterations, and the gain in nats below which they stop."""

_LEAST = 1e-6
"""Minimum variance of a direction, relative to the trace of the covariance."""

_ROUNDED = 1e-12
"""Relative eigenvalue below which rounding dominates."""

_LEAST_AMPLITUDE = 1e-2
"""Relative amplitude below which a cosine is omitted from the course."""


@dataclass(frozen=True)
class CommonCause:
    """Common cause of the drifts of channels.

    Attributes:
        gain: log-likelihood gain of correlated over independent drifts, in nats.
        p_value: of that gain, if the drifts were independent.
        direction: (c,), change of the residual channels at a course of 1.
        shape: the course, of range 1.
    """

    gain: float
    p_value: float
    direction: Float[Tensor, " c"]
    shape: Shape

    def towards(self, direction: Float[Tensor, " c"]) -> CommonCause:
        """Return the cause with the sign for which its direction has a positive product with ``direction``."""
        if float(self.direction @ direction) >= 0.0:
            return self
        return replace(self, direction=-self.direction, shape={name: -value for name, value in self.shape.items()})


def common_cause(linearised: LinearisedSearch, slow: SlowBasis | None) -> CommonCause | None:
    """Compare a full covariance of the channels' drifts with a diagonal covariance.

    The axes of a sensor drift independently; a common cause correlates them. Variance components by minorisation and
    maximisation, Zhou, Hu, Zhou & Lange, "MM algorithms for variance components models", J. Comput. Graph. Stat. 28
    (2019). Without a common cause, twice the gain is chi-square distributed with the number of covariances as its
    degrees of freedom (Wilks 1938).

    Args:
        linearised: a fit and its residual.
        slow: the basis of its drift.

    Returns:
        None without drift, or with drift in a single channel.
    """
    if slow is None or slow.channels < 2 or not linearised.has_drift:
        return None
    part = linearised.search.drift_statistics(linearised.series)
    c = slow.channels
    start = torch.diag(part.size * torch.ones(c, dtype=part.inner.dtype))
    apart, alone, _ = _most_likely_covariance(part, start, _diagonal)
    likely, together, courses = _most_likely_covariance(part, apart, _free)
    gain = max(together - alone, 0.0)
    dof = likely.new_tensor(0.5 * c * (c - 1))
    p_value = float(log_survival(likely.new_tensor(2.0 * gain), dof).exp())
    along = torch.linalg.eigh(likely).eigenvectors[:, -1]
    relative = part.scale[:c] / part.scale[0]
    amplitudes = part.scale[::c] * (courses @ along)
    course = course_of(amplitudes, len(slow.tangents))
    span = float(course.max() - course.min())
    text = amplitudes.abs() > _LEAST_AMPLITUDE * amplitudes.abs().max()
    shape = {
        f"{COURSE}{k + 1}": math.sqrt(2.0) * float(amplitudes[k]) / span for k in text.nonzero().flatten().tolist()
    }
    return CommonCause(gain, p_value, span * relative * along, shape)


def _most_likely_covariance(
    part: DriftStatistics, start: Float[Tensor, "c c"], step: Callable[[Tensor, Tensor, Tensor], Tensor]
) -> tuple[Float[Tensor, "c c"], float, Float[Tensor, "K c"]]:
    """Return the covariance relative to the white variance, its log-likelihood, and the predicted courses."""
    covariance, (value, courses, seen, expected) = start, _at(part, start)
    for _ in range(_ROUNDS):
        moved = step(covariance, seen, expected)
        moved = 0.5 * (moved + moved.mT) + _LEAST * moved.trace() * torch.eye(len(moved), dtype=moved.dtype)
        found = _at(part, moved)
        gained = found[0] - value
        if gained > 0.0:
            covariance, (value, courses, seen, expected) = moved, found
        if gained < _SETTLED:
            break
    return covariance, value, courses


def _at(part: DriftStatistics, covariance: Float[Tensor, "c c"]) -> tuple[float, Tensor, Tensor, Tensor]:
    """Return log-likelihood, predicted courses (K, c), and observed and expected part of the gradient."""
    c, inverse = len(covariance), torch.linalg.inv(covariance)
    K = len(part.inner) // c
    precision = part.gram.clone()
    precision.unflatten(0, (K, c)).unflatten(2, (K, c)).diagonal(dim1=0, dim2=2).add_(inverse.unsqueeze(-1))
    root = torch.linalg.cholesky(precision)
    mean = torch.cholesky_solve(part.inner.unsqueeze(-1), root).squeeze(-1)
    left = max(part.power - float(part.inner @ mean), 1e-12 * part.power)
    log_det = 2.0 * float(root.diagonal().log().sum()) + K * float(torch.logdet(covariance))
    value = -0.5 * log_det - 0.5 * part.dof * math.log(left)
    courses = mean.unflatten(0, (K, c))
    score = courses @ inverse
    known = torch.cholesky_inverse(root).unflatten(0, (K, c)).unflatten(2, (K, c)).diagonal(dim1=0, dim2=2).sum(-1)
    expected = K * inverse - inverse @ known @ inverse
    return value, courses, score.mT @ score * (part.dof / left), expected


def _diagonal(covariance: Tensor, seen: Tensor, expected: Tensor) -> Tensor:
    ratio = seen.diagonal() / expected.diagonal().clamp(min=1e-300)
    return torch.diag(covariance.diagonal() * ratio.clamp(min=0.0).sqrt())


def _free(covariance: Tensor, seen: Tensor, expected: Tensor) -> Tensor:
    # the expected part of a nearly constant direction is a difference of large numbers and may round below zero
    values, vectors = torch.linalg.eigh(0.5 * (expected + expected.mT))
    values = values.clamp(min=_ROUNDED * float(values.abs().max()))
    root, inverse = (vectors * values.sqrt()) @ vectors.mT, (vectors * values.rsqrt()) @ vectors.mT
    inner = root @ covariance @ seen @ covariance @ root
    values, vectors = torch.linalg.eigh(0.5 * (inner + inner.mT))
    return inverse @ (vectors * values.clamp(min=0.0).sqrt()) @ vectors.mT @ inverse


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


def proxy_driver_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return whether the column of the last finding may be a proxy of an unrecorded cause."""
    return EvidenceResult("stand_in", bool(case.ahead))


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
