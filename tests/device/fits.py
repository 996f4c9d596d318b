"""Robust fits on a device: many rows, and batches of small problems."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from mkc_torch.linear._estimator import LinearEstimator
from tests.device.modes import synchronise
from tests.estimators import estimators

SHOWN = ("LeastSquares", "FixedPointLinear", "MKCRegression", "LeastAbsoluteDeviations", "MMRegression")
ESTIMATORS: dict[str, Callable[[], LinearEstimator]] = {name: estimators(0.1)[name] for name in SHOWN}


def problem(device: torch.device, *shape: int) -> tuple[Tensor, Tensor]:
    """Regressors (*, N, n) and targets (*, N), 10 % of them wrong."""
    generator = torch.Generator(device).manual_seed(0)
    X = torch.randn(shape, generator=generator, device=device)
    y = X.sum(-1) + 0.1 * torch.randn(shape[:-1], generator=generator, device=device)
    wrong = torch.rand(shape[:-1], generator=generator, device=device) < 0.1
    return X, torch.where(wrong, y + 10.0, y)


def print_fits(device: torch.device, *, large: int, many: int) -> None:
    """Print the time of a fit of many rows and of many small fits, or the error."""
    for name, make in ESTIMATORS.items():
        for what, shape in (("rows", (large, 9)), ("problems of 100 x 2", (many, 100, 2))):
            X, y = problem(device, *shape)
            start = time.perf_counter()
            try:
                make().fit(X, y)
                synchronise(device)
                found = f"{1e3 * (time.perf_counter() - start):10.1f} ms"
            except (RuntimeError, ValueError) as error:
                found = f"{type(error).__name__}: {str(error).splitlines()[0][:80]}"
            print(f"  {name:26}{shape[0]:9} {what:20}{found}", flush=True)
