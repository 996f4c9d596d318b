"""`python corrected.py NEW.csv` gives the numbers of `mkc check`, and those of an integration by SciPy."""

import importlib.util
import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

pytest.importorskip("polars")

from mkc_torch import Recording, check
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.validation.alone import run_alone
from mkc_torch.diagnosis.validation.predict import predict
from mkc_torch.effects.dynamics import HiddenLag
from mkc_torch.recording.recording import write_table
from mkc_torch.simulation import load_simulation
from tests.diagnosis.validation.tank import Tank, tank_recording, usual_model

SOURCE = f"from mkc_torch.simulation import Dynamics, Parameter\n\n\n{inspect.getsource(Tank)}"


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    """The folder of corrected.py and of new recordings, the recording, and its check."""
    folder, recording = tmp_path_factory.mktemp("alone"), tank_recording(1)
    (folder / "vessel.py").write_text(SOURCE, encoding="utf-8")
    source = load_simulation(f"{folder / 'vessel.py'}:Tank")
    known = usual_model()
    model = DiagnosedModel("Tank", known.state, known.theta, known.terms, list(known.gammas), source, known.reference)
    (folder / "corrected.py").write_text(model.to_python(folder=folder), encoding="utf-8")
    write_table(folder / "new.csv", dict(recording.columns))
    return folder, recording, check(model, recording)


def loaded(folder):
    spec = importlib.util.spec_from_file_location("corrected_alone", folder / "corrected.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.CorrectedTank


def test_its_outputs_are_those_of_the_check_and_of_scipy(corrected, capsys):
    folder, recording, checked = corrected
    kind = loaded(folder)
    run_alone(kind, [str(folder / "new.csv"), "--output", str(folder / "simulated.csv")])
    printed = capsys.readouterr().out
    assert float(printed.split("level: ")[1].split()[0]) == pytest.approx(checked.outputs[0].corrected, rel=1e-5)
    simulated = Recording.read(folder / "simulated.csv", recognise=False)
    assert simulated.names == ("time", "level_simulated")
    level, reach = simulated["level_simulated"], float(np.ptp(recording["level"].numpy()))
    assert float((level - checked.traces.corrected[:, 0]).abs().max()) < 1e-6 * reach
    # the class's own equations, integrated by another solver from the estimated initial level
    system, time = kind(), recording["time"].numpy()
    inflow, drain = recording["inflow"].numpy(), system.parameters["drain"].value

    def rate(at, state):
        x, u, p = (type("Names", (), {})() for _ in range(3))
        x.level, p.drain = torch.tensor(state, dtype=torch.float64), drain
        u.inflow = torch.tensor([np.interp(at, time, inflow)], dtype=torch.float64)
        return system.derivative(torch.tensor([at]), x, u, p)["level"].numpy()

    start = [float(checked.initial[0, 0])]
    found = solve_ivp(rate, (0.0, time[-1]), start, t_eval=time, rtol=1e-9, atol=1e-10, max_step=0.1)
    assert np.abs(found.y[0] - level.numpy()).max() < 1e-6 * reach


@pytest.mark.process
def test_it_runs_as_a_script(corrected):
    folder, _, checked = corrected
    command = [sys.executable, str(folder / "corrected.py"), "new.csv", "--start-seconds", "2"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=True)
    assert "initial states from the first 2 s" in done.stdout
    printed = float(done.stdout.split("level: ")[1].split()[0])
    assert printed == pytest.approx(checked.outputs[0].corrected, rel=0.3)


def test_a_recording_that_cannot_be_used_is_one_line(corrected):
    folder, _, _ = corrected
    with pytest.raises(SystemExit, match=r"none.csv: there is no such file"):
        run_alone(Tank, [str(folder / "none.csv")])
    with pytest.raises(SystemExit, match="Expected argument `start_seconds` to be at least"):
        run_alone(Tank, [str(folder / "new.csv"), "--start-seconds", "99"])


@pytest.mark.e2e
def test_the_memory_of_an_effect_starts_as_in_the_model(corrected):
    """A second store that lags behind the level: as a state of corrected.py it is not estimated."""
    folder, recording, _ = corrected
    source = load_simulation(f"{folder / 'vessel.py'}:Tank")
    term = Term(HiddenLag(), None, {"time_constant": 2.0}, "lagged rate of level")
    theta, gamma = torch.tensor([0.3]).double(), torch.tensor([0.2]).double()
    model = DiagnosedModel("Tank", {"input_hold": {"inflow": "linear"}}, theta, [term], [gamma], source)
    (folder / "lagged").mkdir()
    (folder / "lagged" / "corrected.py").write_text(model.to_python(folder=folder / "lagged"), encoding="utf-8")
    system = loaded(folder / "lagged")()
    assert len(system.states) == 2
    assert list(system.starts_as.values()) == ["level"]
    plain = DiagnosedModel(system.name, {}, theta, (), (), system)
    own, written = predict(model, recording), predict(plain, recording)
    assert own.start_seconds == written.start_seconds
    assert written.simulated == pytest.approx(own.simulated, abs=1e-6)
