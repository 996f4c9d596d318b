"""A special case in place of a general form that held-out blocks do not prefer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import NamingSettings
from mkc_torch.nonlinear import NoFitError

REACH = 2.0
"""Limits of separability within which a special case is compared on held-out blocks: a Bayes factor of 8,000.

The likelihoods are those under each fit's own noise, whose sizes and correlation times are estimated too. Beyond this
distance that estimate cannot account for the difference. Judgement, checked on recordings of a sled
(`python -m tests.thresholds.open_loop --systems sled`, seeds 0 to 3): with a drag of exponent 1.5 the quadratic drag is
19 to 49 nats behind the power law, twice this distance at least, and blocks prefer the power law, in 4 of 4. With
quadratic drag in thinning air the quadratic drag is most likely itself in 3 of 4, and not compared in the fourth.
"""

Scores = Callable[[FittedModel], Evidence]
"""A fit's evidence on held-out blocks."""


def with_special_case(
    located: SearchResult, scores: Scores, blocks: HeldOutBlocks, seed: int, settings: NamingSettings
) -> SearchResult:
    """Return the search result with the most likely special case first, unless held-out blocks prefer the general form.

    A general form, such as a power of the speed with any exponent, follows the errors of a nearly right special case,
    such as drag in air whose density falls. Both remain candidates that the recording does not distinguish.

    Args:
        located: the search result, of a general form or not.
        scores: evidence of a fit on the held-out blocks.
        blocks: the held-out blocks.
        seed: of the interval's bootstrap.
        settings: limit of separability.
    """
    if not located.term.effect.is_generalisation:
        return located
    terms = located.scene.terms
    gaps = {terms[rival.number].key: rival.gap for rival in located.ranking}
    near = [
        fit
        for fit in located.compared
        if fit.model.terms[-1].port == located.term.port
        and not (fit.model.terms[-1].effect.is_generalisation or fit.model.terms[-1].effect.is_curve)
        and gaps.get(fit.model.terms[-1].key, torch.inf) < REACH * settings.separable
    ]
    if not near:
        return located
    special = min(near, key=lambda fit: gaps[fit.model.terms[-1].key])
    try:
        difference = scores(located.fit).log_likelihood - scores(special).log_likelihood
    except NoFitError:
        return located
    _, (low, _) = gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))
    if low > 0.0:
        return located
    alike = {special.model.terms[-1].key, located.term.key}
    moved = [replace(rival, gap=0.0) if terms[rival.number].key in alike else rival for rival in located.ranking]
    key = special.model.terms[-1].key
    ranking = tuple(sorted(moved, key=lambda rival: (rival.gap, terms[rival.number].key != key)))
    return replace(located, fit=special, term=special.model.terms[-1], ranking=ranking)
