"""Experiment design: how much to record, and in which state, to distinguish an effect from a rival."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.unit_text import sized
from mkc_torch.diagnosis.search.run import SearchResult

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

SAME = "In this recording their effects are equal within the noise: only a recording in which they differ helps."

_NOTHING = 0.05
"""Expected gain in nats below which no similar recording distinguishes two effects."""

_BETTER = 1.5
"""Minimum information of a sample, relative to the mean, for a state to be named."""

_FEWEST = 0.03
"""Minimum share of samples in that state."""

_MAINLY = 0.8
"""Minimum share of a signal's norm along its main axis."""

_MOST = 20.0
"""Ratio of samples above which "far more samples" is reported."""


def distinguishing_state(located: SearchResult, own: int, rival: int) -> str:
    """Return a sentence on what to record.

    The trace of the effect is projected on the rival and the simulation's parameters. Half the squared residual of the
    projection, in units of the noise, is the expected log-likelihood gain in nats; its distribution over the recording
    shows the informative samples.

    Args:
        located: the search that named the effect.
        own: number of the effect among its candidates.
        rival: number of the rival.
    """
    search, series = located.look.linearised.search, located.look.linearised.series
    trace, _, _ = search.trace(own, series)
    _, space, _ = search.trace(rival, series)
    nats = 0.5 * float((trace - space @ (space.mT @ trace)).square().sum())
    if nats < _NOTHING:
        return SAME
    more = located.scene.settings.naming.separable / nats
    often = f"about {more:.1f} times as many samples" if more > 1.0 else "as many samples again"
    if more > _MOST:
        often = "far more samples"
    text = f"In a similar recording, {often} would distinguish them"
    left = _left(located, own, rival)
    times, words = max(((state.times(left), state.display_name) for state in _states(located)), default=(0.0, ""))
    if times < _BETTER:
        return f"{text}."
    return f"{text}; best samples in which {words}, with {times:.1f} times the mean information."


@dataclass(frozen=True)
class _State:
    """A condition, and the samples that meet it."""

    display_name: str
    samples: Bool[Tensor, " N"]

    def times(self, left: Float[Tensor, " N"]) -> float:
        """Return the information of a sample in this state, relative to the mean."""
        share = float(self.samples.double().mean())
        mean = float(left.mean())
        return float(left[self.samples].mean()) / mean if share >= _FEWEST and mean > 0 else 0.0


def _left(located: SearchResult, own: int, rival: int) -> Float[Tensor, " N"]:
    """Return the squared residual of the projection at each sample, in units of the noise."""
    gamma = located.look.linearised.search.estimate(own, located.look.linearised.series)[0]
    weight = (located.scene.counts / located.fit.d).unsqueeze(-1)
    candidates = located.scene.tangents.candidates
    target = (weight.squeeze(-1) * (candidates[own] @ gamma)).flatten()
    columns = (weight * torch.cat([located.scene.tangents.nuisance, candidates[rival]], -1)).flatten(0, 1)
    size = torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300)
    basis = torch.linalg.qr(columns / size).Q
    left = target - basis @ (basis.mT @ target)
    return left.square().unflatten(0, located.scene.counts.shape).sum(-1)


def _states(located: SearchResult) -> Iterator[_State]:
    """Yield low and high values of each recorded driver, and main axes of the port's signal."""
    drivers = {t.driver.columns[0]: t.driver for t in located.scene.terms if t.driver and len(t.driver.columns) == 1}
    for name, driver in drivers.items():
        values = driver.values[:, 0]
        if len(values) != len(located.scene.counts):
            continue
        low, high = (float(v) for v in torch.quantile(values, values.new_tensor([1.0 / 3.0, 2.0 / 3.0])))
        for word, edge, inside in (("below", low, values < low), ("above", high, values > high)):
            yield _State(f"{name} is {word} {sized(edge + float(driver.reference), driver.units[0])}", inside)
    yield from _along(located)


def _along(located: SearchResult) -> Iterator[_State]:
    model = located.fit.model
    name = model.terms[-1].port
    port, signals = model.prepared.ports[name], _signals(located)
    if name not in signals or port.carries or len(signals[name]) != len(located.scene.counts):
        return
    signal = signals[name]
    share = signal / torch.linalg.vector_norm(signal, dim=-1, keepdim=True).clamp(min=1e-300)
    for axis, part in zip(port.channels, share.unbind(-1), strict=True):
        for word, inside in (("+", part > _MAINLY), ("−", part < -_MAINLY)):
            yield _State(f"the signal at the {name} is mainly along {word}{axis}", inside)


def _signals(located: SearchResult) -> Mapping[str, Tensor]:
    signals = located.fit.model.signals(located.fit.parameters)
    return {name: value for name, value in signals.items() if math.isfinite(float(value.abs().sum()))}
