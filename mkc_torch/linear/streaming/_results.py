"""Results of a streamed fit, from its last pass and the step after it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mkc_torch.linear.streaming._progress import StreamProgress
from mkc_torch.linear.streaming._sums import Report

if TYPE_CHECKING:
    from jaxtyping import Float64
    from torch import Tensor

__all__ = ["results"]


def results(before: StreamProgress, progress: StreamProgress, report: Report) -> dict[str, Any]:
    """Return the attributes of a fitted estimator by name.

    Args:
        before: progress before the last pass; the sums of that pass are at its trial.
        progress: progress after the last pass.
        report: sums of the last pass.
    """
    assert before.climb is not None
    assert progress.climb is not None
    survey, at = progress.survey, before.climb.trial
    place = progress.climb.trial if progress.converged else at
    nll = progress.likelihood().channels(at, report.slopes)
    return {
        "coef_": survey.to_coef() @ place.beta,
        "sigma_": place.kappa.rsqrt(),
        "d_": torch.exp(place.log_d),
        "bound_": torch.exp(progress.log_bound),
        "log_likelihood_": -(survey.weight * nll).sum(),
        "covariance_": covariance(before, report),
        "dof_": torch.tensor(float(survey.used - survey.shape.n), dtype=torch.float64),
        "history_": torch.tensor(progress.climb.history, dtype=torch.float64),
        "exact_fit_": torch.tensor(progress.begun.exact),
        "converged_": torch.tensor(progress.converged),
        "n_iter_": progress.passes,
        "n_rows_": survey.rows,
        "n_pilot_": progress.begun.rows,
        "n_light_": int(report.light),
    }


def covariance(before: StreamProgress, report: Report) -> Float64[Tensor, "n n"]:
    """Sandwich covariance of the coefficients for independent rows, with N / (N - n) for the degrees of freedom."""
    assert before.climb is not None
    survey, turn = before.survey, before.likelihood().to_basis
    n, to_coef = survey.shape.n, survey.to_coef()
    left = survey.used - n
    if left <= 0:  # with as many coefficients as values no residual is left to estimate the errors from
        return torch.full((n, n), torch.inf, dtype=torch.float64)
    curvature = torch.einsum("c,cij->ij", torch.exp(-2.0 * before.climb.trial.log_d), report.slopes.gram)
    inverse = torch.linalg.pinv(turn.mT @ curvature @ turn, hermitian=True)
    middle = inverse @ (turn.mT @ report.meat @ turn) @ inverse
    return (left + n) / left * to_coef @ middle @ to_coef.mT
