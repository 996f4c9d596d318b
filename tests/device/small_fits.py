"""Batches of small fits on a device: errors, agreement with the CPU in float64, and microseconds of a fit."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.linear._estimator import LinearEstimator
from tests.device.modes import synchronise
from tests.estimators import estimators

_GOALS = {
    "FixedPointLinear": 2.0,
    "MKCRegression": 5.0,
    **dict.fromkeys(("LeastAbsoluteDeviations", "SRegression", "MMRegression", "LeastTrimmedSquares"), 20.0),
}

ESTIMATORS: dict[str, tuple[Callable[[], LinearEstimator], float]] = {
    name: (make, _GOALS.get(name, math.inf)) for name, make in estimators(1.0).items()
}
"""Estimators with the goal of microseconds a fit at 100,000 problems of 100 x 2."""

GOAL_OF_SIX = 100.0
"""Microseconds of a fit at 2,000 problems of 300 x 6."""


def problems(device: torch.device, count: int, N: int, n: int) -> tuple[Tensor, Tensor]:
    """Regressors with an intercept and targets, 10 % of them wrong; the same on every device."""
    generator = torch.Generator().manual_seed(1)
    X = torch.randn(count, N, n, generator=generator, dtype=torch.float64)
    X[..., 0] = 1.0
    y = X.sum(-1) + torch.randn(count, N, generator=generator, dtype=torch.float64)
    y[..., : N // 10] += 20.0
    return X.to(device), y.to(device)


def seconds_of(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of the second of two runs."""
    for _ in range(2):
        synchronise(device)
        start = time.perf_counter()
        work()
        synchronise(device)
        taken = time.perf_counter() - start
    return taken


def standard_errors(X: Tensor, y: Tensor, coef: Tensor) -> Tensor:
    """Rough standard errors of coefficients (B, n), from the median absolute residual."""
    residual = y - torch.matmul(X, coef.unsqueeze(-1)).squeeze(-1)
    scale = 1.4826 * residual.abs().median(-1).values
    inverse = torch.linalg.inv(torch.matmul(X.mT, X))
    return scale.unsqueeze(-1) * inverse.diagonal(dim1=-2, dim2=-1).sqrt()


def objective_of(fit: LinearEstimator) -> Tensor | None:
    """What a fit makes small, (B,), where it has an attribute for that."""
    for name, sign in (("objective_", 1.0), ("log_likelihood_", -1.0), ("entropy_", 1.0)):
        if hasattr(fit, name):
            value: Tensor = sign * getattr(fit, name)
            return value.cpu().double().reshape(value.shape[0], -1).sum(-1)
    return None


def agreement(make: Callable[[], LinearEstimator], fit: LinearEstimator, X: Tensor, y: Tensor) -> tuple[float, bool]:
    """Share of problems whose coefficients are the CPU's to 1e-5 standard errors, and whether the others are no worse.

    Others count as no worse where the objective is lower than the CPU's plus a millionth of it.
    """
    reference = make().fit(X, y)
    some = len(y)
    off = (fit.coef_[:some].cpu().double() - reference.coef_).abs() / standard_errors(X, y, reference.coef_)
    near = off.amax(-1) <= 1e-5
    found, expected = objective_of(fit), objective_of(reference)
    if found is None or expected is None:
        return float(near.double().mean()), float(near.double().mean()) >= 0.999
    worse = ~near & (found[:some] > expected + 1e-6 * expected.abs().clamp(min=1.0))
    return float(near.double().mean()), float(worse.double().mean()) <= 1e-3


def print_small_fits(device: torch.device, *, many: int, few: int, compared: int, ellipsoids: int) -> bool:
    """Print microseconds a fit, their ratio to the goal, and the agreement. Returns whether all is right."""
    right = True
    print(f"  {'':26}{'us a fit':>10}{'goal':>8}{'ratio':>8}{'to 1e-5 se':>12}")
    for count, N, n in ((many, 100, 2), (few, 300, 6)):
        print(f"  {count} problems of {N} x {n}", flush=True)
        X, y = problems(device, count, N, n)
        for name, (make, goal) in ESTIMATORS.items():
            goal = goal if n == 2 or goal == math.inf else GOAL_OF_SIX
            estimator = make()
            # its Chebyshev fits take seconds for thousands of problems
            part = max(1, count // 10) if name == "LeastMedianOfSquares" and n > 2 else count
            try:
                taken = 1e6 * seconds_of(functools.partial(estimator.fit, X[:part], y[:part]), device) / part
            except (RuntimeError, ValueError) as error:
                print(f"  {name:26}{type(error).__name__}: {str(error).splitlines()[0][:80]}", flush=True)
                right = False
                continue
            some = min(compared if n == 2 else compared // 20 + 1, part)
            share, no_worse = agreement(make, estimator, X[:some].cpu(), y[:some].cpu())
            right = right and no_worse
            text = "" if no_worse else "  WORSE than the CPU's"
            print(f"  {name:26}{taken:10.2f}{goal:8.0f}{taken / goal:8.2f}{share:12.4f}{text}", flush=True)
    return print_ellipsoids(device, ellipsoids) and right


def print_ellipsoids(device: torch.device, count: int, points: int = 500, part: int = 20_000) -> bool:
    """Print the seconds of ellipsoid fits in parts, compared with a minute for a million."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.randn(min(part, count), points, 3, generator=generator, dtype=torch.float64)
    unit = unit / torch.linalg.vector_norm(unit, dim=-1, keepdim=True)
    noise = 0.2 * torch.randn(unit.shape, generator=generator, dtype=torch.float64)
    cloud = (unit * torch.tensor([40.0, 50.0, 60.0]) + torch.tensor([1.0, 2.0, 3.0]) + noise).to(device)
    centre = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    EllipsoidFit().fit(cloud[: min(100, count)])  # compiles
    synchronise(device)
    start = time.perf_counter()
    done, off = 0, 0.0
    while done < count:
        some = cloud[: min(part, count - done)]
        fit = EllipsoidFit().fit(some)
        off = max(off, float((fit.center_.cpu() - centre).abs().max()))
        done += len(some)
        taken = time.perf_counter() - start
        if taken > 30.0:  # the rest is extrapolated
            break
    whole = taken * 1e6 / done
    print(
        f"  ellipsoids of {points} points: {done} in {taken:.1f} s, a million in {whole:.0f} s, goal 60, off {off:.2f}"
    )
    return off < 1.0
