"""Inspection of a loss: warnings about its training, and the test of its residuals' tails."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim import Optimizer

from mkc_torch._support.arguments import refuse_not_real
from mkc_torch.density.noise_spread import TailsOverInput, spread_over
from mkc_torch.density.tails import assess_tails
from mkc_torch.losses._checks import checked_weight, format_channels
from mkc_torch.losses.residual_scale import NORMAL_QUANTILE, OTHER_FIT_RATIO, QUANTILE, weighted_quantile

NEAR_FLOOR = 2.0
"""Factor on the floor of d below which a scale is reported as collapsed."""

MOST_BEYOND = 0.01
"""Share of errors beyond a given bound above which it is reported."""


@torch.no_grad()
def training_warnings(
    loss: Any, input: Tensor | None, target: Tensor | None, weight: Tensor | None, optimizer: Optimizer | None
) -> tuple[str, ...]:
    """Warnings of :meth:`mkc_torch.MKCLoss.check`."""
    found = []
    d, d_min, bound = loss.d.detach(), loss.d_min, loss.bound
    has_floor = loss.raw_d is not None or loss._follows
    low = [int(k) for k in (d < NEAR_FLOOR * d_min).nonzero().flatten()] if has_floor else []
    if low:
        found.append(
            f"The scale d of channel {_listed(low)} is {format_channels(d[low])}, close to its floor "
            f"{format_channels(d_min[low])}, so outliers smaller than that floor are not found. If the errors on "
            "validation data are as small, lower `d_min`. If they are larger, the network fits the noise of its "
            "targets, and the likelihood grows without limit as d -> 0: regularise, or stop earlier."
        )
    if input is not None and target is not None and loss.residual_scale is not None:
        residual, share, _ = _rows(loss, input, target, weight)
        size = weighted_quantile(torch, residual.abs().T, share.T, QUANTILE) / NORMAL_QUANTILE
        ratio = torch.where(loss.residual_scale.batches > 0, size / loss.residual_scale.scale, 0.0)
        wide = [int(k) for k in (ratio > OTHER_FIT_RATIO).nonzero().flatten()]
        if wide:
            found.append(
                f"The errors of channel {_listed(wide)} are {format_channels(ratio[wide])} times as large as those of "
                "the training. On validation data the network fits the noise of its training targets: regularise, or "
                "stop earlier. In a new fit the loss is that of another fit: call loss.reset_parameters() before it."
            )
    if loss._bound_was_given and (input is not None or loss.residual_scale is not None):
        residual, share, _ = _rows(loss, input, target, weight)
        beyond = (share * (residual.abs() > bound)).sum(0) / share.sum(0).clamp(min=torch.finfo(share.dtype).tiny)
        far = [int(k) for k in (beyond > MOST_BEYOND).nonzero().flatten()]
        if far:
            shares = ", ".join(f"{100.0 * float(beyond[k]):.2g} %" for k in far)
            found.append(
                f"{shares} of the errors of channel {_listed(far)} lie beyond the bound "
                f"{format_channels(bound[far])}, where the density is 0. Pass the largest possible error as `bound`, "
                "in the unit of the targets, or omit `d` and `bound` to take them from the residuals."
            )
    learned = [name for name in ("raw_kappa", "raw_d") if getattr(loss, name) is not None]
    if optimizer is not None and learned:
        optimised = {id(p) for group in optimizer.param_groups for p in group["params"]}
        missing = [name for name in learned if id(getattr(loss, name)) not in optimised]
        if missing:
            names = " and ".join({"raw_kappa": "sigma", "raw_d": "d"}[name] for name in missing)
            found.append(
                f"The optimizer does not have {names} of the loss. Add `*loss.param_groups()` to its parameter groups, "
                "or make the loss with `learn_sigma=False, learn_d=False`."
            )
    if loss.schedule is not None and isinstance(optimizer, torch.optim.SGD):
        found.append(
            "The optimizer is SGD, whose steps are proportional to the gradient; the gradient of this loss grows as "
            "1 / scale while the residuals shrink. Clip it before each step, "
            "torch.nn.utils.clip_grad_norm_(parameters, 1.0), or use an optimizer that adapts its steps, such as AdamW."
        )
    return tuple(found)


@torch.no_grad()
def tails_of(
    loss: Any, input: Tensor | None, target: Tensor | None, weight: Tensor | None, features: Tensor | None
) -> TailsOverInput:
    """Test of :meth:`mkc_torch.MKCLoss.tails`."""
    rows = _rows(loss, input, target, weight)
    if not bool((rows.weight.sum(0) > 0).all()):
        raise ValueError(
            "Expected residuals of every channel but got none; call the loss in training first, or pass `input` and "
            "`target`."
        )
    columns = [] if features is None else _feature_columns(loss, features, input)
    tails = assess_tails(rows.residual, rows.weight, bound=loss.bound.to(rows.residual))
    channels = zip(*map(_channels, rows), strict=True)
    spread = tuple(
        spread_over(error, share, [("the prediction", prediction), *columns]) for error, share, prediction in channels
    )
    return TailsOverInput(**{field.name: getattr(tails, field.name) for field in fields(tails)}, spread=spread)


def _feature_columns(loss: Any, features: Tensor, input: Tensor | None) -> list[tuple[str, np.ndarray]]:
    """Names and values of the columns of features, one value for each sample of the input."""
    refuse_not_real("features", features)
    if input is None:
        raise ValueError(
            "Expected argument `features` with `input` and `target` but got it alone; the loss does not keep the "
            "features of its training. Pass those of a validation set."
        )
    samples = input.movedim(loss.channel_dim, -1).shape[:-1]
    if features.shape[:-1] != samples or not bool(torch.isfinite(features).all()):
        got = tuple(features.shape) if features.shape[:-1] != samples else "NaN or infinity"
        raise ValueError(
            f"Expected argument `features` of finite values of shape ({', '.join(map(str, samples))}, p) but got "
            f"{got}; pass what the network takes, a row for each sample of the input."
        )
    return [(f"feature {k}", column) for k, column in enumerate(_channels(features.detach().flatten(0, -2)))]


def _channels(values: Tensor) -> list[np.ndarray]:
    return list(values.detach().double().cpu().numpy().T)


class _Rows(NamedTuple):
    """Residuals, weights and predictions, (N, m) each."""

    residual: Tensor
    weight: Tensor
    prediction: Tensor


def _rows(loss: Any, input: Tensor | None, target: Tensor | None, weight: Tensor | None) -> _Rows:
    """Rows of the given batch or of the most recent batches."""
    if input is None or target is None:
        if loss.residual_scale is None:
            raise ValueError(
                "Expected arguments `input` and `target` but got None: a loss with a given `d` keeps no residuals; "
                "pass predictions and targets, for example of a validation set."
            )
        recent = loss.residual_scale.recent
        return _Rows(recent[0].T, recent[2].T, recent[1].T)
    batch = loss._batch(input, target, weight)
    shares = torch.ones_like(batch.input) if weight is None else checked_weight(weight, batch.input, batch.axis)[0]
    prediction = batch.input if batch.counts is None else torch.where(batch.counts, batch.input, 0.0)
    rows = (batch.error(), shares, prediction)
    return _Rows(*(value.movedim(batch.axis, -1).reshape(-1, loss.num_channels) for value in rows))


def _listed(channels: list[int]) -> str:
    return ", ".join(map(str, channels))
