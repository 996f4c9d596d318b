"""The curve of an effect over its driver, its signal or time, within the range of the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.environment import Curve
from mkc_torch.diagnosis.findings.shape import FINE_POINTS, drawn_points
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.context import Context
from mkc_torch.effects.per_recording import PerRecording

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_NORMAL_95 = 1.959964
"""Half-width of a 95 % interval in standard errors."""

_NEAR, _FEWEST_NEAR = 0.05, 3
"""Distance from a point of a free curve, as a share of the range, and least number of samples within it."""


def curve_of_effect(term: Term, gamma: Tensor, covariance: Tensor, context: Context) -> Curve | None:
    """Return the effect's change at its port over its driver, signal or time, with its 95 % band.

    A free curve is NaN where the recording has no samples: there only its basis decides. A size that differs between
    recordings gives a curve for each recording.
    """
    made = _along(term, context)
    if made is None:
        return None
    driver, unit, x, synthetic, known = made
    shape = {name: value for name, value in term.shape.items() if name != "lag"}

    def change(gamma: Tensor) -> Tensor:
        each = [term.effect.change(gamma, shape, one) for one in _of_each_recording(term, synthetic)]
        return torch.cat(each, -1)

    slope = torch.func.jacfwd(dual_constants(change))(gamma)
    variance = torch.einsum("ncq,qr,ncr->nc", slope, covariance, slope).clamp(min=0.0)
    channels, value_unit = places_of(term, context.channels), tidy(context.signal_unit)
    if term.effect.recordings:
        channels = tuple(f"{channel} in {name}" for name in term.effect.recordings for channel in channels)
    value = change(gamma).detach()
    # formulas are fitted to evenly spaced points of a free curve
    kept = drawn_points(value, evenly=term.effect.is_curve or driver == "time")
    band = _NORMAL_95 * variance.sqrt()
    if term.effect.is_curve and known is not None:
        unseen = ~is_sampled(x, known)
        value, band = value.clone(), band.clone()
        value[unseen] = band[unseen] = torch.nan
    return Curve(driver, unit, x[kept], value[kept], band[kept], channels, value_unit)


def _of_each_recording(term: Term, context: Context) -> list[Context]:
    """Return the context in each recording, where the size differs between them."""
    if not isinstance(term.effect, PerRecording):
        return [context]
    runs = term.effect.first_runs
    return [replace(context, run=torch.full_like(context.time, run, dtype=torch.long)) for run in runs]


def is_sampled(x: Float[Tensor, " P"], known: Float[Tensor, " N"]) -> Bool[Tensor, " P"]:
    """Return whether a curve has samples near its points.

    Args:
        x: points of the curve.
        known: the recorded values of its argument.

    Example:
        >>> known = torch.cat([torch.linspace(0.0, 1.0, 50), torch.linspace(4.0, 5.0, 50)])
        >>> is_sampled(torch.tensor([0.5, 2.5, 4.5]), known).tolist()
        [True, False, True]
    """
    ordered = known.sort().values
    reach = _NEAR * float(ordered[-1] - ordered[0])
    count = torch.searchsorted(ordered, x + reach, right=True) - torch.searchsorted(ordered, x - reach)
    return count >= min(_FEWEST_NEAR, len(ordered))


def _along(term: Term, context: Context) -> tuple[str, str, Tensor, Context, Tensor | None] | None:
    """Return name and unit of a curve's argument, its points, the context there, and its recorded values.

    The recorded values are None for a curve over time.
    """
    if context.parts and term.driver is None:
        return _along_part(term, context)
    flat = context.signal.median(0).values.expand(FINE_POINTS, -1)
    if term.driver is not None:
        values = context.drivers
        if values.shape[1] == 1:
            x = torch.linspace(float(values.min()), float(values.max()), FINE_POINTS, dtype=values.dtype)
            drivers, name, unit = x.unsqueeze(-1), term.columns[0], term.driver.units[0]
            shown, known = x + term.driver.reference, values[:, 0] + term.driver.reference
        else:
            direction = torch.linalg.svd(values - values.mean(0), full_matrices=False).Vh[0]
            along = values @ direction
            x = torch.linspace(float(along.min()), float(along.max()), FINE_POINTS, dtype=values.dtype)
            drivers, unit, shown, known = x.unsqueeze(-1) * direction, term.driver.units[0], x, along
            name = f"{term.columns[0].rpartition('_')[0]}, main direction"
        time = torch.arange(FINE_POINTS, dtype=values.dtype)
        return name, unit, shown, replace(context, time=time, drivers=drivers, signal=flat), known
    if term.effect.follows_signal:
        reach = float(context.signal.abs().max())
        x = torch.linspace(-reach, reach, FINE_POINTS, dtype=context.signal.dtype)
        signal = x.unsqueeze(-1).expand(-1, context.signal.shape[1])
        time = torch.arange(FINE_POINTS, dtype=x.dtype)
        none = context.drivers.new_zeros(FINE_POINTS, 0)
        synthetic = replace(context, time=time, signal=signal, drivers=none)
        return "field on the axis", context.signal_unit, x, synthetic, context.signal.flatten()
    index = torch.linspace(0, len(context.time) - 1, FINE_POINTS).long()
    time, signal = context.time[index], context.signal[index]
    none = context.drivers.new_zeros(len(index), 0)
    return "time", "s", time, replace(context, time=time, drivers=none, signal=signal), None


def _along_part(term: Term, context: Context) -> tuple[str, str, Tensor, Context, Tensor | None] | None:
    """Return the range of the effect's main component, with the other components at their medians."""
    part = term.effect.plot_axis
    if part not in context.parts:
        return None
    name = context.parts[part]
    values = context.component(name)
    x = torch.linspace(float(values.min()), float(values.max()), FINE_POINTS, dtype=values.dtype)
    signal = context.signal.median(0).values.expand(FINE_POINTS, -1).clone()
    signal[:, (context.carries or context.channels).index(name)] = x
    time = torch.arange(FINE_POINTS, dtype=x.dtype)
    synthetic = replace(context, time=time, signal=signal, drivers=context.drivers.new_zeros(FINE_POINTS, 0))
    return name, context.unit_of(part), x, synthetic, values


def places_of(term: Term, channels: Sequence[str]) -> tuple[str, ...]:
    """Return the places on which a term acts: channels of a residual, or rates, inputs and parameters."""
    if "rate of " in term.at or term.at.startswith("exchange of "):
        return tuple(f"rate of {name}" for name in channels)
    kind = "input" if "entry of " in term.at else term.at.partition(" ")[0]
    return tuple(f"{kind} {name}" if kind in ("input", "parameter", "constant") else name for name in channels)
