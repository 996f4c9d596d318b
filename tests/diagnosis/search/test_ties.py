"""Ties between candidates do not depend on rounding."""

import math
from types import SimpleNamespace

import pytest

from mkc_torch.diagnosis.search.ranking import in_order

PLAIN, SHAPED = SimpleNamespace(shape={}), SimpleNamespace(shape={"surface": 15.7, "draught": 3.9})


@pytest.mark.parametrize("bits", [-4e-13, 0.0, 4e-13])
def test_the_simpler_of_two_equal_candidates_is_first_in_either_order(bits):
    assert in_order([20.4 + bits, 20.4], [SHAPED, PLAIN]) == [1, 0]
    assert in_order([20.4, 20.4 + bits], [PLAIN, SHAPED]) == [0, 1]


def test_equal_candidates_keep_their_order():
    assert in_order([3.0, 3.0 + 1e-12, 3.0], [PLAIN] * 3) == [0, 1, 2]


def test_the_better_candidate_is_first_whatever_its_shape():
    terms = [PLAIN, SHAPED, PLAIN, SHAPED]
    assert in_order([1.0, 1.001, -math.inf, math.inf], terms) == [3, 1, 0, 2]
