"""The ceiling of any fit: what a smooth correction by all columns and by time would gain on blocks it has not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, scored
from mkc_torch.diagnosis.evidence.smooth_curves import TIME, Smooth, curves_of, smooth_tangents
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.functional import mkc_weight

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Ceiling", "ceiling"]

_MOST = 4
"""Columns taken up, one after the other; a column counts once for each port."""

_PENALTIES = (1e-3, 3e-2, 1.0)
"""Strengths tried of the pull on a quadratic, over that of the training samples; on steeper curves it is stronger."""

_MIDDLE = 3e-2
"""The strength that columns are taken up with."""

_REACH = 3.0
"""Robust standard deviations of the residual that the domain of its density holds at least."""

_ROUNDS = 2
"""Rounds of reweighting, by the density that the round before has left."""

_ALIKE = 0.02
"""Share of the loss that is not worth another column, if it is within the error."""

_TINY = 1e-9
"""Least root mean square of a tangent, and the precision, a sample, of directions that nothing is known of."""

_ROUNDING = 1e-12
"""Share of its own that is added to the products of each tangent, for of two that are one rounding would decide."""


@dataclass(frozen=True)
class Ceiling:
    """A smooth correction on held-out blocks, and the recorded columns that most of its fits take up."""

    evidence: Evidence
    columns: tuple[str, ...]


def ceiling(model: JointModel, fit: FittedModel, drivers: Sequence[Driver], blocks: HeldOutBlocks) -> Ceiling:
    """How far a smooth correction beside a model comes, on the blocks, the bound and the density of the other models.

    At every port the correction adds Legendre curves of every column and of time, by ridge regression on roughness. For
    each fold, on the samples of the others, columns are taken up one after the other, whichever gains most; how many
    and how smooth is what predicts best on average in the *other* held-out folds, so that noise with a memory does not
    pass for a curve as it does by generalised cross-validation. Two rounds of reweighting and a density of its own
    follow.

    It is what a fit *could* reach and no evidence that something is missing: noise that wanders for longer than a block
    is smooth in time, and in every column that wanders too, so a ceiling above the simulation is to be expected there.
    What it cannot follow is a jump, or what depends on the measured signal itself.

    Args:
        model: what the correction stands beside, such as the simulation alone.
        fit: the likeliest model; the residual is taken for linear around its parameters, and samples that it rejects
            do not choose the columns.
        drivers: the columns.
        blocks: to predict.
    """
    parameters = fit.parameters[: model.size]
    residual = model.residual(parameters).detach()
    curves = curves_of(drivers, len(residual))
    smooth = smooth_tangents(model, parameters, curves, fit.weights / fit.d.square(), blocks)
    problem = _problem(model, parameters, residual, smooth, fit.d)
    paths = _paths(problem, smooth, fit.weights, blocks)
    chosen = _chosen(paths)
    taken = [{smooth.names[k] for k in item.groups} for item in chosen]
    common = [name for name in curves if name != TIME and 2 * sum(name in names for names in taken) > len(taken)]
    return Ceiling(_judged(problem, chosen, fit, blocks), tuple(common))


@dataclass(frozen=True)
class _Problem:
    """Residuals on the scale of the noise, ``residual + tangents @ δ``, and a quadratic that pulls at δ.

    Tangents have a mean square of one, those of the model's own parameters stand first; ``rough`` is for a strength of
    one, ``prior`` and ``pull`` are of the parameters.
    """

    residual: Tensor  # (N, m)
    tangents: Tensor  # (N m, P)
    rough: Tensor  # (P,)
    prior: Tensor  # (p, p)
    pull: Tensor  # (p,)

    def penalised(self, gram: Float[Tensor, "q q"], index: Tensor, strength: float) -> Float[Tensor, "q q"]:
        """Products of the tangents in ``index``, which begin with the parameters', with the penalty on them."""
        # of two tangents that are one, rounding alone would tell what is whose
        out = gram + torch.diag(strength * self.rough[index] + _ROUNDING * gram.diagonal())
        out[: len(self.pull), : len(self.pull)] += self.prior
        return out

    def pulled(self, gradient: Float[Tensor, " q"]) -> Float[Tensor, " q"]:
        return torch.cat([gradient[: len(self.pull)] + self.pull, gradient[len(self.pull) :]])


def _problem(
    model: JointModel, parameters: Tensor, residual: Float[Tensor, "N m"], smooth: Smooth, d: Float[Tensor, " m"]
) -> _Problem:
    # in their place: of a long recording they are most of what there is, and nobody asks for them again
    tangents = smooth.tangents.div_(d.unsqueeze(-1)).flatten(0, 1)
    samples = len(tangents)
    size = (torch.linalg.vector_norm(tangents, dim=0) / math.sqrt(samples)).clamp(min=_TINY)
    own = size[: smooth.own]
    # directions that nothing is known of stay where they are
    prior, pull = torch.diag(torch.full_like(own, _TINY * samples)), torch.zeros_like(own)
    known = model.prior
    if known is not None:
        precision = known.precision if known.precision.dim() == 2 else torch.diag(known.precision)
        prior += precision / own / own.unsqueeze(-1)
        pull = precision @ (parameters - known.mean) / own
    return _Problem(residual / d, tangents.div_(size), samples * smooth.roughness, prior, pull)


@dataclass(frozen=True)
class _Step:
    """One of a fold's fits: the groups and tangents in it, δ, the penalty's strength, and its loss on the fold."""

    groups: tuple[int, ...]
    index: Tensor
    delta: Tensor
    strength: float
    loss: float


def _paths(
    problem: _Problem, smooth: Smooth, weights: Float[Tensor, "N m"], blocks: HeldOutBlocks
) -> list[list[list[_Step]]]:
    """For each fold, for each number of columns, for each penalty, the fit to the other folds."""
    folds = len(blocks.train)
    # samples that the same folds train on go into one product
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
    """Weighted products of tangents and residual, which comes last."""
    part = torch.cat([problem.tangents[rows], problem.residual.reshape(-1, 1)[rows]], -1)
    part.mul_(weights[rows].sqrt().unsqueeze(-1))
    return part.mT @ part


def _path(problem: _Problem, smooth: Smooth, train: Tensor, held: Tensor, allowed: Sequence[bool]) -> list[list[_Step]]:
    """Take up one column after the other, whichever gains most by Akaike's criterion."""
    P = len(problem.rough)
    gradient = problem.pulled(train[:P, P])
    everything = problem.penalised(train[:P, :P], torch.arange(P), _MIDDLE)
    index = torch.arange(smooth.own)
    groups: tuple[int, ...] = ()
    path: list[list[_Step]] = []
    while True:
        path.append([_fit(problem, train, held, gradient, groups, index, item) for item in _PENALTIES])
        free = [k for k in range(len(smooth.groups)) if allowed[k] and k not in groups]
        if len(groups) == _MOST or not free:
            return path
        # beside what is in already
        across = everything[:, index]
        solved = torch.linalg.solve(across[index], torch.cat([across.mT, gradient[index, None]], -1))
        beside, left = everything - across @ solved[:, :-1], gradient - across @ solved[:, -1]
        gain = [_gain(beside, left, smooth.groups[k]) for k in free]
        best = free[max(range(len(free)), key=gain.__getitem__)]
        groups, index = (*groups, best), torch.cat([index, smooth.groups[best]])


def _gain(beside: Tensor, left: Tensor, group: Tensor) -> float:
    step = torch.linalg.solve(beside[group.unsqueeze(-1), group], left[group])
    return 0.5 * float(left[group] @ step) - len(group)


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
    one = torch.cat([delta, delta.new_ones(1)])
    seen = torch.cat([index, index.new_tensor([len(held) - 1])])
    return _Step(groups, index, delta, strength, float(one @ held[seen.unsqueeze(-1), seen] @ one))


def _chosen(paths: Sequence[Sequence[Sequence[_Step]]]) -> list[_Step]:
    """Of each fold the fit of as many columns and of that penalty which do best on the other folds.

    As few columns as are within a standard error of the best, if that is a small share of the loss.

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
    """Reweighted by densities of their own, on the shared domain, and scored on the fold that was left out."""
    residual, bound = problem.residual, fit.bound / fit.d
    used = torch.stack(blocks.train).unsqueeze(-1).to(residual)
    columns = [problem.tangents[:, step.index] for step in chosen]
    left = torch.stack([_moved(residual, c, s.delta) for c, s in zip(columns, chosen, strict=True)])
    sigma, d = fit.sigma.expand(len(chosen), -1), torch.ones_like(left[:, 0])
    for _ in range(_ROUNDS):
        weights = used * mkc_weight(left, sigma.unsqueeze(1), d.unsqueeze(1)) / d.square().unsqueeze(1)
        left = torch.stack([_reweighted(problem, c, s, w) for c, s, w in zip(columns, chosen, weights, strict=True)])
        weight = used.expand_as(left)
        # a curve that runs away on one fold leaves more than the domain holds
        room = bound.maximum(_REACH * robust_scale(left, weight).amax(0))
        density = fit_density(left, bound=room, weight=weight, tol=1e-6)
        sigma, d = density.sigma, density.d
    score = torch.stack(
        [scored(e, s, size * fit.d, fit.bound) for e, s, size in zip(left * fit.d, sigma, d, strict=True)]
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
