"""The kernels on a GPU if there is one, else under Triton's interpreter."""

import numpy as np
import pytest
import torch


def _release(package):
    """The first two numbers of a package's version."""
    return tuple(int(number) for number in package.__version__.split(".")[:2])


@pytest.fixture(scope="session")
def device():
    """A device that runs the kernels."""
    triton = pytest.importorskip("triton")
    if torch.cuda.is_available():
        return torch.device("cuda")
    from mkc_torch.losses.kernels.launch import kernels_are_interpreted

    if not kernels_are_interpreted():
        pytest.skip("the kernels were imported before TRITON_INTERPRET=1 was set")
    if _release(triton) < (3, 3) and _release(np) >= (2, 4):
        pytest.skip("the interpreter of Triton 3.2, of torch 2.6, needs NumPy below 2.4: pip install 'numpy<2.4'")
    return torch.device("cpu")
