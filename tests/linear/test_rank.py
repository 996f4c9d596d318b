"""The tolerance of the rank test."""

import torch

from mkc_torch.linear._basis import rank_tolerance


def test_the_rank_test_accepts_many_rows_of_float32():
    assert rank_tolerance(10_000_000, 9, torch.float32) < 1e-2
    assert rank_tolerance(500, 9, torch.float64) == 500 * torch.finfo(torch.float64).eps
    assert rank_tolerance(5, 9, torch.float64) == 9 * torch.finfo(torch.float64).eps
