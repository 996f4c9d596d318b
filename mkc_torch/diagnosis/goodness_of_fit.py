"""Whether a simulation follows its recording at all: its residual beside the output's own variation and the floor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch._support.quantum import rounding_of
from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["goodness_of_fit", "pooled", "poor_fits", "size_of", "units_of"]

_SLOWER = 1e-4
"""Share of an output's variation below which a floor that was estimated from samples tells nothing."""

_FAR = 5.0
"""Robust standard deviations from the median at which a value ends, for a mean that outliers do not move."""

_CORNER, _EXPECTED, _ROUNDS = 2.5, 0.97764, 30
"""Standard deviations at which a residual's square ends, and the mean of that of a normal variable."""

_LENGTH = (3.0 - 8.0 / math.pi) ** 0.5
"""Standard deviation of the length of a vector of three independent standard normal numbers (Maxwell's)."""


def size_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Standard deviation about 0 by Huber's proposal 2: a few outliers count as the edge, a broad misfit in full.

    Huber, "Robust Statistics" (1981), 6.4.
    """
    size, whole = robust_scale(values), values.square().mean(0).sqrt()
    # of a series that rests most of the time the scale is 0
    rests = size == 0
    for _ in range(_ROUNDS):
        size = (torch.minimum(values.square(), (_CORNER * size).square()).mean(0) / _EXPECTED).sqrt()
    return torch.where(rests, whole, size)


def goodness_of_fit(
    prepared: PreparedSimulation,
    residual: Float[Tensor, "N m"] | None,
    declared: Mapping[str, float],
    floor: Sequence[float] | None,
) -> tuple[GoodnessOfFit, ...]:
    """Of each output.

    Args:
        prepared: the simulation.
        residual: recording less the simulation alone, running freely; None where that run is lost.
        declared: standard deviation of the white noise of outputs that it is known of.
        floor: the same as it was estimated; None to estimate it by what is new from sample to sample.
    """
    known: Tensor | None = getattr(prepared, "measured", None)
    if known is None:
        return ()
    own = known - known.median(0).values
    if len(prepared.channels) == 1 and known.shape[1] > 1:
        # a length is compared, and the vector varies: readings scattered alike in all directions leave that much of it
        variation = _LENGTH * size_of(own).square().mean().sqrt().reshape(1)
        recorded = torch.linalg.vector_norm(known, dim=-1, keepdim=True)
    elif known.shape[1] == len(prepared.channels):
        variation, recorded = size_of(known - _middle(known)), known
        if _in_other_axes(prepared):
            # no column is of one axis of these: each varies by what the vector varies by
            variation = variation.square().mean().sqrt().expand_as(variation)
    else:
        return ()
    lost = residual is None or not bool(residual.isfinite().all())
    left = variation.clone() if lost or residual is None else size_of(residual)
    rounding = rounding_of(recorded)
    estimated = _new(recorded if residual is None or lost else residual) if floor is None else left.new_tensor(floor)
    last = size_of(recorded[1:] - recorded[:-1])
    last = last.square().mean().sqrt().expand_as(last) if _in_other_axes(prepared) else last
    units = units_of(prepared)
    found = []
    for k, name in enumerate(prepared.channels):
        of_steps = float(rounding[k])
        size, source = float(estimated[k]), "samples"
        if name in declared:
            size, source = declared[name], "declared"
        elif of_steps > size:
            size, source = of_steps, "quantisation"
        whole = float(variation[k])
        if source != "declared" and size < _SLOWER * whole:
            size = math.nan  # sampled more slowly than the noise changes, which no sample then shows
        share = 0.0 if lost else 1.0 - (float(left[k]) / whole) ** 2 if whole > 0 else 0.0
        found.append(
            GoodnessOfFit(name, units[k], float(left[k]), whole, share, size, source, whole, float(last[k]))  # type: ignore[arg-type]
        )
    return tuple(found)


def _in_other_axes(prepared: PreparedSimulation) -> bool:
    """Whether a vector is compared in axes that turn with it, those of the world say, and not column by column."""
    recording = getattr(prepared, "recording", None)
    return len(prepared.channels) > 1 and recording is not None and not set(prepared.channels) & set(recording.names)


def poor_fits(follows: Sequence[GoodnessOfFit], least: float) -> tuple[GoodnessOfFit, ...]:
    """The outputs that the simulation does not follow: less than this share of their variation is explained."""
    return tuple(one for one in follows if not one.explained >= least)


def pooled(follows: Sequence[GoodnessOfFit]) -> float:
    """Share of the variation that is explained, of all outputs together, each by its own variation.

    A lost output explains nothing; worse than its mean is no better than that.
    """
    return sum(max(one.explained, 0.0) for one in follows) / len(follows) if follows else 0.0


def _middle(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Mean of each column, outliers aside."""
    centre = values.median(0).values
    reach = _FAR * robust_scale(values)
    reach = torch.where(reach > 0, reach, torch.inf)
    return centre + (values - centre).clamp(-reach, reach).mean(0)


def _new(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """White noise by third differences."""
    third = values[3:] - 3.0 * values[2:-1] + 3.0 * values[1:-2] - values[:-3]
    return robust_scale(third) / 20.0**0.5


def units_of(prepared: PreparedSimulation) -> tuple[str, ...]:
    """Of the channels of a simulation's residual."""
    output = prepared.ports.get("output")
    if prepared.unit or output is None:
        return (prepared.unit,) * len(prepared.channels)
    names = {output.parts.get(part, part): unit for part, unit in output.part_units.items()}
    return tuple(names.get(name, "") for name in prepared.channels)
