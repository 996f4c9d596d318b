"""The truth of a recording: motion, sensor, surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mkc_torch.challenge.draws import direction, normal, uniform
from mkc_torch.challenge.magnetometer.motion import Motion

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class SensorTruth:
    """``measured = soft · field + hard``, µT in the sensor's axes."""

    soft: Float[Tensor, "3 3"]
    hard: Float[Tensor, " 3"]


@dataclass(frozen=True)
class Scene:
    """The truth of a recording. ``settled``: a later recording, in which transients have ended."""

    motion: Motion
    sensor: SensorTruth
    field_world: Float[Tensor, " 3"]  # µT
    temperature: Float[Tensor, " N"]  # °C
    current: Float[Tensor, " N"]  # A
    settled: bool = False

    @property
    def time(self) -> Float[Tensor, " N"]:
        return self.motion.time

    @property
    def step(self) -> float:
        """Seconds between samples."""
        return float(self.time[1] - self.time[0])

    @property
    def field(self) -> Float[Tensor, "N 3"]:
        """The undisturbed field in the sensor's axes, µT."""
        return self.motion.into_body(self.field_world.expand(len(self.time), 3))

    @property
    def along(self) -> Float[Tensor, "N 3"]:
        """Change of the measurement by 1 µT of field length."""
        return torch.nn.functional.normalize(self.field, dim=-1) @ self.sensor.soft.mT

    @property
    def sensitivity(self) -> Float[Tensor, "N 3"]:
        """Change of the calibrated length for a change of the measurement: u of r = u·δB, in the measurement's axes."""
        return torch.nn.functional.normalize(self.field, dim=-1) @ torch.linalg.inv(self.sensor.soft)

    def measured(self, world: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return the change of the measurement by a field in world axes."""
        return self.motion.into_body(world) @ self.sensor.soft.mT


def draw_sensor(g: Generator) -> SensorTruth:
    """Draw hard iron up to 40 µT and soft iron up to ±10 %."""
    a = torch.randn((3, 3), generator=g, dtype=torch.float64).clamp(-2.0, 2.0) / 2.0
    soft = torch.eye(3, dtype=torch.float64) + 0.1 * 0.5 * (a + a.mT)
    return SensorTruth(soft, uniform(g, 0.0, 40.0) * direction(g))


def draw_field(g: Generator) -> Float[Tensor, " 3"]:
    """Draw a field of 25-65 µT in any direction."""
    size = uniform(g, 25.0, 65.0)
    return size * torch.nn.functional.normalize(normal(g, 3), dim=0)
