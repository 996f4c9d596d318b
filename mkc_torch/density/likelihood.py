"""Mean negative log-likelihood of the MKC density in κ = 1/σ² and log d: derivatives and Newton steps.

In κ, σ = ∞ is the finite value 0. Steps in log κ would overshoot: once the tail has more mass than there are outliers,
the likelihood falls exponentially.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch.density._numpy_newton import (
    KAPPA_OFFSET,
    LEAST_KAPPA_SHARE,
    LONGEST_STEP,
    Channel,
    channel_step,
    is_short,
)
from mkc_torch.density.energy import KAPPA_MAX, energy_terms, energy_value
from mkc_torch.density.head import head_rule, integrate, tail_density
from mkc_torch.density.normalizer import log_partition_value

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Derivatives(NamedTuple):
    """Value, gradient and Hessian of a function of (κ, log d), each of shape (*, m)."""

    value: Tensor
    kappa: Tensor
    log_d: Tensor
    kappa_kappa: Tensor
    kappa_log_d: Tensor
    log_d_log_d: Tensor


def _mean(values: Tensor, weight: Tensor | None) -> Tensor:
    """Mean over samples; ``weight`` sums to 1 over them."""
    return values.mean(-2) if weight is None else (weight * values).sum(-2)


def energy_derivatives(error: Tensor, weight: Tensor | None, kappa: Tensor, log_d: Tensor) -> Derivatives:
    q = 0.5 * (error * torch.exp(-log_d).unsqueeze(-2)).square()
    w, e, first, second = energy_terms(q, kappa.unsqueeze(-2))
    qw = q * w
    q2w = q * qw
    mean_qw, mean_q2w = _mean(qw, weight), _mean(q2w, weight)
    return Derivatives(
        value=_mean(e, weight),
        kappa=-_mean(first, weight),
        log_d=-2.0 * mean_qw,
        kappa_kappa=_mean(second, weight),
        kappa_log_d=2.0 * mean_q2w,
        log_d_log_d=4.0 * (mean_qw - kappa * mean_q2w),
    )


def normaliser_derivatives(kappa: Tensor, log_d: Tensor, log_bound: Tensor) -> Derivatives:
    """Derivatives of log(d Z(κ, bound / d))."""
    length = torch.exp(log_bound - log_d)
    tail = tail_density(kappa)
    k = torch.where(tail > 0, kappa, 1.0)
    tail_1, tail_2 = tail / k.pow(2), tail * (1.0 - 2.0 * k) / k.pow(4)
    nodes, weights = head_rule(kappa, length)
    _, e, first, second = energy_terms(0.5 * nodes.square(), kappa.unsqueeze(-1))
    p = torch.exp(-e)

    z = integrate(p, tail, length, weights)
    z_k = integrate(first * p, tail_1, length, weights) / z
    z_kk = integrate((first.square() - second) * p, tail_2, length, weights) / z
    w_end, e_end, first_end, _ = energy_terms(0.5 * length.square(), kappa)
    edge = 2.0 * torch.exp(-e_end) / z
    l_1 = length * edge
    l_2 = length * l_1 * (-length * w_end - edge) + l_1
    return Derivatives(
        value=torch.log(z) + log_d,
        kappa=z_k,
        log_d=1.0 - l_1,
        kappa_kappa=z_kk - z_k.square(),
        kappa_log_d=-l_1 * (first_end - z_k),
        log_d_log_d=l_2,
    )


@dataclass(frozen=True)
class DensityState:
    """Iterate of a fit, every field (*, m); ``value`` is the mean negative log-likelihood at the last step."""

    kappa: Tensor
    log_d: Tensor
    log_bound: Tensor
    log_d_min: Tensor
    damping: Tensor
    value: Tensor
    free_kappa: bool = True
    free_d: bool = True

    def select(self, index: Tensor) -> DensityState:
        """The state of the problems at ``index``."""
        fields = ("kappa", "log_d", "log_bound", "log_d_min", "damping", "value")
        return replace(self, **{f: getattr(self, f)[index] for f in fields})

    def moved(self, moves: Bool[Tensor, " B"], to: DensityState) -> DensityState:
        """The state ``to`` for the problems that move, and this state for the others."""
        mask = moves.unsqueeze(-1)
        return replace(
            self,
            kappa=torch.where(mask, to.kappa, self.kappa),
            log_d=torch.where(mask, to.log_d, self.log_d),
            damping=torch.where(mask, to.damping, self.damping),
            value=torch.where(mask, to.value, self.value),
        )


def negative_log_likelihood(error: Tensor, weight: Tensor | None, state: DensityState) -> Float[Tensor, "*batch m"]:
    """Mean negative log-density of the residuals of each channel."""
    z = error * torch.exp(-state.log_d).unsqueeze(-2)
    log_z = log_partition_value(state.kappa, torch.exp(state.log_bound - state.log_d))
    return _mean(energy_value(z, state.kappa.unsqueeze(-2)), weight) + state.log_d + log_z


def initial_state(
    error: Float[Tensor, "*batch N m"],
    weight: Float[Tensor, "*batch N m"] | None,
    scale: Float[Tensor, "*batch m"],
    bound: Float[Tensor, "*batch m"],
    d_min: Float[Tensor, "*batch m"],
    *,
    kappa: Float[Tensor, "*batch m"] | None = None,
    d: Float[Tensor, "*batch m"] | None = None,
    tails: Sequence[float | Tensor] = (0.1, 0.4, 1.5),
) -> DensityState:
    """The most likely start among a Gaussian and densities with κ from ``tails`` and the given scale.

    A given ``kappa`` or ``d`` is kept fixed.
    """
    rms = torch.sqrt(_mean(error.square(), weight)).clamp(min=d_min)
    log_bound, log_d_min = torch.log(bound), torch.log(d_min)
    blank = DensityState(rms, rms, log_bound, log_d_min, torch.full_like(rms, 1e-3), rms, kappa is None, d is None)
    best: DensityState | None = None
    for start_kappa, start_d in ((0.0, rms), *((tail, scale) for tail in tails)):
        state = replace(
            blank,
            kappa=torch.as_tensor(start_kappa).to(rms).expand_as(rms) if kappa is None else kappa.expand_as(rms),
            log_d=torch.log(start_d.clamp(min=d_min)) if d is None else torch.log(d).expand_as(rms),
        )
        state = replace(state, value=negative_log_likelihood(error, weight, state))
        if best is None:
            best = state
        else:
            better = state.value < best.value
            best = replace(
                best,
                kappa=torch.where(better, state.kappa, best.kappa),
                log_d=torch.where(better, state.log_d, best.log_d),
                value=torch.where(better, state.value, best.value),
            )
    assert best is not None
    return best


def newton_step(error: Tensor, weight: Tensor | None, state: DensityState) -> DensityState:
    """One damped Newton step in (κ, log d) with κ in [0, 400] and d in [d_min, bound]; the value never increases."""
    if is_short(error):
        return _newton_step_of_one(error, weight, state)
    total = likelihood_derivatives(energy_derivatives(error, weight, state.kappa, state.log_d), state)
    proposal = newton_proposal(total, state)
    value = negative_log_likelihood(error, weight, proposal)
    better = value <= total.value
    return replace(
        state,
        kappa=torch.where(better, proposal.kappa, state.kappa),
        log_d=torch.where(better, proposal.log_d, state.log_d),
        damping=torch.where(better, 0.1 * state.damping, 10.0 * state.damping).clamp(1e-9, 1e6),
        value=torch.where(better, value, total.value),
    )


def _newton_step_of_one(
    error: Float[Tensor, "1 N m"], weight: Float[Tensor, "1 N m"] | None, state: DensityState
) -> DensityState:
    """:func:`newton_step` of a single problem, channel by channel in NumPy."""
    fields = (state.kappa, state.log_d, state.log_bound, state.log_d_min, state.damping, state.value)
    channels = [Channel(*numbers) for numbers in zip(*(field[0].tolist() for field in fields), strict=True)]
    errors = error[0].numpy().T
    weights = [None] * len(errors) if weight is None else weight[0].numpy().T
    free = state.free_kappa, state.free_d
    with np.errstate(all="ignore"):
        found = [channel_step(e, w, at, *free) for e, w, at in zip(errors, weights, channels, strict=True)]
    kappa, log_d, damping, value = torch.from_numpy(np.array(found, dtype=float).T.copy()).unsqueeze(1)
    return replace(state, kappa=kappa, log_d=log_d, damping=damping, value=value)


def likelihood_derivatives(energy: Derivatives, state: DensityState) -> Derivatives:
    """Derivatives of the mean negative log-likelihood, from those of the mean energy."""
    norm = normaliser_derivatives(state.kappa, state.log_d, state.log_bound)
    return Derivatives(*(a + b for a, b in zip(energy, norm, strict=True)))


def newton_proposal(total: Derivatives, state: DensityState) -> DensityState:
    """Iterate after a damped Newton step from ``state``; its value is not updated."""
    chain = state.kappa + KAPPA_OFFSET
    g_s, g_l = total.kappa * chain, total.log_d
    h_ss = total.kappa_kappa * chain.square()
    h_sl, h_ll = total.kappa_log_d * chain, total.log_d_log_d
    held_s = ((state.kappa <= 0) & (g_s > 0)) | ((state.kappa >= KAPPA_MAX) & (g_s < 0))
    held_l = ((state.log_d <= state.log_d_min) & (g_l > 0)) | ((state.log_d >= state.log_bound) & (g_l < 0))
    if not state.free_kappa:
        held_s = torch.ones_like(held_s)
    if not state.free_d:
        held_l = torch.ones_like(held_l)
    g_s, g_l = torch.where(held_s, 0.0, g_s), torch.where(held_l, 0.0, g_l)
    h_sl = torch.where(held_s | held_l, 0.0, h_sl)
    h_ss, h_ll = torch.where(held_s, 1.0, h_ss), torch.where(held_l, 1.0, h_ll)
    # scaled separately: near a Gaussian the curvature by κ is a thousandth of that by log d
    r_s, r_l = (h.abs().clamp(min=1e-8 * (h_ss.abs() + h_ll.abs())).rsqrt() for h in (h_ss, h_ll))
    a, b, c = h_ss * r_s * r_s, h_sl * r_s * r_l, h_ll * r_l * r_l
    # Levenberg's shift also lifts the smaller eigenvalue above 0
    middle, spread = 0.5 * (a + c), torch.hypot(0.5 * (a - c), b)
    shift = (spread - middle + 1e-3).clamp(min=0.0) + state.damping
    a, c = a + shift, c + shift
    determinant = a * c - b * b
    g_s, g_l = g_s * r_s, g_l * r_l
    step_s, step_l = r_s * (b * g_l - c * g_s) / determinant, r_l * (b * g_s - a * g_l) / determinant
    longest = torch.maximum(step_s.abs(), step_l.abs())
    shorten = (LONGEST_STEP / longest.clamp(min=LONGEST_STEP)).nan_to_num(0.0)
    grown = (1.0 + shorten * step_s.nan_to_num(0.0)).clamp(min=LEAST_KAPPA_SHARE)
    kappa = (chain * grown - KAPPA_OFFSET).clamp(0.0, KAPPA_MAX)
    log_d = torch.minimum(
        torch.maximum(state.log_d + shorten * step_l.nan_to_num(0.0), state.log_d_min), state.log_bound
    )
    return replace(
        state, kappa=kappa if state.free_kappa else state.kappa, log_d=log_d if state.free_d else state.log_d
    )


def conclusive(before: DensityState, after: DensityState) -> Tensor:
    """Whether a step is evidence for convergence: accepted, or the damping is at its limit. Shape (*, m)."""
    return (after.damping <= before.damping) | (after.damping >= 1e3)


class Maximum(NamedTuple):
    """Result of Newton steps: the last iterate, which channels converged, (*, m), and the number of steps."""

    state: DensityState
    converged: Bool[Tensor, "*batch m"]
    n_iter: int


def maximise(error: Tensor, weight: Tensor | None, state: DensityState, *, max_iter: int, tol: float) -> Maximum:
    """Maximise the likelihood of each channel by Newton steps, until two in a row gain less than ``tol`` plus rounding.

    Args:
        error: residuals, (*, N, m).
        weight: weights that sum to 1 over the samples; None for equal weights.
        state: the start, from :func:`initial_state`.
        max_iter: maximum number of Newton steps.
        tol: tolerance of the mean log-likelihood, in nats per residual.
    """
    still = torch.zeros_like(state.value, dtype=torch.int64)
    n_iter = 0
    while n_iter < max_iter:
        n_iter += 1
        before = state
        state = newton_step(error, weight, state)
        rounding = 8 * torch.finfo(error.dtype).eps * state.value.abs().clamp(min=1.0)
        improved = before.value - state.value > tol + rounding
        still = torch.where(improved, 0, still + conclusive(before, state).to(still.dtype))
        if bool((still >= 2).all()):
            break
    return Maximum(state, still >= 2, n_iter)
