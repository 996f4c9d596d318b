"""Kernels run on a GPU, or by Triton's interpreter on the CPU."""

import pytest
import torch

from tests.triton_interpreter import skip_without_interpreter


@pytest.fixture(scope="session")
def device():
    """A device that runs the kernels."""
    pytest.importorskip("triton")
    if torch.cuda.is_available():
        return torch.device("cuda")
    from mkc_torch.losses.kernels.launch import kernels_are_interpreted

    if not kernels_are_interpreted():
        pytest.skip("the kernels were imported before TRITON_INTERPRET=1 was set")
    skip_without_interpreter()
    return torch.device("cpu")
