"""The stretches of long recordings: of a quick look at a simulation that steps, and of any diagnosis."""

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions, prepare
from mkc_torch.diagnosis.pipeline.stretch import LONG, MOST, in_stretches, quick_stretch, within_stretches
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.recording.join_recordings import join_recordings
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


def logged(samples, begin=0.0):
    """A pendulum's log: at rest but for a swing in a twentieth of it, and a slow rise of a temperature."""
    time = begin + 0.01 * torch.arange(samples, dtype=torch.float64)
    share = torch.linspace(0.0, 1.0, samples, dtype=torch.float64)
    swing = torch.where((share > 0.6) & (share < 0.65), torch.sin(3.0 * time), 0.0)
    noise = 1e-3 * torch.randn(2, samples, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    columns = {"torque": swing, "angle": 0.2 * swing + noise[0], "speed": 0.6 * swing + noise[1]}
    return Recording({"time": time, **columns, "temperature": 20.0 + 30.0 * share}, name="log")


def test_a_long_recording_keeps_its_rare_events_and_its_levels():
    recording = logged(30 * 2000)
    found = within_stretches(recording, 5 * 2000, 2000)
    assert len(found) == 10_000
    assert float(found["torque"].abs().max()) > 0.9
    assert float(found["temperature"].max() - found["temperature"].min()) > 0.9 * 30.0
    # a sample is as it was, and a stretch without a gap is a run of its own
    rows = (found["time"] / 0.01).round().long()
    assert torch.equal(found["angle"], recording["angle"][rows])
    assert torch.equal(rows.diff() != 1, found["experiment"].diff() != 0)
    first, last = (float(found["time"][row]) for row in (0, -1))
    assert found.labels["experiment"][0].startswith(f"{first:.6g} to ")
    assert found.labels["experiment"][-1].endswith(f" to {last:.6g} s")
    assert "10000 of 60000 samples, in 5 stretches" in found.notes[-1] or len(found.labels["experiment"]) < 5


def test_stretches_lie_within_runs():
    parts = [logged(n, begin) for n, begin in ((3000, 0.0), (1500, 0.0), (9000, 50.0))]
    whole = join_recordings(parts, "own")
    found = within_stretches(whole, 20_000, 2000)
    assert len(found) == 13_500
    assert found["experiment"].long().bincount().tolist() == [3000, 1500, 9000]


def test_all_recordings_keep_a_share():
    recording = logged(LONG)
    assert in_stretches([recording]) == (recording,)
    short, long = in_stretches([logged(5000), logged(45_000)])
    assert 2000 <= len(short) <= 4000
    assert LONG - 2000 <= len(short) + len(long) <= LONG + 4000


OPTIONS = SearchOptions(0.05, 19, 3, 0, Settings(), {}, {}, False)


def test_a_diagnosis_uses_the_stretches_of_one_recording():
    problem = prepare(Equations(), logged(40_000), (), OPTIONS, None, lambda _: None)
    assert LONG <= len(problem.prepared.time) <= LONG + 2000
    assert any("of 40000 samples, in " in note for note in problem.prepared.recording.notes)
    assert problem.recordings == ()
    short = prepare(Equations(), logged(LONG), (), OPTIONS, None, lambda _: None)
    assert len(short.prepared.time) == LONG


def test_a_diagnosis_uses_the_stretches_of_several_recordings():
    problem = prepare(Equations(), [logged(6000), logged(14_000)], (), OPTIONS, None, lambda _: None)
    assert LONG - 2000 <= len(problem.prepared.time) <= LONG + 4000
    assert len(problem.run_counts) == len(problem.recordings) == 2
    assert sum(problem.run_counts) == int(problem.prepared.recording["experiment"].max()) + 1
    assert all(
        any(f"of {count} samples" in note for note in problem.prepared.recording.notes) for count in (6000, 14000)
    )
