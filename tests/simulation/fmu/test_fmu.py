"""FMUs as simulations: description, refusals, and comparison with recordings."""

import pickle
import zipfile
from dataclasses import replace

import pytest
import torch

pytest.importorskip("fmpy")
pytest.importorskip("sympy")

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, FmuError, Parameter, SimulationError, load_fmu, load_simulation
from mkc_torch.simulation.fmu import binary
from tests.simulation.fmu.made import COMPILER, PENDULUM, Model, description, make_fmu

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no compiler of C (cc, gcc or clang)")


class Pendulum(Dynamics):
    states = ("angle", "speed")
    inputs = ("torque",)
    outputs = ("angle",)
    parameters = {"stiffness": 9.0, "damping": Parameter(0.1, lower=0.0, unit="1/s")}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": u.torque - p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


def pendulum_recording(count=60, **renamed):
    time = 0.05 * torch.arange(count, dtype=torch.float64)
    columns = {"time": time, "torque": torch.sin(2.0 * time), "angle": 0.4 * torch.cos(3.0 * time)}
    return Recording({renamed.get(name, name): values for name, values in columns.items()})


@pytest.mark.parametrize("version", [2, 3])
def test_the_description_gives_states_inputs_outputs_and_parameters(tmp_path, version):
    simulation = load_simulation(str(make_fmu(tmp_path / "p.fmu", PENDULUM, version)))
    assert (simulation.name, simulation.states, simulation.inputs) == ("Pendulum", ("angle", "speed"), ("torque",))
    assert simulation.units == {"angle": "rad", "speed": "rad/s", "torque": "N·m"}
    assert simulation.parameters["damping"] == Parameter(0.1, lower=0.0, unit="1/s")
    assert simulation.initial == {"angle": 0.0, "speed": 0.0}


@pytest.mark.parametrize(("version", "derivatives"), [(2, True), (2, False), (3, True)])
def test_residual_equals_the_same_equations_in_torch(tmp_path, version, derivatives):
    simulation = load_fmu(make_fmu(tmp_path / "p.fmu", PENDULUM, version, derivatives=derivatives))
    fmu, expected = simulation.prepare(pendulum_recording()), Pendulum().prepare(pendulum_recording())
    theta = expected.start()
    assert fmu.parameter_names == expected.parameter_names
    assert fmu.kinematic == {"angle": "speed"}
    torch.testing.assert_close(fmu.start(), theta, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(fmu.residual(theta, {}), expected.residual(theta, {}), rtol=1e-9, atol=1e-9)
    slopes = [torch.func.jacfwd(lambda at, which=which: which.residual(at, {}))(theta) for which in (fmu, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-7, atol=1e-7)


def test_a_state_has_the_name_of_the_output_that_equals_it(tmp_path):
    model = replace(PENDULUM, outputs={"load.phi": "angle", "height": "1 - cos(angle)"})
    simulation = load_fmu(make_fmu(tmp_path / "p.fmu", model))
    assert simulation.states == ("load_phi", "speed")
    # a column may have the name in the FMU
    prepared = simulation.prepare(pendulum_recording(angle="load.phi"))
    assert prepared.channels == ("load_phi",)
    assert torch.equal(prepared.guess[prepared.rows][:, 0], pendulum_recording()["angle"])
    raised = simulation.prepare(pendulum_recording(angle="height"))
    assert raised.channels == ("height",)
    states = torch.tensor([[0.3, 0.1]], dtype=torch.float64).expand(60, 2)
    x = type("X", (), {"load_phi": states[:, 0], "speed": states[:, 1]})()
    u, p = (
        type("U", (), {"torque": states[:, 0]})(),
        type("P", (), {"stiffness": states[0, 0], "damping": states[0, 0]})(),
    )
    shown = raised.system.output(torch.zeros(60), x, u, p)["height"]
    torch.testing.assert_close(shown, 1.0 - torch.cos(states[:, 0]))


def test_the_error_lists_outputs_and_columns(tmp_path):
    model = replace(PENDULUM, outputs={"body.height": "1 - cos(angle)"})
    simulation = load_fmu(make_fmu(tmp_path / "p.fmu", model))
    with pytest.raises(
        SimulationError, match=r"It has body\.height, angle, speed; the recording has time, torque, phi"
    ):
        simulation.prepare(pendulum_recording(angle="phi"))


def test_an_fmu_can_be_pickled(tmp_path):
    simulation = load_fmu(make_fmu(tmp_path / "p.fmu", PENDULUM))
    again = pickle.loads(pickle.dumps(simulation))
    assert again.states == simulation.states
    theta = Pendulum().prepare(pendulum_recording()).start()
    assert torch.equal(
        again.prepare(pendulum_recording()).residual(theta, {}),
        simulation.prepare(pendulum_recording()).residual(theta, {}),
    )


SPILLWAY = Model(
    "Stop",
    {"level": "inflow - loss*level - r0*spill*(level - rim)"},
    {"loss": (0.3, 0.0, None, "1/s"), "spill": (2.0, None, None, ""), "rim": (0.5, None, None, "")},
    ("inflow",),
    events=("level - rim",),
)
"""Above the rim it spills; the condition is frozen between events, as in usual tools."""


@pytest.mark.parametrize("version", [2, 3])
def test_discrete_equations_are_solved_at_each_moment(tmp_path, version):
    simulation = load_fmu(make_fmu(tmp_path / "s.fmu", SPILLWAY, version))
    level = torch.tensor([0.2, 0.9, 0.3, 0.7], dtype=torch.float64)
    x, u = type("X", (), {"level": level})(), type("U", (), {"inflow": torch.zeros_like(level)})()
    p = type("P", (), {name: torch.tensor(start).double() for name, (start, *_) in SPILLWAY.parameters.items()})()
    found = simulation.derivative(torch.zeros_like(level), x, u, p)["level"]
    torch.testing.assert_close(found, -0.3 * level - 2.0 * (level - 0.5).clamp(min=0.0))


@pytest.mark.parametrize("version", [2, 3])
def test_fmus_with_state_resets_or_memory_are_refused(tmp_path, version):
    bouncing = replace(SPILLWAY, reset={"level": "-0.8*level"})
    with pytest.raises(SimulationError, match=r"resets its states at an event.*`--simulator-output SIM.csv`"):
        load_fmu(make_fmu(tmp_path / "b.fmu", bouncing, version))
    with pytest.raises(FmuError, match=r"depend on earlier events.*`--simulator-output SIM.csv`"):
        load_fmu(make_fmu(tmp_path / "m.fmu", replace(SPILLWAY, memory=True), version))


def write_fmu(path, text, *more):
    with zipfile.ZipFile(path, "w") as archive:
        if text is not None:
            archive.writestr("modelDescription.xml", text)
        for name in more:
            archive.writestr(name, "")


DESCRIPTION = description(PENDULUM)
STATIC_MODEL = Model("Still", {}, {"gain": (1.0, None, None, "")}, ("torque",), {"force": "gain*torque"})


@pytest.mark.parametrize(
    ("text", "more", "words"),
    [
        (None, (), "this is not an FMU, or it is damaged: it has no modelDescription.xml"),
        ("<fmiModelDescription fmiVersion='2.0'", (), "its modelDescription.xml cannot be parsed"),
        (description(PENDULUM, fmi="1.0"), (), "this FMU is of FMI 1.0; FMI 2.0 and 3.0 are read"),
        ("<model/>", (), "this FMU is of FMI (no version)"),
        (description(PENDULUM, 3, kind="ScheduledExecution"), (), "for scheduled execution only; export it for model"),
        (description(STATIC_MODEL), (), "no continuous states, so there is no differential equation in it"),
        (DESCRIPTION.replace("start=\"9.0\"", ""), (), "its parameter stiffness has no start, which FMI requires"),
        (DESCRIPTION.replace("start=\"9.0\"", "start=\"nine\""), (), "its parameter stiffness has the value 'nine'"),
        (DESCRIPTION.replace("start=\"0.1\"", "start=\"-0.1\""), (), "its parameter damping cannot be fitted"),
        (DESCRIPTION, (), "it has no binaries, and none for"),
        (DESCRIPTION, ("binaries/mars64/Pendulum.so",), "it has binaries for mars64 only, and none for"),
        (DESCRIPTION, ("sources/all.c",), "it contains sources; compile them with `fmpy compile MODEL.fmu`"),
        (DESCRIPTION, ("binaries/PLATFORM/Pendulum.so",), "its binary cannot be used"),
    ],
)  # fmt: skip
def test_unusable_fmus_are_refused_with_the_reason(tmp_path, text, more, words):
    path = tmp_path / "model.fmu"
    write_fmu(path, text, *(name.replace("PLATFORM", binary._platform(2)) for name in more))
    with pytest.raises(FmuError) as caught:
        load_fmu(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert message.endswith(".")
    assert "\n" not in message


def test_other_files_are_refused(tmp_path):
    (tmp_path / "model.fmu").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(FmuError, match="damaged: it is not a zip archive"):
        load_fmu(tmp_path / "model.fmu")
    with pytest.raises(FmuError, match=r"there is no such file"):
        load_fmu(tmp_path / "other.fmu")


def test_without_fmpy_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fmpy", None)
    (tmp_path / "model.fmu").write_bytes(b"")
    with pytest.raises(ImportError, match=r'install it with `pip install "mkc-torch\[fmu\]"`'):
        load_fmu(tmp_path / "model.fmu")


COSIMULATION = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Lag(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.drive, self.level = 0.0, 0.0
        self.register_variable(Real("drive", causality=Fmi2Causality.input))
        self.register_variable(Real("level", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.level += step_size * (self.drive - self.level)
        return True
"""


def test_a_co_simulation_fmu_is_compared_like_a_simulator_output(tmp_path):
    builder = pytest.importorskip("pythonfmu.builder")
    (tmp_path / "lag.py").write_text(COSIMULATION, encoding="utf-8")
    path = builder.FmuBuilder.build_FMU(str(tmp_path / "lag.py"), dest=str(tmp_path))
    simulation = load_fmu(path)
    time = 0.05 * torch.arange(80, dtype=torch.float64)
    drive = torch.ones_like(time)
    level = 1.0 - torch.exp(-time)  # the exact solution
    prepared = simulation.prepare(Recording({"time": time, "drive": drive, "level": level}))
    assert (simulation.name, prepared.channels) == ("simulated", ("level",))
    left = prepared.residual(prepared.start(), {})
    assert float(left.abs().max()) < 0.02
    with pytest.raises(SimulationError, match=r"It has level; the recording has time, drive, height"):
        simulation.prepare(Recording({"time": time, "drive": drive, "height": level}))
