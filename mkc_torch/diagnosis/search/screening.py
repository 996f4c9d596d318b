"""Screening after a finding: usually there is no further finding, and a search with refits is slow."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.diagnosis.search.p_value import surrogate_p_value
from mkc_torch.diagnosis.search.quick import any_pays
from mkc_torch.diagnosis.search.run import SearchResult

__all__ = ["screening_p_value"]


def screening_p_value(
    located: SearchResult, possible: Sequence[bool], surrogates: int, generator: torch.Generator, *, quick: bool = False
) -> float:
    """Return the p-value of the strongest further candidate, in the linearisation of the search for an effect.

    Candidates, noise and mask are those of that search. The effect's tangents are projected out of everything, like
    those of the simulation's parameters. Nothing is refitted.

    Args:
        located: the effect.
        possible: whether each of its ``terms`` would be a further finding.
        surrogates: number of surrogates.
        generator: of the surrogates.
        quick: draw none; test whether a candidate gains more than its penalty.

    Returns:
        0 if an effect acts through a trajectory: there refits can find what the linearisation does not.
    """
    scene, own = located.scene, located.fit.model.terms[-1]
    if any(scene.is_nonlinear(term) for term in (*scene.terms, own)):
        return 0.0
    remaining = located.look.given(own, located.fit)
    mask = torch.tensor(list(possible)) & remaining.possible
    if not bool(mask.any()):
        return 1.0
    if quick:
        return any_pays(remaining, mask)
    noise = scene.settings.noise
    return surrogate_p_value(
        remaining.linearised, remaining.noise, remaining.gains, mask, surrogates, generator, noise
    )[0]
