"""Cross-validation on blocks of consecutive samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.settings import ConfirmationSettings
from mkc_torch.functional import mkc_nll

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class HeldOutBlocks:
    """Block and fold of each sample (N,), and the training samples of each fold."""

    block: Tensor
    fold: Tensor
    train: tuple[Bool[Tensor, " N"], ...]


@dataclass(frozen=True)
class Evidence:
    """Scores on held-out samples: log-likelihood (N,), residual (N, m), and the density's σ and d (m,).

    ``parameters`` (folds, p) are those of the fits without each fold; ``left_out`` is the mean share of excluded
    samples.
    """

    log_likelihood: Float[Tensor, " N"]
    residual: Float[Tensor, "N m"]
    sigma: Float[Tensor, " m"]
    d: Float[Tensor, " m"]
    parameters: Float[Tensor, "folds p"]
    left_out: float

    @property
    def jackknife(self) -> Float[Tensor, " p"]:
        """Jackknife standard errors of the parameters, over folds.

        Each fold has blocks from the whole recording, so the errors include misfits of the noise model and of the
        effect's shape. Efron & Tibshirani, "An Introduction to the Bootstrap" (1993), (11.5).
        """
        return ((1.0 - self.left_out) / self.left_out * self.parameters.var(0, correction=0)).sqrt()


def blocks_of(
    N: int, correlation: int, settings: ConfirmationSettings, always: Bool[Tensor, " N"] | None = None
) -> HeldOutBlocks:
    """Return blocks and folds; by default 25 blocks in 5 folds.

    The gap between training and held-out samples is at least a correlation time, but at most half a block; a longer
    drift affects both sides.

    Args:
        N: number of samples.
        correlation: integrated correlation time in samples.
        settings: number of blocks and folds, and the gap.
        always: samples that all fits use, such as the first samples of each run, which determine the initial states;
            None for none.
    """
    folds = settings.folds
    count = folds * settings.blocks_per_fold
    block = (torch.arange(N) * count).div(N, rounding_mode="floor")
    fold = block % folds
    # at most half a block, so that training blocks are not empty
    gap = max(1, min(max(math.ceil(settings.gap * N), correlation), N // (2 * count)))
    train = []
    for k in range(folds):
        near = (fold == k).to(torch.float64).reshape(1, 1, -1)
        widened = torch.nn.functional.max_pool1d(near, 2 * gap + 1, stride=1, padding=gap)
        far = widened.reshape(-1) == 0
        train.append(far if always is None else far | always)
    return HeldOutBlocks(block, fold, tuple(train))


def held_out(
    fit: FittedModel,
    blocks: HeldOutBlocks,
    reread: Callable[[Bool[Tensor, " N"]], tuple[JointModel, Float[Tensor, " p"]]] | None = None,
) -> Evidence:
    """Refit without each fold, and score on the fold.

    Args:
        fit: on all folds.
        blocks: blocks and folds.
        reread: returns model and start for the training samples; default those of ``fit``, with fixed shapes.
    """
    N = len(fit.residual)
    log_likelihood = fit.residual.new_zeros(N)
    residual = torch.zeros_like(fit.residual)

    def without(train: Bool[Tensor, " N"]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        rows = train.to(fit.residual.dtype)
        model, start = (fit.model, fit.parameters) if reread is None else reread(train)
        found = fitted(model, start, fit.bound, rows=rows, graduate=False)
        return found.residual, found.sigma, found.d, found.bound, found.parameters

    folds = run_parallel([partial(without, train) for train in blocks.train], fit.model.prepared, thing="part held out")
    for number, (out, sigma, d, bound, _) in enumerate(folds):
        seen = blocks.fold == number
        residual[seen] = out[seen]
        log_likelihood[seen] = scored(out, sigma, d, bound, fit.recorded)[seen]
    _, sigmas, scales, _, parameters = zip(*folds, strict=True)
    middle = torch.stack(sigmas).median(0).values, torch.stack(scales).median(0).values
    left_out = 1.0 - float(torch.stack(blocks.train).double().mean())
    return Evidence(log_likelihood, residual, *middle, torch.stack(parameters), left_out)


def on_all(fit: FittedModel) -> Evidence:
    """Score a fit on its training samples, in place of held-out blocks."""
    log_likelihood = scored(fit.residual, fit.sigma, fit.d, fit.bound, fit.recorded)
    return Evidence(log_likelihood, fit.residual, fit.sigma, fit.d, fit.parameters.unsqueeze(0), 0.5)


def scored(
    residual: Tensor, sigma: Tensor, d: Tensor, bound: Tensor, recorded: Bool[Tensor, "N m"] | None = None
) -> Float[Tensor, " N"]:
    """Return the log-likelihood of each sample, summed over the channels that are recorded there."""
    lost = mkc_nll(residual, sigma, d, bound)
    return -(lost if recorded is None else recorded * lost).sum(-1)


_DRAWS = 2000
"""Draws of the block bootstrap."""


def gain_interval(
    difference: Float[Tensor, " N"],
    block: Tensor,
    generator: torch.Generator,
    *,
    coverage: float = 0.95,
) -> tuple[float, tuple[float, float]]:
    """Return the mean of paired differences and its interval (95 % by default), by a block bootstrap."""
    count = int(block.max()) + 1
    total = difference.new_zeros(count).index_add(0, block, difference)
    size = difference.new_zeros(count).index_add(0, block, torch.ones_like(difference))
    drawn = torch.randint(count, (_DRAWS, count), generator=generator)
    means = total[drawn].sum(-1) / size[drawn].sum(-1)
    tail = 0.5 * (1.0 - coverage)
    low, high = torch.quantile(means, torch.tensor([tail, 1.0 - tail], dtype=means.dtype)).tolist()
    return float(difference.mean()), (low, high)
