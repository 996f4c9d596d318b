"""Numbers of each channel and their derivatives, from a loss's raw parameters and running state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mkc_torch.density.energy import KAPPA_MAX, as_computed
from mkc_torch.density.normalizer import log_partition_with_slopes
from mkc_torch.losses.bandwidth_schedule import UNLIMITED

if TYPE_CHECKING:
    from jaxtyping import Float

_LEAST_LOGIT = -80.0
"""Lower limit of the logistic function's argument: below it exp overflows float32, and the value is below 1e-34."""


class ChannelState(NamedTuple):
    """Values of the buffers in a forward pass, (m,) each; they have no gradient.

    ``scale`` is None if d is given and the objective is the likelihood; ``log_bandwidth`` and ``share`` are None
    if the likelihood trains the network.
    """

    bound: Any
    floor: Any
    scale: Any = None
    log_bandwidth: Any = None
    share: Any = None

    @property
    def is_robust(self) -> bool:
        return self.share is not None


class ChannelTable(NamedTuple):
    """Numbers of each channel for the sums over elements, (m,) each; None if not needed."""

    kappa: Any
    d: Any
    kappa_by_raw: Any
    d_by_raw: Any
    log_normalizer: Any
    log_normalizer_by_kappa: Any
    log_normalizer_by_d: Any
    annealed_kappa: Any
    annealed_d: Any
    scale: Any
    share: Any


def logistic(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``1 / (1 + exp(-raw))``, accurate near 0.

    A large σ, and a d small relative to its bound, correspond to tiny values. ``sigmoid`` is accurate there in torch,
    but runtimes of exported models compute it to seven decimals only. Exported code therefore uses the formula.

    Example:
        >>> logistic(torch.tensor([0.0, -20.0]))
        tensor([5.0000e-01, 2.0612e-09])
    """
    if torch.compiler.is_compiling():
        return 1.0 / (1.0 + torch.exp(-raw.clamp(min=_LEAST_LOGIT)))
    return raw.sigmoid()


def scale_ratio(xp: Any, raw: Any) -> Any:
    """Ratio of d to the scale of the residuals, in (e⁻², e²)."""
    return xp.exp(2.0 * xp.tanh(0.5 * raw))


def to_d(raw: Tensor | None, state: ChannelState, *, follows: bool) -> Float[Tensor, " m"]:
    """d as a differentiable function of its raw parameter; if d follows the residuals, None gives the scale itself."""
    if not follows:
        assert raw is not None
        return state.floor + (state.bound - state.floor) * logistic(raw)
    d = state.scale if raw is None else state.scale * scale_ratio(torch, raw)
    return torch.minimum(torch.maximum(d, state.floor), 0.5 * state.bound)


def annealed_kappa(xp: Any, kappa: Any, d: Any, state: ChannelState, *, follows: bool) -> Any:
    """1/σ² of the annealed loss: from the selected bandwidth, or the likelihood's where that is as narrow or narrower.

    The annealed loss's d is the scale if d follows the residuals, else the likelihood's d.
    """
    if follows:
        return xp.exp(-2.0 * state.log_bandwidth)
    widest = xp.exp(state.log_bandwidth)
    least = xp.where(widest < UNLIMITED, (d / (widest * state.scale)) ** 2, 0.0)
    return xp.maximum(kappa, least)


def channel_table(
    xp: Any,
    raw_kappa: Any,
    fixed_kappa: Any,
    raw_d: Any,
    fixed_d: Any,
    state: ChannelState,
    *,
    follows: bool,
    normalize: bool,
) -> ChannelTable:
    """All numbers of each channel, in float64 if ``xp`` is NumPy.

    Args:
        xp: ``numpy`` or ``torch``, the library of the other arrays.
        raw_kappa, fixed_kappa: raw parameter of 1/σ², or None and 1/σ² itself.
        raw_d, fixed_d: raw parameter of d, or None and d itself; both None if d is the scale.
        state: values of the buffers.
        follows: whether d follows the residuals.
        normalize: whether the log-normaliser is needed.
    """
    given = (raw_kappa, fixed_kappa, raw_d, fixed_d)
    if xp is np:
        wide = [None if value is None else value.astype(np.float64) for value in given]
        state = ChannelState(*(None if value is None else value.astype(np.float64) for value in state))
    else:
        dtype = as_computed(*(value for value in (*given, *state) if value is not None))[0].dtype
        wide = [None if value is None else value.to(dtype) for value in given]
        state = ChannelState(*(None if value is None else value.to(dtype) for value in state))
    raw_kappa, fixed_kappa, raw_d, fixed_d = wide
    kappa, kappa_by_raw = fixed_kappa, None
    if raw_kappa is not None:
        share = _logistic(xp, raw_kappa)
        kappa, kappa_by_raw = KAPPA_MAX * share, KAPPA_MAX * share * (1.0 - share)
    d, d_by_raw = fixed_d, None
    if follows:
        free = state.scale if raw_d is None else state.scale * scale_ratio(xp, raw_d)
        d = xp.minimum(xp.maximum(free, state.floor), 0.5 * state.bound)
        if raw_d is not None:
            d_by_raw = xp.where(d == free, free * (1.0 - xp.tanh(0.5 * raw_d) ** 2), 0.0)
    elif raw_d is not None:
        share, width = _logistic(xp, raw_d), state.bound - state.floor
        d, d_by_raw = state.floor + width * share, width * share * (1.0 - share)
    norm, norm_by_kappa, norm_by_d = None, None, None
    if normalize:
        length = state.bound / d
        log_z, norm_by_kappa, by_length = log_partition_with_slopes(xp, kappa, length)
        norm, norm_by_d = xp.log(d) + log_z, (1.0 - by_length * length) / d
    annealed = (None, None, None, None)
    if state.is_robust:
        own = annealed_kappa(xp, kappa, d, state, follows=follows)
        annealed = (own, state.scale if follows else d, state.scale, state.share)
    return ChannelTable(kappa, d, kappa_by_raw, d_by_raw, norm, norm_by_kappa, norm_by_d, *annealed)


def _logistic(xp: Any, raw: Any) -> Any:
    if xp is np:
        return 1.0 / (1.0 + np.exp(-np.clip(raw, -700.0, None)))
    return raw.sigmoid()
