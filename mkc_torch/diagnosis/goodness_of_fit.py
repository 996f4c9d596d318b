"""Goodness of fit: the open-loop residual compared with the output's variation and the noise floor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch._support.quantum import rounding_of
from mkc_torch.diagnosis.environment import GoodnessOfFit
from mkc_torch.diagnosis.noise.floor import white_noise
from mkc_torch.diagnosis.thresholds import ABOVE_FLOOR
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_SMOOTHED = 1e-4
"""Share of an output's variation below which an estimated noise floor is not that of a sensor."""

_FAR = 5.0
"""Robust standard deviations from the median at which values are clipped for the mean."""

_CORNER = 2.5
"""Standard deviations at which a residual's square is clipped."""

_EXPECTED = 0.97764
"""Mean of the clipped square of a standard normal variable."""

_ROUNDS = 30
"""Iterations of the scale."""

_LENGTH = (3.0 - 8.0 / math.pi) ** 0.5
"""Standard deviation of the length of a vector of three independent standard normal numbers (Maxwell's)."""


def size_of(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Return the standard deviation about 0 of each column, by Huber's proposal 2.

    Outliers are clipped; a broad misfit counts in full. Huber, "Robust Statistics" (1981), 6.4.
    """
    size, whole = robust_scale(values), values.square().mean(0).sqrt()
    # a series that is 0 most of the time has a robust scale of 0
    rests = size == 0
    for _ in range(_ROUNDS):
        size = (torch.minimum(values.square(), (_CORNER * size).square()).mean(0) / _EXPECTED).sqrt()
    return torch.where(rests, whole, size)


def goodness_of_fit(
    prepared: PreparedSimulation,
    residual: Float[Tensor, "N m"] | None,
    declared: Mapping[str, float],
) -> tuple[GoodnessOfFit, ...]:
    """Return the goodness of fit of each output.

    The noise floor is declared, or that of the recorded samples, whatever the simulation: their white noise, and at
    least the rounding of the file. It is unknown where the samples do not show it.

    Args:
        prepared: the simulation.
        residual: of the open-loop simulation; None if it has no finite trajectory.
        declared: known standard deviations of the outputs' white noise, by output.
    """
    known = prepared.measured
    own = known - known.median(0).values
    if len(prepared.channels) == 1 and known.shape[1] > 1:
        # a vector's length is compared: its variation if readings scatter equally in all directions
        variation = _LENGTH * size_of(own).square().mean().sqrt().reshape(1)
        recorded = torch.linalg.vector_norm(known, dim=-1, keepdim=True)
    elif known.shape[1] == len(prepared.channels):
        variation, recorded = size_of(known - _middle(known)), known
        if _in_other_axes(prepared):
            # the compared axes turn against the columns: use the vector's mean variation for each
            variation = variation.square().mean().sqrt().expand_as(variation)
    else:
        return ()
    lost = residual is None or not bool(residual.isfinite().all())
    left = variation.clone() if lost or residual is None else size_of(residual)
    rounding = rounding_of(recorded)
    seen = prepared.recorded
    seen = seen if seen is not None and seen.shape == recorded.shape else None
    estimated = white_noise(recorded, prepared.time, rounding, seen)
    if _in_other_axes(prepared):
        estimated = estimated.square().mean().sqrt().expand_as(variation)
    last = _each(_steps, recorded, seen)
    last = last.square().mean().sqrt().expand_as(last) if _in_other_axes(prepared) else last
    units = units_of(prepared)
    found = []
    for k, name in enumerate(prepared.channels):
        of_steps = float(rounding[k])
        size, source = float(estimated[k]), "samples"
        if name in declared:
            size, source = declared[name], "declared"
        elif of_steps > 0.0 and size <= of_steps:
            size, source = of_steps, "quantisation"
        whole = float(variation[k])
        # smoothed or computed values have no sensor's noise; samples in no order of time scatter more than the noise
        if source != "declared" and (size < _SMOOTHED * whole or float(left[k]) < size / ABOVE_FLOOR):
            size = math.nan
        share = 0.0 if lost else 1.0 - (float(left[k]) / whole) ** 2 if whole > 0 else 0.0
        found.append(
            GoodnessOfFit(name, units[k], float(left[k]), whole, share, size, source, whole, float(last[k]))  # type: ignore[arg-type]
        )
    return tuple(found)


def _in_other_axes(prepared: PreparedSimulation) -> bool:
    """Whether a vector is compared in axes that turn against the recorded columns, such as those of the Earth."""
    return len(prepared.channels) > 1 and not set(prepared.channels) & set(prepared.recording.names)


def poor_fits(follows: Sequence[GoodnessOfFit], least: float) -> tuple[GoodnessOfFit, ...]:
    """Return the outputs of which the simulation explains less than this share of the variation."""
    return tuple(fit for fit in follows if not fit.explained >= least)


def pooled(follows: Sequence[GoodnessOfFit], least: float = 0.0) -> float:
    """Return the mean explained share of the variation over all outputs.

    Args:
        follows: goodness of fit of each output.
        least: smaller shares of an output count as this; an unknown share counts as 0.
    """
    shares = [0.0 if math.isnan(fit.explained) else max(fit.explained, least) for fit in follows]
    return sum(shares) / len(shares) if shares else 0.0


def _middle(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Return the mean of each column with outliers clipped."""
    centre = values.median(0).values
    reach = _FAR * robust_scale(values)
    reach = torch.where(reach > 0, reach, torch.inf)
    return centre + (values - centre).clamp(-reach, reach).mean(0)


def _each(
    scale: Callable[[Tensor], Tensor], values: Float[Tensor, "N m"], recorded: Bool[Tensor, "N m"] | None
) -> Float[Tensor, " m"]:
    """Return a scale of each column at its recorded samples, which follow one another."""
    if recorded is None:
        return scale(values)
    columns = zip(values.unbind(-1), recorded.unbind(-1), strict=True)
    return torch.cat([scale(column[used].unsqueeze(-1)) for column, used in columns])


def _steps(values: Float[Tensor, "N m"]) -> Float[Tensor, " m"]:
    """Return the size of the changes from sample to sample."""
    return size_of(values[1:] - values[:-1])


def units_of(prepared: PreparedSimulation) -> tuple[str, ...]:
    """Return the unit of each channel of a simulation's residual."""
    output = prepared.ports.get("output")
    if prepared.unit or output is None:
        return (prepared.unit,) * len(prepared.channels)
    names = {output.parts.get(part, part): unit for part, unit in output.part_units.items()}
    return tuple(names.get(name, "") for name in prepared.channels)
