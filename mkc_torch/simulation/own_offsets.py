"""Offsets of outputs that are another one in each recording, where several recordings share one simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["OwnOffset", "determined_offsets"]

_DETERMINED = 0.01
"""Share of an offset's column that the other parameters have to leave, for the offset to be fitted beside them."""


@dataclass(frozen=True)
class OwnOffset:
    """The offset of one output in one recording, a parameter of the simulation.

    Attributes:
        output: name of the output.
        recording: number of the recording, from 0.
        name: of the parameter.
    """

    output: str
    recording: int
    name: str


def determined_offsets(
    tangents: Float[Tensor, "N m p"], outputs: Sequence[str], recording: Int[Tensor, " N"], names: Sequence[str]
) -> tuple[OwnOffset, ...]:
    """The offsets that can be told from the simulation's own parameters and first states.

    The offset of a position and its first value are one and the same where nothing depends on the position; such an
    offset is left at 0. Where the simulation has an offset of its own that all recordings share, the first recording's
    is left at 0, and the others are counted from there.

    Args:
        tangents: of the residual by the simulation's parameters, first states included.
        outputs: names of the m outputs.
        recording: number of each sample's recording.
        names: of the recordings.

    Example:
        A line through the origin, in two recordings, leaves room for both offsets; a line with an intercept for one:

        >>> x, run = torch.linspace(0.0, 1.0, 8, dtype=torch.float64).repeat(2), torch.arange(2).repeat_interleave(8)
        >>> [one.name for one in determined_offsets(x[:, None, None], ("y",), run, ("a", "b"))]
        ['offset of y in a', 'offset of y in b']
        >>> line = torch.stack([x, torch.ones_like(x)], -1).unsqueeze(1)
        >>> [one.name for one in determined_offsets(line, ("y",), run, ("a", "b"))]
        ['offset of y in b']
    """
    known = _orthonormal(tangents.flatten(0, 1))
    found = []
    for k, output in enumerate(outputs):
        # the last ones first, so that it is the first recording that the others are counted from
        for number in range(len(names) - 1, -1, -1):
            column = torch.zeros_like(tangents[..., 0])
            column[recording == number, k] = 1.0
            unit = column.flatten() / torch.linalg.vector_norm(column)
            left = unit - known @ (known.T @ unit)
            length = torch.linalg.vector_norm(left)
            if float(length) > _DETERMINED:
                known = torch.cat([known, (left / length).unsqueeze(-1)], -1)
                found.append(OwnOffset(output, number, f"offset of {output} in {names[number]}"))
    order = {output: k for k, output in enumerate(outputs)}
    return tuple(sorted(found, key=lambda one: (order[one.output], one.recording)))


def _orthonormal(columns: Float[Tensor, "R p"]) -> Float[Tensor, "R q"]:
    """A basis of what columns span, each measured by its own length."""
    length = torch.linalg.vector_norm(columns, dim=0)
    scaled = columns[:, length > 0] / length[length > 0]
    left, size, _ = torch.linalg.svd(scaled, full_matrices=False)
    return left[:, size > torch.finfo(columns.dtype).eps ** 0.5]
