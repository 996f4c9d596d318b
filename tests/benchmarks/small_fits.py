"""CPU time of small robust fits compared with that of scikit-learn and statsmodels, in one run:

    python -m tests.benchmarks.small_fits

Prints CPU milliseconds of one thread for one fit, the least of several: for one fit of 300 × 6 with 10 % outliers, and
for each of many fits of 100 × 2 in one call. Packages that are not installed are left out.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mkc_torch.linear import LeastTrimmedSquares, MKCRegression, MMRegression, SRegression

MANY = 5000
"""Fits in one call."""

REPEATS = 7
"""Number of timings; the least is printed."""


def sample(seed: int, *shape: int) -> tuple[Tensor, Tensor]:
    """X (*, N, n) with an intercept, and y whose first tenth lies 20 higher."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.randn(*shape, generator=generator, dtype=torch.float64)
    X[..., 0] = 1.0
    y = X.sum(-1) + torch.randn(*shape[:-1], generator=generator, dtype=torch.float64)
    y[..., : shape[-2] // 10] += 20.0
    return X, y


def milliseconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Least CPU milliseconds of the process; the first of several runs is left out."""
    taken = []
    for _ in range(repeats + (repeats > 1)):
        begin = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - begin))
    return min(taken)


def peers(X: np.ndarray, y: np.ndarray) -> dict[str, Callable[[], object]]:
    """Fits of other packages, where installed; X holds its intercept."""
    found: dict[str, Callable[[], object]] = {}
    try:
        from sklearn.linear_model import HuberRegressor

        found["scikit-learn HuberRegressor"] = lambda: HuberRegressor(fit_intercept=False).fit(X, y)
    except ImportError:
        pass
    try:
        import statsmodels.api as sm
        from statsmodels.robust.resistant_linear_model import RLMDetSMM

        found["statsmodels RLM, Tukey"] = lambda: sm.RLM(y, X, M=sm.robust.norms.TukeyBiweight()).fit()
        found["statsmodels RLMDetSMM"] = lambda: RLMDetSMM(y, X).fit()
    except ImportError:
        pass
    return found


def main() -> None:
    torch.set_num_threads(1)
    X, y = sample(0, 300, 6)
    print(f"one fit of 300 × 6, 10 % outliers{'ms':>16}")
    for kind in (LeastTrimmedSquares, SRegression, MMRegression, MKCRegression):
        print(f"  {kind.__name__:<36}{milliseconds(lambda kind=kind: kind().fit(X, y)):>9.1f}", flush=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, fit in peers(X.numpy(), y.numpy()).items():
            print(f"  {name:<36}{milliseconds(fit):>9.1f}", flush=True)
    X, y = sample(1, MANY, 100, 2)
    print(f"each of {MANY} fits of 100 × 2 in one call{'ms':>11}")
    for kind in (MMRegression, MKCRegression):
        kind().fit(X[:50], y[:50])
        print(f"  {kind.__name__:<36}{milliseconds(lambda kind=kind: kind().fit(X, y), 1) / MANY:>9.3f}", flush=True)
    print(f"one fit of 100 × 2{'ms':>29}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, fit in peers(X[0].numpy(), y[0].numpy()).items():
            print(f"  {name:<36}{milliseconds(fit):>9.3f}", flush=True)


if __name__ == "__main__":
    main()
