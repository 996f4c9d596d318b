"""Linear regression, one estimator a file, all with ``fit(X, Y, sample_weight=None)`` and ``coef_``.

X is (*, N, m, n) with Y (*, N, m), N samples of m channels and n coefficients, or (*, N, n) with Y (*, N) for one
channel; ``*`` are batch dimensions. X (A, B, n) with Y (A, B) fits both shapes. It is read as A samples of B channels,
unless B exceeds n and also exceeds 16 or A; then it is read as A problems of B samples.
``X.unsqueeze(-2), Y.unsqueeze(-1)`` means one channel whatever the sizes.
"""

from mkc_torch.linear._estimator import NotFittedError
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.linear.em import MKCRegression
from mkc_torch.linear.fixed_point import FixedPointLinear
from mkc_torch.linear.generalized_maximum_entropy import GeneralizedMaximumEntropy
from mkc_torch.linear.least_absolute_deviations import LeastAbsoluteDeviations
from mkc_torch.linear.least_entropy_like import LeastEntropyLike
from mkc_torch.linear.least_median_of_squares import LeastMedianOfSquares
from mkc_torch.linear.least_squares import LeastSquares, Ridge
from mkc_torch.linear.least_trimmed_squares import LeastTrimmedSquares
from mkc_torch.linear.m_estimator import MEstimator
from mkc_torch.linear.minimum_entropy import MinimumEntropy
from mkc_torch.linear.mm_regression import MMRegression
from mkc_torch.linear.reweighted_least_squares import ReweightedLeastSquares
from mkc_torch.linear.s_regression import SRegression

__all__ = [
    "FixedPointLinear",
    "GeneralizedMaximumEntropy",
    "LeastAbsoluteDeviations",
    "LeastEntropyLike",
    "LeastMedianOfSquares",
    "LeastSquares",
    "LeastTrimmedSquares",
    "MEstimator",
    "MKCRegression",
    "MMRegression",
    "MinimumEntropy",
    "NotFittedError",
    "RankDeficientError",
    "ReweightedLeastSquares",
    "Ridge",
    "SRegression",
]
