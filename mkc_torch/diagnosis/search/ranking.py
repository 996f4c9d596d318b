"""Candidates in their order: each physics at its best shape, by what it gains beyond its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.linearised.linear_search import Gains
from mkc_torch.diagnosis.linearised.linearise import Linearised
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Key, Term, continuous
from mkc_torch.diagnosis.search.preference import Preference

if TYPE_CHECKING:
    from jaxtyping import Bool

__all__ = ["SEPARABLE", "Ranked", "own_p", "possible_of", "ranked"]

SEPARABLE = 4.5
"""Nats by which a rival must be less likely to count as told apart: three standard errors of what sets them apart."""


@dataclass(frozen=True)
class Ranked:
    """A candidate at its best shape: number in the list of candidates, gain in nats, and nats behind the first."""

    number: int
    gain: float
    gap: float


def ranked(
    terms: tuple[Term, ...], found: Gains, prefer: Preference, possible: Bool[Tensor, " C"]
) -> tuple[Ranked, ...]:
    """By gain in nats less one for each parameter and each number of the shape (Akaike's criterion), each physics at
    its best possible shape."""
    gain = 0.5 * found.ratio[:, 0]
    numbers = gain.new_tensor([float(len(continuous(term))) for term in terms])
    handicap = [prefer.handicap(term, float(one)) for term, one in zip(terms, gain, strict=True)]
    score = gain - found.dof - numbers - gain.new_tensor(handicap)
    score = torch.where((found.dof > 0) & possible, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in score.argsort(descending=True).tolist():
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(number, float(gain[number]), float(score.max() - score[number])) for number in best.values())


def possible_of(terms: tuple[Term, ...], linearised: Linearised) -> Bool[Tensor, " C"]:
    """Whether the amplitudes that fit have a sign that the physics allows."""
    possible = torch.ones(len(terms), dtype=torch.bool)
    for number, term in enumerate(terms):
        if term.effect.one_sided:
            possible[number] = bool((linearised.search.estimate(number, linearised.series)[0] < 0).any())
    return possible


def own_p(found: Gains, terms: tuple[Term, ...], fit: FittedModel) -> float:
    """The p-value of a fit's candidate, as if it were the only one."""
    return float(found.log_p[terms.index(fit.model.terms[-1]), 0].exp())
