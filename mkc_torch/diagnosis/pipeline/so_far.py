"""What a running diagnosis has found so far, in words for its progress."""

from __future__ import annotations

from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from mkc_torch.diagnosis.search.in_words import terms_in_words


def found_so_far(search: StepwiseSearch, level: float) -> str:
    """Return the findings of a search so far, or until models are compared the result of its screening; else empty.

    Args:
        search: the search so far.
        level: of its tests.
    """
    if search.found:
        return f"found {terms_in_words([located.term for located in search.found])}"
    if search.first is None or search.models:
        return ""
    if search.first.p_value > level:
        return "no effect is significant"
    return f"some effect is missing; strongest in the screening: {terms_in_words([search.first.term])}"
