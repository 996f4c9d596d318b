"""Typical magnitudes in the runs of a plant, which scale the hidden effects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mkc_torch.challenge.dynamics.integrate import Course
from mkc_torch.challenge.dynamics.plant import Array, Plant, RunSet


@dataclass(frozen=True)
class SystemScene:
    """A plant and its trajectory without hidden effects."""

    plant: Plant
    trial: RunSet
    course: Course

    def state(self, name: str) -> Array:
        """(F, R)."""
        return self.course.states[self.plant.row(name)]

    def typical(self, name: str) -> float:
        """Return the median absolute value of a state."""
        return float(np.median(np.abs(self.state(name))))

    def largest(self, name: str) -> float:
        return float(np.abs(self.state(name)).max())

    def pace(self, name: str) -> float:
        """Return the RMS rate of a state."""
        rates = self.plant.rate(self.course.states, self.course.inputs, self.plant.values)
        return float(np.sqrt(np.square(rates[self.plant.row(name)]).mean()))

    def largest_input(self, name: str) -> float:
        return float(np.abs(self.trial.inputs[self.plant.inputs.index(name)]).max())

    @property
    def length(self) -> float:
        """Of a run, in s."""
        return (self.trial.samples - 1) * self.trial.step
