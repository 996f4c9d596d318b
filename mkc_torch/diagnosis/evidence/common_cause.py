"""Whether the drifts of several channels have a common cause: one course along one direction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.drift import DriftStatistics
from mkc_torch.diagnosis.linearised.linear_search import log_survival
from mkc_torch.diagnosis.linearised.linearise import LinearisedSearch
from mkc_torch.diagnosis.linearised.tangents import SlowBasis
from mkc_torch.diagnosis.noise.cosine_basis import course_of
from mkc_torch.effects.context import Shape
from mkc_torch.effects.sensor.unrecorded import COURSE

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["CommonCause", "common_cause"]

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
