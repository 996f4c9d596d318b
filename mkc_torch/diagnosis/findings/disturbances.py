"""What pushes a simulation that nobody recorded: which state, how strongly, when, and what it goes along with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import Curve, DisturbanceEstimate, ProcessNoise
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.simulation.dynamics.noise import DisturbancePath, StateSpaceNoise, disturbance_paths
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["forcing_of", "pushes_of"]

_BINS = 20
"""Parts of a range that a push is averaged over."""

_NORMAL_95 = 1.96
"""Standard errors to either side that a 95 % interval reaches."""

_PLAIN = 0.3
"""Correlation, of either sign, above which a push is said to go along with something, where it is beyond chance too."""


def pushes_of(prepared: PreparedDynamics, noise: StateSpaceNoise) -> tuple[ProcessNoise, ...]:
    """The disturbances of a noise, strongest first, with their units."""
    found = noise.selected
    sentences = []
    for disturbance, error, gain in zip(found.disturbances, found.errors, found.gains, strict=True):
        unit = prepared.ports[f"rate of {disturbance.place}"].unit if disturbance.at_rate else _unit_of(prepared, disturbance.place)
        of_size = disturbance.size * error if math.isfinite(error) else disturbance.size
        sentences.append(ProcessNoise(disturbance.place, disturbance.at_rate, disturbance.lasting, disturbance.size, of_size, unit, gain))
    return tuple(sentences)


def forcing_of(fit: FittedModel, noise: StateSpaceNoise) -> tuple[DisturbanceEstimate, ...]:
    """The courses of the pushes by all samples, with what they go along with.

    Args:
        fit: along whose trajectory.
        noise: around it.
    """
    prepared, model = fit.model.prepared, fit.model
    assert isinstance(prepared, PreparedDynamics)
    theta, changes = fit.parameters[: model.base], model.changes(fit.parameters)
    courses = disturbance_paths(prepared, theta, changes, model.near, noise.selected)
    states = prepared.trajectory(theta, changes, model.near).states.detach()[prepared.rows]
    beside = {
        **dict(zip(prepared.system.states, states.unbind(-1), strict=False)),
        **dict(zip(prepared.system.inputs, prepared.inputs_at_rows.unbind(-1), strict=True)),
    }
    found = []
    for push, course in zip(pushes_of(prepared, noise), courses, strict=False):
        curves = tuple(_curve(name, values, course, push, prepared) for name, values in beside.items())
        found.append(
            DisturbanceEstimate(
                push.place,
                push.at_rate,
                push.unit,
                prepared.time,
                course.value,
                _NORMAL_95 * course.error,
                tuple(curve for curve in curves if curve is not None),
                _sentences(push, course, prepared),
            )
        )
    return tuple(found)


def _curve(
    name: str, values: Float[Tensor, " N"], course: DisturbancePath, push: ProcessNoise, prepared: PreparedDynamics
) -> Curve | None:
    """Mean of a push over parts of the range of what it may depend on, as many samples in each, with its band."""
    if float(values.std()) <= 1e-12 * float(values.abs().max().clamp(min=1e-300)):
        return None
    parts = values.argsort().tensor_split(max(min(_BINS, len(values) // 10), 1))
    x = torch.stack([values[part].mean() for part in parts])
    y = torch.stack([course.value[part].mean() for part in parts])
    band = _NORMAL_95 * _error_of_means(course.value, parts)
    unit = prepared.system.units.get(name, prepared.recording.units[name] if name in prepared.recording else "")
    return Curve(name, unit, x, y.unsqueeze(-1), band.unsqueeze(-1), (f"rate of {push.place}",), push.unit)


def _error_of_means(values: Float[Tensor, " N"], parts: Sequence[Tensor]) -> Float[Tensor, " parts"]:
    """Standard errors of the means of some samples of a series each: neighbours are alike, as the series has it."""
    N = len(values)
    inside = torch.stack([values.new_zeros(N).index_fill(0, part, 1.0) for part in parts])
    (alike, *pairs) = _lagged(torch.stack([values - values.mean(), *inside]))
    # beyond where it first vanishes there is nothing but chance
    memory = int((alike <= 0).long().argmax()) or N
    count = inside.sum(-1)
    of_pairs = torch.stack([pair[0] * alike[0] + 2.0 * (pair[1:memory] * alike[1:memory]).sum() for pair in pairs])
    return (of_pairs / N).clamp(min=0.0).sqrt() / count


def _lagged(series: Float[Tensor, "k N"]) -> Float[Tensor, "k N"]:
    """Sums of the products of each series with itself, so many samples later."""
    N = series.shape[-1]
    return torch.fft.irfft(torch.fft.rfft(series, n=2 * N).abs().square(), n=2 * N)[..., :N]


def _sentences(push: ProcessNoise, course: DisturbancePath, prepared: PreparedDynamics) -> tuple[str, ...]:
    what = f"rate of {push.place}" if push.at_rate else push.place
    step = float(prepared.time.diff().median())
    if push.correlation_time > 0.0:
        sentences = [f"What pushes {what} is not white: it keeps its value for about {push.correlation_time:.2g} s."]
    else:
        sentences = [f"What pushes {what} is white: it is new at each sample."]
    for name, values in zip(prepared.system.inputs, prepared.inputs_at_rows.unbind(-1), strict=True):
        lag, size, chance = _strongest(course.value, values, push.correlation_time / step if step > 0 else 0.0)
        if size > max(chance, _PLAIN):
            when = "at once" if lag == 0 else f"{lag * step:.2g} s after it"
            sentences.append(f"It goes along with {name}, {when} (correlation {size:.2f}).")
        else:
            sentences.append(f"It is independent of {name} at every lag.")
    return tuple(sentences)


def _strongest(push: Float[Tensor, " N"], given: Float[Tensor, " N"], memory: float) -> tuple[int, float, float]:
    """The lag, in samples, by which a push follows an input most; that correlation, and what chance reaches."""
    N = len(push)
    one, other = push - push.mean(), given - given.mean()
    size = torch.linalg.vector_norm(one) * torch.linalg.vector_norm(other)
    if not float(size) > 0.0:
        return 0, 0.0, 1.0
    farthest = min(N // 4, 200)
    spectrum = torch.fft.rfft(one, n=2 * N) * torch.fft.rfft(other, n=2 * N).conj()
    correlation = torch.fft.irfft(spectrum, n=2 * N)[: farthest + 1] / size
    lag = int(correlation.abs().argmax())
    independent = max(N / max(1.0 + 2.0 * memory, 1.0), 2.0)
    return lag, float(correlation[lag].abs()), 4.0 / independent**0.5


def _unit_of(prepared: PreparedDynamics, name: str) -> str:
    return prepared.system.units.get(name, prepared.recording.units[name] if name in prepared.recording else "")
