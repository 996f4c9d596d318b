"""Texts of the noise model, of the scores on held-out blocks, and of the smooth correction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mkc_torch._support.typesetting import plain, several
from mkc_torch.diagnosis.result import Diagnosis, NoiseSummary, Number
from mkc_torch.diagnosis.vetoes import counts
from mkc_torch.report.diagnosis.numbers import measured
from mkc_torch.report.words.numbers import bandwidth, number, size

_CLEARLY = 0.99
"""Ratio of residuals below which the smaller is reported."""

_KINDS = {"white": "white", "ar": "autoregressive", "random_walk": "random walk"}
_NOISE = {"drift": "drift of the offset", "drift_period": "cut-off of the drift"}
_CHANNELS = {
    "norm": "norm: measured length of the field minus the simulated length",
    "along": "along: residual along the ambient field (the field's length shows it too)",
    "across_1": "across_1 and across_2: the two perpendicular residuals, which include errors of the attitude",
}


def noise_model(noise: NoiseSummary) -> str:
    """Return the noise model in words: its description, or its kind."""
    return plain(noise.description.strip()) or f"{_KINDS[noise.model]} noise"


def noise_parameters(noise: NoiseSummary, channels: Sequence[str]) -> list[tuple[str, str]]:
    """Return the parameters of the noise model, and those of the density per channel."""
    rows: list[tuple[str, str]] = []
    for name, value in noise.parameters.items():
        unit = noise.units.get(name, "")
        if name == "autoregression":
            rows += _memory(value, channels)
        elif name in _NOISE:
            text = " ".join(measured(value, None, unit))
            rows.append((_NOISE[name], _drift_text(name, text)))
        else:
            rows.append((plain(name), " ".join(measured(value, None, unit))))
    unit = f" {plain(noise.unit)}" if noise.unit else ""
    density = zip(noise.sigma, noise.d, noise.bound, strict=True)
    for i, (sigma, d, bound) in enumerate(density):
        name = "density"
        if len(noise.sigma) > 1 and i < len(channels):
            name = f"{name} of {plain(channels[i])}"
        within = f"within ±{size(bound)}{unit}"
        tail = f"; {noise.tails[i]}" if i < len(noise.tails) else ""
        rows.append((name, f"σ = {bandwidth(sigma)}, d = {size(d)}{unit}, {within}{tail}"))
    return rows


def _drift_text(name: str, text: str) -> str:
    if name == "drift":
        return f"{text}, its standard deviation over the recording"
    return f"period {text}"


def _memory(value: Number, channels: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Return one row per channel with autoregression coefficients."""
    each = list(value) if isinstance(value, Sequence) else [value]
    for i, item in enumerate(each):
        if not isinstance(item, Sequence) or item:
            name = "autoregression"
            if len(each) > 1 and i < len(channels):
                name = f"{name} of {plain(channels[i])}"
            text = measured(item, None, "")[0].removeprefix("(").removesuffix(")")
            yield name, f"coefficients {text}"


def channel_notes(channels: Sequence[str]) -> str:
    """Return the meaning of a magnetometer's channels; empty for other simulations."""
    return "; ".join(note for name, note in _CHANNELS.items() if name in channels)


def held_out_rows(diagnosis: Diagnosis) -> list[tuple[str, list[str]]]:
    """Return RMSE, log-likelihood, σ and d of each model on held-out blocks."""
    rows = [("the simulation without findings", diagnosis.baseline)]
    if any(counts(finding) for finding in diagnosis.findings):
        rows.append(("with the findings", diagnosis.corrected))
    if diagnosis.ceiling is not None and _shown(diagnosis):
        rows.append(("with a smooth correction by all recorded columns", diagnosis.ceiling))
    return [
        (
            name,
            [
                size(s.rmse) if _one_unit(diagnosis) else "–",
                number(s.log_likelihood, 3),
                several([bandwidth(v) for v in s.sigma]),
                several([size(v) for v in s.d]),
            ],
        )
        for name, s in rows
    ]


def smooth_fit(diagnosis: Diagnosis) -> str:
    """Return the residual of a smooth correction by all columns; empty if it is not smaller."""
    d = diagnosis
    if d.ceiling is None or not d.ceiling.rmse < _CLEARLY * d.corrected.rmse or not _one_unit(d):
        return ""
    unit = plain(d.traces.unit)
    smooth = f"a smooth correction by all recorded columns and by time reaches {size(d.ceiling.rmse)} {unit}".rstrip()
    residual = f"{size(d.corrected.rmse)} {unit}".rstrip()
    return ("{smooth}; with the findings {residual}" if d.findings else "{smooth}; the residual is {residual}").format(
        smooth=smooth, residual=residual
    )


def _shown(diagnosis: Diagnosis) -> bool:
    """Whether the smooth correction is clearly better than the findings."""
    d = diagnosis
    return d.ceiling is not None and (not d.findings or d.ceiling.rmse < _CLEARLY * d.corrected.rmse)


def _one_unit(diagnosis: Diagnosis) -> bool:
    """Whether the residuals of all channels share a unit."""
    return len(diagnosis.traces.channels) == 1 or bool(diagnosis.traces.unit)
