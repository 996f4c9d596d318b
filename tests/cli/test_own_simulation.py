"""`mkc diagnose` and `mkc apply` with a simulation of the user, and with the output of a simulator."""

import importlib.util
import json

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")
pytest.importorskip("jsonschema")


from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.diagnosis_json import validate
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.simulation import SimulationFileError, load_simulation
from tests.cli.commands import flat, mkc

STATIC = """
from mkc_torch.simulation import Static

class Thermistor(Static):
    inputs = ("temperature",)
    outputs = ("voltage",)
    parameters = {"bottom": 0.3, "slope": 0.01}
    units = {"voltage": "V"}

    def output(self, time, u, p):
        return {"voltage": p.bottom + p.slope * u.temperature}
"""

TANK = """
from mkc_torch.simulation import Dynamics, Parameter

class Tank(Dynamics):
    states = ("level",)
    inputs = ("inflow",)
    parameters = {"drain": Parameter(0.3, lower=0.0, unit="1/s")}
    units = {"level": "m", "inflow": "m/s"}

    def derivative(self, time, x, u, p):
        return {"level": u.inflow - p.drain * x.level}
"""

# what a reader of a report on anything but a magnetometer has to be spared
MAGNETOMETER_WORDS = ("magnetometer", "µT", "sensor axes", "field on the axis", "corrected field")


def thermistor_table(path, *, count=250):
    g = torch.Generator().manual_seed(1)
    time = torch.arange(count, dtype=torch.float64) / 10.0
    temperature = 20.0 + 8.0 * torch.sin(0.4 * time) + 3.0 * torch.sin(1.7 * time)
    current = torch.sin(0.9 * time + 1.0) + 0.3 * torch.randn(count, generator=g, dtype=torch.float64)
    voltage = 0.5 + 0.02 * temperature + 0.05 * current + 0.01 * torch.randn(count, generator=g, dtype=torch.float64)
    write_table(path, {"time": time, "temperature": temperature, "current": current, "voltage": voltage})
    return path


def tank_table(path, *, drag=0.0, seed=0):
    """Write two runs of a vessel with a hidden loss by the square of its level."""
    g = torch.Generator().manual_seed(seed)
    time = torch.arange(150, dtype=torch.float64) / 10.0
    runs = []
    for number, start in enumerate((2.0, 0.5)):
        inflow = 0.6 + 0.5 * torch.sin(0.7 * time + number)
        level, values = start, []
        for k in range(len(time)):
            values.append(level)
            for part in range(20):
                flow = torch.lerp(inflow[k], inflow[min(k + 1, len(time) - 1)], part / 20.0)
                level += (float(flow) - 0.3 * level - drag * level**2) / 200.0
        noisy = torch.tensor(values, dtype=torch.float64)
        noisy = noisy + 0.005 * torch.randn(len(time), generator=g, dtype=torch.float64)
        runs.append({"time": time, "inflow": inflow, "level": noisy, "experiment": torch.full_like(time, number)})
    write_table(path, {name: torch.cat([run[name] for run in runs]) for name in runs[0]})
    return path


@pytest.fixture
def thermistor(tmp_path):
    path = tmp_path / "bench.py"
    path.write_text(STATIC)
    return f"{path}:Thermistor", thermistor_table(tmp_path / "bench.csv"), tmp_path / "out"


@pytest.fixture(scope="module")
def tank(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    (folder / "vessel.py").write_text(TANK)
    table = tank_table(folder / "runs.csv", drag=0.15)
    source = f"{folder / 'vessel.py'}:Tank"
    result = mkc("diagnose", table, "--simulation", source, "--output", folder / "out", "--surrogates", 19, "--seed", 1)
    assert result.exit_code == 0, result.output
    return folder, source, result


@pytest.mark.e2e
def test_a_dynamics_diagnosis_is_free_of_magnetometer_words(tank):
    folder, _, result = tank
    place = folder / "out" / "runs"
    assert sorted(p.name for p in place.iterdir()) == ["corrected.py", "diagnosis.json", "model.json", "report.html"]
    content = json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))
    validate(content)
    # both runs in one fit, not one diagnosis each
    assert (content["simulation"], content["samples"], content["verdict"]) == ("Tank", 300, "explained")
    first = content["findings"][0]
    assert first["effect"] == "quadratic_drag"
    assert first["channels"] == ["rate of level"]
    assert first["intervals"] == []
    assert first["parameters"][0]["unit"] == "1/(m·s)"
    assert first["parameters"][0]["value"] == pytest.approx(0.15, rel=0.2)
    page = (place / "report.html").read_text(encoding="utf-8")
    for words in MAGNETOMETER_WORDS:
        assert words not in result.stdout
        assert words not in page
    assert "acts on the rate of level" in result.stdout
    assert "Tank" in page


@pytest.mark.e2e
def test_a_model_simulates_another_recording(tank, tmp_path):
    folder, source, _ = tank
    new, output = tank_table(tmp_path / "new.csv", drag=0.15, seed=5), tmp_path / "corrected.csv"
    model = folder / "out" / "runs" / "model.json"
    refused = mkc("apply", model, new, "--output", output)
    assert refused.exit_code == 1
    assert "no code is run because a model's file names it" in flat(refused.stderr)
    assert "--simulation FILE.py:Tank" in flat(refused.stderr)
    assert not output.exists()
    result = mkc("apply", model, new, "--output", output, "--simulation", source)
    assert result.exit_code == 0, result.output
    assert "300 rows of level_simulated simulated with the findings, RMSE of level 0.00" in flat(result.stdout)
    corrected = Recording.read(output)
    # the measured level is kept
    assert corrected.names == (*Recording.read(new).names, "level_simulated")
    assert all(torch.equal(corrected[name], Recording.read(new)[name]) for name in Recording.read(new).names)
    assert float((corrected["level_simulated"] - Recording.read(new)["level"]).square().mean().sqrt()) < 0.008


@pytest.mark.e2e
def test_exported_python_simulates_as_apply_does(tank):
    folder, source, _ = tank
    place = folder / "out" / "runs"
    text = (place / "corrected.py").read_text(encoding="utf-8")
    assert 'rates["level"] = rates["level"] - 0.1' in text
    assert "# quadratic_drag: δv̇ = −γ v |v|" in text
    spec = importlib.util.spec_from_file_location("corrected_tank", place / "corrected.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    recording = Recording.read(folder / "runs.csv")
    written = module.CorrectedTank().prepare(recording)
    model = DiagnosedModel.from_json(
        (place / "model.json").read_text(encoding="utf-8"), simulation=load_simulation(source)
    )
    starts = model.theta[1:]
    theta = torch.cat([written.start()[:1], starts])
    expected = model(recording)["level"]
    assert float((written.simulated(theta, {})[:, 0] - expected).abs().max()) < 2e-3
    plain = load_simulation(source).prepare(recording)
    assert float((plain.simulated(theta, {})[:, 0] - expected).abs().max()) > 0.02


@pytest.mark.e2e
def test_a_corrected_simulation_loads_from_any_folder_and_is_diagnosed_again(tank, tmp_path, monkeypatch):
    """From the folder of the base class, from the results, and from elsewhere; the result can be corrected again."""
    folder, _, _ = tank
    place = folder / "out" / "runs"
    text = (place / "corrected.py").read_text(encoding="utf-8")
    assert 'Tank = base_class("../../vessel.py:Tank", __file__)' in text
    assert str(folder) not in text
    for stand, source in (
        (folder, "out/runs/corrected.py:CorrectedTank"),
        (place, "corrected.py:CorrectedTank"),
        (tmp_path, f"{place / 'corrected.py'}:CorrectedTank"),
    ):
        monkeypatch.chdir(stand)
        again = load_simulation(source)
        assert (again.name, again.states) == ("CorrectedTank", ("level",))
    new = tank_table(tmp_path / "new.csv", drag=0.15, seed=3)
    result = mkc("diagnose", new, "--simulation", source, "--output", tmp_path / "again", "--surrogates", 19)
    assert result.exit_code == 0, result.output
    second = tmp_path / "again" / "new" / "corrected.py"
    assert "class CorrectedCorrectedTank(CorrectedTank)" in second.read_text(encoding="utf-8")
    assert load_simulation(f"{second}:CorrectedCorrectedTank").parameters["drain"].value == pytest.approx(0.3, abs=0.1)
    # what is moved alone finds its base class next to it, and reports what to do without it
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "corrected.py").write_text(text, encoding="utf-8")
    with pytest.raises(SimulationFileError, match=r"nor next to it, nor in the folder of the call; put vessel\.py"):
        load_simulation(f"{alone / 'corrected.py'}:CorrectedTank")
    (alone / "vessel.py").write_text(TANK, encoding="utf-8")
    assert load_simulation(f"{alone / 'corrected.py'}:CorrectedTank").name == "CorrectedTank"


@pytest.mark.e2e
def test_the_default_simulation_is_a_magnetometer_if_its_columns_are_present(thermistor, tmp_path):
    _, table, output = thermistor
    result = mkc("diagnose", table, "--output", output)
    assert result.exit_code == 1
    assert "give --simulation or --simulator-output" in flat(result.stderr)
    assert "no magnetometer is recognised among `time`, `temperature`, `current`, `voltage`" in flat(result.stderr)
    assert not output.exists()
    sensor = tmp_path / "sensor.csv"
    columns = simulated_recording()[0].columns
    write_table(sensor, {name.replace("mag_", "axis_"): values[:700] for name, values in columns.items()})
    assert "--columns mag_x=axis_x,mag_y=axis_y" in flat(mkc("diagnose", sensor, "--output", output).stderr)
    named = "mag_x=axis_x,mag_y=axis_y,mag_z=axis_z"
    result = mkc("diagnose", sensor, "--output", output, "--columns", named, "--surrogates", 19)
    assert result.exit_code == 3, result.output
    assert "the recording has a magnetometer, so `--simulation magnetometer` is used" in flat(result.stderr)
    content = json.loads((output / "sensor" / "diagnosis.json").read_text(encoding="utf-8"))
    assert content["simulation"] == "magnetometer"


def test_a_static_simulation_is_diagnosed(thermistor):
    source, table, output = thermistor
    result = mkc("diagnose", table, "--simulation", source, "--output", output, "--surrogates", 19)
    assert result.exit_code == 0, result.output
    folder = output / "bench"
    assert sorted(p.name for p in folder.iterdir()) == ["diagnosis.json", "model.json", "report.html"]
    content = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert content["simulation"] == "Thermistor"
    assert content["findings"][0]["drivers"] == ["current"]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert not any(words in page + result.stdout for words in MAGNETOMETER_WORDS)


@pytest.mark.e2e
def test_columns_can_be_renamed_and_unit_labels_are_refused(thermistor, tmp_path):
    source, table, output = thermistor
    known = Recording.read(table)
    other = tmp_path / "other.csv"
    write_table(other, {name.replace("voltage", "adc"): values for name, values in known.columns.items()})
    result = mkc(
        "diagnose", other, "--simulation", source, "--output", output, "--surrogates", 19, "--columns", "voltage=adc"
    )
    assert result.exit_code == 0, result.output
    result = mkc("diagnose", table, "--simulation", source, "--output", output, "--unit-label", "V")
    assert result.exit_code == 2
    assert "apply to a magnetometer" in flat(result.stderr.replace("│", " "))


def test_noise_and_inputs_are_declared_by_name(thermistor, monkeypatch):
    given = {}

    def reported(*_arguments, **options):
        given.update(options)
        raise ValueError("far enough")

    source, table, output = thermistor
    command = ("diagnose", table, "--simulation", source, "--output", output, "--surrogates", 19)
    result = mkc(
        *command, "--noise", "voltage=0.01,other=2", "--noise", "third=1e-3", "--input-hold", "temperature=held"
    )
    assert result.exit_code == 1
    assert "they are `voltage`" in flat(result.stderr)
    result = mkc(*command, "--noise", "voltage=0.01", "--input-hold", "voltage=held")
    assert "inputs in the equations of this simulation but got `voltage`; it has none" in flat(result.stderr)
    monkeypatch.setattr("mkc_torch.cli.diagnosis_files.diagnose", reported)
    result = mkc(
        *command, "--noise", "voltage=0.01, other=2", "--noise", "third=1e-3", "--input-hold", "temperature=held"
    )
    assert "far enough" in result.stderr
    assert given["noise"] == {"voltage": 0.01, "other": 2.0, "third": 0.001}
    assert given["input_hold"] == {"temperature": "held"}
    assert given["suspect"] == ()


def test_suspicions_are_refused_without_differential_equations_and_passed_on(thermistor, monkeypatch):
    given = {}
    source, table, output = thermistor
    command = ("diagnose", table, "--simulation", source, "--output", output, "--suspect", "gain", "--suspect", "lag")
    result = mkc(*command)
    assert result.exit_code == 1
    assert "scored for differential equations only and Thermistor has none" in flat(result.stderr)
    monkeypatch.setattr("mkc_torch.cli.diagnosis_files.diagnose", lambda *_, **options: given.update(options) or 1 / 0)
    assert mkc(*command).exit_code == 1
    assert given["suspect"] == ("gain", "lag")


@pytest.mark.e2e
def test_a_simulator_output_is_diagnosed_and_corrected(tmp_path):
    def signal(time):
        return torch.sin(1.1 * time) + 0.6 * torch.sin(2.7 * time + 1.0)

    g = torch.Generator().manual_seed(2)
    time = torch.arange(300, dtype=torch.float64) / 20.0
    dense = torch.arange(-20, 340, dtype=torch.float64) / 20.0
    sim, table = tmp_path / "SIM.csv", tmp_path / "rec.csv"
    write_table(sim, {"time": dense, "y": signal(dense)})
    noise = 0.03 * torch.randn(300, generator=g, dtype=torch.float64)
    write_table(table, {"time": time, "y": 1.1 * signal(time) + noise})
    output = tmp_path / "out"
    result = mkc("diagnose", table, "--simulator-output", sim, "--output", output, "--surrogates", 19)
    assert result.exit_code == 0, result.output
    model = output / "rec" / "model.json"
    assert json.loads((output / "rec" / "diagnosis.json").read_text())["findings"][0]["effect"] == "gain"
    corrected = tmp_path / "corrected.csv"
    refused = mkc("apply", model, table, "--output", corrected)
    assert "--simulator-output SIM.csv" in flat(refused.stderr)
    assert mkc("apply", model, table, "--output", corrected, "--simulator-output", sim).exit_code == 0
    assert float((Recording.read(corrected)["y"] / signal(time)).median()) == pytest.approx(1.1, abs=0.01)
    write_table(tmp_path / "LATE.csv", {"time": dense + 1000.0, "y": signal(dense)})
    result = mkc("diagnose", table, "--simulator-output", tmp_path / "LATE.csv", "--output", output, "--force")
    assert result.exit_code == 1
    assert "do not overlap in time: 0 to 14.95 s was recorded, 999 to 1016.95 s simulated" in flat(result.stderr)


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("raise KeyError('gone')\n", "Thermistor", ["raised an error of its own", "line 1", "KeyError: 'gone'"]),
        (STATIC, "Missing", ["defines no `Missing`; simulations in it: Thermistor"]),
        (STATIC.replace("p.slope", "p.incline"), "Thermistor", ["Thermistor raised an error of its own", "p.incline"]),
        (STATIC.replace("u.temperature", "u.temperature[:3]"), "Thermistor", ["should be a tensor of shape (250,)"]),
    ],
)
def test_failing_code_is_reported_and_nothing_is_written(tmp_path, text, name, words):
    path = tmp_path / "own.py"
    path.write_text(text)
    table = thermistor_table(tmp_path / "bench.csv")
    result = mkc("diagnose", table, "--simulation", f"{path}:{name}", "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    for word in words:
        assert word in result.stderr
    assert "report it" not in result.stderr
    assert not list((tmp_path / "out").rglob("*")) if (tmp_path / "out").exists() else True


def test_invalid_simulation_options_exit_with_two(thermistor):
    source, table, output = thermistor
    for more, words in (
        (("--simulation", source, "--simulator-output", table), "give one of --simulation and --simulator-output"),
        (("--simulation", "bench"), "your own simulation as FILE.py:CLASS, MODEL.fmu or MODEL.xml"),
    ):
        result = mkc("diagnose", table, "--output", output, *more)
        assert result.exit_code == 2
        assert words in flat(result.stderr.replace("│", " "))
    assert not output.exists()


UNUSED = """
from mkc_torch.simulation import Dynamics


class Decay(Dynamics):
    states = ("level",)
    inputs = ("inflow",)
    parameters = {"loss": 0.4}

    def derivative(self, time, x, u, p):
        return {"level": -p.loss * x.level}
"""


def decay_table(path, *, zero=False):
    time = torch.arange(150, dtype=torch.float64) / 10.0
    noise = 0.01 * torch.randn(150, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    level = 0.0 * time if zero else torch.exp(-0.3 * time) + noise
    write_table(path, {"time": time, "inflow": torch.sin(time), "level": level})
    return path


@pytest.mark.e2e
def test_an_unused_input_is_diagnosed(tmp_path):
    (tmp_path / "decay.py").write_text(UNUSED)
    command = ("--simulation", f"{tmp_path / 'decay.py'}:Decay", "--output", tmp_path / "out", "--surrogates", 19)
    result = mkc("diagnose", decay_table(tmp_path / "run.csv"), *command)
    assert result.exit_code == 0, result.output
    assert "internal error" not in flat(result.stderr)


def test_an_output_of_zeros_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "decay.py").write_text(UNUSED)
    command = ("--simulation", f"{tmp_path / 'decay.py'}:Decay", "--output", tmp_path / "out", "--surrogates", 19)
    result = mkc("diagnose", decay_table(tmp_path / "run.csv", zero=True), *command)
    assert result.exit_code == 1
    assert "`level`" in flat(result.stderr)
    assert "internal error" not in flat(result.stderr)
