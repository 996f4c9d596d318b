"""Robust linear estimators by name, for tests of all estimators."""

from collections.abc import Callable

from mkc_torch.linear import (
    FixedPointLinear,
    LeastAbsoluteDeviations,
    LeastEntropyLike,
    LeastMedianOfSquares,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MinimumEntropy,
    MKCRegression,
    MMRegression,
    ReweightedLeastSquares,
    SRegression,
)
from mkc_torch.linear._estimator import LinearEstimator


def estimators(d: float) -> dict[str, Callable[[], LinearEstimator]]:
    """Return functions that make the estimators; ``d`` is the scale of `FixedPointLinear`."""
    return {
        "LeastSquares": LeastSquares,
        "FixedPointLinear": lambda: FixedPointLinear(sigma=2.0, d=d),
        "MKCRegression": MKCRegression,
        "LeastAbsoluteDeviations": LeastAbsoluteDeviations,
        "SRegression": SRegression,
        "MMRegression": MMRegression,
        "LeastTrimmedSquares": LeastTrimmedSquares,
        "MEstimator": lambda: MEstimator("tukey"),
        "ReweightedLeastSquares": ReweightedLeastSquares,
        "LeastMedianOfSquares": lambda: LeastMedianOfSquares(starts=300),
        "MinimumEntropy": MinimumEntropy,
        "LeastEntropyLike": LeastEntropyLike,
    }
