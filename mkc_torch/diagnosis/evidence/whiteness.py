"""Whiteness test of the final model's residual."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult, Row, Table
from mkc_torch.diagnosis.settings import EvidenceSettings

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Whiteness", "test", "whiteness"]

_FIRST = 20
"""Number of lags of the portmanteau statistic."""

_FARTHEST = 0.25
"""Largest lag that is tested on its own, as a share of the recording."""

_TITLE = "Whiteness of the residual"
_NOTE = (
    "Autocorrelation of the final model's residual, without rejected samples: the last significant lag, the "
    "correlation "
    "of neighbours, and the p-value of the first {lags} lags together. The level is {level:.2g}."
)


@dataclass(frozen=True)
class Whiteness:
    """Whiteness of a channel: the last significant lag in samples, 0 if white.

    ``neighbours`` is the correlation at lag 1, ``p_value`` that of the first ``lags`` lags together.
    """

    lag: int
    neighbours: float
    p_value: float
    lags: int


def test(case: EvidenceContext) -> EvidenceResult:
    """Test each channel of the final fit's pseudo-residual."""
    settings = case.settings.evidence
    values, counts = case.final.fit.pseudo(case.settings.noise)
    time = case.prepared.time
    step = 1.0 if case.prepared.recording.time is None else float(time.diff().median())
    unit = "samples" if case.prepared.recording.time is None else "s"
    channels = {
        name: whiteness(column, used, settings)
        for name, column, used in zip(case.prepared.channels, values.unbind(-1), counts.unbind(-1), strict=True)
    }
    content = [
        {"channel": name, "white": found.lag == 0, **asdict(found), "lag": step * found.lag}
        for name, found in channels.items()
    ]
    rows = tuple(
        (
            name,
            f"{step * found.lag:.3g} {unit}" if found.lag else "white",
            f"{found.neighbours:.2f}",
            f"{found.p_value:.2g}" if found.p_value >= 1e-4 else "< 0.0001",
        )
        for name, found in channels.items()
    )
    table = Table(
        _TITLE,
        ("channel", "correlated up to", "correlation of neighbours", "p-value"),
        rows,
        _NOTE.format(lags=next(iter(channels.values())).lags, level=settings.white_level),
    )
    return EvidenceResult(
        "whiteness",
        channels,
        content={"unit": unit, "channels": content},
        rows=(Row("residual", _in_words(channels, step, unit)),),
        table=table,
    )


def _in_words(channels: Mapping[str, Whiteness], step: float, unit: str) -> str:
    """Return the channel with the longest correlation, and the number of white channels.

    Example:
        >>> white, coloured = Whiteness(0, 0.01, 0.4, 20), Whiteness(20, 0.8, 0.0, 20)
        >>> _in_words({"norm": white}, 0.02, "s"), _in_words({"norm": coloured}, 0.02, "s")
        ('white', 'correlated up to 0.4 s')
        >>> _in_words({"x": white, "y": coloured}, 1.0, "samples")
        'y correlated up to 20 samples; 1 of 2 channels white'
    """
    name, longest = max(channels.items(), key=lambda item: item[1].lag)
    if longest.lag == 0:
        return "white"
    reach = f"correlated up to {step * longest.lag:.3g} {unit}"
    if len(channels) == 1:
        return reach
    white = sum(found.lag == 0 for found in channels.values())
    return f"{name} {reach}; {white or 'none'} of {len(channels)} channels white"


def whiteness(values: Float[Tensor, " N"], counts: Float[Tensor, " N"], settings: EvidenceSettings) -> Whiteness:
    """Test whether a series with masked samples is white.

    It is rejected by the portmanteau statistic of the first autocorrelations, or by an autocorrelation at any lag, with
    Bartlett's standard error, which includes the previous lags.

    Ljung & Box, "On a measure of lack of fit in time series models", Biometrika 65 (1978); with missing samples,
    Stoffer & Toloi, Statistics & Probability Letters 13 (1992). Bartlett, J. R. Stat. Soc. Suppl. 8 (1946).

    Args:
        values: the series; 0 for masked samples.
        counts: mask, 0 or 1.
        settings: level of the test.

    Example:
        >>> draws = torch.randn(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> sums, mask, usual = draws[1:] + draws[:-1], torch.ones_like(draws), EvidenceSettings()
        >>> whiteness(draws, mask, usual).lag, whiteness(sums, mask[1:], usual).lag
        (0, 1)
    """
    N = len(values)
    farthest = max(int(_FARTHEST * N), 1)
    centred = counts * (values - values.sum() / counts.sum().clamp(min=1.0))
    products, pairs = (_lagged_sums(count.double())[: farthest + 1] for count in (centred, counts))
    pairs = pairs.round().clamp(min=1.0)
    variance = products[0] / pairs[0]
    if float(variance) <= 0.0:
        return Whiteness(0, 0.0, 1.0, min(_FIRST, farthest))
    correlation = (products / pairs / variance)[1:]
    square = correlation.square()
    first = min(_FIRST, farthest)
    statistic = (pairs[1 : first + 1] * square[:first]).sum()
    p_value = float(torch.special.gammaincc(0.5 * statistic.new_tensor(first), 0.5 * statistic))
    error = ((1.0 + 2.0 * (square.cumsum(0) - square)) / pairs[1:]).sqrt()
    size = correlation.abs() / error
    most = float(torch.special.ndtri(torch.tensor(1.0 - 0.25 * settings.white_level / farthest, dtype=torch.float64)))
    beyond = (size > most).nonzero().flatten().tolist()
    if not beyond and p_value <= 0.5 * settings.white_level:
        beyond = [int(size[:first].argmax())]
    return Whiteness(beyond[-1] + 1 if beyond else 0, float(correlation[0]), p_value, first)


def _lagged_sums(values: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Return the lagged products of a series, summed over samples."""
    N = len(values)
    return torch.fft.irfft(torch.fft.rfft(values, n=2 * N).abs().square(), n=2 * N)[:N]
