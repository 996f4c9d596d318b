"""The model that is exported: the simulation with the findings that count."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from mkc_torch.diagnosis.model.fit import FittedModel, fitted, without_term
from mkc_torch.diagnosis.optional import optional
from mkc_torch.diagnosis.parts import Finding


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
    return optional(
        "fitting the model without the findings that are not confirmed",
        lambda: fitted(start.model, start.parameters, final.bound, graduate=False),
        lambda: alone,
    )


def left_out_note(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return a note on the findings that the exported model leaves out; empty if there are none.

    Example:
        >>> left_out_note([])
        ()
    """
    names = ", ".join(f"`{finding.effect}`" for finding in findings if not counts(finding))
    return (f"The exported model leaves out {names}: not confirmed.",) if names else ()


def counts(finding: Finding) -> bool:
    """Whether a finding belongs into a corrected model: it is confirmed, or was not tested and has a possible size."""
    untested = finding.held_out is None and not finding.cannot_be
    return finding.grade != "unconfirmed" or untested
