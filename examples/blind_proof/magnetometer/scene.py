"""The truth of a recording: motion, sensor, surroundings, and its drivers, true and recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import choose, direction, happens, log_uniform, normal, smooth, uniform, whole
from examples.blind_proof.magnetometer.motion import Motion

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
    return uniform(g, 25.0, 65.0) * direction(g)


def draw_temperature(g: Generator, time: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw a temperature in °C: a warm-up, a trend, slow weather, or a switched heater."""
    x = time - time[0]
    step = float(x[1])
    start, span = uniform(g, 10.0, 35.0), log_uniform(g, 3.0, 20.0)
    kind = choose(g, ("warm-up", "trend", "weather", "heater"), (0.25, 0.15, 0.3, 0.3))
    if kind == "warm-up":
        shape = 1.0 - torch.exp(-x / uniform(g, 10.0, 60.0))
    elif kind == "trend":
        shape = x / float(x[-1]) * choose(g, (-1.0, 1.0))
    elif kind == "weather":
        shape = 0.5 * smooth(g, len(x), 1, step, uniform(g, 20.0, 60.0))[:, 0]
    else:
        period, phase = uniform(g, 20.0, 50.0), uniform(g, 0.0, 1.0)
        on = ((x / period + phase) % 1.0 < uniform(g, 0.3, 0.7)).double()
        shape = lagged(on, step, uniform(g, 4.0, 12.0))
    return start + span * (shape + 0.02 * smooth(g, len(x), 1, step, 8.0)[:, 0])


def draw_current(g: Generator, time: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw a current in A, as from a throttle: steps, ramps and rests between 0.3 A and a peak of 4-30 A."""
    count, step = len(time), float(time[1] - time[0])
    peak = log_uniform(g, 4.0, 30.0)
    level = 0.0
    values: list[float] = []
    while len(values) < count:
        hold = max(round(uniform(g, 1.0, 9.0) / step), 1)
        # no recording has a constant current
        rests = bool(values) and happens(g, 0.25)
        target = 0.0 if rests else uniform(g, 0.1, 1.0)
        rise = max(round(choose(g, (0.05, uniform(g, 0.5, 4.0))) / step), 1)
        values += [level + (target - level) * (k + 1) / rise for k in range(rise)] + [target] * hold
        level = target
    throttle = torch.tensor(values[:count], dtype=torch.float64)
    ripple = 0.02 * throttle * smooth(g, count, 1, step, 0.5)[:, 0]
    return 0.3 + peak * (throttle.square() * 0.6 + throttle * 0.4 + ripple)


def recorded_temperature(g: Generator, true: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Add noise of 0.02-0.1 K, and round to 1/16 K or 1/100 K."""
    noisy = true + uniform(g, 0.02, 0.1) * normal(g, len(true))
    return quantised(noisy, choose(g, (0.0625, 0.01)))


def recorded_current(g: Generator, true: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Add noise of 0.3-1 % of the range, and round to 0.01-0.1 A."""
    spread = uniform(g, 0.003, 0.01) * float(true.max())
    return quantised(true + spread * normal(g, len(true)), choose(g, (0.01, 0.05, 0.1)))


def recorded_voltage(g: Generator, current: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Return the voltage in V of a battery that sags under the current and discharges."""
    cells = whole(g, 2, 6)
    used = torch.linspace(0.0, uniform(g, 0.0, 0.15), len(current), dtype=torch.float64)
    sag = uniform(g, 0.004, 0.03) * current
    return quantised(cells * (4.1 - used) - sag + 0.03 * normal(g, len(current)), 0.01)


def lagged(values: Float[Tensor, " N"], step: float, constant: float) -> Float[Tensor, " N"]:
    """Apply a first-order lag with a time constant in s, starting from the first value.

    Example:
        >>> lagged(torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64), 1.0, 0.0)
        tensor([0., 1., 1.], dtype=torch.float64)
    """
    if constant <= 0.0:
        return values.clone()
    keep, state = math.exp(-step / constant), float(values[0])
    out = []
    for value in values.tolist():
        state = keep * state + (1.0 - keep) * value
        out.append(state)
    return torch.tensor(out, dtype=torch.float64)


def quantised(values: Float[Tensor, " N"], step: float) -> Float[Tensor, " N"]:
    return (values / step).round() * step
