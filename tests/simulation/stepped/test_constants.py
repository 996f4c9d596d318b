"""Constants of a simulation that steps: a change of each is that of the model itself, and a diagnosis finds it."""

import math

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis import diagnose
from mkc_torch.effects import DYNAMICS
from mkc_torch.recording import Recording
from mkc_torch.simulation import Parameter, SimulationError, Stepper, load_mjcf
from tests.simulation.stepped.models import TWO_LINKS

CHANGES = {
    "lower_mass": 0.2,
    "lower_centre": 0.03,
    "lower_distance": 0.05,
    "base_tilt_x": 0.07,
    "base_tilt_y": -0.1,
    "shoulder_ref": 0.1,
    "elbow_ref": -0.15,
    "shoulder_armature": 0.02,
}
"""Change by constant; together they are the whole list of the two links."""


class Pendulum(Stepper):
    """A driven pendulum with a load that is known, by semi-implicit Euler steps."""

    states, inputs, time_step = ("angle", "speed"), ("torque",), 0.01
    positions, forces = {"angle": "speed"}, {"moment": "speed"}
    constants = {"load": Parameter(0.8, lower=0.0, unit="kg")}
    units = {"angle": "rad", "speed": "rad/s", "torque": "N m", "moment": "N m"}
    parameters = {"damping": Parameter(0.2, lower=0.0, unit="N m s")}

    def step(self, x, u, tau, p, dt):
        angle, speed = x.T
        moment = u[:, 0] + tau[:, 0] - p.damping * speed - 9.81 * 0.5 * p.load * np.sin(angle)
        speed = speed + dt * moment / (0.25 * p.load)
        return np.stack([angle + dt * speed, speed], 1)


def swinging(load, samples=220, noise=0.0, seed=1):
    """A recording of the pendulum with a load."""
    rng = np.random.default_rng(seed)
    torque = np.repeat(1.2 * rng.normal(size=samples // 20), 20)
    model, state, angles = Pendulum(), np.zeros((1, 2)), []
    p = type("Names", (), {"damping": 0.25, "load": load})
    for u in torque:
        angles.append(state[0, 0])
        for _ in range(2):
            state = model.step(state, np.array([[u]]), np.zeros((1, 1)), p, model.time_step)
    angle = torch.tensor(np.array(angles) + noise * rng.normal(size=samples))
    time = 0.02 * torch.arange(samples, dtype=torch.float64)
    return Recording({"time": time, "torque": torch.tensor(torque), "angle": angle})


def changed_by(name, amount):
    return {f"constant {name}": lambda signal: torch.full_like(signal, amount)}


def test_a_change_of_a_constant_is_the_simulation_with_this_constant():
    prepared = Pendulum().prepare(swinging(1.0))
    theta = prepared.given.new_tensor([0.25, 0.0, 0.0])
    assert prepared.residual(theta, {}).abs().max() > 0.1
    assert prepared.residual(theta, changed_by("load", 0.2)).abs().max() < 1e-9
    assert prepared.ports["constant load"].unit == "kg"
    assert "input load" not in prepared.ports


def test_a_constant_out_of_its_bounds_has_no_trajectory():
    prepared = Pendulum().prepare(swinging(1.0))
    assert not prepared.trajectory(prepared.given, changed_by("load", -0.9)).converged


def test_derivatives_by_the_change_of_a_constant_equal_differences():
    prepared = Pendulum().prepare(swinging(1.0))
    both = torch.cat([prepared.given, prepared.given.new_zeros(1)])
    along = torch.zeros_like(both)
    along[-1] = 1.0

    def residual(values):
        return prepared.residual(values[:-1], {"constant load": lambda signal: values[-1].expand_as(signal)})[:, 0]

    slope = torch.func.jvp(residual, (both,), (along,))[1]
    difference = (residual(both + 1e-4 * along) - residual(both - 1e-4 * along)) / 2e-4
    assert torch.allclose(slope, difference, atol=1e-3 * float(slope.abs().max()))  # slopes of near points are reused


def test_a_recorded_column_with_the_name_of_a_constant_is_refused():
    recording = swinging(1.0)
    taken = Recording({**{name: recording[name] for name in recording.names}, "load": recording["angle"]})
    with pytest.raises(SimulationError, match="`load`, the name of a force or a constant"):
        Pendulum().prepare(taken)


@pytest.mark.e2e
def test_a_load_that_differs_is_found():
    found = diagnose(Pendulum(), swinging(1.0, noise=0.003), quick=True)
    first = found.findings[0]
    assert first.effect == "constant_change"
    assert first.channels == ("constant load",)
    assert float(found.model.gammas[0][0]) == pytest.approx(0.2, abs=3.0 * first.parameters[0].standard_error)


@pytest.fixture
def two_links(tmp_path):
    (tmp_path / "two_links.xml").write_text(TWO_LINKS)
    return tmp_path / "two_links.xml"


def by_the_spec(path, name, amount):
    """The model with another constant, by MuJoCo's own specification."""
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_file(str(path))
    part, _, kind = name.rpartition("_")
    if kind == "mass":
        plain = spec.compile()
        load = spec.body(part).add_geom()
        load.type, load.size, load.mass = mujoco.mjtGeom.mjGEOM_SPHERE, [1e-4, 0.0, 0.0], amount
        load.pos = plain.body_ipos[plain.body(part).id]
        load.contype, load.conaffinity = 0, 0
    elif kind == "centre":
        model, body = spec.compile(), spec.body(part)
        place = model.body(part).id
        body.explicitinertial, body.mass, body.inertia = True, model.body_mass[place], model.body_inertia[place]
        body.iquat, length = model.body_iquat[place], np.linalg.norm(model.body_ipos[place])
        body.ipos = model.body_ipos[place] * (1.0 + amount / length)
    elif kind == "distance":
        pos = np.array(spec.body(part).pos)
        spec.body(part).pos = pos * (1.0 + amount / np.linalg.norm(pos))
    elif kind == "armature":
        spec.joint(part).armature += amount
    elif kind == "ref":
        spec.joint(part).ref += math.degrees(amount) if spec.compiler.degree else amount
    else:
        gravity = np.array(spec.option.gravity)
        gravity["xy".index(kind)] += np.linalg.norm(gravity) * math.sin(amount)
        spec.option.gravity = gravity
    return spec.compile()


def angles_of(model, controls):
    """Angles of both joints before each control, stepped by MuJoCo itself."""
    mujoco = pytest.importorskip("mujoco")
    data, angles = mujoco.MjData(model), []
    data.qpos[:] = 0.0
    for control in controls:
        angles.append(data.qpos.copy())
        data.ctrl[:] = control
        for _ in range(round(0.02 / model.opt.timestep)):
            data.qacc_warmstart[:] = 0.0
            mujoco.mj_step(model, data)
    return np.array(angles)


def controls_of(rows=60):
    return np.repeat(np.random.default_rng(0).normal(size=(rows // 10, 2)), 10, 0) * [0.6, 0.8]


def recorded(controls, angles):
    names = ("shoulder_ctrl", "elbow_motor", "shoulder", "elbow")
    columns = torch.tensor(np.concatenate([controls, angles], 1)).unbind(-1)
    time = 0.02 * torch.arange(len(controls), dtype=torch.float64)
    return Recording({"time": time, **dict(zip(names, columns, strict=True))})


@pytest.mark.parametrize("name", CHANGES)
def test_constants_of_a_mujoco_model_are_those_of_its_own_elements(two_links, name):
    controls = controls_of()
    angles = angles_of(by_the_spec(two_links, name, CHANGES[name]), controls)
    simulation = load_mjcf(two_links)
    assert set(simulation.constants) == set(CHANGES)
    prepared = simulation.prepare(recorded(controls, angles))
    theta = prepared.given
    theta[-4:] = 0.0
    plain, changed = (
        prepared.residual(theta, changes).abs().max() for changes in ({}, changed_by(name, CHANGES[name]))
    )
    assert plain > 1e-3 or name == "base_tilt_y"  # both axes are along y, so it moves nothing that is measured
    assert changed < 1e-6


@pytest.mark.parametrize("name", CHANGES)
def test_the_file_with_a_changed_constant_simulates_the_same(two_links, name):
    mujoco = pytest.importorskip("mujoco")
    from mkc_torch.simulation.stepped.mujoco.corrected import corrected_xml

    text = corrected_xml(load_mjcf(two_links).description, {}, {}, {name: CHANGES[name]})
    own, other = (
        angles_of(model, controls_of())
        for model in (by_the_spec(two_links, name, CHANGES[name]), mujoco.MjModel.from_xml_string(text))
    )
    assert np.abs(own - other).max() < 1e-4  # of the digits in the file


@pytest.mark.e2e
def test_a_payload_away_from_the_centre_of_mass_is_a_mass_and_a_centre(two_links):
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_file(str(two_links))
    load = spec.body("lower").add_geom()
    load.type, load.size, load.mass, load.pos = mujoco.mjtGeom.mjGEOM_SPHERE, [0.01, 0.0, 0.0], 0.15, [0.0, 0.0, -0.28]
    load.contype, load.conaffinity = 0, 0
    model, controls = spec.compile(), controls_of(150)
    angles = angles_of(model, controls) + 1e-3 * np.random.default_rng(3).normal(size=(150, 2))
    effects = tuple(effect for effect in DYNAMICS if effect.id == "constant_change")
    pair = "constant_change@lower_mass + constant_change@lower_centre"
    found = diagnose(load_mjcf(two_links, []), recorded(controls, angles), effects=effects, quick=True, suspect=pair)
    scored = {frozenset(model.terms): model for model in found.decisions.models}
    both, mass = (scored[frozenset(names.split(" + "))] for names in (pair, "constant_change@lower_mass"))
    assert both.score > mass.score + 100.0
    by_place = dict(zip(both.terms, (parameters[0].value for parameters in both.parameters), strict=True))
    plain, new = load_mjcf(two_links).description.model, model.body("lower").id
    # a load away from the centre also adds to the inertia about it, which neither number does
    assert by_place["constant_change@lower_mass"] == pytest.approx(0.15, rel=0.25)
    moved = np.linalg.norm(model.body_ipos[new]) - np.linalg.norm(plain.body_ipos[new])
    assert by_place["constant_change@lower_centre"] == pytest.approx(moved, rel=0.5)
