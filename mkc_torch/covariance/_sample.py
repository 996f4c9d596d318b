"""A checked sample of points, with columns standardised for the search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_not_finite, refuse_not_real
from mkc_torch._support.arrays import Data, as_tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def real_tensor(name: str, value: Data) -> Float[Tensor, "*shape"]:
    """``value`` as a finite tensor of float32 or float64.

    Raises:
        TypeError: neither a floating-point tensor nor an array of real numbers.
        ValueError: a value that is NaN or infinite, or whose square overflows.
    """
    tensor = as_tensor(name, value)
    refuse_not_real(name, tensor)
    if tensor.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected argument `{name}` of dtype float32 or float64 but got {tensor.dtype}; use .float().")
    refuse_not_finite(name, tensor, "Drop those samples, or fill the values in")
    limit = float(torch.finfo(working_dtype(tensor)).max) ** 0.25
    if tensor.numel() and float(tensor.detach().abs().max()) > limit:
        raise ValueError(
            f"Expected argument `{name}` of a magnitude of at most {limit:.0e} but got "
            f"{float(tensor.detach().abs().max()):.3g}; choose another unit."
        )
    return tensor


def working_dtype(tensor: Tensor) -> torch.dtype:
    """float64, so that covariances of float32 data are exact, if the device supports it."""
    return tensor.dtype if tensor.device.type == "mps" else torch.float64


@dataclass(frozen=True)
class Sample:
    """Points (B, N, p) in the working dtype, raw and standardised by centre and scale of each column.

    The standardised points, and so the choice of the support, have no gradient.
    """

    points: Float[Tensor, "B N p"]
    standardised: Float[Tensor, "B N p"]
    centre: Float[Tensor, "B p"]
    scale: Float[Tensor, "B p"]
    resolution: Float[Tensor, B]
    """Rounding error of the given values, as a share of the scale; the largest of all columns."""
    batch: torch.Size
    dtype: torch.dtype

    @property
    def shape(self) -> tuple[int, int]:
        """N and p."""
        return self.points.shape[-2], self.points.shape[-1]

    def restore(self, values: Float[Tensor, B * rest]) -> Float[Tensor, "*batch *rest"]:
        """Values of the flattened problems in the user's batch dimensions and, if floating-point, dtype."""
        values = values.reshape((*self.batch, *values.shape[1:]))
        return values.to(self.dtype) if values.is_floating_point() else values


def checked_sample(name: str, value: Data) -> Sample:
    """Check points, and standardise them by median and median absolute deviation.

    Raises:
        TypeError, ValueError: as :func:`real_tensor`, or a shape other than (*, N, p) with N > p + 1.
    """
    X = real_tensor(name, value)
    if X.dim() < 2 or X.numel() == 0:
        fix = f"; for a single column pass {name}.unsqueeze(-1)" if X.dim() == 1 else ""
        raise ValueError(f"Expected argument `{name}` of shape (*, N, p) but got {tuple(X.shape)}{fix}.")
    N, p = X.shape[-2:]
    if p + 2 > N:
        raise ValueError(
            f"Expected at least {p + 2} samples for a scatter of {p} columns but got {N}; add samples (five per "
            f"column are few), or try {name}.mT if a sample is a column."
        )
    points = X.to(working_dtype(X)).reshape(-1, N, p)
    with torch.no_grad():
        centre = points.median(-2).values
        error = points - centre.unsqueeze(-2)
        scale = error.abs().median(-2).values
        # if half of the values of a column are equal, their median absolute deviation is 0
        scale = torch.where(scale > 0, scale, error.abs().mean(-2))
        scale = torch.where(scale > 0, scale, 1.0)
        # squares of the standardised values must stay finite
        bound = float(torch.finfo(points.dtype).max) ** 0.2
        standardised = (error / scale.unsqueeze(-2)).clamp(-bound, bound)
        resolution = torch.finfo(X.dtype).eps * (1.0 + (centre.abs() / scale).amax(-1))
    return Sample(points, standardised, centre, scale, resolution, X.shape[:-2], X.dtype)
