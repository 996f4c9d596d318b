"""A model of the noise of the world: sensors' white noise, and what pushes rates or is added to outputs beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mkc_torch.simulation.dynamics.observer import Disturbance

__all__ = ["NoiseModel", "place_of"]


@dataclass(frozen=True)
class NoiseModel:
    """A model of the noise.

    Attributes:
        sensor: standard deviation of each output's white noise, in its unit.
        pushes: disturbances: the number of the rate, or of an output after all rates; the standard deviation in the
            unit of that rate or output; the time constant in s, 0 for one that is new at each sample.
        known: of each output whether its white noise is declared.
        floor: of each output the least size that white noise may have which is not declared; none for any.
    """

    sensor: tuple[float, ...]
    pushes: tuple[tuple[int, float, float], ...] = ()
    known: tuple[bool, ...] = ()
    floor: tuple[float, ...] = ()

    @property
    def least_scale(self) -> float:
        """By which all sizes can be multiplied at least, for no sensor's noise to be below its floor."""
        each = zip(self.floor, self.sensor, self.known or [False] * len(self.sensor), strict=False)
        return max((least / size for least, size, known in each if size > 0.0 and not known), default=0.0)

    def no_lower(self) -> NoiseModel:
        """The same with no sensor's noise below its floor."""
        floor, known = (self.floor or (0.0,) * len(self.sensor)), self.known or (False,) * len(self.sensor)
        each = zip(self.sensor, floor, known, strict=True)
        return replace(self, sensor=tuple(one if told else max(one, least) for one, least, told in each))

    def disturbances(self, rates: Sequence[str], outputs: Sequence[str], scale: float = 1.0) -> tuple[Disturbance, ...]:
        """The disturbances by the names of rates and outputs, their sizes times a scale."""
        names, p = (*rates, *outputs), len(rates)
        return tuple(Disturbance(names[a], a < p, lasting, scale * size) for a, size, lasting in self.pushes)

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
        """The model with these disturbances."""
        places = (*rates, *outputs)
        pushes = tuple((place_of(places, one, len(rates)), one.size, one.lasting) for one in disturbances)
        return cls(tuple(sensor), pushes, tuple(known) or (False,) * len(outputs), tuple(floor))


def place_of(places: Sequence[str], one: Disturbance, rates: int) -> int:
    """Number of a disturbance's place; a state and an output may have one name."""
    return places.index(one.place) if one.at_rate else rates + places[rates:].index(one.place)
