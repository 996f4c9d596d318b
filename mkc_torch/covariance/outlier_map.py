"""The outlier map of a robust regression: standardised residuals against robust distances of the predictors."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, refuse_other_type
from mkc_torch._support.arrays import as_tensors
from mkc_torch.covariance._chi_square import chi_square_quantile
from mkc_torch.covariance._sample import real_tensor
from mkc_torch.covariance.exact_fit import ExactFitError
from mkc_torch.covariance.minimum_covariance_determinant import MinimumCovarianceDeterminant
from mkc_torch.linear._estimator import LinearEstimator
from mkc_torch.linear._problem import common_batch

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from mkc_torch._support.arrays import Data


class SampleKind(IntEnum):
    """Kind of a sample in a regression: large residual, predictors far from the others, or both."""

    REGULAR = 0
    VERTICAL_OUTLIER = 1
    GOOD_LEVERAGE = 2
    BAD_LEVERAGE = 3


@dataclass(frozen=True, eq=False)
class OutlierMap:
    """Standardised residual and robust distance of every sample; ``*`` are batch dimensions.

    Attributes:
        residuals: residuals over the scale of the fit, dimensionless, (*, N).
        distances: robust Mahalanobis distances of the predictors, dimensionless, (*, N).
        residual_cutoff: limit of the absolute residuals of regular samples.
        distance_cutoff: limit of the distances of regular samples.
        columns: columns of X used as predictors; constant columns are left out.
    """

    residuals: Float[Tensor, "*batch N"]
    distances: Float[Tensor, "*batch N"]
    residual_cutoff: float
    distance_cutoff: float
    columns: tuple[int, ...]

    @property
    def kind(self) -> Int[Tensor, "*batch N"]:
        """The :class:`SampleKind` of each sample as a number; ``map.kind == SampleKind.BAD_LEVERAGE`` is a mask."""
        vertical = (self.residuals.abs() > self.residual_cutoff).long() * SampleKind.VERTICAL_OUTLIER
        return vertical + (self.distances > self.distance_cutoff).long() * SampleKind.GOOD_LEVERAGE

    def plot(self, ax: Any = None, *, labels: int = 12) -> Any:
        """Draw the map with its cutoffs and four regions, and label the outermost samples by index.

        Args:
            ax: matplotlib axes to draw in; None makes a figure.
            labels: maximum number of labels, for the samples that exceed a cutoff by the largest factor; neighbouring
                samples share a label.

        Returns:
            The axes.

        Raises:
            ImportError: matplotlib is not installed.
            ValueError: the map is of a batch of problems.
        """
        # matplotlib is an optional dependency
        from mkc_torch.covariance._outlier_picture import PlotCoordinates, draw

        if self.residuals.dim() != 1:
            raise ValueError(
                f"Expected the map of a single problem but got a batch of shape {tuple(self.residuals.shape[:-1])}; "
                "make a map from each problem's fit and data."
            )
        x, y = (values.detach().cpu().double() for values in (self.distances, self.residuals))
        return draw(PlotCoordinates(x, y, self.kind.cpu(), self.distance_cutoff, self.residual_cutoff), ax, labels)


def outlier_map(
    fit: LinearEstimator,
    X: Data,
    Y: Data,
    *,
    estimator: MinimumCovarianceDeterminant | None = None,
    residual_cutoff: float = 2.5,
    cutoff: float = 0.975,
) -> OutlierMap:
    """Classify samples as regular, vertical outliers, or good or bad leverage points.

    A bad leverage point has predictors far from those of the other samples, and a large residual. A good leverage point
    has a small residual and makes the fit more precise. The fit must be robust against leverage points (LTS, S, MM): a
    fit that follows them leaves them small residuals.

    Args:
        fit: an estimator of ``mkc_torch.linear`` fitted to a single channel; it needs ``scale_``.
        X: predictors (*, N, n) of the fit. Constant columns, such as an intercept, are left out.
        Y: targets (*, N) of the fit.
        estimator: unfitted estimator of the predictors' location and scatter; None takes the default MCD.
        residual_cutoff: limit of absolute residuals, in scales of the fit, positive; 2.5 as in the paper, 2.24 is the
            same quantile as ``cutoff``.
        cutoff: limit of squared distances, as a quantile in (0, 1) of the chi-square distribution with as many degrees
            of freedom as predictors.

    Raises:
        NotFittedError: ``fit`` was not fitted.
        TypeError: an argument of another type.
        ValueError: shapes that do not fit, an estimator without a scale for each problem, an exact fit (scale 0), or no
            predictor.
        ExactFitError: half of the samples have predictors on a hyperplane, such as an indicator that is mostly 0.

    References:
        Rousseeuw & van Zomeren, "Unmasking multivariate outliers and leverage points", JASA 85 (1990) 633-639.

    Example:
        >>> from mkc_torch.linear import MMRegression
        >>> x = torch.linspace(-2.0, 2.0, 40).double()
        >>> y = x + 0.1 * torch.sin(40.0 * x)
        >>> x[:3], y[3:5] = 9.0 + x[:3], 8.0  # three bad leverage points, two vertical outliers
        >>> X = torch.stack([torch.ones(40).double(), x], -1)
        >>> found = outlier_map(MMRegression().fit(X, y), X, y)
        >>> found.kind[:6].tolist(), found.columns
        ([3, 3, 3, 1, 1, 0], (1,))
    """
    refuse_other_type("fit", fit, LinearEstimator, "a fitted estimator of mkc_torch.linear", "call its fit first")
    if estimator is None:
        estimator = MinimumCovarianceDeterminant()
    refuse_other_type("estimator", estimator, MinimumCovarianceDeterminant, "an MCD", "None takes the default")
    residual_cutoff = checked_number("residual_cutoff", residual_cutoff, advice="it counts scales, and 2.5 is usual")
    cutoff = checked_number("cutoff", cutoff, 0.0, 1.0, "()", "it is a probability, and 0.975 is usual")
    x, y = as_tensors(X=X, Y=Y)
    predictors, residuals = real_tensor("X", x).detach(), _standardised(fit, x, real_tensor("Y", y))
    columns = _with_spread(predictors)
    try:
        # the given estimator is not modified
        distances = copy(estimator).fit(predictors[..., list(columns)]).distances_
    except ExactFitError as error:
        raise error.among(columns) from None
    return OutlierMap(
        residuals=residuals,
        distances=distances.expand(residuals.shape),
        residual_cutoff=residual_cutoff,
        distance_cutoff=math.sqrt(chi_square_quantile(cutoff, len(columns))),
        columns=columns,
    )


def _standardised(fit: LinearEstimator, X: Tensor, Y: Tensor) -> Float[Tensor, "*batch N"]:
    """Residuals over the scale of the fit."""
    coef = fit.coef_.detach()
    n = coef.shape[-1]
    if X.dim() < 2 or X.shape[-1] != n or Y.dim() < 1 or Y.shape[-1] != X.shape[-2]:
        raise ValueError(
            f"Expected `X` of shape (*, N, {n}), as many columns as the fit has coefficients, with `Y` (*, N), but got "
            f"{tuple(X.shape)} and {tuple(Y.shape)}; a map is of a single channel."
        )
    if X.dtype != coef.dtype or Y.dtype != coef.dtype:
        raise TypeError(
            f"Expected `X` and `Y` of the dtype of the fit, {coef.dtype}, but got {X.dtype} and {Y.dtype}; convert "
            "them, X.to(fit.coef_)."
        )
    scale = getattr(fit, "scale_", None)
    if not isinstance(scale, Tensor) or scale.shape != (*coef.shape[:-1], 1):
        raise ValueError(
            f"Expected argument `fit` to have a `scale_` for each problem but {type(fit).__name__} has none, or was "
            "fitted to several channels; take MMRegression, SRegression or LeastTrimmedSquares on one channel."
        )
    if not (scale > 0).all():
        raise ValueError(
            "Expected a fit of positive scale but got scale 0: every sample off an exact fit is an outlier."
        )
    common_batch("X", X.shape[:-2], "coef_", coef.shape[:-1])
    common_batch("Y", Y.shape[:-1], "coef_", coef.shape[:-1])
    residual = Y.detach() - torch.matmul(X.detach(), coef.unsqueeze(-1)).squeeze(-1)
    return residual / scale.detach()


def _with_spread(X: Float[Tensor, "*batch N n"]) -> tuple[int, ...]:
    """Indices of the columns that are not constant; they must be the same in every problem."""
    spread = (X.amax(-2) > X.amin(-2)).reshape(-1, X.shape[-1])
    if not (spread == spread[:1]).all():
        column = int((spread != spread[:1]).any(0).nonzero()[0])
        raise ValueError(
            f"Expected column {column} of `X` to be constant in every problem or in none; make a map of each problem."
        )
    columns = tuple(int(column) for column in spread[0].nonzero().flatten())
    if not columns:
        raise ValueError("Expected at least one column of `X` that is not constant; a map needs a predictor.")
    return columns
