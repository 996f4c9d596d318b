"""Candidates beside pushes of any size: what each gains once the pushes that it makes needless are gone.

Under the pushes that are likeliest without an effect all that it does could be a push, and little is left to be gained.
So the likelihood with a candidate and that without one are each taken at their own size of the pushes, of the recording
and of the draws alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.tangents import Tangents
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.simulation.dynamics.observer import Observer
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.rescaled import rescaled, unclipped

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Profiled", "profiled"]

SHARES = (1.0, 0.4, 0.15, 0.05, 0.015, 0.0)
"""Of the pushes' sizes."""

_SINGULAR = 1e-9
"""Share of a candidate's squares, or of their largest eigenvalue, below which a direction of it is none."""


@dataclass(frozen=True)
class Profiled:
    """What candidates gain.

    Attributes:
        gain: (C,), in nats, at each candidate's own size of the pushes.
        dof: (C,), its numbers.
        share: (C,), that size.
        gamma: of each at that size.
        shift: (C, p), by how much the simulation's parameters then move.
        p_value: of the strongest, after the whole search.
        beyond: nats by which it is beyond the strongest of the draws.
        rarity: (1 + draws,), of the strongest candidate, of the recording and of each draw, in standard deviations.
        observers: for the pushes that each leaves.
    """

    gain: Float[Tensor, " C"]
    dof: Float[Tensor, " C"]
    share: Float[Tensor, " C"]
    gamma: tuple[Tensor, ...]
    shift: Float[Tensor, "C p"]
    p_value: float
    beyond: float
    rarity: Float[Tensor, " B"]
    observers: tuple[Observer | None, ...]

    def longer(self, level: float) -> float:
        """Times as long a recording has to be for its strongest candidate to be beyond the level, if it is there."""
        own, needed = float(self.rarity[0]), float(torch.quantile(self.rarity[1:], 1.0 - level))
        return (needed / own) ** 2 if own > 0.0 else torch.inf


def profiled(
    base: FittedModel,
    terms: Sequence[Term],
    tangents: Tangents,
    residual: Float[Tensor, "N m"],
    counts: Float[Tensor, "N m"],
    draws: int,
    generator: torch.Generator,
) -> Profiled | None:
    """The search beside a fit under pushes; None where its trajectory is lost.

    Args:
        base: the fit.
        terms: candidates.
        tangents: of the fit's parameters and the candidates.
        residual, counts: its innovations, and what counts of them.
        draws: of noise, each with the innovations' sizes and signs of its own.
        generator: of the draws.
    """
    prepared, model = base.model.prepared, base.model
    assert isinstance(prepared, PreparedDynamics)
    theta, changes = base.parameters[: model.base], model.changes(base.parameters)
    maps = rescaled(prepared, theta, changes, model.near, SHARES, counts)
    linear = unclipped(prepared, theta, changes, model.near, counts)
    if not maps or linear is None:
        return None
    values = linear[0](residual)
    sign = 2.0 * torch.randint(2, (*values.shape, draws), generator=generator).to(values.dtype) - 1.0
    scale = (counts * values.square()).sum(0).div(counts.sum(0).clamp(min=1.0)).sqrt()
    series = torch.cat([values.unsqueeze(-1), sign * values.unsqueeze(-1)], -1)
    sizes = [one.shape[-1] for one in tangents.candidates]
    columns = torch.cat([series, linear[1](torch.cat([tangents.nuisance, *tangents.candidates], -1))], -1)
    C, B = len(terms), 1 + draws
    null, best = values.new_full((B,), -torch.inf), values.new_full((C, B), -torch.inf)
    share = values.new_zeros(C)
    gamma: list[Tensor] = [values.new_zeros(size) for size in sizes]
    shift = values.new_zeros(C, model.size)
    dof = values.new_zeros(C)
    # of several outputs each is on its own scale
    weight = (counts / scale.clamp(min=1e-300)).unsqueeze(-1)
    for part, one in zip(SHARES, maps, strict=True):
        moved = (weight * one(columns)).flatten(0, 1)
        if not bool(moved.isfinite().all()):
            continue
        y, own, candidates = moved[:, :B], moved[:, B : B + model.size], moved[:, B + model.size :]
        size = torch.linalg.vector_norm(own, dim=0).clamp(min=1e-300)
        basis = _orthonormal(own / size)
        left = y - basis @ (basis.mT @ y)
        rest = candidates - basis @ (basis.mT @ candidates)
        power = left.square().sum(0)
        n = float(counts.sum()) - basis.shape[1]
        null = torch.maximum(null, -0.5 * n * power.clamp(min=1e-300).log())
        place = 0
        for number, width in enumerate(sizes):
            directions, whole = rest[:, place : place + width], candidates[:, place : place + width]
            place += width
            norm = torch.linalg.vector_norm(whole, dim=0).clamp(min=1e-300)
            gram = (directions / norm).mT @ (directions / norm)
            inner = (directions / norm).mT @ left
            inverse = torch.linalg.pinv(gram, hermitian=True, atol=_SINGULAR, rtol=_SINGULAR)
            solved = inverse @ inner
            if terms[number].effect.one_sided:
                inner = torch.where((solved < 0).any(0), inner, 0.0)
            explained = (inner * solved).sum(0)
            value = -0.5 * n * (power - explained).clamp(min=1e-12 * power).log()
            if float(value[0]) > float(best[number, 0]):
                share[number], gamma[number] = part, -solved[:, 0] / norm
                against = torch.linalg.lstsq(own / size, (y[:, 0] - whole / norm @ solved[:, 0]).unsqueeze(-1)).solution
                shift[number] = -against.squeeze(-1) / size
            best[number] = torch.maximum(best[number], value)
            dof[number] = max(float(dof[number]), float(torch.linalg.matrix_rank(gram, atol=_SINGULAR, rtol=_SINGULAR)))
    ratio = 2.0 * (best - null)
    # a gain is as rare as its numbers make it: Wilson and Hilferty's root makes them alike
    k = dof.clamp(min=1.0).unsqueeze(-1)
    rarity = ((ratio.clamp(min=0.0) / k).pow(1.0 / 3.0) - 1.0 + 2.0 / (9.0 * k)) / (2.0 / (9.0 * k)).sqrt()
    rarity = torch.where(dof.unsqueeze(-1) > 0, rarity, -torch.inf)
    strongest = rarity.amax(0)
    p_value = float((strongest >= strongest[0]).double().mean())
    beyond = 0.5 * float(strongest[0].clamp(min=0.0).square() - strongest[1:].amax().clamp(min=0.0).square())
    observers = {part: one.other if part > 0 else None for part, one in zip(SHARES, maps, strict=True)}
    kept = tuple(observers[min(SHARES, key=lambda part: abs(part - float(one)))] for one in share)
    return Profiled(0.5 * ratio[:, 0], dof, share, tuple(gamma), shift, p_value, beyond, strongest, kept)


def _orthonormal(columns: Float[Tensor, "M p"]) -> Float[Tensor, "M k"]:
    basis, size, _ = torch.linalg.svd(columns, full_matrices=False)
    return basis[:, size > 1e-10 * size.max().clamp(min=1e-300)]
