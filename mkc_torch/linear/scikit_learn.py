"""Any linear estimator for one channel as a scikit-learn regressor; needs the extra ``sklearn``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

try:
    from sklearn.base import BaseEstimator, RegressorMixin, clone
    from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data
except ImportError as error:
    raise ImportError(
        "The regressor for scikit-learn needs scikit-learn 1.6 or later; install it with "
        '`pip install "mkc-torch[sklearn]"`.'
    ) from error

from mkc_torch._support.arguments import refuse_other_type
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.linear.mm_regression import MMRegression

if TYPE_CHECKING:
    from jaxtyping import Float


class ScikitLearnRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn has no types
    """Robust linear regression with scikit-learn's interface, for pipelines, searches and cross-validation.

    X is (n_samples, n_features) and y (n_samples,), of any type that scikit-learn takes; results are NumPy arrays.

    Args:
        estimator: any estimator of ``mkc_torch.linear``; None is ``MMRegression()``. Its parameters have names such as
            ``estimator__efficiency``.
        fit_intercept: add a constant column, whose coefficient is ``intercept_``. It is treated as any other column:
            a penalty or bound on coefficients, as in ``Ridge``, applies to the intercept too.

    Attributes, after ``fit``:
        coef_: (n_features,), without the intercept.
        intercept_: the intercept; 0 without ``fit_intercept``.
        scale_: robust scale of the residuals, in the unit of y, for estimators that have a scale.
        weights_: weight of each sample in the fit, in [0, 1], (n_samples,); outliers have small weights.
        estimator_: the fitted estimator with all its results, as tensors; the intercept is its last coefficient.
        n_features_in_, feature_names_in_: as in scikit-learn.

    References:
        Buitinck et al., "API design for machine learning software: experiences from the scikit-learn project" (2013).

    Example:
        >>> from sklearn.pipeline import make_pipeline
        >>> from sklearn.preprocessing import StandardScaler
        >>> X = np.arange(10.0)[:, None]
        >>> y = 1 + 2 * X[:, 0]
        >>> y[:3] = 100.0
        >>> model = make_pipeline(StandardScaler(), ScikitLearnRegressor()).fit(X, y)
        >>> model.predict([[20.0]]).round(6)
        array([41.])
    """

    coef_: Float[np.ndarray, " n"]
    intercept_: float
    scale_: float
    weights_: Float[np.ndarray, " N"]
    estimator_: LinearEstimator

    def __init__(self, estimator: LinearEstimator | None = None, *, fit_intercept: bool = True) -> None:
        self.estimator = estimator
        self.fit_intercept = fit_intercept

    def fit(self, X: Any, y: Any, sample_weight: Any = None) -> ScikitLearnRegressor:
        """Fit ``y ~ X coef_ + intercept_``.

        Args:
            X: (n_samples, n_features); float32 is fitted in float32, everything else in float64.
            y: (n_samples,).
            sample_weight: non-negative weights (n_samples,).

        Raises:
            TypeError: ``estimator`` is not an estimator of ``mkc_torch.linear``.
            ValueError: bad input, reported by scikit-learn or by the estimator.
            RankDeficientError: features are linearly dependent, or a feature is constant and an intercept is fitted.
        """
        inner = MMRegression() if self.estimator is None else self.estimator
        what = "an estimator of mkc_torch.linear"
        refuse_other_type("estimator", inner, LinearEstimator, what, "None takes MMRegression()")
        X, y = validate_data(self, X, y, dtype=_FLOATS, y_numeric=True, ensure_min_samples=2)
        weight = None
        if sample_weight is not None:
            weight = torch.tensor(_check_sample_weight(sample_weight, X, dtype=X.dtype))
        rows = np.column_stack([X, np.ones(len(X), X.dtype)]) if self.fit_intercept else X
        # one channel, whatever the sizes
        given = torch.tensor(rows).unsqueeze(-2), torch.tensor(y.astype(X.dtype)).unsqueeze(-1)
        try:
            self.estimator_ = clone(inner).fit(*given, weight)
        except RankDeficientError as error:
            where = f" Column {X.shape[1]} is the constant column of the intercept." if self.fit_intercept else ""
            raise RankDeficientError(f"{error}{where}") from None
        self._keep_results()
        return self

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = getattr(self.estimator, "_may_miss_clean_data", False)
        return tags

    def predict(self, X: Any) -> Float[np.ndarray, " N"]:
        """``X coef_ + intercept_``, of X (n_samples, n_features).

        Raises:
            sklearn.exceptions.NotFittedError: before ``fit``.
            ValueError: X has other features than those of the fit, or values that are NaN or infinite.
        """
        check_is_fitted(self)
        X = validate_data(self, X, dtype=_FLOATS, reset=False)
        return X @ self.coef_ + self.intercept_

    def _keep_results(self) -> None:
        coef = _as_numpy(self.estimator_.coef_)
        self.coef_, self.intercept_ = (coef[:-1], coef[-1]) if self.fit_intercept else (coef, coef.dtype.type(0.0))
        self.weights_ = _as_numpy(self.estimator_.weights_).squeeze(-1)
        self.__dict__.pop("scale_", None)
        if "scale_" in vars(self.estimator_):
            self.scale_ = float(self.estimator_.scale_)


_FLOATS = [np.float64, np.float32]
"""Dtypes in which X is fitted: float32 if X is float32, else float64."""


def _as_numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().numpy()
