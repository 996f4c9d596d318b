"""The noise that a diagnosis reports: its model, disturbances, and offsets of single recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized, tidy
from mkc_torch.density.tails import time_series_tails
from mkc_torch.diagnosis.environment import Curve, DisturbanceEstimate, Offset, ProcessNoise, Run
from mkc_torch.diagnosis.goodness_of_fit import units_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.result import NoiseSummary, Number
from mkc_torch.diagnosis.search.estimate import FinalEstimate
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.simulation.dynamics.noise import DisturbancePath, StateSpaceNoise, disturbance_paths
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float


def noise_summary(final: FinalEstimate, settings: NoiseSettings) -> NoiseSummary:
    """Return the noise model (white, autoregressive or random walk) with its parameters."""
    fit, drift = final.fit, final.noise
    prepared = fit.model.prepared
    orders = final.spectrum.coefficients
    coloured = any(float(phi.square().sum()) > settings.reported_autocorrelation for phi in orders)
    parameters: dict[str, Number] = {}
    units: dict[str, str] = {}
    clear = drift.size > 0 and drift.gain > settings.reported_drift
    if clear:
        parameters["drift"] = final.drift_spread
        units["drift"] = next(port.unit for port in prepared.ports.values() if port.allows_drift)
        if drift.family > 0:
            length = float(prepared.time[-1] - prepared.time[0])
            parameters["drift_period"] = 2.0 * length / settings.plateaus[drift.family - 1][0]
            units["drift_period"] = "s"
    if coloured:
        parameters["autoregression"] = tuple(tuple(phi.tolist()) for phi in orders)
    if clear and drift.family == 0:
        model = "random_walk"
        size = f"{parameters['drift']:.2g} {units['drift']}"
        text = f"noise around an offset with a random walk of standard deviation {size}"
    elif clear or coloured:
        model, text = "ar", "coloured noise" + (", with drift of the offset" if clear else "")
    else:
        model, text = "white", "white noise"
    tails = time_series_tails(fit.residual)
    tail = "Gaussian" if all(channel.is_gaussian for channel in tails) else "heavy-tailed"
    return NoiseSummary(
        model,  # type: ignore[arg-type]
        parameters,
        tuple(fit.sigma.tolist()),
        tuple(fit.d.tolist()),
        tuple(fit.bound.tolist()),
        f"{tail} {text}",
        units,
        prepared.unit,
        tails,
    )


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
        unit = _unit_of(prepared, disturbance.place)
        if disturbance.at_rate:
            unit = f"{unit}/s" if unit else "1/s"
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
    what = f"The disturbance of the rate of {process.place}" if process.at_rate else f"The drift of {process.place}"
    step = float(prepared.time.diff().median())
    if process.correlation_time > 0.0:
        sentences = [
            f"{what} is not white: its correlation time is about "
            f"{sized(float(f'{process.correlation_time:.2g}'), 's')}."
        ]
    else:
        sentences = [f"{what} is white."]
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


def offsets_of(final: FinalEstimate, names: Sequence[str]) -> tuple[Offset, ...]:
    """Return the offsets of each output in each recording, for outputs with a fitted offset.

    Args:
        final: the fit with all findings.
        names: of the recordings.
    """
    prepared = final.fit.model.prepared
    own = prepared.own_offsets
    units, error = dict(zip(prepared.channels, units_of(prepared), strict=True)), final.standard_error
    row = {name: k for k, name in enumerate(prepared.parameter_names)}
    fitted = {(offset.output, offset.recording): row[offset.name] for offset in own}
    sentences = []
    for output in dict.fromkeys(offset.output for offset in own):
        for number, name in enumerate(names):
            at = fitted.get((output, number))
            value = 0.0 if at is None else float(final.fit.parameters[at])
            sentences.append(
                Offset(output, units[output], number + 1, name, value, math.nan if at is None else float(error[at]))
            )
    return tuple(sentences)


_SHARED_ERRORS = 3.0
"""Standard errors that a shared offset has to exceed, and that each offset may differ from it."""

_SHARED_SPREAD = 0.2
"""Largest difference of an offset from the shared offset, relative to it, if its standard error is smaller."""


def shared_offsets(offsets: Sequence[Offset]) -> tuple[str, ...]:
    """Return a sentence for each output with the same offset in all recordings: it repeats, so the simulation lacks it.

    Args:
        offsets: of each output in each recording.

    Example:
        >>> each = [Offset("lift", "rad", k, name, 0.037, 0.001) for k, name in ((1, "a.csv"), (2, "b.csv"))]
        >>> shared_offsets(each)[0].split(". ")[0]
        'The offset of `lift` is the same in all recordings: 0.037 ± 0.00071 rad'
        >>> shared_offsets([*each, Offset("lift", "rad", 3, "c.csv", 0.0, 0.001)])
        ()
    """
    sentences = []
    for output in dict.fromkeys(offset.output for offset in offsets):
        known = [offset for offset in offsets if offset.output == output]
        if len(known) < 2 or not all(0.0 < offset.standard_error < math.inf for offset in known):
            continue
        weight = [offset.standard_error**-2 for offset in known]
        mean = sum(w * offset.value for w, offset in zip(weight, known, strict=True)) / sum(weight)
        if any(
            abs(offset.value) <= _SHARED_ERRORS * offset.standard_error
            or abs(offset.value - mean) > max(_SHARED_ERRORS * offset.standard_error, _SHARED_SPREAD * abs(mean))
            for offset in known
        ):
            continue
        size = f"{mean:.2g} ± {sum(weight) ** -0.5:.2g} {tidy(known[0].unit)}".rstrip()
        sentences.append(
            f"The offset of `{output}` is the same in all recordings: {size}. Look for a cause that does not change, "
            "such as a sensor's zero or a constant load, and add it to the simulation."
        )
    return tuple(sentences)


def runs_of(prepared: PreparedSimulation, names: Sequence[str], counts: Sequence[int]) -> tuple[Run, ...]:
    """Return the runs, in the order of a finding's shares; empty for a single run or unknown runs.

    Args:
        prepared: the simulation.
        names: of the recordings; empty for a single recording.
        counts: number of runs per recording; empty for a single recording.
    """
    system = prepared.dynamics
    if system is None or int(system.run.max()) < 1:
        return ()
    if not names:
        return tuple(Run(0, "", number + 1) for number in range(int(system.run.max()) + 1))
    each = [
        Run(number, name, run + 1 if count > 1 else 0)
        for number, (name, count) in enumerate(zip(names, counts, strict=True), start=1)
        for run in range(count)
    ]
    first = (system.run.diff(prepend=system.run[:1] - 1) != 0).nonzero().flatten()
    return tuple(each[int(number)] for number in prepared.recording["experiment"][first])
