"""Linear regression, one estimator a file, all with ``fit(X, Y, sample_weight=None)`` and ``coef_``."""

from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.linear.least_squares import LeastSquares, Ridge

__all__ = ["LeastSquares", "RankDeficientError", "Ridge"]
