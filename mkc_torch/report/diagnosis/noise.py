"""The noise of a diagnosis in words: its model, how well its density fits, and what smooth curves reach beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mkc_torch.diagnosis.result import DensityCheck, Diagnosis, Noise, Number
from mkc_torch.report.diagnosis.numbers import measured
from mkc_torch.report.words.numbers import bandwidth, number, size
from mkc_torch.report.words.typesetting import plain, several

__all__ = [
    "channel_notes",
    "density_check",
    "held_out_rows",
    "noise_model",
    "noise_parameters",
    "smooth_fit",
]

_CLEARLY = 0.99  # of a residual, below which another one is smaller
_NOISE = {
    "wander": ("slow wander of the offset", "{}, its standard deviation over the recording"),
    "wander_period": ("the wander falls off", "below a period of {}"),
}
_CHANNELS = {
    "norm": "norm: the length of the field, less what the simulation has for it",
    "along": "along: the part of the residual along the ambient field, which its length shows too",
    "across_1": "across_1 and across_2: the two parts at right angles to it, which errors of the attitude enter",
}


def noise_model(noise: Noise) -> str:
    """The noise in words."""
    kind = {"white": "white", "ar": "autoregressive", "random_walk": "random walk"}[noise.model]
    return f"{kind}: {plain(noise.description)}" if noise.description.strip() else f"{kind} noise"


def noise_parameters(noise: Noise, channels: Sequence[str]) -> list[tuple[str, str]]:
    """The numbers of the noise model in words, those of the density once a channel."""
    rows: list[tuple[str, str]] = []
    for name, value in noise.parameters.items():
        unit = noise.units.get(name, "")
        if name == "autoregression":
            rows += _memory(value, channels)
        elif name in _NOISE:
            rows.append((_NOISE[name][0], _NOISE[name][1].format(" ".join(measured(value, None, unit)))))
        else:
            rows.append((plain(name), " ".join(measured(value, None, unit))))
    unit = f" {plain(noise.unit)}" if noise.unit else ""
    density = zip(noise.sigma, noise.d, noise.bound, strict=True)
    for i, (sigma, d, bound) in enumerate(density):
        named = f" of {plain(channels[i])}" if len(noise.sigma) > 1 and i < len(channels) else ""
        rows.append((f"density{named}", f"σ = {bandwidth(sigma)}, d = {size(d)}{unit}, within ±{size(bound)}{unit}"))
    return rows


def _memory(value: Number, channels: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Autoregression coefficients, a row a channel that has some."""
    each = list(value) if isinstance(value, Sequence) else [value]
    for i, one in enumerate(each):
        if not isinstance(one, Sequence) or one:
            named = f" of {plain(channels[i])}" if len(each) > 1 and i < len(channels) else ""
            told = measured(one, None, "")[0].removeprefix("(").removesuffix(")")
            yield f"memory{named}", f"{told} times the samples before it"


def density_check(check: DensityCheck) -> tuple[str, str, str]:
    """How far a channel's density is off, how far a Student-t is, and what that says.

    Example:
        >>> density_check(DensityCheck("norm", 0.021, 0.034, 4.0, 0.05, False))
        ('0.021', '0.034 (4 degrees of freedom)', 'no more than chance')
    """
    said = "a Student-t is closer" if check.closer else "no more than chance"
    if not check.closer and check.distance > check.allowed:
        said = "the density is off, and a Student-t clearly no better"
    freedom = f"{check.degrees_of_freedom:g} degree{'' if check.degrees_of_freedom == 1 else 's'} of freedom"
    return f"{check.distance:.2g}", f"{check.student_distance:.2g} ({freedom})", said


def channel_notes(channels: Sequence[str]) -> str:
    """What a magnetometer's channels are called; empty for others."""
    return "; ".join(note for name, note in _CHANNELS.items() if name in channels)


def held_out_rows(diagnosis: Diagnosis) -> list[tuple[str, list[str]]]:
    """The models compared on held-out blocks: root mean square, log-likelihood, and σ and d of each channel."""
    rows = [("the simulation as it is", diagnosis.baseline)]
    if diagnosis.findings:
        rows.append(("with the findings", diagnosis.corrected))
    if diagnosis.ceiling is not None and _shown(diagnosis):
        rows.append(("with a smooth correction by all recorded columns", diagnosis.ceiling))
    return [
        (
            name,
            [
                size(s.rmse),
                number(s.log_likelihood, 3),
                several([bandwidth(v) for v in s.sigma]),
                several([size(v) for v in s.d]),
            ],
        )
        for name, s in rows
    ]


def smooth_fit(diagnosis: Diagnosis) -> str:
    """How far a smooth correction by all columns comes, beside the residual; empty where what was found is better."""
    d = diagnosis
    if d.ceiling is None or not _shown(d):
        return ""
    unit = plain(d.traces.unit)
    reached = f"a smooth correction by all recorded columns and by time reaches {size(d.ceiling.rmse)} {unit}".rstrip()
    with_it = "with the findings it is" if d.findings else "the residual is"
    return f"{reached}; {with_it} {size(d.corrected.rmse)} {unit}".rstrip()


def _shown(diagnosis: Diagnosis) -> bool:
    """Whether the smooth correction says something that the findings do not."""
    d = diagnosis
    return d.ceiling is not None and (not d.findings or d.ceiling.rmse < _CLEARLY * d.corrected.rmse)
