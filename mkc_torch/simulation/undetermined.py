"""Warnings about parameters that a recording does not determine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

_TINY = 1e-6
"""Relative singular value up to which a direction is undetermined."""

_NAMED = 0.1
"""Share of a direction from which a parameter is named."""


def undetermined(
    tangents: Float[Tensor, "R p"], theta: Float[Tensor, " p"], names: Sequence[str], of_interest: int | None = None
) -> tuple[str, ...]:
    """A sentence for each direction of the parameters along which the residual is constant, near ``theta``.

    Each parameter is scaled by its absolute value, or 1 where it is 0, so that directions are relative.

    Args:
        tangents: derivatives of the R residuals by the p parameters.
        theta: the parameters.
        names: names of the parameters.
        of_interest: number of leading parameters of interest: a direction that involves only the others is omitted.
            None for all.

    Example:
        A mass and a spring of which only the quotient is identifiable:

        >>> tangents = torch.ones(5, 2) * torch.tensor([1.0, -2.0])
        >>> undetermined(tangents, torch.tensor([2.0, 1.0]), ("spring", "mass"))
        ('The recording does not determine `spring` and `mass` separately: ... 0.71 spring + 0.71 mass, relative).',)
    """
    size = torch.where(theta == 0, 1.0, theta.abs())
    scaled = tangents * size
    if not bool(scaled.isfinite().all()) or scaled.shape[1] == 0:
        return ()
    # R has the same singular values and directions, with fewer rows
    _, length, directions = torch.linalg.svd(torch.linalg.qr(scaled, mode="r").R, full_matrices=True)
    length = torch.cat([length, length.new_zeros(len(directions) - len(length))])
    return tuple(
        _sentence(direction, names)
        for size, direction in zip(length, directions, strict=True)
        if float(size) <= _TINY * float(length.max()) and bool((direction[:of_interest].abs() > _NAMED).any())
    )


def _sentence(direction: Float[Tensor, " p"], names: Sequence[str]) -> str:
    shares = direction * direction[direction.abs().argmax()].sign()
    moving = [(name, float(share)) for name, share in zip(names, shares, strict=True) if abs(share) > _NAMED]
    if len(moving) == 1:
        return f"The recording does not determine `{moving[0][0]}`: whatever it is, the residual is the same."
    parameters = " and ".join(f"`{name}`" for name, _ in moving)
    sum_ = " ".join(f"{'+' if share > 0 else '−'} {abs(share):.2g} {name}" for name, share in moving).removeprefix("+ ")
    return (
        f"The recording does not determine {parameters} separately: moving them along one direction leaves the "
        f"residual unchanged (direction {sum_}, relative)."
    )
