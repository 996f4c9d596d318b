"""Robust estimators of location and scatter, and the outlier map of a regression, which uses them.

X is (*, N, p), N samples of p columns; ``*`` are batch dimensions.
"""

from mkc_torch.covariance.exact_fit import ExactFitError
from mkc_torch.covariance.minimum_covariance_determinant import MinimumCovarianceDeterminant
from mkc_torch.covariance.outlier_map import OutlierMap, SampleKind, outlier_map

__all__ = ["ExactFitError", "MinimumCovarianceDeterminant", "OutlierMap", "SampleKind", "outlier_map"]
