"""Sentences and tables of goodness of fit, process noise, drift, input hold and offsets."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch._support.typesetting import plain
from mkc_torch._support.unit_text import sized, tidy
from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment, ProcessNoise
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.report.diagnosis.evidence import Table
from mkc_torch.report.diagnosis.numbers import measured
from mkc_torch.report.diagnosis.recordings import recording_called
from mkc_torch.report.words.numbers import number, size

_MOST_OUTPUTS = 6
_STILL = 2.0
"""Variation, in noise floors, up to which an output hardly varies."""
_MOST_DECIMALS = 4
_SOURCES = {"declared": "declared", "samples": "estimated", "quantisation": "resolution of the recording"}
_BETWEEN = {
    "held": "`{input}` is constant between samples",
    "linear": "`{input}` is linear between samples",
    "smooth": "`{input}` is smooth between samples",
}


def explained(value: float) -> str:
    """Format a share of the variance, with all its nines.

    Example:
        >>> explained(0.9997), explained(0.12), explained(-0.06), explained(0.985), explained(1.0)
        ('99.97 %', '12 %', 'nothing', '98.5 %', '100 %')
    """
    if not value > 0.0:
        return "nothing"
    places = 0 if value < 0.9 or value == 1.0 else min(max(-math.floor(math.log10(1.0 - value)) - 2, 1), _MOST_DECIMALS)
    return f"{number(100.0 * value, places)} %"


def output_lines(diagnosis: Diagnosis) -> list[str]:
    """Return one line per output, with residual and noise floor in its unit, and the offsets."""
    each = diagnosis.environment.goodness_of_fit
    lines = [_fit_text(fit, lost=diagnosis.verdict == "unfit") for fit in each[:_MOST_OUTPUTS]]
    more = len(each) - len(lines)
    offsets = [] if diagnosis.verdict == "unfit" else offset_sentences(diagnosis.environment)
    return [*lines, *([f"and {more} more outputs; see the table"] if more else []), *offsets]


def _fit_text(fit: GoodnessOfFit, *, lost: bool) -> str:
    """Format the goodness of fit of an output; for a poor fit, with the RMSE of the mean.

    Example:
        >>> fit = GoodnessOfFit("angle", "rad", 0.0049, 0.35, 0.9998, 0.005, "declared", 0.35, 0.02)
        >>> _fit_text(fit, lost=False)
        'angle: residual 0.00490 rad; noise floor 0.00500 rad (declared); explains 99.98 % of the variance'
    """
    if lost:
        return (
            f"{plain(fit.output)}: the simulation explains {explained(fit.explained)} of the variance; "
            f"RMSE {_sized(fit.residual, fit.unit)}, of the output's mean "
            f"{_sized(fit.rmse_of_mean, fit.unit)}; noise floor {_floor(fit)}"
        )
    key = (
        "{output}: residual {residual}; noise floor {floor}; the output hardly varies"
        if fit.variation <= _STILL * fit.noise_floor
        else "{output}: residual {residual}; noise floor {floor}; explains {share} of the variance"
    )
    share = explained(fit.explained)
    return key.format(output=plain(fit.output), residual=_sized(fit.residual, fit.unit), floor=_floor(fit), share=share)


def _floor(fit: GoodnessOfFit) -> str:
    if not math.isfinite(fit.noise_floor):
        return "unknown (sampled too slowly)"
    return f"{_sized(fit.noise_floor, fit.unit)} ({_SOURCES[fit.floor_source]})"


def _sized(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{size(value)} {plain(unit)}".rstrip()


def goodness_of_fit_table(environment: NoiseEnvironment) -> Table | None:
    """Return the goodness of fit of each output; None if it was not computed."""
    if not environment.goodness_of_fit:
        return None
    rows = tuple(
        (
            plain(fit.output),
            _sized(fit.residual, fit.unit),
            _floor(fit),
            _sized(fit.variation, fit.unit),
            explained(fit.explained),
            _sized(fit.rmse_of_mean, fit.unit),
            _sized(fit.rmse_of_last_value, fit.unit),
        )
        for fit in environment.goodness_of_fit
    )
    return Table(
        "Goodness of fit",
        tuple(key for key in _FOLLOWS_COLUMNS),
        rows,
        (
            "The residual is the robust RMSE of the open-loop simulation; the noise floor is the sensor's. Where "
            "the residual is as large as the RMSE of the mean, the simulation does not predict the output."
        ),
    )


_FOLLOWS_COLUMNS = (
    "output",
    "residual",
    "noise floor",
    "standard deviation of the output",
    "explained variance",
    "RMSE if predicted by the mean",
    "RMSE if predicted by the last value",
)


def process_noise_sentences(processes: Sequence[ProcessNoise]) -> list[str]:
    """Format process noise and drift, one sentence for each state and each output.

    Example:
        >>> process_noise_sentences([ProcessNoise("rate", True, 0.7, 0.2284, 0.021, "rad/s²", 300.0)])
        ['Process noise on the rate of `rate`: 0.228 ± 0.021 rad/s², correlation time 0.7 s.']
        >>> process_noise_sentences([ProcessNoise("rate", True, 0.0, 0.2284, 0.021, "rad/s²", 300.0)])
        ['Process noise on the rate of `rate`: 0.228 ± 0.021 rad/s², white noise.']
        >>> slow = ProcessNoise("temp", False, 463.0, 0.053, 0.0071, "°C", 12.0)
        >>> process_noise_sentences([slow])
        ['Drift of `temp` in addition to its white noise: 0.0530 ± 0.0071 °C, correlation time 460 s.']
        >>> process_noise_sentences([slow, ProcessNoise("temp", False, 30.0, 0.01, 0.002, "°C", 12.0)])[0][-75:]
        ' °C, correlation time 460 s; and 0.0100 ± 0.0020 °C, correlation time 30 s.'
    """
    sizes: dict[tuple[bool, str], list[str]] = {}
    for process in processes:
        sizes.setdefault((process.at_rate, plain(process.place)), []).append(_size_and_memory(process))
    return [
        f"Process noise on the rate of `{place}`: {'; and '.join(each)}."
        if at_rate
        else f"Drift of `{place}` in addition to its white noise: {'; and '.join(each)}."
        for (at_rate, place), each in sizes.items()
    ]


def _size_and_memory(process: ProcessNoise) -> str:
    amount = measured(process.size, process.standard_error, tidy(process.unit))[0]
    if not process.correlation_time > 0.0:
        return f"{amount}, white noise"
    return f"{amount}, correlation time {sized(float(f'{process.correlation_time:.2g}'))} s"


def process_noise_table(environment: NoiseEnvironment) -> Table | None:
    """Return the numbers of process noise and drift; None if there is neither."""
    if not environment.process_noise:
        return None
    rows = tuple(
        (
            f"the rate of {plain(process.place)}" if process.at_rate else plain(process.place),
            measured(process.size, process.standard_error, tidy(process.unit))[0],
            f"{sized(float(f'{process.correlation_time:.3g}'))} s" if process.correlation_time > 0.0 else "sample",
            size(process.log_likelihood_gain) if math.isfinite(process.log_likelihood_gain) else "unknown",
        )
        for process in environment.process_noise
    )
    columns = ("acts on", "standard deviation", "correlation time", "log-likelihood gain, nats")
    return Table(
        "Process noise and drift",
        columns,
        rows,
        "± is a standard error; the last column is the log-likelihood gain over a model without it.",
    )


def input_hold_sentence(environment: NoiseEnvironment) -> str:
    """Format the input hold; empty if it was not selected.

    Example:
        >>> input_hold_sentence(NoiseEnvironment(input_hold={"torque": "held", "force": "linear"}))
        'Input hold: `torque` is constant between samples, `force` is linear between samples.'
    """
    each = [_BETWEEN[how].format(input=plain(name)) for name, how in environment.input_hold.items()]
    return f"Input hold: {', '.join(each)}." if each else ""


def offset_sentences(environment: NoiseEnvironment) -> list[str]:
    """Format the offsets of each output in several recordings.

    Example:
        >>> from mkc_torch.diagnosis.environment import Offset
        >>> offset_sentences(NoiseEnvironment(offsets=(Offset("speed", "m/s", 1, "a.csv", 0.3, 0.001),)))
        ['Offset of speed in each recording: recording 1 (a.csv): 0.3000 ± 0.0010 m/s.']
    """
    sizes: dict[str, list[str]] = {}
    for offset in environment.offsets:
        known = math.isfinite(offset.standard_error)
        value = measured(offset.value, offset.standard_error, tidy(offset.unit))[0] if known else "0"
        sizes.setdefault(offset.output, []).append(f"{recording_called(offset.recording, offset.name)}: {value}")
    return [f"Offset of {plain(name)} in each recording: {', '.join(each)}." for name, each in sizes.items()]


def remainder(diagnosis: Diagnosis) -> str:
    """State process noise and drift, or that the residual is the sensor's noise; empty if neither was tested."""
    d = diagnosis
    if d.environment.process_noise:
        return " ".join(process_noise_sentences(d.environment.process_noise))
    if d.verdict == "adequate" and d.environment.goodness_of_fit:
        return "The residual is the sensor's noise."
    return ""


def noise_lines(diagnosis: Diagnosis) -> list[str]:
    """Return the sentences on process noise, drift and input hold."""
    return [line for line in (remainder(diagnosis), input_hold_sentence(diagnosis.environment)) if line]
