"""A noise model as numbers, and the filter models of several of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mkc_torch.simulation.dynamics.kalman import FilterModels, Flow
from mkc_torch.simulation.dynamics.observer import Disturbance


@dataclass(frozen=True)
class NoiseModel:
    """A noise model.

    Attributes:
        sensor: standard deviation of each output's white noise, in its unit.
        components: the disturbances, each with its place (the index of a rate, or the number of rates plus the index
            of an output), its standard deviation in the unit of that rate or output, and its time constant in s (0
            for white noise).
        known: whether each output's white noise is declared.
        floor: smallest white noise of each output, where it is not declared; empty for no limit.
    """

    sensor: tuple[float, ...]
    components: tuple[tuple[int, float, float], ...] = ()
    known: tuple[bool, ...] = ()
    floor: tuple[float, ...] = ()

    @property
    def least_scale(self) -> float:
        """Smallest factor for all sizes that keeps every undeclared sensor noise at or above its floor."""
        each = zip(self.floor, self.sensor, self.known or [False] * len(self.sensor), strict=False)
        return max((least / size for least, size, known in each if size > 0.0 and not known), default=0.0)

    def raised_to_floor(self) -> NoiseModel:
        """The model with every undeclared sensor noise raised to its floor."""
        floor, known = (self.floor or (0.0,) * len(self.sensor)), self.known or (False,) * len(self.sensor)
        each = zip(self.sensor, floor, known, strict=True)
        return replace(self, sensor=tuple(size if declared else max(size, least) for size, least, declared in each))

    def disturbances(self, rates: Sequence[str], outputs: Sequence[str], scale: float = 1.0) -> tuple[Disturbance, ...]:
        """The disturbances with the names of their rates or outputs, and their sizes times a scale."""
        names, p = (*rates, *outputs), len(rates)
        return tuple(Disturbance(names[a], a < p, lasting, scale * size) for a, size, lasting in self.components)

    @classmethod
    def of(
        cls,
        disturbances: Sequence[Disturbance],
        sensor: Sequence[float],
        rates: Sequence[str],
        outputs: Sequence[str],
        known: Sequence[bool] = (),
        floor: Sequence[float] = (),
    ) -> NoiseModel:
        """The model with these disturbances and this white noise of the outputs."""
        places = (*rates, *outputs)
        components = tuple(
            (place_of(places, disturbance, len(rates)), disturbance.size, disturbance.lasting)
            for disturbance in disturbances
        )
        return cls(tuple(sensor), components, tuple(known) or (False,) * len(outputs), tuple(floor))


def filter_models(flow: Flow, noises: Sequence[NoiseModel]) -> FilterModels:
    """The filter models of several noise models."""
    p = flow.rates
    D = max(sum(1 for component in noise.components if component[2] > 0) for noise in noises)
    B = len(noises)
    white, place = np.zeros((B, p)), np.zeros((B, D), dtype=int)
    size, lasting = np.zeros((B, D)), np.ones((B, D))
    for row, noise in enumerate(noises):
        slot = 0
        for at, deviation, time in noise.components:
            if time > 0:
                place[row, slot], size[row, slot], lasting[row, slot] = at, deviation, time
                slot += 1
            else:
                white[row, at] = deviation
    return FilterModels(white, place, size, lasting, np.array([noise.sensor for noise in noises]))


def longest_run(flow: Flow) -> float:
    """Length of the longest run in s."""
    ends = np.flatnonzero(np.concatenate([flow.step <= 0, [True]]))
    total = np.concatenate([[0.0], flow.step.cumsum()])
    return float(np.diff(np.concatenate([[0.0], total[ends]])).max())


def place_of(places: Sequence[str], disturbance: Disturbance, rates: int) -> int:
    """Index of a disturbance's place; a state and an output may share a name."""
    return places.index(disturbance.place) if disturbance.at_rate else rates + places[rates:].index(disturbance.place)
