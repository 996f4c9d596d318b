"""Effects in systems of differential equations, against Runge-Kutta solutions."""

import math

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import DriverSettings, NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics
from tests.simulation.dynamics.runge_kutta import runge_kutta

EFFECTS = {effect.id: effect for effect in DYNAMICS}
TIME = np.arange(150) * 0.04


def table(**columns):
    return Recording({name: torch.as_tensor(values) for name, values in columns.items()})


class Mass(Dynamics):
    """A mass on a spring, driven by a known force."""

    states = ("height", "speed")
    inputs = ("drive",)
    parameters = {"damping": 0.3}
    units = {"height": "m", "speed": "m/s", "drive": "m/s²"}

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": u.drive - 4.0 * x.height - p.damping * x.speed}


class Ball(Dynamics):
    states = ("x", "y", "vx", "vy")
    parameters = {"drag": 0.05}
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}

    def derivative(self, time, x, u, p):
        return {"x": x.vx, "y": x.vy, "vx": -p.drag * x.vx, "vy": -9.81 - p.drag * x.vy}


def drive(t):
    """Return a force that is linear between the samples, as in the simulation."""
    return np.interp(t, TIME, np.sin(2.3 * TIME) + np.sin(0.9 * TIME))


def spin(t):
    return np.interp(t, TIME, 30.0 + 10.0 * np.cos(3.0 * TIME))


def drive_behind_play(gap):
    """Return the drive behind play, by its definition."""
    u = drive(TIME)
    y = u.copy()
    for k in range(1, len(u)):
        y[k] = max(u[k] - gap, min(u[k] + gap, y[k - 1]))
    return y


def mass(force=lambda *_: 0.0, inertia=1.0):
    def rate(t, y):
        return [y[1], (drive(t) - 4.0 * y[0] - 0.3 * y[1]) / inertia + force(*y)]

    return rate


def hysteretic_mass(gamma, yields):
    def rate(t, y):
        x, v, z = y
        plain = drive(t) - 4.0 * x - 0.3 * v
        return [v, plain - gamma * z, v - (abs(v) * z + v * abs(z)) / (2.0 * yields)]

    return rate


def damped_second_mass(gamma, lag):
    """Return the rate of a mass with a second mass behind a damper, whose speed is the third state."""

    def rate(t, y):
        x, v, w = y
        return [v, drive(t) - 4.0 * x - 0.3 * v + gamma * (w - v), (v - w) / lag]

    return rate


def sprung_second_mass(share, period, damping):
    """Return the rate of a mass with a second mass on a spring, whose position and speed are the last two states."""
    omega = 2.0 * math.pi / period

    def rate(t, y):
        x, v, place, w = y
        force = omega**2 * (place - x) + 2.0 * damping * omega * (w - v)
        return [v, drive(t) - 4.0 * x - 0.3 * v + share * force, w, -force]

    return rate


def lifted_ball(coefficient):
    def rate(t, y):
        _, _, vx, vy = y
        w = coefficient(t)
        return [vx, vy, -0.05 * vx - w * vy, -9.81 - 0.05 * vy + w * vx]

    return rate


def buoyant_rate(x, _):
    return 6.0 * min(max((0.3 - x) / 0.5, 0.0), 1.0)


def mass_with_play():
    behind = drive_behind_play(0.4)
    # between the samples the load is not linear where the gap starts and ends
    fine = np.linspace(0.0, TIME[-1], 40 * (len(TIME) - 1) + 1)
    side = drive(fine)
    for k in range(1, len(side)):
        side[k] = max(side[k] - 0.4, min(side[k] + 0.4, side[k - 1]))
    assert np.abs(side[::40] - behind).max() < 1e-12

    def rate(t, y):
        return [y[1], np.interp(t, fine, side) - 4.0 * y[0] - 0.3 * y[1]]

    return rate


# effect: port, shape, γ, the equations with the effect, their initial states, tolerance
CASES = {
    "backlash": ("input drive", {"half_gap": 0.4}, [1.0], mass_with_play(), [0.5, 0.0], 2e-3),
    "bouc_wen_hysteresis": (
        "hysteretic rate of speed", {"yield_deflection": 0.2}, [3.0], hysteretic_mass(3.0, 0.2), [0.5, 0.0, 0.0], 2e-4,
    ),
    "hidden_lag": (
        "lagged rate of speed", {"time_constant": 0.4}, [0.6], damped_second_mass(1.5, 0.4), [0.5, 0.7, 0.7], 1e-4,
    ),
    "hidden_mode": (
        "resonant rate of speed", {"period": 0.9, "damping": 0.1}, [0.3], sprung_second_mass(0.3, 0.9, 0.1),
        [0.5, 0.7, 0.5, 0.7], 2e-4,
    ),
    "added_mass": ("rate of speed", {}, [0.2], mass(inertia=1.25), [0.5, 0.0], 1e-4),
    "buoyancy": ("rate of speed", {"surface": 0.3, "draught": 0.5}, [6.0], mass(buoyant_rate), [0.5, 0.0], 2e-4),
    "magnus_lift": (
        "exchange of vx and vy", {}, [0.4], lifted_ball(lambda _: 0.4), [0.0, 1.0, 20.0, 5.0], 1e-4,
    ),
}  # fmt: skip


def prepared(name, rate, first, **attributes):
    """Return the simulation of a recording with the effect, the true states, and the true parameters."""
    system = Ball if name == "magnus_lift" else Mass
    known = list(system.states[:2])
    truth = runge_kutta(rate, first, TIME)
    columns = dict(zip(known, truth.T[:2], strict=True))
    recording = table(time=TIME, **columns, **({} if system is Ball else {"drive": drive(TIME)}))
    simulation = type(system.__name__, (system,), {"step": 0.01, **attributes})()
    own = [0.05] if system is Ball else [0.3]
    theta = torch.tensor([*own, *first[: len(system.states)]], dtype=torch.float64)
    return simulation.prepare(recording), torch.from_numpy(truth[:, :2]), theta


def joint_model(name, simulation, shape, gamma, theta):
    term = Term(EFFECTS[name], None, shape, CASES[name][0])
    model = JointModel(simulation, (term,))
    return model, torch.cat([theta, torch.tensor(gamma, dtype=torch.float64)])


@pytest.mark.parametrize("name", CASES)
class TestAgainstSteps:
    """The simulation with an effect solves the equations with the effect."""

    def test_residual_is_zero_at_the_truth(self, name):
        _, shape, gamma, rate, first, tolerance = CASES[name]
        simulation, truth, theta = prepared(name, rate, first)
        model, parameters = joint_model(name, simulation, shape, gamma, theta)
        assert float(model.residual(parameters).abs().max()) < tolerance * float(truth.abs().max())
        without = simulation.residual(theta, {})
        assert float(without.abs().max()) > 30.0 * tolerance * float(truth.abs().max())

    def test_derivatives_equal_differences(self, name):
        """In forward mode, in reverse mode and under vmap, by all parameters."""
        _, shape, gamma, rate, first, _ = CASES[name]
        simulation, _, theta = prepared(name, rate, first, step=0.04)
        model, parameters = joint_model(name, simulation, shape, gamma, theta)
        slope = torch.func.jacfwd(model.residual)(parameters)  # vmap over jvp
        step = 1e-5 * torch.eye(len(parameters), dtype=torch.float64)
        near = [(model.residual(parameters + h) - model.residual(parameters - h)) / 2e-5 for h in step]
        torch.testing.assert_close(slope, torch.stack(near, -1), rtol=1e-3, atol=1e-4 * float(slope.abs().max()))
        weights = torch.linspace(-1.0, 1.0, slope[..., 0].numel(), dtype=torch.float64).reshape(slope.shape[:-1])
        wanted = parameters.clone().requires_grad_()
        (model.residual(wanted) * weights).sum().backward()
        torch.testing.assert_close(wanted.grad, torch.einsum("nm,nmp->p", weights, slope), rtol=1e-6, atol=1e-9)

    def test_tangents_of_the_search_equal_those_of_the_fit(self, name):
        """The tangent of a candidate is the derivative of the joint model at amplitude 0."""
        _, shape, gamma, rate, first, _ = CASES[name]
        simulation, _, theta = prepared(name, rate, first, step=0.02)
        model, parameters = joint_model(name, simulation, shape, [0.0] * len(gamma), theta)
        found = tangents_of(JointModel(simulation), theta, NoiseSettings(), model.terms).candidates[0]
        exact = torch.func.jacfwd(model.residual)(parameters)[..., -1:]
        torch.testing.assert_close(found, exact, rtol=0.0, atol=0.01 * float(exact.abs().max()))


class TestMemory:
    """Internal states of effects."""

    def model(self, **attributes):
        _, shape, gamma, rate, first, _ = CASES["bouc_wen_hysteresis"]
        simulation, _, theta = prepared("bouc_wen_hysteresis", rate, first, **attributes)
        return joint_model("bouc_wen_hysteresis", simulation, shape, gamma, theta)

    def test_a_constant_force_does_not_act_on_the_internal_state(self):
        model, parameters = self.model()
        port = "hysteretic rate of speed"
        changes = model.changes(parameters)
        theta = parameters[: model.base]
        seen = model.prepared.signals(theta, changes)
        nothing, something = (torch.full((len(seen[port]), 1), value).double() for value in (0.0, 0.1))
        torch.testing.assert_close(model.residual_with_change(parameters, port, nothing), model.residual(parameters))
        forced = model.residual_with_change(parameters, port, something)
        other = model.residual_with_change(parameters, "rate of speed", something)
        torch.testing.assert_close(forced, other, rtol=0.0, atol=1e-9)

    def test_without_the_effect_there_is_no_internal_state(self):
        model, parameters = self.model()
        theta = parameters[: model.base]
        constant = {"hysteretic rate of speed": lambda s: torch.full_like(s[:, :1], 0.1)}
        assert model.prepared.trajectory(theta, constant).states.shape[1] == 2
        assert model.prepared.trajectory(theta, model.changes(parameters)).states.shape[1] == 3

    def test_a_second_store_starts_at_the_first(self):
        for name, like in (("hidden_lag", ("speed",)), ("hidden_mode", ("", "speed"))):
            _, shape, gamma, rate, first, _ = CASES[name]
            simulation, _, theta = prepared(name, rate, first)
            model, parameters = joint_model(name, simulation, shape, gamma, theta)
            begin = simulation.trajectory(theta, model.changes(parameters)).states[0]
            assert tuple(simulation.ports[CASES[name][0]].memory.values()) == like
            assert begin[2:].tolist() == [float(first[1]) if name else 0.0 for name in like]

    def test_a_vanishing_lag_changes_nothing(self):
        rate, first = CASES["hidden_lag"][3:5]
        simulation, _, theta = prepared("hidden_lag", rate, first)
        plain = simulation.residual(theta, {})
        left = []
        for lag in (1e-2, 1e-3, 1e-4):
            exchange = 1.5  # with a vanishing store
            model, parameters = joint_model("hidden_lag", simulation, {"time_constant": lag}, [exchange * lag], theta)
            left.append(float((model.residual(parameters) - plain).abs().max()))
        assert left[0] > 9.0 * left[1] > 81.0 * left[2]
        assert left[2] < 1e-3

    def test_a_store_with_a_short_lag_adds_its_capacity(self):
        simulation, _, theta = prepared("hidden_lag", *CASES["hidden_lag"][3:5])
        larger = JointModel(simulation, (Term(EFFECTS["added_mass"], None, {}, "rate of speed"),))
        whole = larger.residual(torch.cat([theta, theta.new_tensor([0.6 / 1.6])]))
        model, parameters = joint_model("hidden_lag", simulation, {"time_constant": 1e-3}, [0.6], theta)
        away = (whole - simulation.residual(theta, {})).abs().max()
        assert float((model.residual(parameters) - whole).abs().max()) < 0.02 * float(away)

    def test_a_stiff_spring_adds_its_mass(self):
        _, _, _, rate, first, _ = CASES["hidden_mode"]
        simulation, _, theta = prepared("hidden_mode", rate, first)
        heavier = JointModel(simulation, (Term(EFFECTS["added_mass"], None, {}, "rate of speed"),))
        rigid = heavier.residual(torch.cat([theta, theta.new_tensor([0.3 / 1.3])]))
        left = []
        for period in (0.4, 0.1):
            shape = {"period": period, "damping": 0.5}
            model, parameters = joint_model("hidden_mode", simulation, shape, [0.3], theta)
            left.append(float((model.residual(parameters) - rigid).abs().max()))
        assert left[1] < 0.25 * left[0]
        assert left[1] < 0.05 * float((rigid - simulation.residual(theta, {})).abs().max())

    def test_several_effects_have_separate_internal_states(self):
        """Each effect has its own internal states, with any other effects at the rate."""
        names = ("bouc_wen_hysteresis", "hidden_lag", "hidden_mode")
        simulation, _, theta = prepared("hidden_lag", *CASES["hidden_lag"][3:5])
        terms = [Term(EFFECTS[name], None, CASES[name][1], CASES[name][0]) for name in names]
        model = JointModel(simulation, terms)
        gammas = [theta.new_tensor(CASES[name][2]) for name in names]
        assert simulation.trajectory(theta, model.changes(torch.cat([theta, *gammas]))).states.shape[1] == 6
        for k, name in enumerate(names):
            only = [gamma if i == k else 0.0 * gamma for i, gamma in enumerate(gammas)]
            alone, parameters = joint_model(name, simulation, CASES[name][1], CASES[name][2], theta)
            jointly = model.residual(torch.cat([theta, *only]))
            torch.testing.assert_close(jointly, alone.residual(parameters), rtol=0.0, atol=1e-9)

    def test_internal_states_restart_with_every_run(self):
        """Two joint runs equal two separate runs."""
        _, shape, gamma, rate, first, _ = CASES["bouc_wen_hysteresis"]
        firsts = (first, [-0.2, 1.0, 0.0])
        parts = [runge_kutta(rate, start, TIME)[:, 0] for start in firsts]
        both = table(
            time=np.concatenate([TIME, TIME]),
            drive=np.tile(drive(TIME), 2),
            height=np.concatenate(parts),
            experiment=np.repeat([0.0, 1.0], len(TIME)),
        )
        simulation = type("Mass", (Mass,), {"step": 0.01})().prepare(both)
        theta = torch.tensor([0.3, *first[:2], -0.2, 1.0], dtype=torch.float64)
        model, parameters = joint_model("bouc_wen_hysteresis", simulation, shape, gamma, theta)
        assert float(model.residual(parameters).abs().max()) < 2e-4


def test_a_recorded_spin_drives_the_lift():
    """γ₁ at the mean spin, and γ₂ per unit of deviation."""
    truth = runge_kutta(lifted_ball(lambda t: 0.01 * spin(t)), [0.0, 1.0, 20.0, 5.0], TIME)
    recording = table(time=TIME, x=truth[:, 0], y=truth[:, 1], spin=spin(TIME))
    simulation = type("Ball", (Ball,), {"step": 0.01})().prepare(recording)
    from mkc_torch.diagnosis.model.term import find_drivers

    (driver,) = find_drivers(
        simulation.recording, simulation.system.columns, DriverSettings(), frozenset({"spin"})
    ).drivers
    model = JointModel(simulation, (Term(EFFECTS["magnus_lift"], driver, {}, "exchange of vx and vy"),))
    mean = 0.01 * float(driver.reference)
    parameters = torch.tensor([0.05, 0.0, 1.0, 20.0, 5.0, mean, 0.01], dtype=torch.float64)
    assert float(model.residual(parameters).abs().max()) < 1e-3
    assert model.sizes == (2,)


def test_added_mass_is_not_identifiable_next_to_an_inertia():
    """An inertia of the simulation scales the whole rate: the tangent of the added mass is parallel to its tangent."""

    class Own(Mass):
        parameters = {"inertia": 1.0}
        step = 0.02

        def derivative(self, time, x, u, p):
            return {"height": x.speed, "speed": (u.drive - 4.0 * x.height - 0.3 * x.speed) / p.inertia}

    truth = runge_kutta(mass(), [0.5, 0.0], TIME)
    simulation = Own().prepare(table(time=TIME, drive=drive(TIME), height=truth[:, 0]))
    theta = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
    found = tangents_of(
        JointModel(simulation), theta, NoiseSettings(), (Term(EFFECTS["added_mass"], None, {}, "rate of speed"),)
    )
    own, tangent = found.nuisance[:, 0], found.candidates[0][:, 0]
    remainder = tangent - own @ torch.linalg.lstsq(own, tangent).solution
    assert float(remainder.norm()) < 1e-6 * float(tangent.norm())


@pytest.mark.parametrize("name", ["backlash", "input_delay"])
def test_runs_on_a_common_clock_have_separate_inputs(name):
    """Runs on a common clock and on separate clocks have the same residual."""
    first, second = np.arange(60) * 0.05, 3.0 + np.arange(60) * 0.05
    torque = np.concatenate([2.0 + np.sin(3.0 * first), -2.0 + np.cos(4.0 * second)])
    theta = torch.tensor([0.3, 0.1, 0.0, -0.1, 0.0], dtype=torch.float64)
    shape = {"backlash": {"half_gap": 0.5}, "input_delay": {"delay": 0.4}}[name]
    simulated = []
    for later in (second, second - 3.0):
        recording = table(
            time=np.concatenate([first, later]),
            drive=torque,
            height=0.0 * torque,
            experiment=np.repeat([0.0, 1.0], 60),
        )
        simulation = type("Mass", (Mass,), {"step": 0.05})().prepare(recording)
        model = JointModel(simulation, (Term(EFFECTS[name], None, shape, "input drive"),))
        simulated.append(model.residual(torch.cat([theta, theta.new_ones(1)])))
    torch.testing.assert_close(simulated[0], simulated[1], rtol=0.0, atol=1e-9)
    assert math.isfinite(float(simulated[0].abs().max()))


class Idle(Dynamics):
    """A declared input that its rates do not use."""

    states = ("angle", "speed")
    inputs = ("torque",)
    outputs = ("angle",)
    parameters = {"stiffness": 9.0}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle)}


def test_an_unused_input_has_zero_tangents():
    time = torch.arange(0.0, 4.0, 0.05, dtype=torch.float64)
    recording = Recording({"time": time, "torque": torch.sin(time), "angle": torch.cos(3.0 * time)})
    simulation = Idle().prepare(recording)
    terms = [
        Term(EFFECTS[name], None, shape, "input torque")
        for name, shape in (("input_delay", {"delay": 0.1}), ("dead_zone", {"width": 0.3, "softness": 0.1}))
    ]
    found = tangents_of(JointModel(simulation), simulation.start(), NoiseSettings(), terms).candidates
    assert [tangent.shape for tangent in found] == [(80, 1, 1)] * 2
    assert all(float(tangent.abs().max()) == 0.0 for tangent in found)
