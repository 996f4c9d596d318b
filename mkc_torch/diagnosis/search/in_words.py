"""Sets of effects in words, for the progress of a search."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.diagnosis.model.term import Term


def terms_in_words(terms: Sequence[Term]) -> str:
    """Return the names of effects with their places.

    Example:
        >>> from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
        >>> terms_in_words([Term(QuadraticDrag(), None, {}, "rate of speed")])
        'quadratic drag on the rate of speed'
    """
    return " + ".join(_in_words(term) for term in terms)


def _in_words(term: Term) -> str:
    by = f" by {', '.join(term.columns)}" if term.columns else ""
    each = " with a size for each recording" if term.effect.recordings else ""
    return f"{term.effect.display_name}{by} on the {term.port}{each}"


def leading(terms: Sequence[Term]) -> str:
    """Return the effects of the model that scores highest so far."""
    return f"{terms_in_words(terms)} scores highest, not yet tested" if terms else "the simulation alone scores highest"
