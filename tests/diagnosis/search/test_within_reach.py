"""Candidates far behind the first are not refitted."""

import dataclasses

from mkc_torch.diagnosis.search.ranking import within_reach
from mkc_torch.diagnosis.settings import SearchSettings


def test_candidates_far_behind_are_not_refitted():
    settings = dataclasses.replace(SearchSettings(), behind=50.0)
    assert within_reach([400.0, 151.0, 149.0], settings) == [True, True, False]
    # a candidate without a gain sets no share for the others
    assert within_reach([-10.0, -59.0, -61.0], settings) == [True, True, False]
