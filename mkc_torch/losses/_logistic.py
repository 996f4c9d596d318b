"""The logistic function with all digits of what is near 0."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["logistic"]

_LEAST = -80.0
"""Below it the exponential leaves float32, and the logistic function is less than 1e-34."""


def logistic(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """``1 / (1 + exp(-raw))``.

    A large σ is made of a tiny value of it, and so is a d that is small beside its bound. torch has all their digits;
    runtimes of exported models have seven behind the point alone, so that in exported code it is written out.

    Example:
        >>> logistic(torch.tensor([0.0, -20.0]))
        tensor([5.0000e-01, 2.0612e-09])
    """
    if torch.compiler.is_compiling():
        return 1.0 / (1.0 + torch.exp(-raw.clamp(min=_LEAST)))
    return raw.sigmoid()
