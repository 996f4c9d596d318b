"""Rank candidates: each effect at its best shape, by its penalised gain."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from mkc_torch.diagnosis.model.term import Key, continuous
from mkc_torch.diagnosis.search.linearized import LinearizedSearch
from mkc_torch.diagnosis.search.model_prior import ModelPrior
from mkc_torch.diagnosis.search.ties import in_order

__all__ = ["Ranked", "ranked"]


@dataclass(frozen=True)
class Ranked:
    """A candidate at its best shape: its number in the list of candidates, gain in nats, and nats behind the first."""

    number: int
    gain: float
    gap: float


def ranked(look: LinearizedSearch, prefer: ModelPrior) -> tuple[Ranked, ...]:
    """Rank effects at their best possible shapes by gain, less 1 nat per parameter and shape number, less penalties."""
    terms, found = look.scene.terms, look.gains
    gain = 0.5 * found.ratio[:, 0]
    numbers = gain.new_tensor([float(len(continuous(term))) for term in terms])
    penalty = [prefer.penalty(term, float(nats)) for term, nats in zip(terms, gain, strict=True)]
    score = gain - found.dof - numbers - gain.new_tensor(penalty)
    score = torch.where((found.dof > 0) & look.possible, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in in_order(score.tolist(), terms):
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(number, float(gain[number]), float(score.max() - score[number])) for number in best.values())
