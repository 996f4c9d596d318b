"""A lag of a sensor is distinguished from a lag of the input once the other physics is in the model."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

NAMES = ("input_lag", "input_delay", "sensor_lag", "thermal_loss", "input_saturation")


class Heater(Dynamics):
    """A heated plate; the simulation has no radiation and a thermometer without a lag."""

    states, inputs = ("temperature",), ("power",)
    units = {"temperature": "°C", "power": "%"}
    parameters = {
        "loss": Parameter(0.005, lower=0.0, unit="1/s"),
        "gain": Parameter(0.003, lower=0.0),
        "room": Parameter(22.0, unit="°C"),
    }

    def derivative(self, time, x, u, p):
        return {"temperature": -p.loss * (x.temperature - p.room) + p.gain * u.power}


def recording(samples=800, step=3.0, fine=20):
    """Return a recording of a plate that radiates, with a thermometer of 12 s, rounded to a quarter of a degree."""
    g = torch.Generator().manual_seed(7)
    levels = torch.tensor([0.0, 25.0, 50.0, 80.0, 100.0])[torch.randint(5, (samples // 80,), generator=g)]
    power = levels.repeat_interleave(80).tolist()
    plate, seen, measured = 21.0, 21.0, []
    for k in range(samples):
        measured.append(seen)
        for _ in range(fine):
            radiated = 4e-11 * ((plate + 273.15) ** 4 - 294.15**4)
            rate = -0.003 * (plate - 21.0) + 0.016 * power[k] - radiated
            plate, seen = plate + step / fine * rate, seen + step / fine * (plate - seen) / 12.0
    noisy = torch.tensor(measured).double() + 0.05 * torch.randn(samples, generator=g, dtype=torch.float64)
    time = step * torch.arange(samples, dtype=torch.float64)
    return Recording(
        {"time": time, "power": torch.tensor(power).double(), "temperature": (noisy / 0.25).round() * 0.25}
    )


@pytest.mark.e2e
@pytest.mark.slow
def test_radiation_and_a_lag_of_the_sensor_are_found():
    effects = [effect for effect in DYNAMICS if effect.id in NAMES]
    found = diagnose(Heater(), recording(), effects=effects, surrogates=19)
    sizes = {finding.effect: {p.name: p.value for p in finding.parameters} for finding in found.findings}
    assert set(sizes) == {"thermal_loss", "sensor_lag"}
    assert sizes["sensor_lag"]["lag"] == pytest.approx(12.0, rel=0.02)
