"""The covariance of coloured noise as a dense matrix, which the whitening of the blind proof must agree with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from examples.blind_proof.magnetometer.process import Process


def dense_covariance(white: Tensor, gains: Tensor, processes: Sequence[Process]) -> Tensor:
    """Return the covariance, for short series."""
    count = len(white)
    total = torch.diag(white.reshape(-1))
    for k, process in enumerate(processes):
        series = torch.from_numpy(_series_covariance(process, count))
        g = gains[..., k]
        total = total + torch.einsum("nc,nm,md->ncmd", g, series, g).reshape(total.shape)
    return total


def _series_covariance(process: Process, count: int) -> np.ndarray:
    f, p = process.transition(), process.start()
    drive = np.zeros_like(p)
    drive[0, 0] = process.innovation**2
    c = np.zeros((count, count))
    for k in range(count):
        ahead = p
        for j in range(k, count):
            c[k, j] = c[j, k] = ahead[0, 0]
            ahead = f @ ahead
        p = f @ p @ f.T + drive
    return c
