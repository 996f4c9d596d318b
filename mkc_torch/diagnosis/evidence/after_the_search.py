"""What is told of findings once they are known, in parts that need nothing of one another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from mkc_torch.diagnosis.evidence.ceiling import Ceiling, ceiling
from mkc_torch.diagnosis.evidence.driver_shift import shifted
from mkc_torch.diagnosis.evidence.extrapolation import extrapolated
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval, held_out
from mkc_torch.diagnosis.evidence.onset import onset_interval
from mkc_torch.diagnosis.evidence.remaining import remaining
from mkc_torch.diagnosis.evidence.stand_in import stand_in_warning
from mkc_torch.diagnosis.linearised.estimate import Estimate, estimate
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import FittedModel, without_term
from mkc_torch.diagnosis.model.side_by_side import memory_kept
from mkc_torch.diagnosis.result import DriverShift, Extrapolation
from mkc_torch.diagnosis.search.locate import Located

__all__ = ["Beyond", "Ending", "ending_parts", "nameless"]


@dataclass(frozen=True)
class Beyond:
    """What a finding is worth where its driver is high, and when it is moved; and how sure its onset is.

    ``without`` is the evidence of the final model without it, where what was found later may have hidden its gain.
    """

    extrapolation: Extrapolation | None
    driver_shift: DriverShift | None
    onset_interval: tuple[float, float] | None
    without: Evidence | None


@dataclass(frozen=True)
class Ending:
    """The parts, in the order of :func:`ending_parts`.

    Attributes:
        stand_in: a warning of a column that only goes much as the cause does.
        beyond: of each finding.
        within_reach: the ceiling of any fit, and the columns along which something smooth remains.
        final: the final parameters.
    """

    stand_in: tuple[str, ...]
    beyond: tuple[Beyond, ...]
    within_reach: tuple[Ceiling, tuple[str, ...]]
    final: Estimate

    @property
    def reach(self) -> Ceiling:
        return self.within_reach[0]

    @property
    def left(self) -> tuple[str, ...]:
        return self.within_reach[1]


def ending_parts(
    base: FittedModel,
    found: Sequence[Located],
    evidence: Sequence[Evidence],
    blocks: HeldOutBlocks,
    drivers: Sequence[Driver],
    seed: int,
) -> list[Callable[[], Any]]:
    """Works that give the parts of an :class:`Ending`; the last one takes longest.

    Args:
        base: the simulation alone.
        found: what was found.
        evidence: of the simulation alone, and with one finding more each.
        blocks: of the evidence.
        drivers: the columns.
        seed: of the bootstraps.
    """
    fits = [base, *(one.fit for one in found)]
    fit = fits[-1]

    def beyond() -> tuple[Beyond, ...]:
        return tuple(
            _beyond(without, fit, one, k, evidence, blocks, seed)
            for k, (without, one) in enumerate(zip(fits, found, strict=False))
        )

    def within_reach() -> tuple[Ceiling, tuple[str, ...]]:
        reach = ceiling(base.model, _answerable(base, fit), drivers, blocks)
        left = () if nameless(fit) else remaining(reach, evidence[-1], fit, drivers, blocks, seed)
        return reach, left

    def final() -> Estimate:
        return estimate(fit).at_least(evidence[-1].jackknife)

    def begun(work: Callable[[], Any]) -> Any:
        with memory_kept(base.model.prepared):
            fit.model.residual(fit.parameters)  # to be the newest that a simulation remembers
            return work()

    return [partial(begun, work) for work in (partial(stand_in_warning, fit), beyond, within_reach, final)]


def _beyond(
    without: FittedModel,
    final: FittedModel,
    found: Located,
    number: int,
    evidence: Sequence[Evidence],
    blocks: HeldOutBlocks,
    seed: int,
) -> Beyond:
    model, term, fit = without.model, final.model.terms[number], found.fit
    beside = None
    if number < len(final.model.terms) - 1 and model.prepared.ports[term.port].clock is None:
        # what was found later belongs to both
        without, fit = without_term(final, number), final
        if not _confirmed(evidence[number], evidence[number + 1], blocks, seed):
            beside = held_out(without, blocks)
    return Beyond(extrapolated(without, fit, term, seed), shifted(model, found), onset_interval(model, found), beside)


def _confirmed(before: Evidence, after: Evidence, blocks: HeldOutBlocks, seed: int) -> bool:
    """Whether unseen blocks are surely better."""
    difference = after.log_likelihood - before.log_likelihood
    return gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))[1][0] > 0.0


def nameless(fit: FittedModel) -> bool:
    """Whether an effect is a curve over a driver that no physics of the catalogue accounts for."""
    return any(term.effect.is_curve for term in fit.model.terms)


def _answerable(base: FittedModel, final: FittedModel) -> FittedModel:
    """The final fit; that of the simulation alone, if it has no answer at the other's parameters."""
    alone = base.model.residual(final.parameters[: base.model.size])
    return final if bool(alone.isfinite().all()) else base
