"""One thread a worker, so that workers do not fight over the cores; forward mode loaded once."""

import gc
import os
import warnings

import numpy  # noqa: F401 - its linear algebra can only be limited once it is there
import pytest
import torch
from _pytest.doctest import DoctestModule

from mkc_torch._parallel.processes import one_thread
from mkc_torch._support.side_by_side import forced

one_thread()
gc.set_threshold(100_000)  # collecting makes a million objects that stay

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read where Triton is imported, which torch's compiler may do in any test


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Tests hold no doctests: with --doctest-modules every one of their files would be collected twice."""
    return [item for item in (yield) if not isinstance(item, DoctestModule)]


SIDE_BY_SIDE = "cpu, side by side"
DEVICES = ("cpu", SIDE_BY_SIDE, *(f"cuda:{i}" for i in range(min(1, torch.cuda.device_count()))))


@pytest.fixture(params=DEVICES)
def device(request):
    """Every available device, and the CPU with problems computed in parallel, as on a GPU."""
    if request.param == SIDE_BY_SIDE:
        with forced():
            yield torch.device("cpu")
    else:
        yield torch.device(request.param)


@pytest.fixture(scope="session", autouse=True)
def _forward_mode():
    # torch warns of a deprecation of its own at the first use
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (torch.ones(1),), (torch.ones(1),))
