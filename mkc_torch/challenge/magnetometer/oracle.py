"""Residual on a second recording of a fit that knows the effect's form, the noise and the inliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.challenge.magnetometer.power import Metric

if TYPE_CHECKING:
    from jaxtyping import Float


def second_residual(
    metrics: tuple[Metric, Metric],
    traces: Sequence[Sequence[Float[Tensor, "N 3"]]],
    errors: tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]],
    good: tuple[Float[Tensor, " N"], Float[Tensor, " N"]],
) -> float:
    """Return the RMS of the calibrated length about its mean, on the inliers of the second recording, µT.

    Generalised least squares on the inliers of the first recording estimates the calibration and the effects' sizes.
    Its error propagates to the second. All to first order about the truth.

    Args:
        metrics: metric of the calibrated length, for the first and the second recording.
        traces: traces of the effects, for each recording.
        errors: errors of the measurement.
        good: masks of inliers.
    """
    tangents = [
        torch.cat([metric.nuisance(), *(metric.residual(trace[..., None]) for trace in group)], -1)
        for metric, group in zip(metrics, traces, strict=True)
    ]
    noise = [metric.residual(error[..., None]) for metric, error in zip(metrics, errors, strict=True)]
    scale = torch.linalg.vector_norm(tangents[0], dim=(0, 1)).clamp(min=1e-300)
    white = _for_the_mean(metrics[0]).whitened(torch.cat([tangents[0] / scale, noise[0]], -1), good[0])
    error = torch.linalg.pinv(white[:, :-1], rtol=1e-9) @ white[:, -1]
    left = (noise[1][..., 0] - (tangents[1] / scale) @ error)[:, 0][good[1]]
    return float(left.std())


def _for_the_mean(metric: Metric) -> Metric:
    """Remove random walks of the offset: generalised least squares would estimate their start, not their mean."""
    return replace(metric, noise=replace(metric.noise, walks=None))
