import math
from pathlib import Path

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.recording.recording import MissingColumnError
from mkc_torch.simulation import Parameter, SimulationError, Static


class Thermistor(Static):
    inputs = ("temperature",)
    outputs = ("voltage",)
    parameters = {"bottom": 0.3, "slope": Parameter(0.01, lower=0.0, unit="V/K")}
    units = {"voltage": "V"}

    def output(self, time, u, p):
        return {"voltage": p.bottom + p.slope * u.temperature}


def recording(*, load=0.0, count=300, **more):
    g = torch.Generator().manual_seed(1)
    time = torch.arange(count, dtype=torch.float64) / 10.0
    temperature = 20.0 + 8.0 * torch.sin(0.4 * time) + 3.0 * torch.sin(1.7 * time)
    current = torch.sin(0.9 * time + 1.0) + 0.3 * torch.randn(count, generator=g, dtype=torch.float64)
    voltage = 0.5 + 0.02 * temperature + load * current + 0.01 * torch.randn(count, generator=g, dtype=torch.float64)
    voltage[torch.rand(count, generator=g) < 0.05] += 0.5
    columns = {"time": time, "temperature": temperature, "current": current, "voltage": voltage}
    return Recording(columns | more, name="bench")


@pytest.mark.parametrize(
    "simulation",
    [Thermistor(), Static(torch.nn.Linear(1, 1), inputs=("temperature",), outputs=("voltage",))],
    ids=["class", "module"],
)
def test_the_driver_of_an_output_is_found(simulation):
    found = diagnose(simulation, recording(load=0.05), surrogates=19, max_findings=1)
    first = found.findings[0]
    assert (first.effect, first.drivers, first.channels) == ("driver_linear", ("current",), ("voltage",))
    assert first.parameters[0].value == pytest.approx(0.05, abs=0.005)
    assert first.curve.driver == "current"
    model = DiagnosedModel.from_json(found.model.to_json(), simulation=simulation)
    table = recording(load=0.05, count=100)
    columns = model(Recording({name: table[name] for name in ("temperature", "current")}))
    assert set(columns) == {"time", "voltage"}
    assert float((columns["voltage"] - table["voltage"]).abs().median()) < 0.012


def test_a_temperature_coefficient_is_distinguished_from_the_gain_that_a_parameter_sets():
    bench = recording(load=0.0)
    gain = 1.0 + 0.05 * bench["current"]
    scaled = {name: bench[name] for name in bench.names} | {"voltage": bench["voltage"] * gain}
    found = diagnose(Thermistor(), Recording(scaled, name="bench"), surrogates=19, max_findings=1)
    (first,) = found.findings
    assert (first.effect, first.drivers) == ("driver_gain", ("current",))
    assert [p.name for p in first.parameters] == ["gain_per_unit"]
    assert first.parameters[0].value == pytest.approx(0.05, abs=0.005)
    assert not any(rival.effect == "gain" for rival in first.alternatives)


class Joint(Static):
    inputs = ("command",)
    outputs = ("angle",)
    parameters = {"scale": 1.0}
    units = {"command": "rad", "angle": "rad"}

    def output(self, time, u, p):
        return {"angle": p.scale * u.command}


def test_a_wrong_zero_is_an_offset_despite_a_chance_correlation():
    """A slope of three standard errors: more than the penalty of a parameter, less than that of a generalisation."""
    count = 300
    g = torch.Generator().manual_seed(4)
    time = 0.02 * torch.arange(count, dtype=torch.float64)
    command, trend = torch.sin(2.0 * time) + 0.4 * torch.sin(5.0 * time), time - time.mean()
    noise = 0.01 * torch.randn(count, generator=g, dtype=torch.float64)
    trend = trend / torch.linalg.vector_norm(trend)
    noise = noise - (noise @ trend) * trend + 3.0 * 0.01 * trend
    columns = {"time": time, "command": command, "angle": command + 0.05 + noise, "temperature": 22.0 + 3.0 * trend}
    found = diagnose(Joint(), Recording(columns), surrogates=19, max_findings=1)
    assert [(finding.effect, finding.drivers) for finding in found.findings] == [("offset", ())]
    assert found.findings[0].parameters[0].value == pytest.approx(0.05, abs=0.003)


def test_a_correct_simulation_is_adequate():
    assert diagnose(Thermistor(), recording(), surrogates=19).verdict == "adequate"


def test_a_module_predicts_the_same_values():
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Tanh(), torch.nn.BatchNorm1d(3), torch.nn.Linear(3, 1))
    before = {name: values.clone() for name, values in module.state_dict().items()}
    table = recording()
    prepared = Static(module, inputs=("temperature", "current"), outputs=("voltage",)).prepare(table)
    predicted = table.stack("voltage") - prepared.residual(prepared.start(), {})
    expected = module.double().eval()(table.stack("temperature", "current"))
    torch.testing.assert_close(predicted, expected, rtol=1e-6, atol=1e-9)
    assert len(prepared.parameter_names) == 9 + 6 + 4
    assert prepared.parameter_names[:2] == ("0.weight[0,0]", "0.weight[0,1]")
    for name, values in before.items():
        assert torch.equal(values.double(), module.state_dict()[name].double())


def test_a_recording_without_time_has_sample_numbers_units_and_bounds():
    table = recording()
    prepared = Thermistor().prepare(Recording({name: table[name] for name in ("temperature", "voltage")}))
    assert prepared.unit == "V"
    assert prepared.time[:3].tolist() == [0.0, 1.0, 2.0]
    assert prepared.bounds[0].tolist() == [-math.inf, 0.0]


def test_parameters_that_the_data_cannot_determine_are_named():
    class Divider(Static):
        inputs = ("current",)
        outputs = ("voltage",)
        parameters = {"upper": 2.0, "lower": 4.0, "unused": 1.0}

        def output(self, time, u, p):
            return {"voltage": p.upper / p.lower * u.current}

    warnings = " ".join(Divider().prepare(recording()).warnings)
    assert "does not determine `upper` and `lower` separately" in warnings
    assert "direction 0.71 upper + 0.71 lower" in warnings
    assert "does not determine `unused`" in warnings
    assert Thermistor().prepare(recording()).warnings == ()


class StaticReturning(Thermistor):
    def __init__(self, value):
        super().__init__()
        self.value = value

    def output(self, time, u, p):
        return self.value(u)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (lambda u: {"voltage": u.temperature[:5]}, r"`voltage` should be a tensor of shape \(300,\)"),
        (lambda _: {"voltage": 3.0}, "but is float"),
        (lambda u: {"tension": u.temperature}, "does not return `voltage`.* it returns tension"),
        (lambda u: {"voltage": (u.temperature - 20.5).log()}, "is nan at time .* parameters bottom = 0.3"),
    ],
)
def test_invalid_outputs_are_refused_with_the_reason(value, words):
    with pytest.raises(SimulationError, match=words):
        StaticReturning(value).prepare(recording())


def test_invalid_modules_and_columns_are_refused_with_the_reason():
    line = torch.nn.Linear(1, 2)
    with pytest.raises(
        SimulationError, match=r"shape \(300, 1\), a column for each of voltage, but it returns \(300, 2\)"
    ):
        Static(line, inputs=("temperature",), outputs=("voltage",)).prepare(recording())
    with pytest.raises(SimulationError, match="no parameters"):
        Static(torch.nn.Tanh(), inputs=("temperature",), outputs=("voltage",))
    with pytest.raises(SimulationError, match="10,100 numbers, more than 200"):
        Static(torch.nn.Linear(100, 100), inputs=("temperature",), outputs=("voltage",))
    with pytest.raises(SimulationError, match="has no `outputs`"):
        Static(torch.nn.Linear(1, 1)).prepare(recording())
    with pytest.raises(NotImplementedError, match="wrap a module"):
        Static(outputs=("voltage",)).prepare(recording())
    with pytest.raises(MissingColumnError, match="temperature"):
        Thermistor().prepare(Recording({"voltage": torch.ones(5)}))
    with pytest.raises(
        SimulationError, match=r"Linear: the module fails on inputs of shape \(300, 2\), a column for each"
    ):
        Static(torch.nn.Linear(1, 1), inputs=("temperature", "current"), outputs=("voltage",)).prepare(recording())
    with pytest.raises(SimulationError, match="Linear names the column `temperature` twice"):
        Static(torch.nn.Linear(2, 1), inputs=("temperature", "temperature"), outputs=("voltage",)).prepare(recording())


@pytest.mark.parametrize(
    ("module", "got"),
    [
        ("line", "'line'; derive from Static"),
        (lambda x: x, "a function; derive from Static, with an `output`, for a function"),
        (torch.nn.Linear, r"the class Linear; make one, Linear\(\.\.\.\)"),
    ],
)
def test_other_objects_than_modules_are_refused(module, got):
    with pytest.raises(TypeError, match=rf"`module`.*torch\.nn\.Module.*got {got}"):
        Static(module, inputs=("temperature",), outputs=("voltage",))


def test_text_is_refused_as_a_sequence_of_names():
    line = torch.nn.Linear(1, 1)
    with pytest.raises(TypeError, match=r"`inputs`.*tuple of names of columns.*got 'ab'; write \('ab',\)"):
        Static(line, inputs="ab", outputs=("voltage",))
    with pytest.raises(TypeError, match=r"`outputs`.*tuple of names of columns.*got 'voltage'; write"):
        Static(line, inputs=("temperature",), outputs="voltage")
    with pytest.raises(TypeError, match=r"`inputs`.*tuple of names of columns.*got \(3,\)"):
        Static(line, inputs=(3,), outputs=("voltage",))

    class Letters(Thermistor):
        inputs = "temperature"

    with pytest.raises(TypeError, match=r"but got 'temperature'; write \('temperature',\)"):
        Letters()
    with pytest.raises(TypeError, match=r"`name`.*text.*got 3"):
        Static(line, inputs=("temperature",), outputs=("voltage",), name=3)


@pytest.mark.parametrize(
    ("value", "remedy"),
    [
        ("NEW.csv", r"read it, Recording\.read\('NEW\.csv'\)"),
        (Path("NEW.csv"), r"read it, Recording\.read\('NEW\.csv'\)"),
        ({"time": torch.ones(3)}, r"make one, Recording\(\{'time': \.\.\., \.\.\.\}\)"),
        (Recording, r"make one, Recording\(\.\.\.\)"),
    ],
)
def test_other_objects_than_recordings_are_refused_with_the_remedy(value, remedy):
    with pytest.raises(TypeError, match=rf"`recording`.*Recording.*; {remedy}"):
        Thermistor().prepare(value)
