"""A parameter of a simulation, and the error of one that cannot be computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    pass

__all__ = ["Parameter", "SimulationError"]


class SimulationError(ValueError):
    """A simulation that cannot be computed; the sentence says where and why."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a simulation.

    Attributes:
        value: to start from.
        lower, upper: least and greatest value.
        unit: for reports.
    """

    value: float
    lower: float = -torch.inf
    upper: float = torch.inf
    unit: str = ""
