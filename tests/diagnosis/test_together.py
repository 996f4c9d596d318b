"""Several recordings diagnosed together: one simulation, one set of findings, own states at the start of each."""

import json

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.files.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.joined import joined
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.recording import RecordingError
from mkc_torch.simulation import Dynamics, Magnetometer, Paired, Static
from tests.simulation.tumbling import tumbling


class Decay(Dynamics):
    states = ("level",)
    outputs = ("level",)
    parameters = {"rate": 0.8}  # noqa: RUF012

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"level": -p.rate * x.level}


class Line(Static):
    inputs, outputs, parameters = ("heat",), ("voltage",), {"slope": 1.0}

    def output(self, time, u, p):  # noqa: ARG002
        return {"voltage": p.slope * u.heat}


def decay(seed, name, first):
    g = torch.Generator().manual_seed(seed)
    time = torch.arange(60, dtype=torch.float64) / 10.0
    level = first * torch.exp(-time) + 0.01 * torch.randn(60, generator=g, dtype=torch.float64)
    return Recording({"time": time, "level": level}, name=name)


def line(seed, name):
    g = torch.Generator().manual_seed(seed)
    time = torch.arange(60, dtype=torch.float64) / 10.0
    noise = 0.01 * torch.randn(60, generator=g, dtype=torch.float64)
    return Recording({"time": time, "heat": torch.sin(time), "voltage": 2.0 * torch.sin(time) + noise}, name=name)


def test_two_recordings_are_one_table_with_a_column_of_experiments():
    a, b = decay(0, "a", 1.0), decay(1, "b", 3.0)
    columns = {name: torch.cat([a[name], b[name]]) for name in a.names}
    table = Recording({**columns, "experiment": torch.arange(2.0).repeat_interleave(60)}, name="table")
    both = diagnose(Decay(), [a, b], effects=(), surrogates=19)
    one = diagnose(Decay(), table, effects=(), surrogates=19)
    assert both.samples == one.samples == 120
    assert (both.verdict, both.noise, both.baseline) == (one.verdict, one.noise, one.baseline)
    torch.testing.assert_close(both.traces.before, one.traces.before)
    assert both.recordings == ("a", "b")
    assert one.recordings == ()
    assert json.loads(diagnosis_to_json(both))["recording"] == ["a", "b"]
    assert json.loads(diagnosis_to_json(one))["recording"] == "table"


def test_each_recording_has_a_start_of_its_own_and_parameters_are_shared():
    whole, names = joined(Decay(), [decay(0, "a", 1.0), decay(1, "b", 3.0)])
    prepared = Decay().prepare(whole)
    assert names == ("a", "b")
    assert prepared.parameter_names == ("rate", "level at the start of a", "level at the start of b")
    assert prepared.start()[1:].tolist() == pytest.approx([1.0, 3.0], abs=0.1)


def test_a_simulation_without_states_has_one_clock():
    result = diagnose(Line(), [line(0, "a"), line(1, "b")], effects=(), surrogates=19)
    assert result.samples == 120
    assert bool((result.traces.time.diff() > 0).all())
    assert any("b is counted" in warning for warning in result.warnings)


def test_an_offset_that_changed_between_two_recordings_is_a_step_between_them():
    first, second = tumbling(400, noise=0.3), tumbling(400, noise=0.3, seed=1)
    moved = Recording({**second.columns, "mag_x": second["mag_x"] + 5.0}, name="b")
    both = [Recording(first.columns, name="a"), moved]
    step = tuple(effect for effect in CATALOGUE if effect.id == "hard_iron_step")
    finding = diagnose(Magnetometer(), both, effects=step, surrogates=19).findings[0]
    end = float(first["time"][-1])
    assert end - 0.5 < finding.onset < end + 10.5
    assert finding.parameters[0].value == pytest.approx((5.0, 0.0, 0.0), abs=0.3)


def test_what_a_simulator_wrote_is_compared_at_its_own_times():
    a, b = decay(0, "a", 1.0), decay(1, "b", 3.0)
    later = Recording({"time": b["time"] + 50.0, "level": b["level"]}, name="b")
    whole, _ = joined(Paired(a), [a, later])
    assert float(whole["time"][60]) == 50.0


def test_recordings_that_differ_are_refused():
    other = Recording({"time": torch.arange(60.0), "temperature": torch.zeros(60)}, name="b")
    with pytest.raises(RecordingError, match="b has `temperature`, which a has not"):
        diagnose(Magnetometer(), [decay(0, "a", 1.0), other])


def test_what_is_in_a_list_and_no_recording_is_refused():
    with pytest.raises(TypeError, match=r"recording\[1\]"):
        diagnose(Decay(), [decay(0, "a", 1.0), "b.csv"])
