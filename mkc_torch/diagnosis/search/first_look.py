"""A first look beside a finding: most often there is nothing more, and a search with its refits takes long."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.diagnosis.linearised.tangents import candidate_tangents
from mkc_torch.diagnosis.search.locate import Located
from mkc_torch.diagnosis.search.p_value import judged
from mkc_torch.diagnosis.search.ranking import possible_of

__all__ = ["p_value_beside"]


def p_value_beside(located: Located, possible: Sequence[bool], surrogates: int, generator: torch.Generator) -> float:
    """The p-value of the strongest other candidate beside an effect, where the search for that effect linearised.

    The candidates, the noise and the samples that count are those of that search; the effect's own tangents are taken
    out of everything, as those of the simulation's parameters are. Nothing is fitted anew.

    Args:
        located: the effect.
        possible: whether each of its ``terms`` would be another finding.
        surrogates: draws of noise.
        generator: of the draws.

    Returns:
        0 where an effect may bend a trajectory: there refits find what straight lines do not.
    """
    model, pointwise = located.fit.model, located.tangents.pointwise
    if any(pointwise[term.port] is None for term in (*located.terms, model.terms[-1])):
        return 0.0
    own = candidate_tangents(model, located.fit.parameters, model.terms[-1:], pointwise)
    beside = located.linearised.without(own, located.counts)
    mask = torch.tensor(list(possible)) & possible_of(located.terms, beside)
    if not bool(mask.any()):
        return 1.0
    noise = beside.search.noise_fit(beside.series)
    found = beside.search.gains(beside.series.unsqueeze(-1))
    return judged(beside, noise, found, mask, surrogates, generator)[0]
