"""Process noise and estimated disturbances, with their dependence on states and inputs."""

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

__all__ = ["forcing_of", "process_noise_of"]

_BINS = 20
"""Number of bins of a disturbance over a variable."""

_NORMAL_95 = 1.96
"""Half-width of a 95 % interval in standard errors."""

_PLAIN = 0.3
"""Absolute correlation above which a significant dependence is reported."""


def process_noise_of(prepared: PreparedDynamics, noise: StateSpaceNoise) -> tuple[ProcessNoise, ...]:
    """Return the process noise and drifts of a noise model, strongest first, with units."""
    found = noise.selected
    sentences = []
    for disturbance, error, gain in zip(found.disturbances, found.errors, found.gains, strict=True):
        unit = (
            prepared.ports[f"rate of {disturbance.place}"].unit
            if disturbance.at_rate
            else _unit_of(prepared, disturbance.place)
        )
        of_size = disturbance.size * error if math.isfinite(error) else disturbance.size
        sentences.append(
            ProcessNoise(
                disturbance.place, disturbance.at_rate, disturbance.lasting, disturbance.size, of_size, unit, gain
            )
        )
    return tuple(sentences)


def forcing_of(fit: FittedModel, noise: StateSpaceNoise) -> tuple[DisturbanceEstimate, ...]:
    """Estimate each disturbance from all samples, with its dependences.

    Args:
        fit: gives the trajectory.
        noise: noise model around it.
    """
    model, prepared = fit.model, fit.model.prepared.dynamics
    if prepared is None:
        return ()
    theta, changes = fit.parameters[: model.base], model.changes(fit.parameters)
    courses = disturbance_paths(prepared, theta, changes, model.near, noise.selected)
    states = prepared.trajectory(theta, changes, model.near).states.detach()[prepared.rows]
    variables = {
        **dict(zip(prepared.system.states, states.unbind(-1), strict=False)),
        **dict(zip(prepared.system.inputs, prepared.inputs_at_rows.unbind(-1), strict=True)),
    }
    found = []
    for process, course in zip(process_noise_of(prepared, noise), courses, strict=False):
        curves = tuple(_curve(name, values, course, process, prepared) for name, values in variables.items())
        found.append(
            DisturbanceEstimate(
                process.place,
                process.at_rate,
                process.unit,
                prepared.time,
                course.value,
                _NORMAL_95 * course.error,
                tuple(curve for curve in curves if curve is not None),
                _sentences(process, course, prepared),
            )
        )
    return tuple(found)


def _curve(
    name: str, values: Float[Tensor, " N"], course: DisturbancePath, process: ProcessNoise, prepared: PreparedDynamics
) -> Curve | None:
    """Return the mean of a disturbance over bins of a variable with equal counts, with its band."""
    if float(values.std()) <= 1e-12 * float(values.abs().max().clamp(min=1e-300)):
        return None
    parts = values.argsort().tensor_split(max(min(_BINS, len(values) // 10), 1))
    x = torch.stack([values[part].mean() for part in parts])
    y = torch.stack([course.value[part].mean() for part in parts])
    band = _NORMAL_95 * _error_of_means(course.value, parts)
    unit = prepared.system.units.get(name, prepared.recording.units[name] if name in prepared.recording else "")
    return Curve(name, unit, x, y.unsqueeze(-1), band.unsqueeze(-1), (f"rate of {process.place}",), process.unit)


def _error_of_means(values: Float[Tensor, " N"], parts: Sequence[Tensor]) -> Float[Tensor, " parts"]:
    """Return standard errors of means over parts of an autocorrelated series."""
    N = len(values)
    inside = torch.stack([values.new_zeros(N).index_fill(0, part, 1.0) for part in parts])
    (alike, *pairs) = _lagged(torch.stack([values - values.mean(), *inside]))
    # the autocorrelation after its first zero is noise
    memory = int((alike <= 0).long().argmax()) or N
    count = inside.sum(-1)
    of_pairs = torch.stack([pair[0] * alike[0] + 2.0 * (pair[1:memory] * alike[1:memory]).sum() for pair in pairs])
    return (of_pairs / N).clamp(min=0.0).sqrt() / count


def _lagged(series: Float[Tensor, "k N"]) -> Float[Tensor, "k N"]:
    """Return the lagged products of each series, summed over samples."""
    N = series.shape[-1]
    return torch.fft.irfft(torch.fft.rfft(series, n=2 * N).abs().square(), n=2 * N)[..., :N]


def _sentences(process: ProcessNoise, course: DisturbancePath, prepared: PreparedDynamics) -> tuple[str, ...]:
    what = f"rate of {process.place}" if process.at_rate else process.place
    step = float(prepared.time.diff().median())
    if process.correlation_time > 0.0:
        sentences = [
            f"The disturbance of {what} is not white: its correlation time is about {process.correlation_time:.2g} s."
        ]
    else:
        sentences = [f"The disturbance of {what} is white."]
    for name, values in zip(prepared.system.inputs, prepared.inputs_at_rows.unbind(-1), strict=True):
        lag, size, chance = _strongest(course.value, values, process.correlation_time / step if step > 0 else 0.0)
        if size > max(chance, _PLAIN):
            when = "without delay" if lag == 0 else f"with a delay of {lag * step:.2g} s"
            sentences.append(f"It is correlated with {name} {when} (correlation {size:.2f}).")
        else:
            sentences.append(f"It is uncorrelated with {name} at all lags.")
    return tuple(sentences)


def _strongest(process: Float[Tensor, " N"], given: Float[Tensor, " N"], memory: float) -> tuple[int, float, float]:
    """Return the lag in samples with the largest correlation to an input, that correlation, and its critical value."""
    N = len(process)
    first, other = process - process.mean(), given - given.mean()
    size = torch.linalg.vector_norm(first) * torch.linalg.vector_norm(other)
    if not float(size) > 0.0:
        return 0, 0.0, 1.0
    farthest = min(N // 4, 200)
    spectrum = torch.fft.rfft(first, n=2 * N) * torch.fft.rfft(other, n=2 * N).conj()
    correlation = torch.fft.irfft(spectrum, n=2 * N)[: farthest + 1] / size
    lag = int(correlation.abs().argmax())
    independent = max(N / max(1.0 + 2.0 * memory, 1.0), 2.0)
    return lag, float(correlation[lag].abs()), 4.0 / independent**0.5


def _unit_of(prepared: PreparedDynamics, name: str) -> str:
    return prepared.system.units.get(name, prepared.recording.units[name] if name in prepared.recording else "")
