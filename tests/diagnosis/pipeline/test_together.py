"""Several recordings diagnosed together: common parameters and findings, separate initial states."""

import json
import re

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.environment import Run
from mkc_torch.diagnosis.findings.noise import runs_of
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.pipeline.prepare import joined, with_own_offsets
from mkc_torch.effects import CATALOGUE
from mkc_torch.recording.recording import RecordingError
from mkc_torch.report.diagnosis.environment import output_lines
from mkc_torch.report.diagnosis.findings import shares_of_runs
from mkc_torch.simulation import Dynamics, Magnetometer, Paired, Static
from tests.simulation.tumbling import tumbling


class Decay(Dynamics):
    states = ("level",)
    outputs = ("level",)
    parameters = {"rate": 0.8}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}


class Line(Static):
    inputs, outputs, parameters = ("heat",), ("voltage",), {"slope": 1.0}

    def output(self, time, u, p):
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
    single = diagnose(Decay(), table, effects=(), surrogates=19)
    assert both.samples == single.samples == 120
    assert both.verdict == single.verdict == "adequate"
    # the offsets of two recordings are fitted as well
    torch.testing.assert_close(both.traces.before, single.traces.before, rtol=0.0, atol=0.01)
    assert both.recordings == ("a", "b")
    assert single.recordings == ()
    assert json.loads(diagnosis_to_json(both))["recording"] == ["a", "b"]
    assert json.loads(diagnosis_to_json(single))["recording"] == "table"


def test_recordings_share_parameters_and_have_their_own_initial_states():
    whole, names = joined(Decay(), [decay(0, "a", 1.0), decay(1, "b", 3.0)])
    prepared = Decay().prepare(whole)
    assert names == ("a", "b")
    assert prepared.parameter_names == ("rate", "level at the start of a", "level at the start of b")
    assert prepared.start()[1:].tolist() == pytest.approx([1.0, 3.0], abs=0.1)


def with_offset(recording, column, by):
    return Recording({**recording.columns, column: recording[column] + by}, name=recording.name)


def rounded_offsets(result):
    return [(offset.output, offset.name, round(offset.value, 1)) for offset in result.environment.offsets]


class Coast(Dynamics):
    states, inputs, parameters = ("speed",), ("force",), {"gain": 1.0}
    units = {"speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.force - 0.1 * x.speed}


def coast(seed, name, offset, count=200, parts=100):
    """Return a recording of a body with hidden quadratic drag, whose speed has an offset."""
    time = torch.arange(count * parts, dtype=torch.float64) * 0.05 / parts
    force = 2.0 * torch.sin(0.7 * time + seed) + 1.5 * torch.sin(2.1 * time) + 1.0
    speed, now = torch.empty_like(time), 1.0 + seed
    for k, now_acting in enumerate(force.tolist()):
        speed[k] = now
        now += 0.05 / parts * (now_acting - 0.1 * now - 0.05 * abs(now) * now)
    noise = 0.01 * torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    columns = {"time": time, "force": force, "speed": speed}
    return Recording({key: values[::parts] for key, values in columns.items()}, name=name), offset + noise


@pytest.mark.e2e
def test_offsets_are_per_recording_and_findings_are_common():
    parts = [coast(seed, name, offset) for seed, name, offset in ((0, "a", 0.3), (1, "b", -0.2), (2, "c", 0.0))]
    recordings = [with_offset(part, "speed", added) for part, added in parts]
    drag = tuple(effect for effect in CATALOGUE if effect.id == "quadratic_drag")
    result = diagnose(Coast(), recordings, effects=drag, surrogates=19)
    assert [finding.effect for finding in result.findings] == ["quadratic_drag"]
    assert result.findings[0].parameters[0].value == pytest.approx(0.05, rel=0.02)
    assert rounded_offsets(result) == [("speed", "a", 0.3), ("speed", "b", -0.2), ("speed", "c", 0.0)]
    assert all(0.0 < o.standard_error < 0.01 and o.unit == "m/s" for o in result.environment.offsets)
    content = json.loads(diagnosis_to_json(result))
    assert [offset["recording"] for offset in content["offsets"]] == [1, 2, 3]
    assert [run["name"] for run in content["runs"]] == ["a", "b", "c"]
    assert re.search(r"recording 1 \(a\): 0\.(30|29)\d* ± 0\.0", " ".join(output_lines(result)))
    shares = shares_of_runs(result.findings[0].experiments, result.environment.runs)
    assert "recording 2 (b): " in shares
    assert "experiment" not in shares
    assert len(result.model.theta) == 4  # a gain and three first states
    assert not any("the same in all recordings" in sentence for sentence in result.advice)


def test_an_offset_common_to_all_recordings_is_reported():
    result = diagnose(
        Decay(), [with_offset(decay(k, n, 1.0 + k), "level", 0.3) for k, n in enumerate("ab")], effects=()
    )
    (sentence,) = [s for s in result.advice if "the same in all recordings" in s]
    assert sentence.startswith("The offset of `level` is the same in all recordings: 0.3 ± 0.0")
    apart = diagnose(
        Decay(), [with_offset(decay(k, n, 1.0 + k), "level", 0.3 * k) for k, n in enumerate("ab")], effects=()
    )
    assert not any("the same in all recordings" in s for s in apart.advice)


def test_an_offset_equivalent_to_an_initial_state_is_not_fitted():
    class Way(Coast):
        states, outputs = ("way", "speed"), ("way",)

        def derivative(self, time, x, u, p):
            return {"way": x.speed, **super().derivative(time, x, u, p)}

    recordings = [coast(seed, name, 0.0)[0] for seed, name in ((0, "a"), (1, "b"))]
    recordings = [
        Recording({**part.columns, "way": part["speed"].cumsum(0) / 20.0}, name=part.name) for part in recordings
    ]
    prepared = Way().prepare(joined(Way(), recordings)[0])
    assert with_own_offsets(prepared, recordings).system is prepared.system


def test_offsets_are_per_recording_not_per_run():
    first, second = decay(0, "a", 1.0), decay(1, "b", 3.0)
    table = {name: torch.cat([first[name], second[name]]) for name in first.names}
    both = [Recording({**table, "experiment": torch.arange(2.0).repeat_interleave(60)}, name="a"), decay(2, "b", 2.0)]
    prepared = with_own_offsets(Decay().prepare(joined(Decay(), both)[0]), both)
    assert [offset.name for offset in prepared.own_offsets] == ["offset of level in a", "offset of level in b"]
    theta = prepared.start()
    apart = torch.zeros_like(theta)
    apart[prepared.parameter_names.index("offset of level in a")] = 1.0
    difference = prepared.residual(theta, {}) - prepared.residual(theta + apart, {})
    torch.testing.assert_close(difference[:, 0], (torch.arange(180) < 120).double())
    assert runs_of(prepared, ("a", "b"), (2, 1)) == (Run(1, "a", 1), Run(1, "a", 2), Run(2, "b", 0))


def test_a_static_simulation_has_offsets_per_recording():
    recordings = [with_offset(line(0, "a"), "voltage", 0.3), with_offset(line(1, "b"), "voltage", -0.2)]
    result = diagnose(Line(), recordings, effects=(), surrogates=19)
    assert rounded_offsets(result) == [("voltage", "a", 0.3), ("voltage", "b", -0.2)]
    assert result.verdict == "adequate"
    assert len(result.model.theta) == 1


def test_a_single_recording_has_no_offsets():
    result = diagnose(Line(), [line(0, "a")], effects=(), surrogates=19)
    assert (result.environment.offsets, result.environment.runs) == ((), ())


def test_a_static_simulation_has_a_common_clock():
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


def test_simulator_output_is_compared_at_its_own_times():
    a, b = decay(0, "a", 1.0), decay(1, "b", 3.0)
    later = Recording({"time": b["time"] + 50.0, "level": b["level"]}, name="b")
    whole, _ = joined(Paired(a), [a, later])
    assert float(whole["time"][60]) == 50.0


def test_recordings_that_differ_raise():
    other = Recording({"time": torch.arange(60.0), "temperature": torch.zeros(60)}, name="b")
    with pytest.raises(RecordingError, match="b has `temperature`, which a has not"):
        diagnose(Magnetometer(), [decay(0, "a", 1.0), other])


def test_a_list_with_other_objects_raises():
    with pytest.raises(TypeError, match=r"recording\[1\]"):
        diagnose(Decay(), [decay(0, "a", 1.0), "b.csv"])
