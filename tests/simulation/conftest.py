"""Forward mode, loaded once: torch warns of a deprecation of its own at the first use."""

import warnings

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def _forward_mode():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (torch.ones(1),), (torch.ones(1),))
