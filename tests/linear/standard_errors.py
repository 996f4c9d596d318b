"""Standard errors of MMRegression relative to robustbase's on published tables; ``python -m`` prints the figures."""

import math

import numpy as np

from mkc_torch.linear import MMRegression
from tests.linear.test_peers import LOWER, TABLES


def ratios() -> np.ndarray:
    """Number of rows, factor √(N / (N - n)), and ratio to robustbase's, of each standard error, (errors, 3)."""
    found = []
    for name, table in TABLES.items():
        if name in LOWER or table["error"] is None:
            continue
        X, y = table["X"], table["y"]
        N, n = X.shape
        own = MMRegression(seed=2).fit(X, y).standard_error_.numpy()
        found += [(N, math.sqrt(N / (N - n)), ratio) for ratio in own / table["error"]]
    return np.array(found)


def main() -> None:
    """Print how much the standard errors differ, with and without the factor."""
    rows, factor, ratio = ratios().T
    larger = 100.0 * (ratio - 1.0)
    print(
        f"{len(ratio)} standard errors: {np.median(larger):.1f} % larger in the median, at most {larger.max():.0f} %;"
    )
    print(f"at most {larger[rows >= 100].max():.1f} % from 100 rows on.")
    other = 100.0 * np.abs(ratio / factor - 1.0)
    far = int(other.argmax())
    share = 100.0 * (other < 1.0).mean()
    print(f"Divided by the factor, {share:.0f} % differ by less than 1 %, the largest by {other[far]:.0f} %", end=" ")
    print(f"({rows[far]:.0f} rows).")


if __name__ == "__main__":
    main()
