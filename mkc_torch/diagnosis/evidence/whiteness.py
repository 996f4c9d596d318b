"""Whether what the final model leaves over is white, and if not, up to which lag it is correlated."""

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
"""Lags of the portmanteau statistic: enough for noise with a memory, few enough to see a short one."""

_FARTHEST = 0.25
"""Share of the recording up to which lags are looked at one by one; beyond, too few samples are left to compare."""

_TITLE = "Is what is left over white?"
_NOTE = (
    "Autocorrelation of what the final model leaves over, rejected samples aside: the last lag at which it is beyond "
    "chance, that of neighbours, and the p-value of all lags up to the {lags}th together. Of white channels "
    "{level:.2g} are called correlated."
)


@dataclass(frozen=True)
class Whiteness:
    """Of one channel: the last lag at which it is correlated, 0 where it is white, in samples.

    ``neighbours`` is its correlation from one sample to the next, ``p_value`` that of the first ``lags`` together.
    """

    lag: int
    neighbours: float
    p_value: float
    lags: int


def test(case: EvidenceContext) -> EvidenceResult:
    """The channels of the final fit's pseudo-residual, each by itself."""
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
        rows=(Row("left over", _in_words(channels, step, unit)),),
        table=table,
    )


def _in_words(channels: Mapping[str, Whiteness], step: float, unit: str) -> str:
    """The channel that is correlated longest, and how many are white.

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
    """Whether a series is white, where some of its samples do not count.

    It is not if the squares of its first autocorrelations are too large together, or one is at any lag, by Bartlett's
    error of it, which grows with those before.

    Ljung & Box, "On a measure of lack of fit in time series models", Biometrika 65 (1978); with missing samples,
    Stoffer & Toloi, Statistics & Probability Letters 13 (1992). Bartlett, J. R. Stat. Soc. Suppl. 8 (1946).

    Args:
        values: 0 where they do not count.
        counts: 1 where they do, else 0.
        settings: the share of white series that may be called correlated.

    Example:
        >>> draws = torch.randn(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> sums, ones, usual = draws[1:] + draws[:-1], torch.ones_like(draws), EvidenceSettings()
        >>> whiteness(draws, ones, usual).lag, whiteness(sums, ones[1:], usual).lag
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
    """Sums of products with the series some samples later."""
    N = len(values)
    return torch.fft.irfft(torch.fft.rfft(values, n=2 * N).abs().square(), n=2 * N)[:N]
