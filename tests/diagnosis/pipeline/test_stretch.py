"""The stretch that a quick look at a simulation that steps uses."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.pipeline.stretch import MOST, quick_stretch
from tests.simulation.stepped.models import Equations
from tests.simulation.stepped.test_servo import Servo, followed


def rested(still, samples):
    """The servo's recording after a rest."""
    own = followed(samples=samples)
    step = own["time"][1]
    columns = {
        name: torch.cat([own[name][:1].expand(still), own[name]]) for name in ("command", "angle") if name in own
    }
    time = step * torch.arange(still + samples, dtype=torch.float64)
    return Recording({"time": time, **columns}, name="rested")


def test_the_stretch_is_where_the_outputs_move_most():
    recording = rested(still=700, samples=MOST)
    found = quick_stretch(Servo().prepare(recording), recording)
    assert found is not None
    assert len(found) == MOST
    # stretches begin at each quarter of their length
    assert float(found["time"][0]) == pytest.approx(float(recording["time"][500]))
    assert found.name == "rested"
    assert f"Quick look at {MOST} of 1700 samples, from 10 to" in found.notes[-1]


def test_a_short_recording_and_a_simulation_of_equations_are_used_whole():
    short, long = followed(samples=MOST), rested(still=700, samples=MOST)
    assert quick_stretch(Servo().prepare(short), short) is None
    named = Recording({"time": long["time"], "torque": long["command"], "angle": long["angle"], "speed": long["angle"]})
    assert quick_stretch(Equations().prepare(named), named) is None


@pytest.mark.e2e
def test_a_quick_look_states_its_stretch():
    found = diagnose(Servo(), rested(still=400, samples=MOST), effects=(), quick=True)
    assert [note for note in found.notes if note.startswith(f"Quick look at {MOST} of 1400 samples")]
