"""What any smooth correction by recorded columns would reach, and the columns along which structure remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, SmoothCorrection
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval, scored
from mkc_torch.diagnosis.evidence.smooth_curves import TIME, Smooth, curves_of, smooth_tangents
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Driver
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.functional import mkc_weight

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_MOST = 4
"""Largest number of selected columns; a column counts once per port."""

_PENALTIES = (1e-3, 3e-2, 1.0)
"""Ridge penalties of a quadratic curve, relative to the training samples; higher degrees have larger penalties."""

_MIDDLE = 3e-2
"""Ridge penalty during the selection of columns."""

_REACH = 3.0
"""Minimum half-width of the density's domain, in robust standard deviations of the residual."""

_ROUNDS = 2
"""Number of reweighting iterations."""

_ALIKE = 0.02
"""Share of the loss below which a further column is not selected, if it is within the standard error."""

_TINY = 1e-9
"""Minimum RMS of a tangent, and minimum precision per sample of a direction."""

_ROUNDING = 1e-12
"""Relative jitter of the Gram matrix; without it, rounding would decide between collinear tangents."""


@dataclass(frozen=True)
class Ceiling:
    """Score of a smooth correction on held-out blocks, and the columns that most folds select."""

    evidence: Evidence
    columns: tuple[str, ...]


def ceiling(model: JointModel, fit: FittedModel, drivers: Sequence[Driver], blocks: HeldOutBlocks) -> Ceiling:
    """Score a smooth correction of a model on held-out blocks, with the bound and density of the other models.

    At every port the correction adds Legendre curves of every column and slow courses of time, by ridge regression.
    For each fold, columns are selected forward on the training samples. Number of columns and penalty are those that
    predict the *other* held-out folds best, so that coloured noise is not fitted as a curve, as generalised
    cross-validation does. Two reweighting iterations and a density fit follow.

    The score is no evidence of missing physics: a drift longer than a block is smooth in time, and in every column that
    drifts too, so the ceiling can exceed the simulation. The correction cannot fit jumps, or dependences on the
    measured
    signal itself.

    Args:
        model: the model to correct, such as the simulation without findings.
        fit: the most likely model; the residual is linearised at its parameters, and its outliers do not select
        columns.
        drivers: the columns.
        blocks: held-out blocks.
    """
    parameters = fit.parameters[: model.size]
    residual = model.residual(parameters).detach()
    curves = curves_of(drivers, len(residual))
    weights = fit.weights if fit.recorded is None else fit.recorded * fit.weights
    smooth = smooth_tangents(model, parameters, curves, weights / fit.d.square(), blocks)
    problem = _problem(model, parameters, residual, smooth, fit.d)
    paths = _paths(problem, smooth, weights, blocks)
    chosen = _chosen(paths)
    taken = [{smooth.names[k] for k in step.groups} for step in chosen]
    common = [name for name in curves if name != TIME and 2 * sum(name in names for names in taken) > len(taken)]
    return Ceiling(_judged(problem, chosen, fit, blocks), tuple(common))


@dataclass(frozen=True)
class _Problem:
    """Linear model ``residual + tangents @ δ`` in units of the noise, with a quadratic penalty on δ.

    Tangents have unit mean square; those of the model's parameters are first. ``rough`` is the penalty at strength 1;
    ``prior`` and ``pull`` are precision and gradient of the parameters' prior.
    """

    residual: Tensor  # (N, m)
    tangents: Tensor  # (N m, P)
    rough: Tensor  # (P,)
    prior: Tensor  # (p, p)
    pull: Tensor  # (p,)

    def penalised(self, gram: Float[Tensor, "q q"], index: Tensor, strength: float) -> Float[Tensor, "q q"]:
        """Return the penalised Gram matrix of the tangents ``index``, the parameters' tangents first."""
        # jitter: rounding alone would decide between collinear tangents
        out = gram + torch.diag(strength * self.rough[index] + _ROUNDING * gram.diagonal())
        out[: len(self.pull), : len(self.pull)] += self.prior
        return out

    def pulled(self, gradient: Float[Tensor, " q"]) -> Float[Tensor, " q"]:
        return torch.cat([gradient[: len(self.pull)] + self.pull, gradient[len(self.pull) :]])


def _problem(
    model: JointModel, parameters: Tensor, residual: Float[Tensor, "N m"], smooth: Smooth, d: Float[Tensor, " m"]
) -> _Problem:
    # in place: they need most of the memory of a long recording and are not used again
    tangents = smooth.tangents.div_(d.unsqueeze(-1)).flatten(0, 1)
    samples = len(tangents)
    size = (torch.linalg.vector_norm(tangents, dim=0) / math.sqrt(samples)).clamp(min=_TINY)
    own = size[: smooth.own]
    # a small precision keeps undetermined directions fixed
    prior, pull = torch.diag(torch.full_like(own, _TINY * samples)), torch.zeros_like(own)
    known = model.prior
    if known is not None:
        precision = known.precision if known.precision.dim() == 2 else torch.diag(known.precision)
        prior += precision / own / own.unsqueeze(-1)
        pull = precision @ (parameters - known.mean) / own
    return _Problem(residual / d, tangents.div_(size), samples * smooth.roughness, prior, pull)


@dataclass(frozen=True)
class _Step:
    """A fit without a fold: selected groups, their tangents, δ, the penalty, and the loss on the fold."""

    groups: tuple[int, ...]
    index: Tensor
    delta: Tensor
    strength: float
    loss: float


def _paths(
    problem: _Problem, smooth: Smooth, weights: Float[Tensor, "N m"], blocks: HeldOutBlocks
) -> list[list[list[_Step]]]:
    """Return the fits without each fold, for each number of columns and each penalty."""
    folds = len(blocks.train)
    # accumulate a common product of samples with the same training folds
    kind = torch.cat([torch.stack(blocks.train, -1), blocks.fold.unsqueeze(-1)], -1)
    kinds, number = kind.unique(dim=0, return_inverse=True)
    number = number.repeat_interleave(problem.residual.shape[1])
    products = torch.stack([_product(problem, weights.flatten(), number == k) for k in range(len(kinds))])
    paths = []
    for fold in range(folds):
        train = torch.einsum("k,kpq->pq", kinds[:, fold].to(products), products)
        held = torch.einsum("k,kpq->pq", (kinds[:, folds] == fold).to(products), products)
        paths.append(_path(problem, smooth, train, held, smooth.allowed[fold].tolist()))
    return paths


def _product(problem: _Problem, weights: Float[Tensor, " Nm"], rows: Bool[Tensor, " Nm"]) -> Float[Tensor, "P1 P1"]:
    """Return the weighted Gram matrix of tangents and residual, the residual last."""
    part = torch.cat([problem.tangents[rows], problem.residual.reshape(-1, 1)[rows]], -1)
    part.mul_(weights[rows].sqrt().unsqueeze(-1))
    return part.mT @ part


def _path(problem: _Problem, smooth: Smooth, train: Tensor, held: Tensor, allowed: Sequence[bool]) -> list[list[_Step]]:
    """Select columns forward by Akaike's criterion."""
    P = len(problem.rough)
    gradient = problem.pulled(train[:P, P])
    everything = problem.penalised(train[:P, :P], torch.arange(P), _MIDDLE)
    index = torch.arange(smooth.own)
    groups: tuple[int, ...] = ()
    path: list[list[_Step]] = []
    while True:
        path.append([_fit(problem, train, held, gradient, groups, index, penalty) for penalty in _PENALTIES])
        free = [k for k in range(len(smooth.groups)) if allowed[k] and k not in groups]
        if len(groups) == _MOST or not free:
            return path
        # Schur complement of the selected tangents
        across = everything[:, index]
        solved = torch.linalg.solve(across[index], torch.cat([across.mT, gradient[index, None]], -1))
        reduced, slope = everything - across @ solved[:, :-1], gradient - across @ solved[:, -1]
        gain = [_gain(reduced, slope, smooth.groups[k]) for k in free]
        best = free[max(range(len(free)), key=gain.__getitem__)]
        groups, index = (*groups, best), torch.cat([index, smooth.groups[best]])


def _gain(reduced: Tensor, slope: Tensor, group: Tensor) -> float:
    step = torch.linalg.solve(reduced[group.unsqueeze(-1), group], slope[group])
    return 0.5 * float(slope[group] @ step) - len(group)


def _fit(
    problem: _Problem,
    train: Tensor,
    held: Tensor,
    gradient: Tensor,
    groups: tuple[int, ...],
    index: Tensor,
    strength: float,
) -> _Step:
    gram = train[index.unsqueeze(-1), index]
    delta = -torch.linalg.solve(problem.penalised(gram, index, strength), gradient[index])
    weights = torch.cat([delta, delta.new_ones(1)])
    seen = torch.cat([index, index.new_tensor([len(held) - 1])])
    return _Step(groups, index, delta, strength, float(weights @ held[seen.unsqueeze(-1), seen] @ weights))


def _chosen(paths: Sequence[Sequence[Sequence[_Step]]]) -> list[_Step]:
    """Return each fold's fit with the number of columns and the penalty that score best on the other folds.

    The smallest number of columns within a standard error of the best, if that error is a small share of the loss.

    Hastie, Tibshirani & Friedman, "The Elements of Statistical Learning" (2009), 7.10.
    """
    length = min(len(path) for path in paths)
    loss = torch.tensor([[[step.loss for step in row] for row in path[:length]] for path in paths])
    found = []
    for fold, path in enumerate(paths):
        others = loss[[k for k in range(len(paths)) if k != fold]].flatten(1)
        best = others[:, [int(others.sum(0).argmin())]]
        error = (others - best).std(0) / math.sqrt(len(others))
        near = (others - best).mean(0) <= error.clamp(max=_ALIKE * float(best.mean()))
        number = int(near.nonzero()[0]) // len(_PENALTIES)
        penalty = int(others.sum(0).unflatten(0, (length, -1))[number].argmin())
        found.append(path[number][penalty])
    return found


def _judged(problem: _Problem, chosen: Sequence[_Step], fit: FittedModel, blocks: HeldOutBlocks) -> Evidence:
    """Reweight each fit by its density, on the common domain, and score it on its held-out fold."""
    residual, bound = problem.residual, fit.bound / fit.d
    used = torch.stack(blocks.train).unsqueeze(-1).to(residual)
    used = used if fit.recorded is None else used * fit.recorded
    columns = [problem.tangents[:, step.index] for step in chosen]
    left = torch.stack([_moved(residual, c, s.delta) for c, s in zip(columns, chosen, strict=True)])
    sigma, d = fit.sigma.expand(len(chosen), -1), torch.ones_like(left[:, 0])
    for _ in range(_ROUNDS):
        weights = used * mkc_weight(left, sigma.unsqueeze(1), d.unsqueeze(1)) / d.square().unsqueeze(1)
        left = torch.stack([_reweighted(problem, c, s, w) for c, s, w in zip(columns, chosen, weights, strict=True)])
        weight = used.expand_as(left)
        # the residual of a curve that diverges on a fold exceeds the domain
        room = bound.maximum(_REACH * robust_scale(left, weight).amax(0))
        density = fit_density(left, bound=room, weight=weight, tol=1e-6)
        sigma, d = density.sigma, density.d
    score = torch.stack(
        [scored(e, s, size * fit.d, fit.bound, fit.recorded) for e, s, size in zip(left * fit.d, sigma, d, strict=True)]
    )
    own = blocks.fold.unsqueeze(0)
    return Evidence(
        score.gather(0, own).squeeze(0),
        left.gather(0, own.unsqueeze(-1).expand(-1, -1, left.shape[-1])).squeeze(0) * fit.d,
        sigma.median(0).values,
        d.median(0).values * fit.d,
        residual.new_zeros(len(chosen), 0),
        1.0 - float(used.mean()),
    )


def _reweighted(problem: _Problem, columns: Tensor, step: _Step, weights: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    weighted = columns * weights.reshape(-1, 1)
    gradient = problem.pulled(weighted.mT @ problem.residual.flatten())
    delta = -torch.linalg.solve(problem.penalised(weighted.mT @ columns, step.index, step.strength), gradient)
    return _moved(problem.residual, columns, delta)


def _moved(residual: Float[Tensor, "N m"], columns: Tensor, delta: Tensor) -> Float[Tensor, "N m"]:
    return residual + (columns @ delta).unflatten(0, residual.shape)


_RUNS_AWAY = 100.0
"""Residual, in half-widths of the density's domain, beyond which a simulation has diverged."""


def within_reach(case: EvidenceContext) -> tuple[Ceiling, tuple[str, ...]]:
    """Return the ceiling, and the columns along which the residual has a smooth trend."""
    base, fit = case.base, case.fit
    reach = ceiling(base.model, _answerable(base, fit), case.drivers, case.blocks)
    if nameless(fit):
        return reach, ()
    return reach, remaining(reach, case.held_out[-1], fit, case.drivers, case.blocks, case.seed, case.settings.evidence)


def remaining_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the score of a smooth correction, and the columns of a smooth trend."""
    reach, columns = case.ahead
    return as_result(SmoothCorrection(case.spread(reach.evidence), columns))


def as_result(smooth: SmoothCorrection) -> EvidenceResult:
    return EvidenceResult("remaining", smooth, keys={"ceiling": smooth.reached})


def nameless(fit: FittedModel) -> bool:
    """Whether a finding is an unnamed curve."""
    return any(term.effect.is_curve for term in fit.model.terms)


def _answerable(base: FittedModel, final: FittedModel) -> FittedModel:
    """Return the final fit; the fit without findings if the simulation diverges at the final parameters."""
    alone = base.model.residual(final.parameters[: base.model.size])
    return final if bool((alone.abs() < _RUNS_AWAY * final.bound).all()) else base


def remaining(
    alone: Ceiling,
    corrected: Evidence,
    fit: FittedModel,
    drivers: Sequence[Driver],
    blocks: HeldOutBlocks,
    seed: int,
    settings: EvidenceSettings,
) -> tuple[str, ...]:
    """Return the columns along which the residual of the final model has a smooth trend.

    A ceiling above the model is no evidence by itself: any slow course follows a drift longer than a block, on held-out
    blocks too. Therefore most folds must select the columns in a correction of the final model, and the columns must
    improve on courses of time alone. A trend that time describes as well is not reported; a column that drifts like the
    noise by chance can still pass.

    Args:
        alone: the ceiling for the simulation without findings.
        corrected: score of the model on held-out blocks.
        fit: the model.
        drivers: the columns.
        blocks: held-out blocks.
        seed: of the bootstraps.
        settings: confidence and minimum gain of the correction.
    """

    def gain(better: Evidence, worse: Evidence, coverage: float) -> tuple[float, float]:
        difference = better.log_likelihood - worse.log_likelihood
        generator = torch.Generator().manual_seed(seed)
        mean, (low, _) = gain_interval(difference, blocks.block, generator, coverage=coverage)
        return mean, low

    if gain(alone.evidence, corrected, 0.95)[1] <= 0.0:
        return ()
    sure = settings.remaining_coverage
    smooth = ceiling(fit.model, fit, drivers, blocks) if fit.model.terms else alone
    mean, low = gain(smooth.evidence, corrected, sure)
    if not smooth.columns or mean < settings.remaining_gain or low <= 0.0:
        return ()
    time = ceiling(fit.model, fit, (), blocks)
    return smooth.columns if gain(smooth.evidence, time.evidence, sure)[1] > 0.0 else ()
