"""What a fit that knows the effect's form, the noise and the good samples leaves on a second recording."""

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
    """Root mean square, in µT, of the calibrated length on the second recording's good samples, about its mean.

    Generalised least squares on the first recording's good samples estimates the calibration and the effects' sizes;
    its error carries over to the second. All to first order about the truth.

    Args:
        metrics: of the calibrated length, for the first recording and the second.
        traces: of the effects, for each recording.
        errors: of the measurement.
        good: samples that are no outliers.
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
    """Without walks of the offset: the best fit to those would seek the offset they began with, not their mean."""
    return replace(metric, noise=replace(metric.noise, walks=None))
