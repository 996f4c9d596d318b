"""Newton's method on the coefficients and each channel's 1/σ² and log d jointly, one pass over the rows a step.

The Hessian is kept while the steps shrink fast, and recomputed otherwise: near the maximum a pass for the gradient
alone is as good as a pass of twice the time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.likelihood import normaliser_derivatives
from mkc_torch.linear.streaming._float32_pass import LEAST_FLOAT32_KAPPA
from mkc_torch.linear.streaming._sums import StreamSums

if TYPE_CHECKING:
    from jaxtyping import Bool, Float64

__all__ = ["NEAR", "Likelihood", "NewtonState", "StreamParameters"]

_KAPPA_OFFSET = 0.02
"""A step in κ is measured in units of κ plus this."""

_LONGEST = 2.0
"""Largest step in log d, and in κ in its units, as in the E-step in memory."""

_FURTHEST_DOWN = 0.1353352832366127
"""Least factor by which a step reduces κ, as in the E-step in memory."""

NEAR = 1e-13
"""Remaining gain, in mean log-likelihood, at which a last step with a new Hessian ends the fit.

The remaining distance is then 4e-7 d, of which such a step leaves the square."""

_FLOAT32_GAIN = 1e-9
"""Least remaining gain, in mean log-likelihood, for a float32 pass: its gradient is accurate to 1e-6."""

_FAST = 1e-2
"""The Hessian is kept while each step gains less than this share of the gain of the step before."""


@dataclass(frozen=True)
class StreamParameters:
    """Coefficients in the basis, 1/σ² and log d."""

    beta: Float64[Tensor, " n"]
    kappa: Float64[Tensor, " m"]
    log_d: Float64[Tensor, " m"]


@dataclass(frozen=True)
class Likelihood:
    """Mean negative log-likelihood as a function of the parameters, from sums over the rows.

    Attributes:
        weight: sum of the weights, (m,).
        log_bound, log_d_min: log half-width of the domain and least log d, (m,).
        free_kappa, free_d: whether κ and log d are learned.
        to_basis: matrix that takes sums over the rows to the basis, (n, n).
        largest: largest absolute value of Y.
        single: whether float32 passes are possible.
    """

    weight: Float64[Tensor, " m"]
    log_bound: Float64[Tensor, " m"]
    log_d_min: Float64[Tensor, " m"]
    free_kappa: bool
    free_d: bool
    to_basis: Float64[Tensor, "n n"]
    largest: float
    single: bool

    def channels(self, place: StreamParameters, sums: StreamSums) -> Float64[Tensor, " m"]:
        """Mean negative log-likelihood of each channel."""
        return sums.energy / self.weight + normaliser_derivatives(place.kappa, place.log_d, self.log_bound).value

    def value(self, place: StreamParameters, sums: StreamSums) -> float:
        return float((self.weight * self.channels(place, sums)).sum() / self.weight.sum())

    def gradient(self, place: StreamParameters, sums: StreamSums) -> Float64[Tensor, " p"]:
        """Gradient by the coefficients in units of the smallest d, by κ and by log d."""
        norm = normaliser_derivatives(place.kappa, place.log_d, self.log_bound)
        unit, precision = torch.exp(place.log_d.min()), torch.exp(-2.0 * place.log_d)
        by_beta = -unit * (precision @ sums.score) @ self.to_basis
        by_kappa = self.weight * norm.kappa - sums.first
        by_log_d = self.weight * norm.log_d - 2.0 * sums.qw
        return torch.cat([by_beta, by_kappa, by_log_d]) / self.weight.sum()

    def hessian(self, place: StreamParameters, sums: StreamSums) -> Float64[Tensor, "p p"]:
        """Hessian by the unknowns of :meth:`gradient`."""
        norm = normaliser_derivatives(place.kappa, place.log_d, self.log_bound)
        unit, precision = torch.exp(place.log_d.min()), torch.exp(-2.0 * place.log_d)
        gram = unit.square() * torch.einsum("c,cij->ij", precision, sums.gram)
        gram = self.to_basis.mT @ gram @ self.to_basis
        once = sums.score * (unit * precision).unsqueeze(-1) @ self.to_basis
        cubed = sums.cubed * (unit * precision.square()).unsqueeze(-1) @ self.to_basis
        by_kappa, by_log_d = 0.5 * cubed.mT, (2.0 * once - place.kappa.unsqueeze(-1) * cubed).mT
        kk = torch.diag(self.weight * norm.kappa_kappa + sums.second)
        kl = torch.diag(self.weight * norm.kappa_log_d + 2.0 * sums.q2w)
        ll = torch.diag(self.weight * norm.log_d_log_d + 4.0 * (sums.qw - place.kappa * sums.q2w))
        rows = (
            torch.cat([0.5 * (gram + gram.mT), by_kappa, by_log_d], -1),
            torch.cat([by_kappa.mT, kk, kl], -1),
            torch.cat([by_log_d.mT, kl, ll], -1),
        )
        return torch.cat(rows, -2) / self.weight.sum()

    def free(self, place: StreamParameters, gradient: Float64[Tensor, " p"]) -> Bool[Tensor, " p"]:
        """Mask of the unknowns that are learned and not held at a limit."""
        n, m = place.beta.shape[0], place.kappa.shape[0]
        g_kappa, g_log_d = gradient[n : n + m], gradient[n + m :]
        held_kappa = ((place.kappa <= 0) & (g_kappa >= 0)) | ((place.kappa >= KAPPA_MAX) & (g_kappa <= 0))
        held_d = ((place.log_d <= self.log_d_min) & (g_log_d >= 0)) | ((place.log_d >= self.log_bound) & (g_log_d <= 0))
        return torch.cat([torch.ones(n, dtype=torch.bool), ~held_kappa & self.free_kappa, ~held_d & self.free_d])

    def allows_float32(self, place: StreamParameters) -> bool:
        """Whether a float32 pass is accurate to six digits; it is not if residuals are small compared to Y."""
        far = self.largest > 1e3 * float(torch.exp(place.log_d.min()))
        return self.single and not far and float(place.kappa.min()) >= LEAST_FLOAT32_KAPPA

    def moved(self, place: StreamParameters, step: Float64[Tensor, " p"]) -> StreamParameters:
        """The parameters after a step, with the step in κ in its units, clipped to the limits."""
        n, m = place.beta.shape[0], place.kappa.shape[0]
        chain = place.kappa + _KAPPA_OFFSET
        kappa = chain * (1.0 + step[n : n + m]).clamp(min=_FURTHEST_DOWN) - _KAPPA_OFFSET
        log_d = torch.minimum(torch.maximum(place.log_d + step[n + m :], self.log_d_min), self.log_bound)
        return StreamParameters(
            beta=place.beta + torch.exp(place.log_d.min()) * step[:n],
            kappa=kappa.clamp(0.0, KAPPA_MAX) if self.free_kappa else place.kappa,
            log_d=log_d if self.free_d else place.log_d,
        )


@dataclass(frozen=True)
class NewtonState:
    """State of the iteration between two passes.

    Attributes:
        trial: parameters at which the next pass is made.
        curvature: whether the next pass computes the Hessian.
        rough: whether the next pass is in float32.
        place, value, gradient, hessian: best parameters so far, with value and derivatives.
        stale: whether the Hessian is that of other parameters, or of a sample.
        loose: whether the value is from a float32 pass.
        gain: predicted gain of the last step, in mean log-likelihood.
        damping: added to the scaled Hessian.
        near: whether a single step with a new Hessian remains.
        history: mean negative log-likelihood, summed over channels, at every pass.
    """

    trial: StreamParameters
    curvature: bool = True
    rough: bool = False
    place: StreamParameters | None = None
    value: float = float("inf")
    gradient: Float64[Tensor, " p"] | None = None
    hessian: Float64[Tensor, "p p"] | None = None
    stale: bool = False
    loose: bool = False
    gain: float = 1.0
    damping: float = 0.0
    near: bool = False
    history: tuple[float, ...] = ()

    def after(self, likelihood: Likelihood, sums: StreamSums) -> NewtonState:
        """State after the pass at ``trial``."""
        value = likelihood.value(self.trial, sums)
        history = (*self.history, float(likelihood.channels(self.trial, sums).sum()))
        if self.place is not None and not value <= self.value + self._rounding(value):
            return self._shorter_step(likelihood, history)
        here = replace(
            self,
            place=self.trial,
            value=value,
            gradient=likelihood.gradient(self.trial, sums),
            hessian=likelihood.hessian(self.trial, sums) if self.curvature else self.hessian,
            stale=not self.curvature,
            loose=self.rough,
            damping=0.1 * self.damping if self.damping > 1e-4 else 0.0,
            history=history,
        )
        step, gain = here._step(likelihood)
        share = gain / self.gain if self.gain > 0 else 0.0
        # steps shrink by at least the same share
        left = gain * min(1.0, share)
        head = float(2.0 * sums.qw.sum() / likelihood.weight.sum())
        eps = torch.finfo(torch.float64).eps
        rounded = (10.0 * eps * likelihood.largest / float(torch.exp(self.trial.log_d.min()))) ** 2
        still = gain <= eps * head + rounded and share >= 0.25
        trial = likelihood.moved(self.trial, step)
        return replace(
            here,
            trial=trial,
            gain=gain,
            curvature=share > _FAST and self.place is not None,
            rough=left > _FLOAT32_GAIN and share <= _FAST and likelihood.allows_float32(trial),
            near=not self.rough and here.damping == 0.0 and (left <= NEAR * head + rounded or still),
        )

    def _rounding(self, value: float) -> float:
        """Difference of two values up to which they count as equal."""
        if self.rough or self.loose:
            return 1e-5 * (1.0 + abs(value))
        # close to the maximum differences of the value are rounding, and only the gradient is informative
        return max(1e-13 * (1.0 + abs(value)), 1e-3 * self.gain if self.gain < 1e-10 else 0.0)

    def _shorter_step(self, likelihood: Likelihood, history: tuple[float, ...]) -> NewtonState:
        """State after a step that was too long: a shorter step from the best place, with a new Hessian if stale."""
        assert self.place is not None
        back = replace(self, history=history, damping=max(10.0 * self.damping, 1e-2))
        back = replace(back, curvature=False, rough=False)
        if self.stale:
            return replace(back, trial=self.place, curvature=True, gain=1.0)
        step, gain = back._step(likelihood)
        return replace(back, trial=likelihood.moved(self.place, step), gain=gain)

    def _step(self, likelihood: Likelihood) -> tuple[Float64[Tensor, " p"], float]:
        """Damped Newton step, 0 for unknowns that are held, and its predicted gain."""
        assert self.place is not None
        assert self.gradient is not None
        assert self.hessian is not None
        n, m = self.place.beta.shape[0], self.place.kappa.shape[0]
        chain = torch.ones_like(self.gradient)
        chain[n : n + m] = self.place.kappa + _KAPPA_OFFSET
        free = likelihood.free(self.place, self.gradient)
        gradient = torch.where(free, chain * self.gradient, 0.0)
        hessian = chain.unsqueeze(-1) * self.hessian * chain
        hessian = torch.where(free.unsqueeze(-1) & free, hessian, torch.diag((~free).to(hessian.dtype)))
        size = hessian.diagonal().abs()
        root = size.clamp(min=1e-8 * float(size.max())).rsqrt()
        values, vectors = torch.linalg.eigh(root.unsqueeze(-1) * hessian * root)
        eps = torch.finfo(values.dtype).eps
        least = float(values[0])
        shift = self.damping + (0.0 if least > 1e2 * len(values) * eps else 1e-3 - least)
        step = -root * (vectors @ ((vectors.mT @ (root * gradient)) / (values + shift)))
        longest = float(step[n:].abs().max())
        step = step * min(1.0, _LONGEST / longest) if longest > 0 else step
        return step, float(-(step * gradient).sum())
