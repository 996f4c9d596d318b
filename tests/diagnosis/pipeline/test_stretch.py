"""The stretches of long recordings that a diagnosis uses, and its check on the whole recording."""

import re

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.pipeline.prepare import SearchOptions, prepare
from mkc_torch.diagnosis.pipeline.stretch import LONG, LONG_STEPPED, QUICK_STEPPED, in_stretches, within_stretches
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


def test_a_simulation_that_steps_uses_the_liveliest_stretch_and_the_most_different_ones():
    recording = rested(still=2000, samples=1000)
    for quick, most in ((False, LONG_STEPPED), (True, QUICK_STEPPED)):
        (found,) = in_stretches([recording], stepped=True, quick=quick)
        assert most <= len(found) <= most + 1000
        assert float(found["time"][-1]) == pytest.approx(float(recording["time"][-1]))
        assert f"The diagnosis uses {len(found)} of 3000 samples" in found.notes[-1]
    (short,) = in_stretches([followed(samples=QUICK_STEPPED)], stepped=True, quick=True)
    assert len(short) == QUICK_STEPPED
    assert not short.notes


@pytest.mark.e2e
def test_a_diagnosis_of_stretches_gives_the_residuals_of_the_whole_recording():
    found = diagnose(Servo(), rested(still=400, samples=1200), effects=(), quick=True)
    assert [note for note in found.notes if note.startswith("The diagnosis uses 1066 of 1600 samples, in a stretch")]
    (note,) = [note for note in found.notes if "of all 1600 samples" in note]
    residual = re.search(r"predicted in open loop: `angle` (\S+) rad\.$", note)
    assert residual is not None
    assert float(residual[1]) == pytest.approx(1e-4, rel=0.3)


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
    assert in_stretches([recording], stepped=False) == (recording,)
    short, long = in_stretches([logged(5000), logged(45_000)], stepped=False)
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
