"""A parameter with narrow bounds does not absorb missing physics."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

DRAG = 1.3e-4
"""1/m."""


class Rocket(Dynamics):
    """Coasting straight up: gravity alone."""

    states = ("altitude", "speed")
    inputs = ()
    outputs = ("altitude",)
    units = {"altitude": "m", "speed": "m/s"}
    initial = {"speed": 170.0}
    parameters = {"gravity": Parameter(9.81, lower=9.7, upper=9.9, unit="m/s^2")}

    def derivative(self, time, x, u, p):
        return {"altitude": x.speed, "speed": -p.gravity}


def flight(drag, seed, hertz=10, seconds=16, slow=2.0):
    """Return a recording of a flight whose barometer has a slow error with a correlation time of 1 s."""
    random = np.random.default_rng(seed)
    altitude, speed, error, path = 300.0, 190.0, slow * random.normal(), []
    kept = np.exp(-1.0 / hertz)
    for _ in range(hertz * seconds):
        path.append(altitude + error + 0.2 * random.normal())
        error = kept * error + slow * np.sqrt(1.0 - kept**2) * random.normal()
        for _ in range(10):
            altitude += 0.1 / hertz * speed
            speed -= 0.1 / hertz * (9.8 + drag * speed * abs(speed))
    time = torch.arange(len(path), dtype=torch.float64) / hertz
    return Recording({"time": time, "altitude": torch.tensor(path, dtype=torch.float64)})


@pytest.mark.e2e
def test_drag_of_a_short_flight_is_named_despite_a_slow_error_of_the_sensor():
    found = diagnose(Rocket(), flight(DRAG, 1))
    assert [finding.effect for finding in found.findings] == ["quadratic_drag"]
    (size,) = found.findings[0].parameters
    assert abs(size.value - DRAG) < 2.0 * size.standard_error


@pytest.mark.e2e
def test_a_flight_without_drag_has_no_finding():
    assert diagnose(Rocket(), flight(0.0, 2)).findings == ()
