"""Noise and covariance of the corrected field of an undisturbed sample."""

from __future__ import annotations

import torch

from mkc_torch.calibration.file import Matrix
from mkc_torch.calibration.plain_values import matrix_of
from mkc_torch.calibration.result import Calibration


def field_covariance(calibration: Calibration) -> Matrix:
    """The covariance of an undisturbed sample's corrected field, (3, 3), in ``field_unit²``.

    It is the noise, equal along all axes, and the offset's uncertainty through the matrix. The standard error of an
    undetermined offset counts as the ellipsoid's radius.
    """
    c = calibration
    matrix = torch.tensor(c.matrix, dtype=torch.float64)
    errors = torch.tensor(c.center_se, dtype=torch.float64).nan_to_num(nan=c.radius, posinf=c.radius)
    offset = matrix @ errors.clamp(max=c.radius).square().diag() @ matrix.mT
    offset = 0.5 * (offset + offset.mT)  # symmetric to the last digit
    return matrix_of(offset + field_noise(c) ** 2 * torch.eye(3, dtype=torch.float64))


def field_noise(calibration: Calibration) -> float:
    """The standard deviation of an undisturbed sample along the field, in ``field_unit``.

    To first order, the algebraic residual, whose scale is ``d``, is twice the relative error of the length.
    """
    return 0.5 * calibration.field_strength * calibration.d
