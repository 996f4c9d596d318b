"""Coverage of 95 % intervals: estimators, outliers and sample sizes.

Outliers lie eight deviations out in a regressor and twenty below the line, at leverage. The errors of the inliers are
Gaussian; with ``--errors spread`` their spread grows with the regressor. An exact interval covers 95 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from torch import Tensor

from mkc_torch.linear import (
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MKCRegression,
    MMRegression,
    ReweightedLeastSquares,
    SRegression,
)

ESTIMATORS = {
    "least squares": LeastSquares(),
    "Huber": MEstimator(),
    "bisquare": MEstimator("tukey"),
    "MM": MMRegression(starts=60),
    "MM, homoscedastic": MMRegression(starts=60, covariance="homoscedastic"),
    "S": SRegression(starts=60),
    "LTS": LeastTrimmedSquares(starts=60),
    "reweighted": ReweightedLeastSquares(starts=60),
    "MKC": MKCRegression(),
}

COEFFICIENTS = 4


def drawn(seed: int, draws: int, N: int, outliers: float, errors: str) -> tuple[Tensor, Tensor]:
    """Draw regressors (draws, N, 4), the first of them constant, and targets around 0."""
    g = torch.Generator().manual_seed(seed)
    X = torch.randn(draws, N, COEFFICIENTS, generator=g, dtype=torch.float64)
    X[..., 0] = 1.0
    y = torch.randn(draws, N, generator=g, dtype=torch.float64)
    if errors == "spread":
        y = y * (0.3 + X[..., 1].abs())
    wrong = round(outliers * N)
    X[:, :wrong, 1] += 8.0
    y[:, :wrong] -= 20.0
    return X, y


def coverage(name: str, N: int, outliers: float, *, draws: int, seed: int, errors: str = "alike") -> float:
    """Return the share of intervals of all coefficients that contain the true value 0."""
    X, y = drawn(seed, draws, N, outliers, errors)
    low, high = ESTIMATORS[name].fit(X, y).confidence_interval().unbind(-1)
    return float(((low <= 0.0) & (high >= 0.0)).double().mean())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="+", default=[40, 100, 400])
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.0, 0.1, 0.2])
    parser.add_argument("--estimators", nargs="+", choices=list(ESTIMATORS), default=list(ESTIMATORS))
    parser.add_argument("--errors", choices=["alike", "spread"], default="alike")
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    cells = [(N, share) for N in options.samples for share in options.outliers]
    print("share of 95 % intervals that contain the truth, in %: N samples, share of outliers")
    print(" " * 20 + "".join(f"{f'{N}, {share:.0%}':>10}" for N, share in cells))
    for name in options.estimators:
        shares = [
            coverage(name, N, share, draws=options.draws, seed=options.seed, errors=options.errors)
            for N, share in cells
        ]
        print(f"{name:<20}" + "".join(f"{100 * share:>10.1f}" for share in shares), flush=True)


if __name__ == "__main__":
    main()
