"""A first look beside a finding: most often there is nothing more, and a search with its refits takes long."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.diagnosis.search.p_value import judged
from mkc_torch.diagnosis.search.quick import any_pays
from mkc_torch.diagnosis.search.run import SearchResult

__all__ = ["p_value_beside"]


def p_value_beside(
    located: SearchResult, possible: Sequence[bool], surrogates: int, generator: torch.Generator, *, quick: bool = False
) -> float:
    """The p-value of the strongest other candidate beside an effect, where the search for that effect linearised.

    The candidates, the noise and the samples that count are those of that search; the effect's own tangents are taken
    out of everything, as those of the simulation's parameters are. Nothing is fitted anew.

    Args:
        located: the effect.
        possible: whether each of its ``terms`` would be another finding.
        surrogates: draws of noise.
        generator: of the draws.
        quick: draw none; ask whether one gains more than its price.

    Returns:
        0 where an effect may bend a trajectory: there refits find what straight lines do not.
    """
    scene, own = located.scene, located.fit.model.terms[-1]
    if any(scene.bends(term) for term in (*scene.terms, own)):
        return 0.0
    beside = located.look.beside(own, located.fit)
    mask = torch.tensor(list(possible)) & beside.possible
    if not bool(mask.any()):
        return 1.0
    if quick:
        return any_pays(beside, mask)
    noise = scene.settings.noise
    return judged(beside.linearised, beside.noise, beside.gains, mask, surrogates, generator, noise)[0]
