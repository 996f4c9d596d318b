"""What to record to tell an effect from a rival: how much more and in which state, by the tangents of a recording."""

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

__all__ = ["SAME", "distinguishing_state"]

SAME = "Their courses are the same in this recording: only one in which they differ can tell them apart."

_NOTHING = 0.05
"""Nats that tell an effect from a rival in all of a recording, below which no recording of this kind would do."""

_BETTER, _FEWEST = 1.5, 0.03
"""Times that a sample has to tell more than one on average, and the share of samples that do, to be worth a word."""

_MAINLY = 0.8
"""Share of a signal's length that an axis has to have for the signal to be mainly along it."""

_MOST = 20.0
"""Times as many samples beyond which it is told as far more."""


def distinguishing_state(located: SearchResult, own: int, rival: int) -> str:
    """A sentence on what to record.

    The effect as it was found has a trace in the residual, and the rival with all of the simulation's own parameters
    follows it as far as it can. Half the square of what is left, in the noise of the search, is what the data are
    expected to tell them apart by, in nats; where in the recording it lies says which samples do it.

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
    text = f"In a recording like this one {often} would tell them apart"
    left = _left(located, own, rival)
    times, words = max(((state.times(left), state.display_name) for state in _states(located)), default=(0.0, ""))
    if times < _BETTER:
        return f"{text}."
    return f"{text}; those while {words} do it best, {times:.1f} times as well as one on average."


@dataclass(frozen=True)
class _State:
    """A state in which some of the samples were recorded."""

    display_name: str
    samples: Bool[Tensor, " N"]

    def times(self, left: Float[Tensor, " N"]) -> float:
        """How many times as much a sample in this state tells as one on average."""
        share = float(self.samples.double().mean())
        mean = float(left.mean())
        return float(left[self.samples].mean()) / mean if share >= _FEWEST and mean > 0 else 0.0


def _left(located: SearchResult, own: int, rival: int) -> Float[Tensor, " N"]:
    """Of each sample, the square of what a rival does not follow, over the noise."""
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
    """Low and high values of each recorded driver, and what passes through the port mainly along one of its axes."""
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
