"""One robust fit of many rows on a device: its time in units of the normal equations, and agreement with the CPU."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from mkc_torch.linear import MKCRegression
from tests.device.modes import synchronise

COLUMNS = 9

REPEATS = 5
"""Number of timings; the least is printed."""

TOLERANCE = 1e-3
"""Largest difference from the CPU's coefficients, in standard errors; those of float32 data are rounded to float32."""


def sample(rows: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """X (rows, 9) with an intercept, and y of which a tenth lies 20 higher."""
    generator = torch.Generator(device).manual_seed(0)
    X = torch.randn(rows, COLUMNS, generator=generator, device=device, dtype=dtype)
    X[:, 0] = 1.0
    y = X.sum(-1) + torch.randn(rows, generator=generator, device=device, dtype=dtype)
    y[: rows // 10] += 20.0
    return X, y


def least_milliseconds(work: Callable[[], object], device: torch.device) -> float:
    """The least time of a few runs after a first run, which compiles."""
    work()
    best = float("inf")
    for _ in range(REPEATS):
        synchronise(device)
        start = time.perf_counter()
        work()
        synchronise(device)
        best = min(best, 1e3 * (time.perf_counter() - start))
    return best


def difference_in_standard_errors(fit: MKCRegression, other: MKCRegression) -> float:
    """Largest difference of the coefficients, in standard errors."""
    difference = fit.coef_.cpu().double() - other.coef_.double()
    return float((difference.abs() / other.standard_error_.double()).max())


def print_rows(device: torch.device, sizes: tuple[int, ...]) -> bool:
    """Print times and agreement of fits of ``sizes`` rows in both precisions; whether all agree with the CPU's."""
    print(f"  {'rows x 9':>12} {'dtype':8}{'fit, ms':>10}{'normal equations':>18}{'ratio':>8}{'apart, s.e.':>13}")
    agree = True
    for rows in sizes:
        for dtype in (torch.float32, torch.float64):
            X, y = sample(rows, dtype, device)
            taken = least_milliseconds(lambda: MKCRegression().fit(X, y), device)  # noqa: B023 - called in this round of the loop
            normal = least_milliseconds(lambda: torch.linalg.solve(X.mT @ X, X.mT @ y), device)  # noqa: B023 - called in this round of the loop
            # the domain, which depends on the pilot's rounding, is that of the device
            fit = MKCRegression().fit(X, y)
            own = difference_in_standard_errors(fit, MKCRegression(bound=fit.bound_.cpu()).fit(X.cpu(), y.cpu()))
            agree = agree and own < TOLERANCE
            name = str(dtype).removeprefix("torch.")
            print(f"  {rows:>12} {name:8}{taken:10.1f}{normal:18.2f}{taken / normal:8.0f}{own:13.1e}", flush=True)
    return agree
