"""What was found under pushes, fitted to its free run again: what residuals are told of, and pictures show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out
from mkc_torch.diagnosis.model.at_once import at_once
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.in_the_world import freed, pushed
from mkc_torch.diagnosis.search.locate import Located
from mkc_torch.nonlinear import NoFitError

__all__ = ["RunningFreely", "running_freely"]


@dataclass(frozen=True)
class RunningFreely:
    """The simulation alone and with one finding more each, on all samples and on blocks that each fit has not seen."""

    base: FittedModel
    found: tuple[Located, ...]
    held_out: tuple[Evidence, ...]


def running_freely(
    base: FittedModel,
    alone: FittedModel | None,
    found: tuple[Located, ...],
    evidence: tuple[Evidence, ...],
    blocks: HeldOutBlocks,
) -> RunningFreely:
    """The free runs; what was found as it is, where one of them loses the recording.

    Args:
        base: the simulation alone, perhaps under pushes.
        alone: as it runs freely; None where that loses the recording.
        found: with one finding more each, under the pushes that are left.
        evidence: of these on blocks.
        blocks: the blocks.
    """
    as_it_is = RunningFreely(base, found, evidence)
    if not any(pushed(fit) for fit in (base, *(one.fit for one in found))):
        return as_it_is
    free = [alone, *(freed(one.fit) for one in found)]
    if any(one is None for one in free):
        return as_it_is
    fits = [one for one in free if one is not None]
    judged = at_once([partial(_judged, fit, blocks) for fit in fits], fits[0].model.prepared)
    if any(one is None for one in judged):
        return as_it_is
    again = tuple(replace(one, fit=fit) for one, fit in zip(found, fits[1:], strict=True))
    return RunningFreely(fits[0], again, tuple(one for one in judged if one is not None))


def _judged(fit: FittedModel, blocks: HeldOutBlocks) -> Evidence | None:
    try:
        return held_out(fit, blocks)
    except NoFitError:
        return None
