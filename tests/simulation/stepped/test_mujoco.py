"""A model of MuJoCo as a simulation: its own steps, names and units, its numbers, and its file with other numbers."""

import difflib
import pickle
import sys

import numpy as np
import pytest
import torch

from mkc_torch.recording import Recording
from mkc_torch.simulation import MjcfError, SimulationError, load_mjcf, load_simulation, mjcf_class
from mkc_torch.simulation.names import Names
from tests.simulation.stepped.models import PENDULUM, TWO_LINKS

mujoco = pytest.importorskip("mujoco")


@pytest.fixture
def two_links(tmp_path):
    (tmp_path / "two_links.xml").write_text(TWO_LINKS)
    return tmp_path / "two_links.xml"


def recorded(path, rows=80, sample=0.02, friction=0.0, seed=0, torque=False):
    """A recording of both joints, stepped by MuJoCo itself; with ``torque`` also of the shoulder's drive."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.joints[1].frictionloss += friction
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    controls = np.repeat(rng.normal(size=(rows // 10 + 1, 2)), 10, 0)[:rows] * [0.6, 0.8]
    angles, torques = [], []
    for control in controls:
        angles.append(data.qpos.copy())
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_actuator[0])
        for _ in range(round(sample / model.opt.timestep)):
            data.qacc_warmstart[:] = 0.0
            mujoco.mj_step(model, data)
    time = sample * torch.arange(rows, dtype=torch.float64)
    names = ("shoulder_ctrl", "elbow_motor", "shoulder", "elbow")
    columns = np.concatenate([controls, np.array(angles)], 1)
    more = {"shoulder_torque": torch.tensor(torques)} if torque else {}
    return Recording({"time": time, **dict(zip(names, torch.tensor(columns).unbind(-1), strict=True)), **more})


def test_names_units_and_numbers_are_those_of_the_file(two_links):
    simulation = load_mjcf(two_links)
    assert simulation.name == "TwoLinks"
    assert simulation.states == ("shoulder", "elbow", "shoulder_vel", "elbow_vel")
    assert simulation.inputs == ("shoulder_ctrl", "elbow_motor")
    assert simulation.forces == {"shoulder_force": "shoulder_vel", "elbow_force": "elbow_vel"}
    assert simulation.units["shoulder_ctrl"] == "rad"
    assert simulation.units["elbow_motor"] == simulation.units["elbow_force"] == "N m"
    values = {name: parameter.value for name, parameter in simulation.parameters.items()}
    assert values == {
        "shoulder_damping": 0.2,
        "shoulder_frictionloss": 0.05,
        "elbow_damping": 0.1,
        "elbow_armature": 0.01,
        "shoulder_kp": 40.0,
        "shoulder_kv": 2.0,
    }
    assert simulation.parameters["shoulder_kp"].uncertainty == pytest.approx(40.0 * np.log(2.0))


def test_the_simulation_is_that_of_mj_step(two_links):
    recording = recorded(two_links)
    prepared = load_simulation(str(two_links)).prepare(recording)
    theta = prepared.given
    theta[-2:] = 0.0  # the recording starts at rest
    assert prepared.residual(theta, {}).abs().max() < 1e-9


def test_steps_depend_on_nothing_that_was_computed_before(tmp_path):
    """A step equals that of a file with the same numbers, after steps with other numbers, singly and in a batch."""
    text = TWO_LINKS.replace('armature="0.01"', 'armature="0.05" frictionloss="0.4"')
    (tmp_path / "arm.xml").write_text(text)
    (tmp_path / "light.xml").write_text(text.replace("0.05", "0.002"))
    arm, light = load_mjcf(tmp_path / "arm.xml"), load_mjcf(tmp_path / "light.xml")
    engine, given, other = (
        arm._engine,
        *({name: p.value for name, p in model.parameters.items()} for model in (arm, light)),
    )
    x, u, tau = np.array([[0.1, 0.2, 0.3, 0.01]]), np.array([[0.3, 0.1]]), np.zeros((1, 2))
    point = x[0].tolist(), u[0].tolist(), tau[0].tolist()
    single, names = engine.single(), Names(**given)
    first = engine.stepped(x, u, tau, given)[0][0]
    np.testing.assert_array_equal(single(*point, names), first)
    changed = engine.stepped(x, u, tau, other)[0][0]
    expected = load_mjcf(tmp_path / "light.xml")._engine.stepped(x, u, tau, other)[0][0]
    np.testing.assert_allclose(changed, expected, rtol=1e-9)
    assert np.abs(changed - first).max() > 1e-3
    np.testing.assert_array_equal(single(*point, names), first)
    engine.stepped(x, u, tau, {**other, "lower_mass": 2.0})
    np.testing.assert_array_equal(engine.stepped(x, u, tau, given)[0][0], first)


def test_dry_friction_at_a_joint_is_close_to_the_friction_loss_of_mujoco(two_links):
    recording = recorded(two_links, friction=0.1)
    prepared = load_mjcf(two_links).prepare(recording)
    theta = prepared.given
    theta[-2:] = 0.0
    without = prepared.residual(theta, {}).abs().max()
    elbow = prepared.system.inputs.index("elbow_force")
    assert elbow == 3
    friction = {"entry of elbow_force": lambda signal: -0.1 * torch.tanh(signal[:, [3]] / 0.02)}
    assert prepared.residual(theta, friction).abs().max() < 0.1 * without


def test_derivatives_are_those_of_whole_rollouts(two_links):
    prepared = load_mjcf(two_links, ["joint:*.damping", "joint:*.frictionloss", "actuator:*.kp"]).prepare(
        recorded(two_links, rows=40)
    )
    theta = prepared.given
    near = prepared.trajectory(theta, {})
    found = torch.func.jacfwd(lambda values: prepared.residual(values, {}, near))(theta)
    for k, value in enumerate(theta):
        step = torch.zeros_like(theta)
        step[k] = 1e-4 * max(abs(float(value)), 0.1)
        expected = (prepared.residual(theta + step, {}) - prepared.residual(theta - step, {})) / (2 * step[k])
        torch.testing.assert_close(found[..., k], expected, rtol=0, atol=1e-3 * float(expected.abs().max()))


def test_sensors_are_outputs(tmp_path):
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    time = 0.02 * torch.arange(50, dtype=torch.float64)
    recording = Recording({"time": time, "drive": torch.sin(3 * time), "encoder": 0.1 * torch.sin(time)})
    prepared = load_mjcf(tmp_path / "pendulum.xml").prepare(recording)
    assert prepared.channels == ("encoder",)
    theta = prepared.given
    states = prepared.trajectory(theta, {}).states[prepared.rows]
    torch.testing.assert_close(prepared.simulated(theta, {})[:, 0], states[:, 0], atol=1e-12, rtol=0)


def test_the_measured_torque_of_a_drive_is_an_output(two_links):
    prepared = load_mjcf(two_links).prepare(recorded(two_links, torque=True))
    assert prepared.channels == ("shoulder", "elbow", "shoulder_torque")
    assert prepared.system.units["shoulder_torque"] == "N m"
    theta = prepared.given
    theta[-2:] = 0.0
    assert float(prepared.measured[:, 2].std()) > 0.1
    assert prepared.residual(theta, {}).abs().max() < 1e-8


def test_the_torque_of_a_joint_that_follows_is_no_output(two_links):
    assert set(load_mjcf(two_links).description.sensors) >= {"shoulder_torque", "elbow_torque"}
    assert "shoulder_torque" not in load_mjcf(two_links, joints=["elbow"]).description.sensors


def test_a_sensor_of_the_name_of_a_torque_stays_the_users(tmp_path):
    text = PENDULUM.replace("<sensor>", '<sensor><jointvel name="hinge_torque" joint="hinge"/>')
    assert text != PENDULUM
    (tmp_path / "pendulum.xml").write_text(text)
    description = load_mjcf(tmp_path / "pendulum.xml").description
    assert "hinge_torque" in description.sensors
    assert "hinge_torque" not in description.units


def test_the_simulation_survives_pickling_with_its_forces(two_links):
    prepared = load_mjcf(two_links).prepare(recorded(two_links))
    again = pickle.loads(pickle.dumps(prepared))
    assert again.system.inputs == prepared.system.inputs
    torch.testing.assert_close(again.residual(prepared.given, {}), prepared.residual(prepared.given, {}))


def test_the_corrected_file_has_the_new_numbers_and_nothing_else(two_links):
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    description = load_mjcf(two_links).description
    same = corrected_xml(description, {}, {})
    text = corrected_xml(description, {"shoulder_kp": 55.0, "elbow_damping": 0.3}, {("elbow", "frictionloss"): 0.07})
    changed = [line for line in difflib.ndiff(same.splitlines(), text.splitlines()) if line[0] in "+-"]
    assert len(changed) == 4
    (two_links.parent / "new.xml").write_text(text)
    new = load_mjcf(two_links.parent / "new.xml")
    values = {name: parameter.value for name, parameter in new.parameters.items()}
    assert values["shoulder_kp"] == 55.0
    assert values["shoulder_kv"] == 2.0
    assert values["elbow_damping"] == 0.3
    assert values["elbow_frictionloss"] == 0.07


def test_a_finding_that_mjcf_cannot_express_is_named_in_the_file(two_links):
    from mkc_torch.diagnosis.io.mjcf import mjcf_source
    from mkc_torch.diagnosis.model.term import Term
    from mkc_torch.effects import CATALOGUE

    named = {effect.id: effect for effect in CATALOGUE if effect.id in ("coulomb_friction", "input_delay")}
    terms = [
        Term(named["coulomb_friction"], None, {"width": 0.05}, "entry of elbow_force"),
        Term(named["input_delay"], None, {"delay": 0.04}, "input shoulder_ctrl"),
    ]
    sizes = [torch.tensor([0.08]), torch.tensor([1.0])]
    system = load_mjcf(two_links)
    theta = [parameter.value for parameter in system.parameters.values()]
    text, others = mjcf_source([(system, theta, terms, sizes)])
    assert 'frictionloss="0.08"' in text
    assert len(others) == 1
    assert "shoulder_ctrl" in others[0]
    assert f"Only corrected.py has: {others[0]}." in text


def test_the_changes_of_a_corrected_model_are_its_numbers_alone(two_links):
    from mkc_torch.diagnosis.io.mjcf import mjcf_changes
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    system = load_mjcf(two_links)
    assert mjcf_changes(system, corrected_xml(system.description, {}, {})) == ""
    text = corrected_xml(system.description, {}, {("elbow", "frictionloss"): 0.07})
    lines = mjcf_changes(system, text).splitlines()
    assert lines[:2] == [f"--- {two_links.name}", "+++ corrected.xml"]
    removed, added = ([line for line in lines[2:] if line[0] == sign] for sign in "-+")
    assert len(removed) == len(added) == 1
    assert 'frictionloss="0.07"' in added[0]
    assert added[0][1:].replace(' frictionloss="0.07"', "") == removed[0][1:]


def test_the_example_recording_has_the_columns_that_a_diagnosis_needs(two_links):
    from mkc_torch.simulation.stepped.mujoco.example import example_recording

    recording = Recording(example_recording(two_links))
    prepared = load_mjcf(two_links).prepare(recording)
    assert prepared.channels == ("shoulder", "elbow")
    theta = prepared.given
    theta[-2:] = 0.0
    assert prepared.residual(theta, {}).abs().max() < 1e-9
    (two_links.parent / "idle.xml").write_text(FREE.replace("<freejoint name=", "<joint name="))
    with pytest.raises(MjcfError, match="the model has no actuator, and nothing drives it"):
        example_recording(two_links.parent / "idle.xml")


def test_a_class_of_a_model_is_found_next_to_the_calling_file(two_links):
    kind = mjcf_class("elsewhere/two_links.xml", str(two_links.parent / "corrected.py"))
    assert kind().states == load_mjcf(two_links).states


FREE = '<mujoco><worldbody><body><freejoint name="base"/><geom size=".1" mass="1"/></body></worldbody></mujoco>'
STILL = '<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FREE, "joint base is free or a ball; a diagnosis needs a model whose joints are hinges and slides"),
        (STILL, "the model has no joint, and so nothing that moves"),
        (STILL.replace("geom", "joint"), "MuJoCo refuses the model: "),
        (None, "there is no such file"),
    ],
)
def test_models_that_cannot_be_used_are_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "arm.xml").write_text(text)
    with pytest.raises(MjcfError, match=message):
        load_mjcf(tmp_path / "arm.xml")


SHELL = """
<mujoco><asset><texture name="wood" type="2d" file="wood.png"/><material name="wood" texture="wood"/>
<mesh name="shell" file="shell.stl"/></asset><worldbody><body><joint name="pan" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .01"/>
<geom type="mesh" mesh="shell" material="wood" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>
"""


def test_a_model_without_the_files_of_its_looks_is_loaded_and_written(tmp_path):
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    (tmp_path / "arm.xml").write_text(SHELL)
    description = load_mjcf(tmp_path / "arm.xml").description
    assert description.model.body_mass[1] == 1.0
    (tmp_path / "new.xml").write_text(corrected_xml(description, {"pan_damping": 0.2}, {}))
    assert load_mjcf(tmp_path / "new.xml").parameters["pan_damping"].value == 0.2


def test_a_missing_file_of_a_part_that_collides_is_named(tmp_path):
    (tmp_path / "arm.xml").write_text(SHELL.replace(' contype="0" conaffinity="0"', ""))
    with pytest.raises(MjcfError, match=r"arm\.xml: MuJoCo refuses the model: .*shell\.stl"):
        load_mjcf(tmp_path / "arm.xml")


def test_a_pattern_that_matches_no_number_lists_the_numbers(two_links):
    with pytest.raises(SimulationError, match=r"--fit joint:wrist\.\*: no number .*joint:elbow\.damping"):
        load_mjcf(two_links, ["joint:wrist.*"])


def test_a_recording_without_a_joint_lists_both(two_links):
    recording = recorded(two_links)
    other = Recording({name: recording[name] for name in ("time", "shoulder_ctrl", "elbow_motor")})
    with pytest.raises(SimulationError, match=r"no joint and no sensor .*shoulder_vel.*--columns NAME=COLUMN"):
        load_mjcf(two_links).prepare(other)


def test_without_mujoco_the_extra_is_named(two_links, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"extra `mujoco`: pip install -e '\.\[mujoco\]'"):
        load_mjcf(two_links)
