"""A grid of noise models: white sensor noise, sensor drift, process noise, and pairs of disturbances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, longest_run
from mkc_torch.simulation.dynamics.noise_selection import usual_size

_SIZES = (0.1, 1.0, 10.0, 100.0)
"""Sizes tried, in units of the size at which a disturbance moves an output by its white noise."""

_TIME_CONSTANTS = (0.004, 0.03, 0.25)
"""Time constants tried, as shares of the longest run."""

_SHORTEST = 1.9
"""Shortest time constant of a lasting disturbance, in samples; shorter disturbances are white."""

_DIGITS = 3
"""Decimals of the logarithm to which two sizes or two time constants are equal."""


@dataclass(frozen=True)
class NoiseGrid:
    """Noise models along a flow.

    Attributes:
        flow: the linearised trajectory.
        white: the model with white sensor noise only.
    """

    flow: Flow
    white: NoiseModel

    def singles(self) -> list[NoiseModel]:
        """White noise alone, and with one disturbance of each place, size and time constant."""
        p, m = self.flow.rates, self.flow.new.shape[1]
        lasting = sorted({max(share * self._longest, 2.0 * self._step) for share in _TIME_CONSTANTS})
        sensor = np.array(self.white.sensor)
        found = [self.white]
        for place in range(p + m):
            for time in [0.0, *lasting] if place < p else lasting:
                unit = usual_size(self.flow, place, time, sensor) if place < p else float(sensor[place - p])
                if math.isfinite(unit):
                    found += [replace(self.white, components=((place, size * unit, time),)) for size in _SIZES]
        return [model for model in found if self.plausible(model)]

    def pairs(self, model: NoiseModel, singles: Sequence[NoiseModel]) -> list[NoiseModel]:
        """A model with each of the single disturbances added, unless its place and time constant are taken."""
        own = {(place, lasting) for place, _, lasting in model.components}
        return [
            replace(model, components=(*model.components, *single.components))
            for single in singles
            if single.components and (single.components[0][0], single.components[0][2]) not in own
        ]

    def neighbours(self, model: NoiseModel, decades: float) -> list[NoiseModel]:
        """A model with one size, one time constant, both, or the noise of one of several sensors changed.

        Args:
            model: the model.
            decades: size of the change, in decades.
        """
        factor = 10.0**decades
        found = []
        for d, (place, size, lasting) in enumerate(model.components):
            sizes = [(place, size * f, lasting) for f in (factor, 1.0 / factor)]
            times = [
                (place, size * by, lasting * f)
                for f in (factor, 1.0 / factor)
                for by in (1.0, factor, 1.0 / factor)
                if lasting > 0 and by != f
            ]
            found += [
                replace(model, components=(*model.components[:d], other, *model.components[d + 1 :]))
                for other in sizes + times
            ]
        several = len(model.sensor) > 1
        for j, known in enumerate(model.known):
            if several and not known:
                found += [
                    replace(model, sensor=(*model.sensor[:j], f * model.sensor[j], *model.sensor[j + 1 :]))
                    for f in (factor, 1.0 / factor)
                    if not model.floor or f * model.sensor[j] >= model.floor[j]
                ]
        return [model for model in found if self.plausible(model)]

    def plausible(self, model: NoiseModel) -> bool:
        """Whether each time constant is white, or between the sampling interval and the longest run."""
        return all(
            lasting == 0.0 or _SHORTEST * self._step <= lasting <= self._longest for _, _, lasting in model.components
        )

    @property
    def _longest(self) -> float:
        return longest_run(self.flow)

    @property
    def _step(self) -> float:
        return float(np.median(self.flow.step[self.flow.step > 0]))


def key_of(model: NoiseModel) -> tuple[object, ...]:
    """A hashable key, equal for models that differ by rounding only."""

    def rounded(value: float) -> float:
        return round(math.log10(value), _DIGITS) if value > 0.0 else -math.inf

    components = sorted((place, rounded(size), rounded(lasting)) for place, size, lasting in model.components)
    return tuple(components), tuple(rounded(size) for size in model.sensor)
