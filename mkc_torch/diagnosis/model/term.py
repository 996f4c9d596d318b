"""A term of a model: an effect at a port, with its driver and shape."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Shape
from mkc_torch.simulation.ports import Port
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["Key", "Term", "context_at", "continuous"]

Key = tuple[str, tuple[str, ...], str]
"""Identity of a candidate without its shape: the effect's id, its columns and its port."""


@dataclass(frozen=True)
class Term:
    """An effect with its driver (None for time or the signal alone), its shape, and its port if it has a choice."""

    effect: Effect
    driver: Driver | None
    shape: Shape
    at: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        return () if self.driver is None else self.driver.columns

    @property
    def port(self) -> str:
        """The port where it acts."""
        return self.at or self.effect.port

    @property
    def key(self) -> Key:
        """Identity without the shape."""
        return self.effect.id, self.columns, self.port

    def context(self, prepared: PreparedSimulation, signal: Tensor | None) -> Context:
        """Return the context in which the effect is evaluated."""
        port = prepared.ports[self.port]
        time = prepared.time if port.clock is None else port.clock.time
        values = time.new_zeros(len(time), 0)
        units: tuple[str, ...] = ()
        if self.driver is not None:
            values, units = self.driver.values, self.driver.units
            values = port.at(values)
        if signal is None:
            signal = time.new_zeros(len(time), len(port.channels))
        return context_at(port, time, values, units, signal)

    def size(self, context: Context) -> int:
        return sum(quantity.size for quantity in self.effect.quantities(self.shape, context))


def context_at(port: Port, time: Tensor, drivers: Tensor, units: tuple[str, ...], signal: Tensor) -> Context:
    """Return the context of an effect at a port."""
    return Context(
        time,
        drivers,
        units,
        signal,
        port.unit,
        port.channels,
        port.carries,
        port.parts,
        port.part_units,
        port.run,
    )


def continuous(term: Term) -> list[str]:
    """Return the names of a candidate's shape numbers that are refined."""
    return [name for name in term.shape if name in term.effect.continuous]
