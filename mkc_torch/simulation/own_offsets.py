"""Offsets of outputs per recording, where several recordings share a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_DETERMINED = 0.01
"""Share of an offset's column that must be independent of the other parameters for the offset to be fitted."""


@dataclass(frozen=True)
class OwnOffset:
    """The offset of one output in one recording, a parameter of the simulation.

    Attributes:
        output: name of the output.
        recording: number of the recording, from 0.
        name: name of the parameter.
    """

    output: str
    recording: int
    name: str


def determined_offsets(
    tangents: Float[Tensor, "N m p"], outputs: Sequence[str], recording: Int[Tensor, " N"], names: Sequence[str]
) -> tuple[OwnOffset, ...]:
    """The offsets that are identifiable next to the simulation's own parameters and initial states.

    The offset of a position is indistinguishable from its initial value where nothing depends on the position; such an
    offset stays 0. Where the simulation has an offset parameter that all recordings share, the offset of the first
    recording stays 0, and the others are relative to it.

    Args:
        tangents: derivatives of the residual by the simulation's parameters, including initial states.
        outputs: names of the m outputs.
        recording: number of each sample's recording.
        names: names of the recordings.

    Example:
        In two recordings, a line through the origin allows both offsets; a line with an intercept allows one:

        >>> x, run = torch.linspace(0.0, 1.0, 8, dtype=torch.float64).repeat(2), torch.arange(2).repeat_interleave(8)
        >>> [offset.name for offset in determined_offsets(x[:, None, None], ("y",), run, ("a", "b"))]
        ['offset of y in a', 'offset of y in b']
        >>> line = torch.stack([x, torch.ones_like(x)], -1).unsqueeze(1)
        >>> [offset.name for offset in determined_offsets(line, ("y",), run, ("a", "b"))]
        ['offset of y in b']
    """
    known = _orthonormal(tangents.flatten(0, 1))
    found = []
    for k, output in enumerate(outputs):
        # in reverse order, so that the first recording is the reference
        for number in range(len(names) - 1, -1, -1):
            column = torch.zeros_like(tangents[..., 0])
            column[recording == number, k] = 1.0
            unit = column.flatten() / torch.linalg.vector_norm(column)
            remainder = unit - known @ (known.T @ unit)
            length = torch.linalg.vector_norm(remainder)
            if float(length) > _DETERMINED:
                known = torch.cat([known, (remainder / length).unsqueeze(-1)], -1)
                found.append(OwnOffset(output, number, f"offset of {output} in {names[number]}"))
    order = {output: k for k, output in enumerate(outputs)}
    return tuple(sorted(found, key=lambda offset: (order[offset.output], offset.recording)))


def _orthonormal(columns: Float[Tensor, "R p"]) -> Float[Tensor, "R q"]:
    """An orthonormal basis of the span of the normalised columns."""
    length = torch.linalg.vector_norm(columns, dim=0)
    scaled = columns[:, length > 0] / length[length > 0]
    left, size, _ = torch.linalg.svd(scaled, full_matrices=False)
    return left[:, size > torch.finfo(columns.dtype).eps ** 0.5]
