"""Drift of a sensor: an offset that varies slowly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_SIZES = 36
"""Number of drift sizes tried, up to a few times the largest that could fit."""


@dataclass(frozen=True)
class DriftStatistics:
    """The statistics of a series for the drift of one family.

    Attributes:
        power: of the series less the simulation's own parameters; ``dof`` are its degrees of freedom.
        inner, gram: inner products of the cosines with the series, (k,), and with one another, (k, k).
        scale: standard deviations of the cosines up to one size, (k,).
        size: the most likely squared size for equal channels.
    """

    power: float
    dof: int
    inner: Float[Tensor, " k"]
    gram: Float[Tensor, "k k"]
    scale: Float[Tensor, " k"]
    size: float


@dataclass(frozen=True)
class DriftFamily:
    """A family of drift; its eigenvectors are computed on first use."""

    scale: Tensor  # (k,) standard deviations of the courses at size 1
    gram: Tensor  # (k, k) inner products of the courses, not yet on this scale

    @cached_property
    def _decomposed(self) -> tuple[Tensor, Tensor]:
        values, vectors = np.linalg.eigh((self.scale.unsqueeze(-1) * self.gram.double() * self.scale).numpy())
        return torch.from_numpy(values).clamp(min=0.0), torch.from_numpy(vectors)

    @property
    def strength(self) -> Float[Tensor, " k"]:
        """Eigenvalues of the inner products on this scale, ascending."""
        return self._decomposed[0]

    @property
    def axes(self) -> Float[Tensor, "k k"]:
        """Their eigenvectors, in columns."""
        return self._decomposed[1]

    @cached_property
    def sizes(self) -> Float[Tensor, " sizes"]:
        """Squared sizes that are tried; the first is 0."""
        tried = torch.logspace(-0.5, 5.0, _SIZES, dtype=torch.float64) / self.strength[-1]
        return torch.cat([tried.new_zeros(1), tried])

    @cached_property
    def shares(self) -> Float[Tensor, "S k"]:
        """The share of each cosine's power that a drift of each positive size explains."""
        sizes = self.sizes[1:].unsqueeze(-1)
        return sizes / (1.0 + sizes * self.strength)


@dataclass(frozen=True)
class NoiseFit:
    """The fitted drift of a series.

    Attributes:
        family: its number.
        size: squared, in units of the white part's variance.
        variance: of the white part.
        log_likelihood, gain: in nats; the gain is over no drift.
    """

    family: int
    size: float
    variance: float
    log_likelihood: float
    gain: float


def without_drift(power: Tensor, rotated: Tensor, family: DriftFamily) -> tuple[Tensor, Tensor]:
    """Return the weighted sum of squares (S, B) and the log-determinant (S, 1) at each positive size of the drift."""
    left = torch.maximum(power - family.shares @ rotated.square(), 1e-12 * power)
    return left, torch.log1p(family.sizes[1:].unsqueeze(-1) * family.strength).sum(-1, keepdim=True)
