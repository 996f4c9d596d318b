"""The corrected model: the simulation with the findings that count."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from mkc_torch._parallel.deadline import within
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.held_out import Evidence, held_out, on_all
from mkc_torch.diagnosis.evidence.prediction import sizes_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted, fitted_like, without_term
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.parts import Finding, HeldOutScore, OutputSize
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.nonlinear import NoFitError

_WITHOUT = "fitting the model without the findings that are not confirmed"
"""Name of the step in a warning."""


_WIDE = 3.0
"""Half-width of a wider domain, in robust scales of the residual at the start."""


@dataclass(frozen=True)
class CorrectedModel:
    """The simulation with the findings that count.

    Attributes:
        exported: the fit that model.json and corrected.py are written from.
        fit: the fit that figures and scores are taken from, in open loop where that is known.
        evidence: its scores on held-out blocks, or on all samples if these are not used.
    """

    exported: FittedModel
    fit: FittedModel
    evidence: Evidence


def corrected_model(
    alone: FittedModel, case: EvidenceContext, kept: Collection[int], *, limit_s: float | None = None
) -> CorrectedModel:
    """Return the corrected model with its scores.

    Args:
        alone: the fit of the simulation alone.
        case: the fits and scores with 0, 1, ... findings, and the final parameters.
        kept: numbers of the findings that count.
        limit_s: time limit in s for the scores, after a stop; None for no limit.
    """
    final = case.final.fit
    exported = counted_fit(final, alone, kept)
    if exported is final:
        return CorrectedModel(exported, final, case.held_out[-1])
    if exported is alone:
        return CorrectedModel(exported, case.base, case.held_out[0])
    first = next(number for number in range(len(final.model.terms)) if number not in kept)
    leading = case.held_out[first]  # with the findings before the first that does not count
    same = [term.key for term in case.fits[first].model.terms] == [term.key for term in exported.model.terms]
    if len(kept) == first and same:
        return CorrectedModel(exported, exported, leading)

    def scores() -> Evidence:
        return held_out(exported, case.blocks) if len(leading.parameters) > 1 else on_all(exported)

    if limit_s is not None:
        return CorrectedModel(exported, exported, within(limit_s, scores) or leading)
    return CorrectedModel(exported, exported, optional(_WITHOUT, scores, lambda: leading))


def counted_fit(final: FittedModel, alone: FittedModel, kept: Collection[int]) -> FittedModel:
    """Return the fit with some of the effects of the final model, each fitted again without the others.

    Args:
        final: the fit with all effects.
        alone: the fit of the simulation alone.
        kept: numbers of the effects to keep, in the order of the final model's terms.

    Returns:
        The final fit if all are kept, and that of the simulation alone if none is, or if the fit fails.
    """
    left_out = [number for number in range(len(final.model.terms)) if number not in kept]
    if not left_out:
        return final
    if not kept:
        return alone
    start = final
    for number in reversed(left_out):
        start = without_term(start, number)
    return optional(_WITHOUT, lambda: _refitted(start, final), lambda: alone)


def _refitted(start: FittedModel, final: FittedModel) -> FittedModel:
    """Fit a model with fewer effects; from a start that is beyond the domain of the final fit in two steps."""
    try:
        return fitted_like(start.model, start.parameters, final)
    except NoFitError:
        residual = start.model.residual(start.parameters).detach()
        near = fitted(start.model, start.parameters, final.bound.maximum(_WIDE * robust_scale(residual)))
        return fitted(start.model, near.parameters, final.bound, graduate=False)


def scores_of(case: EvidenceContext, corrected: CorrectedModel) -> tuple[HeldOutScore, HeldOutScore]:
    """Return the scores of the simulation without findings and of the corrected model, on the same blocks."""
    before = case.held_out[0]
    sizes, _ = sizes_of(case.prepared, case.units, before, corrected.evidence, case.blocks)
    return (
        case.spread(before, {name: OutputSize(size.before, size.unit) for name, size in sizes.items()}),
        case.spread(corrected.evidence, {name: OutputSize(size.after, size.unit) for name, size in sizes.items()}),
    )


def left_out_note(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return a note on the findings that the corrected model leaves out; empty if there are none.

    Example:
        >>> left_out_note([])
        ()
    """
    names = ", ".join(f"`{finding.effect}`" for finding in findings if not counts(finding))
    return (f"The exported model leaves out {names}: not confirmed.",) if names else ()
