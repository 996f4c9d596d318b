"""Warn of bad leverage points that a fit follows: rows far out in X that a high-breakdown fit rejects."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from mkc_torch._support.fisher_f import fisher_tail
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.linear.mm_regression import MMRegression

_FEWEST = 10
_MOST = 20_000
"""Fewest and most rows that are checked; the check costs an MM fit."""

_FAR = 3.5
"""Robust standard scores of a regressor beyond which a row may be a leverage point."""

_REJECTED = 3.0
"""Residuals in scales of the MM fit beyond which it rejects a row."""

_FOLLOWED = 0.5
"""Weight in the fit above which it follows a row."""

_LEVEL = 0.01
"""Significance of the distance between the two fits, in standard errors of the MM fit."""

_MOVED = 1.0
"""Mean squared distance from the weighted fit without the far rows, in its standard errors, below which no MM fit is
made: good rows move a fit by less than its own error."""

_SHOWN = 10
"""Most rows that the warning lists."""


def followed_rows(X: Tensor, Y: Tensor, coef: Tensor, weight: Tensor) -> list[int]:
    """Rows with a bad leverage that a fit follows, from 0; empty for a fit that an MM fit confirms.

    Args:
        X, Y: regressors (N, n) and targets (N,) of a single problem.
        coef: coefficients of the fit, (n,).
        weight: weight of each row in the fit, (N,).

    Example:
        >>> x = torch.linspace(-2.0, 2.0, 40).double()
        >>> y = x + 0.1 * torch.sin(40.0 * x)
        >>> x[:4] += 20.0
        >>> X = torch.stack([torch.ones(40).double(), x], -1)
        >>> followed_rows(X, y, torch.linalg.lstsq(X, y).solution, torch.ones(40))
        [0, 1, 2, 3]
    """
    if not _FEWEST <= len(Y) <= _MOST or len(Y) <= 2 * X.shape[-1]:
        return []
    far = _far(X)
    if not bool((far & (weight > _FOLLOWED)).any()) or _moved(X, Y, coef, torch.where(far, 0.0, weight)) < _MOVED:
        return []
    robust = MMRegression().fit(X, Y)
    scale = float(robust.scale_)
    if not scale > 0.0:
        return []
    residual = (Y - X @ robust.coef_).abs() / scale
    rows = far & (residual > _REJECTED) & (weight > _FOLLOWED)
    if not bool(rows.any()):
        return []
    difference = coef - robust.coef_
    moved = float(difference @ torch.linalg.pinv(robust.covariance_, hermitian=True) @ difference) / len(coef)
    p_value = fisher_tail(torch.tensor(moved), torch.tensor(float(len(coef))), robust.dof_.clamp(min=1.0))
    return rows.nonzero().flatten().tolist() if float(p_value) < _LEVEL else []


def _moved(X: Tensor, Y: Tensor, coef: Tensor, weight: Tensor) -> float:
    """Mean squared distance of coefficients from a weighted fit, in standard errors of that fit."""
    gram = X.mT @ (weight.unsqueeze(-1) * X)
    difference = coef - torch.linalg.pinv(gram, hermitian=True) @ (X.mT @ (weight * Y))
    residual = Y - X @ (coef - difference)
    variance = (weight * residual.square()).sum() / weight.sum()
    return float(difference @ gram @ difference / (variance * len(coef)).clamp(min=1e-300))


def _far(X: Tensor) -> Tensor:
    """Rows with a regressor, or a principal direction of the inner half of the rows, far from the others, (N,)."""
    varying = X[:, X.amax(0) > X.amin(0)]
    if varying.shape[-1] == 0:
        return torch.zeros(len(X), dtype=torch.bool, device=X.device)
    centred = varying - varying.median(0).values
    scale = robust_scale(centred.mT.unsqueeze(-1)).squeeze(-1)
    known = scale > 0  # an indicator that is mostly 0 has no scale
    score = (centred[:, known] / scale[known]) if bool(known.any()) else centred.new_zeros(len(X), 1)
    size = score.abs().amax(-1)
    inner = score[size <= size.median()]
    _, _, directions = torch.linalg.svd(inner, full_matrices=False)
    along = score @ directions.mT
    spread = robust_scale(along.mT.unsqueeze(-1)).squeeze(-1).clamp(min=1e-12)
    return (size > _FAR) | ((along.abs() / spread).amax(-1) > _FAR * math.sqrt(2.0))


def warn_of_followed_rows(name: str, X: Tensor, Y: Tensor, coef: Tensor, weights: Tensor) -> None:
    """Warn of bad leverage points that a fit to a single problem with a single channel follows."""
    rows = followed_rows(X, Y, coef, weights)
    if rows:
        listed = ", ".join(map(str, rows[:_SHOWN])) + (f", … ({len(rows)} rows)" if len(rows) > _SHOWN else "")
        warnings.warn(
            f"{name} follows the bad leverage points in rows {listed}: their X is far from that of the other rows, and "
            "MMRegression, which gives them no weight, has other coefficients. Take MMRegression, or correct or remove "
            "these rows; mkc_torch.covariance.outlier_map shows them.",
            UserWarning,
            stacklevel=4,
        )
