"""Models of the noise that a recording is tried under: white, slow errors of sensors, process noise, pairs of these."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, longest_run
from mkc_torch.simulation.dynamics.noise_selection import usual_size

__all__ = ["NoiseGrid", "key_of"]

_SIZES = (0.1, 1.0, 10.0, 100.0)
"""Sizes tried, over that at which a disturbance moves an output by as much as its white noise."""

_LASTING = (0.004, 0.03, 0.25)
"""Time constants tried, as shares of the longest run."""

_SHORTEST = 1.9
"""Samples that a disturbance with a memory lasts at least; a shorter one is new at each sample."""

_DIGITS = 3
"""Decimals of a logarithm in which two sizes, or two times, are the same."""


@dataclass(frozen=True)
class NoiseGrid:
    """Models of the noise along a flow.

    Attributes:
        flow: of the trajectory.
        white: the sensors' white noise alone.
    """

    flow: Flow
    white: NoiseModel

    def singles(self) -> list[NoiseModel]:
        """White noise alone, and one disturbance of each place, size and time constant beside it."""
        p, m = self.flow.rates, self.flow.new.shape[1]
        lasting = sorted({max(share * self._longest, 2.0 * self._step) for share in _LASTING})
        sensor = np.array(self.white.sensor)
        found = [self.white]
        for place in range(p + m):
            for time in [0.0, *lasting] if place < p else lasting:
                unit = usual_size(self.flow, place, time, sensor) if place < p else float(sensor[place - p])
                if math.isfinite(unit):
                    found += [replace(self.white, pushes=((place, size * unit, time),)) for size in _SIZES]
        return [one for one in found if self.plausible(one)]

    def pairs(self, model: NoiseModel, singles: Sequence[NoiseModel]) -> list[NoiseModel]:
        """A model with each of the single disturbances beside its own."""
        own = {(place, lasting) for place, _, lasting in model.pushes}
        return [
            replace(model, pushes=(*model.pushes, *one.pushes))
            for one in singles
            if one.pushes and (one.pushes[0][0], one.pushes[0][2]) not in own
        ]

    def neighbours(self, model: NoiseModel, decades: float) -> list[NoiseModel]:
        """A model with one size, one time constant, both, or the noise of one of several sensors changed.

        Args:
            model: the model.
            decades: by how much.
        """
        factor = 10.0**decades
        found = []
        for d, (place, size, lasting) in enumerate(model.pushes):
            sizes = [(place, size * f, lasting) for f in (factor, 1.0 / factor)]
            times = [
                (place, size * by, lasting * f)
                for f in (factor, 1.0 / factor)
                for by in (1.0, factor, 1.0 / factor)
                if lasting > 0 and by != f
            ]
            found += [
                replace(model, pushes=(*model.pushes[:d], other, *model.pushes[d + 1 :])) for other in sizes + times
            ]
        several = len(model.sensor) > 1
        for j, known in enumerate(model.known):
            if several and not known:
                found += [
                    replace(model, sensor=(*model.sensor[:j], f * model.sensor[j], *model.sensor[j + 1 :]))
                    for f in (factor, 1.0 / factor)
                    if not model.floor or f * model.sensor[j] >= model.floor[j]
                ]
        return [one for one in found if self.plausible(one)]

    def plausible(self, model: NoiseModel) -> bool:
        """Whether each disturbance is of a time constant that this recording can show."""
        return all(
            lasting == 0.0 or _SHORTEST * self._step <= lasting <= self._longest for _, _, lasting in model.pushes
        )

    @property
    def _longest(self) -> float:
        return longest_run(self.flow)

    @property
    def _step(self) -> float:
        return float(np.median(self.flow.step[self.flow.step > 0]))


def key_of(model: NoiseModel) -> tuple[object, ...]:
    """The same for models that differ by rounding."""

    def rounded(value: float) -> float:
        return round(math.log10(value), _DIGITS) if value > 0.0 else -math.inf

    pushes = sorted((place, rounded(size), rounded(lasting)) for place, size, lasting in model.pushes)
    return tuple(pushes), tuple(rounded(one) for one in model.sensor)
