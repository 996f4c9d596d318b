"""Fits by the logarithms of positive parameters, such as stiffnesses, that a recording may leave open by a factor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.nonlinear import GaussianPrior, NonlinearFit
from mkc_torch.simulation.continuation import Continuation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_REACH = 1e4
"""Largest ratio of a positive parameter to the mean of its prior, or of the mean to the parameter."""


@dataclass(frozen=True)
class Logarithms:
    """Coordinates of a fit: the logarithms of some parameters, the others as they are.

    Attributes:
        places: (p,), True where the logarithm is fitted.
        prior: of the parameters, with a positive mean at these places; its relative spread is that of the logarithm.
        bounds: lower and upper limits of the parameters.

    Example:
        >>> prior = GaussianPrior(torch.tensor([8.0, 0.0]), torch.tensor([1.0, 0.0]))
        >>> free = torch.tensor([torch.inf, torch.inf])
        >>> logarithms = Logarithms(torch.tensor([True, False]), prior, (-free, free))
        >>> logarithms.of(torch.tensor([1.0, 3.0])).tolist(), logarithms.of_prior.precision.tolist()
        ([0.0, 3.0], [64.0, 0.0])
    """

    places: Bool[Tensor, " p"]
    prior: GaussianPrior
    bounds: tuple[Float[Tensor, " p"], Float[Tensor, " p"]]

    def of(self, theta: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """The coordinates of parameters."""
        mean = torch.where(self.places, self.prior.mean, 1.0)
        within = torch.where(self.places, theta, 1.0).clamp(mean / _REACH, mean * _REACH)
        return torch.where(self.places, within.log(), theta)

    def parameters(self, values: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """The parameters of coordinates."""
        return torch.where(self.places, torch.where(self.places, values, 0.0).exp(), values)

    @property
    def of_prior(self) -> GaussianPrior:
        """The prior of the coordinates."""
        mean, precision = self.prior.mean, self.prior.precision
        scale = torch.where(self.places, mean, 1.0)
        own = precision * scale.square() if precision.ndim == 1 else precision * scale * scale.unsqueeze(-1)
        return GaussianPrior(self.of(mean), own)

    def log_prior(self, theta: Float[Tensor, " p"]) -> float:
        """The logarithm of the prior's density, up to its constant."""
        return log_density(self.of_prior, self.of(theta))

    def fit(
        self,
        residual: Continuation,
        start: Float[Tensor, " p"],
        *,
        by: Callable[..., NonlinearFit],
    ) -> NonlinearFit:
        """Fit the coordinates; the result has the parameters.

        Args:
            residual: as a function of the parameters.
            start: the parameters to start from.
            by: fits a residual from a start, with the arguments ``prior``, ``lower`` and ``upper``.
        """
        lower, upper = (self.of(limits) for limits in self.bounds)
        found = by(_InLogarithms(self, residual), self.of(start), prior=self.of_prior, lower=lower, upper=upper)
        return replace(found, theta=self.parameters(found.theta))


def log_density(prior: GaussianPrior | None, theta: Float[Tensor, " p"]) -> float:
    """The logarithm of a Gaussian prior's density, up to its constant; 0 without a prior."""
    if prior is None:
        return 0.0
    away = theta - prior.mean
    precise = prior.precision * away if prior.precision.ndim == 1 else prior.precision @ away
    return -0.5 * float(away @ precise)


class _InLogarithms:
    """A residual as a function of the coordinates."""

    def __init__(self, logarithms: Logarithms, residual: Continuation) -> None:
        self._logarithms, self._residual = logarithms, residual

    def __call__(self, values: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        return self._residual(self._logarithms.parameters(values))

    def tangents(self, values: Float[Tensor, " p"]) -> Float[Tensor, "p N m"] | None:
        theta = self._logarithms.parameters(values)
        rows = self._residual.tangents(theta)
        scale = torch.where(self._logarithms.places, theta, 1.0)
        return None if rows is None else rows * scale[:, None, None]
