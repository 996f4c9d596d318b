"""The running median by a sorted window equals the median of each window."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import median_filter

from mkc_torch.diagnosis.noise.outliers import running_median


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=40), st.integers(0, 39))
def test_the_running_median_is_the_median_of_each_window(values, half):
    half = min(half, len(values) - 1)
    found = running_median(torch.tensor(values, dtype=torch.float64).unsqueeze(-1), half)
    expected = median_filter(torch.tensor(values, dtype=torch.float64).numpy(), 2 * half + 1, mode="mirror")
    assert found.flatten().tolist() == expected.tolist()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_channels_are_independent(dtype):
    values = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    values[10:14, 1] = 0.0
    found = running_median(values, 4)
    assert found.dtype == dtype
    for k in range(3):
        assert torch.equal(found[:, k : k + 1], running_median(values[:, k : k + 1], 4))
