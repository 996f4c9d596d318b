"""Base of all linear estimators: parameters, names of results, prediction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_not_real
from mkc_torch._support.arrays import (
    Data,
    as_tensor,
    as_tensors,
    column_names,
    is_frame,
    refuse_other_columns,
)
from mkc_torch.linear._parameters import Parametrised
from mkc_torch.linear._problem import common_batch

if TYPE_CHECKING:
    from jaxtyping import Float

    from mkc_torch.linear._implicit.layer import Layer
    from mkc_torch.linear._problem import LinearProblem

Self = TypeVar("Self", bound="LinearEstimator")


class NotFittedError(AttributeError):
    """A result was requested before ``fit``, or the estimator has no such result."""


class Fitted(Parametrised):
    """Base with results whose names end in an underscore and exist after ``fit``; a repr shows the parameters."""

    _fit_takes = "X, Y"

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_") and not name.startswith("_"):
            known = sorted(key for key in vars(self) if key.endswith("_") and not key.startswith("_"))
            if known:
                raise NotFittedError(f"{type(self).__name__} has no `{name}`; its results are {', '.join(known)}.")
            raise NotFittedError(f"{type(self).__name__} has no `{name}` yet; call fit({self._fit_takes}) first.")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _keep_columns_of(self, value: object) -> None:
        """Store the column names of a data frame as ``feature_names_in_``, scikit-learn's name for them."""
        names = column_names(value)
        self.__dict__.pop("feature_names_in_", None)
        if names is not None:
            self.feature_names_in_ = names

    def _refuse_other_columns(self, name: str, value: object) -> None:
        refuse_other_columns(name, value, self.__dict__.get("feature_names_in_"))


class LinearEstimator(Fitted):
    """Base of the linear estimators: ``fit(X, Y, sample_weight=None)`` returns the estimator itself.

    ``fit`` and ``predict`` take tensors, NumPy arrays and DataFrames or Series of pandas and polars; results are
    tensors. Float32 arrays stay float32, other arrays become float64; with a tensor, all take its dtype and device.

    Attributes, after ``fit`` (``*`` are batch dimensions):
        coef_: coefficients (*, n).
        weights_: weight of each value in the fit, in [0, 1], (*, N, m); m is 1 for one channel given as (*, N).
        feature_names_in_: column names of X, if it was a DataFrame that has some; ``predict`` then refuses a DataFrame
            with other names.
    """

    _may_miss_clean_data = False
    """Whether the fit of data without outliers may predict worse than their mean."""

    coef_: Float[Tensor, "*batch n"]
    weights_: Float[Tensor, "*batch N m"]
    feature_names_in_: tuple[str, ...]

    def __init__(self) -> None:
        """Base without parameters; a subclass stores each parameter under its own name."""

    def fit(self: Self, X: Data, Y: Data, sample_weight: Data | None = None) -> Self:
        raise NotImplementedError

    def predict(self, X: Float[Tensor, "*batch N m n"] | Data) -> Float[Tensor, "*batch N m"]:
        """``X coef_`` for X of the shape given to ``fit``: (*, N, m, n) or, for one channel, (*, N, n).

        Raises:
            NotFittedError: before ``fit``.
            TypeError: X is not a floating-point tensor or an array of real numbers, or its dtype or device differs from
                that of the coefficients.
            ValueError: X has another number of columns, columns of other names, or other batch dimensions.
        """
        n = self.coef_.shape[-1]
        self._refuse_other_columns("X", X)
        X = as_tensor("X", X, like=self.coef_)
        refuse_not_real("X", X)
        if X.dtype != self.coef_.dtype or X.device != self.coef_.device:
            raise TypeError(
                f"Expected argument `X` of the dtype and device of the fit, {self.coef_.dtype} on {self.coef_.device}, "
                f"but got {X.dtype} on {X.device}; convert it, X.to(fit.coef_)."
            )
        if X.dim() == 0 or X.shape[-1] != n:
            got = X.shape[-1] if X.dim() else 0
            raise ValueError(
                f"Expected argument `X` with {n} columns in its last dimension but got {got}; pass those of the fit."
            )
        samples = 1 if self._single_channel else 2
        common_batch("X", X.shape[: -1 - samples], "coef_", self.coef_.shape[:-1])
        coef = self.coef_.reshape(*self.coef_.shape[:-1], *(1 for _ in range(samples - 1)), -1, 1)
        return torch.matmul(X, coef).squeeze(-1)

    def _tensors(self, X: Data, Y: Data, sample_weight: Data | None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Convert the data given to ``fit`` to tensors; every ``fit`` begins with this."""
        x, y = as_tensors(X=X, Y=Y)
        weight = None if sample_weight is None else as_tensor("sample_weight", sample_weight)
        self._keep_columns_of(X)
        # a data frame of one column is one channel, as a Series is
        if is_frame(Y) and x.dim() == 2 and y.shape[-1] == 1:
            y = y.squeeze(-1)
        return x, y, weight

    def _set_common(self, problem: LinearProblem, beta: Tensor, weights: Tensor) -> None:
        self._single_channel = problem.single_channel
        self.coef_ = problem.coefficients(beta)
        if not bool(torch.isfinite(self.coef_.detach()).all()):
            raise ValueError(
                "The fit has no finite coefficients: squares of `X` or `Y` overflow or vanish. Divide each column by a "
                "unit near its scale, and look for invalid values."
            )
        self.weights_ = problem.restore(weights)

    def _set_layer(self, layer: Layer) -> None:
        self._single_channel = layer.single_channel
        self.coef_ = layer.coef
        self.weights_ = layer.weights
        self.covariance_, self.dof_ = layer.covariance, layer.dof
        self.converged_ = layer.converged
        self.differentiable_ = layer.differentiable
