"""Parameters that a recording does not determine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["undetermined"]

_TINY = 1e-6
_NAMED = 0.1


def undetermined(
    tangents: Float[Tensor, "R p"],
    theta: Float[Tensor, " p"],
    names: Sequence[str],
    of_interest: int | None = None,
) -> tuple[str, ...]:
    """A sentence for each direction of the parameters along which the residual does not move.

    Each parameter is measured by its own size, and by one where it is zero, so that a direction is a relative one. What
    is told is true near ``theta`` alone.

    Args:
        tangents: of the R residuals with the p parameters.
        theta: the parameters.
        names: of the parameters.
        of_interest: how many of the first parameters are asked for: a direction of the others alone is not told. None
            for all.

    Example:
        A mass and a spring of which only the quotient shows:

        >>> tangents = torch.ones(5, 2) * torch.tensor([1.0, -2.0])
        >>> undetermined(tangents, torch.tensor([2.0, 1.0]), ("spring", "mass"))
        ('The recording does not determine `spring` and `mass`, but only ... 0.71 spring + 0.71 mass, relative).',)
    """
    size = torch.where(theta == 0, 1.0, theta.abs())
    scaled = tangents * size
    if not bool(scaled.isfinite().all()) or scaled.shape[1] == 0:
        return ()
    # of many rows, what spans them has the same lengths and directions
    _, length, directions = torch.linalg.svd(torch.linalg.qr(scaled, mode="r").R, full_matrices=True)
    length = torch.cat([length, length.new_zeros(len(directions) - len(length))])
    return tuple(
        _sentence(direction, names)
        for one, direction in zip(length, directions, strict=True)
        if float(one) <= _TINY * float(length.max()) and bool((direction[:of_interest].abs() > _NAMED).any())
    )


def _sentence(direction: Float[Tensor, " p"], names: Sequence[str]) -> str:
    shares = direction * direction[direction.abs().argmax()].sign()
    moving = [(name, float(share)) for name, share in zip(names, shares, strict=True) if abs(share) > _NAMED]
    if len(moving) == 1:
        return f"The recording does not determine `{moving[0][0]}`: whatever it is, the residual is the same."
    told = " and ".join(f"`{name}`" for name, _ in moving)
    sum_ = " ".join(f"{'+' if share > 0 else '−'} {abs(share):.2g} {name}" for name, share in moving).removeprefix("+ ")
    return (
        f"The recording does not determine {told}, but only what they are together: they can move along one direction "
        f"and the residual stays (direction {sum_}, relative)."
    )
