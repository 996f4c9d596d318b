"""Coverage of 95 % intervals of robust regressions on clean data and under contamination.

    python -m tests.linear.interval_coverage [DRAWS]

In each draw y = 1 + 2 x + noise of scale 1, x uniform in [-2, 2]. One sample in ten is wrong: +10 ("one-sided"), +3, or
at x = 8 with y = 1 + noise ("leverage").
"""

import sys

import torch

from mkc_torch.linear import MKCRegression, MMRegression

CASES = ("none", "one-sided", "+3", "leverage")
TRUTH = torch.tensor([1.0, 2.0], dtype=torch.float64)


def draws(case, count, rows, seed=0):
    """X (count, rows, 2) and Y (count, rows)."""
    generator = torch.Generator().manual_seed(seed)
    x = 4.0 * torch.rand(count, rows, generator=generator, dtype=torch.float64) - 2.0
    noise = torch.randn(count, rows, generator=generator, dtype=torch.float64)
    wrong = slice(0, rows // 10)
    if case == "leverage":
        x[:, wrong] = 8.0
    y = TRUTH[0] + TRUTH[1] * x + noise
    if case == "leverage":
        y[:, wrong] = TRUTH[0] + noise[:, wrong]
    elif case != "none":
        y[:, wrong] += 10.0 if case == "one-sided" else 3.0
    return torch.stack([torch.ones_like(x), x], -1), y


def coverage(estimator, case, rows, count, seed=0):
    """Share of the intervals of both coefficients that contain the truth, (2,)."""
    X, Y = draws(case, count, rows, seed)
    interval = estimator.fit(X, Y).confidence_interval(0.95)
    return ((interval[..., 0] <= TRUTH) & (interval[..., 1] >= TRUTH)).double().mean(0)


def main(count):
    for rows in (40, 100):
        for case in CASES:
            shares = {type(e).__name__: coverage(e, case, rows, count) for e in (MKCRegression(), MMRegression())}
            shown = ", ".join(f"{name} {100 * a:.1f} {100 * b:.1f} %" for name, (a, b) in shares.items())
            print(f"N = {rows}, {case}: {shown}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500)
