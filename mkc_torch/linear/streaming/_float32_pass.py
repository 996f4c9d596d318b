"""A pass over float32 data in float32: half the time, for steps that are longer than its rounding error."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mkc_torch.linear.streaming._blocks import Shape, pieces
from mkc_torch.linear.streaming._sums import StreamPoint, StreamSums

if TYPE_CHECKING:
    from jaxtyping import Float64
    from torch import Tensor

__all__ = ["LEAST_FLOAT32_KAPPA", "float32_pass"]

LEAST_FLOAT32_KAPPA = 0.01
"""Least κ = 1/σ² of a float32 pass: from it on, the derivative of the energy by κ is accurate to a thousandth."""

_ROWS = 32_768
"""Rows of a block: three float32 arrays of it are 400 kB. Chosen where a pass over rows of nine values was fastest."""


def float32_pass(batches: Iterable[Any], shape: Shape, point: StreamPoint) -> Float64[Tensor, " k"]:
    """The sums of :class:`StreamSums` without curvature, to six digits: computed in float32, accumulated in float64.

    Args:
        batches: float32 data, read without a copy.
        shape: shape of every batch.
        point: point of the pass; without a change of basis, and with κ at least 0.01.
    """
    flat = np.zeros(StreamSums.length(shape))
    channels = flat[1 : 1 + 6 * shape.m].reshape(6, shape.m)
    score = StreamSums.of(torch.from_numpy(flat), shape).score.numpy()
    coef, space = point.coef.astype(np.float32), np.empty((3, _ROWS), np.float32)
    for x, y, weight in pieces(batches, shape, _ROWS):
        flat[0] += len(x)
        for c in range(shape.m):
            kappa, inverse = float(point.kappa[c]), float(point.d[c]) ** -2
            r, w, s = space[:, : len(x)]
            np.matmul(x[:, c], coef, out=r)
            np.subtract(y[:, c], r, out=r)
            np.multiply(r, r, out=w)
            w *= np.float32(-0.5 * kappa * inverse)
            np.exp(w, out=w)
            total, residual = float(len(x)), r
            if weight is not None:
                own = weight[:, c].astype(np.float32)
                w *= own
                total, residual = float(own.sum(dtype=np.float64)), own * r
            np.multiply(w, r, out=s)
            energy, qw = (total - float(w.sum())) / kappa, 0.5 * inverse * float(np.dot(s, r))
            channels[:, c] += (float(residual.sum()), energy, (energy - qw) / kappa, 0.0, qw, 0.0)
            score[c] += np.matmul(s, x[:, c])
    return torch.from_numpy(flat)
