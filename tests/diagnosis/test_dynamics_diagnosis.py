"""Hidden physics of differential equations is named; the truth is integrated by scipy with independent formulas."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter
from tests.shared_data import shared_data

QUICK = {"surrogates": 39, "max_findings": 1}
NOISE = 0.01


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": 8.0, "damping": Parameter(0.1, lower=0.0, unit="1/s")}
    units = {"angle": "rad", "speed": "rad/s"}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


def contaminated(values, size, seed):
    """Add normal noise, with 5 % outliers of thirty times its size."""
    random = np.random.default_rng(seed)
    bad = random.random(values.shape) < 0.05
    return values + size * (1.0 + 29.0 * bad) * random.standard_normal(values.shape)


def pendulum_recording(hidden, seed=0):
    """600 samples of a damped pendulum's angle, with hidden physics in its equation."""
    time = np.arange(600) * 0.02

    def rate(_, y):
        return [y[1], -9.0 * math.sin(y[0]) - 0.05 * y[1] + hidden(*y)]

    exact = solve_ivp(rate, (0.0, time[-1]), [1.2, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.02)
    angle = contaminated(exact.y[0], NOISE, seed)
    return Recording({"time": torch.from_numpy(time), "angle": torch.from_numpy(angle)}, name="swing")


def value(finding, name):
    """Return a parameter's value and standard error."""
    (match,) = [p for p in finding.parameters if p.name == name]
    return match.value, match.standard_error


def only_confirmed_finding(diagnosis, effect):
    """Return the only finding, with the expected name and confirmed by held-out blocks."""
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    assert finding.effect == effect
    assert finding.p_value <= 0.05
    assert finding.held_out.confidence_interval[0] > 0.0
    assert finding.held_out.rmse_after < finding.held_out.rmse_before
    return finding


@pytest.mark.e2e
@pytest.mark.parametrize(("size", "seed"), [(0.2, 0), pytest.param(0.05, 2, marks=pytest.mark.slow)])
def test_air_drag_is_named_and_sized(size, seed):
    """A body whose flow is laminar at small speeds."""
    recording = pendulum_recording(lambda _, v: -size * v * math.hypot(v, 0.1), seed)
    finding = only_confirmed_finding(diagnose(Pendulum(), recording, **QUICK), "quadratic_drag")
    drag, error = value(finding, "drag")
    assert drag == pytest.approx(size, abs=0.015)
    assert 0.0 < error < 0.01
    assert finding.held_out.rmse_after == pytest.approx(NOISE, rel=0.25)
    assert finding.held_out.rmse_before > 1.2 * NOISE


@pytest.mark.slow
def test_dry_friction_is_named_and_sized():
    """The jump is smoothed by another function than the catalogue's."""
    diagnosis = diagnose(
        Pendulum(), pendulum_recording(lambda _, v: -0.3 * 2.0 / math.pi * math.atan(v / 0.002)), **QUICK
    )
    finding = only_confirmed_finding(diagnosis, "coulomb_friction")
    assert value(finding, "friction")[0] == pytest.approx(0.3, abs=0.03)
    assert finding.held_out.rmse_after == pytest.approx(NOISE, rel=0.25)
    assert finding.alternatives[0].effect == "stribeck_friction"


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_alone_has_no_findings(seed):
    diagnosis = diagnose(Pendulum(), pendulum_recording(lambda _, __: 0.0, seed), **QUICK)
    assert diagnosis.verdict == "adequate"
    assert diagnosis.findings == ()
    assert diagnosis.corrected.rmse == pytest.approx(NOISE, rel=0.25)
    assert dict(zip(("stiffness", "damping"), diagnosis.model.theta.tolist(), strict=False)) == pytest.approx(
        {"stiffness": 9.0, "damping": 0.05}, abs=0.02
    )


class Tanks(Dynamics):
    """Two tanks without a connection."""

    states = ("upper", "lower")
    inputs = ("pump",)
    parameters = {"inflow": Parameter(1.0, lower=0.0), "drain": Parameter(0.3, lower=0.0)}
    units = {"upper": "m", "lower": "m"}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"upper": p.inflow * u.pump - p.drain * x.upper, "lower": -p.drain * x.lower}


def tanks_recording(leak, seed=0):
    """400 samples of two tanks with a pipe between them: the exact solution from sample to sample."""
    step, random = 0.1, np.random.default_rng(seed)
    pump = np.repeat(random.uniform(0.1, 0.9, 40), 10)
    flow = np.array([[-0.25 - leak, leak], [leak, -0.25 - leak]])
    values, vectors = np.linalg.eigh(flow)
    decay = vectors @ np.diag(np.exp(values * step)) @ vectors.T
    levels = [np.array([1.0, 0.8])]
    for u in pump[:-1]:
        rest = -np.linalg.solve(flow, [1.2 * u, 0.0])
        levels.append(rest + decay @ (levels[-1] - rest))
    upper, lower = contaminated(np.array(levels).T, 0.02, seed)
    columns = {"time": np.arange(400) * step, "pump": pump, "upper": upper, "lower": lower}
    return Recording({name: torch.from_numpy(column) for name, column in columns.items()}, name="tanks")


@pytest.mark.e2e
@pytest.mark.slow
def test_a_pipe_between_two_tanks_is_named_and_sized():
    finding = only_confirmed_finding(diagnose(Tanks(), tanks_recording(0.15), **QUICK), "coupling")
    exchange, error = value(finding, "exchange")
    assert exchange == pytest.approx(0.15, abs=0.03)  # the outflow of one tank is the inflow of the other
    assert error < 0.03
    assert finding.held_out.rmse_after == pytest.approx(0.02, rel=0.25)


@pytest.mark.e2e
def test_two_tanks_apart_are_adequate():
    assert diagnose(Tanks(), tanks_recording(0.0), **QUICK).verdict == "adequate"


# effects with memory, and fluids; each with its nearest rivals


def effects_named(*names):
    return tuple(effect for effect in DYNAMICS if effect.id in names)


def solved_recording(rate, first, time, noise, **columns):
    """Return a recording of the first states of an equation with hidden physics, by names and tolerances."""
    exact = solve_ivp(rate, (0.0, time[-1]), first, t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.02)
    known = {name: contaminated(exact.y[k], noise, k) for k, name in enumerate(columns.pop("seen"))}
    return Recording({name: torch.as_tensor(values) for name, values in {"time": time, **known, **columns}.items()})


class Servo(Dynamics):
    """A servo that follows its commanded angle."""

    states = ("angle", "speed")
    inputs = ("command",)
    parameters = {"stiffness": 22.0, "damping": Parameter(3.5, lower=0.0)}
    units = {"angle": "rad", "speed": "rad/s", "command": "rad"}
    step = 0.04

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": p.stiffness * (u.command - x.angle) - p.damping * x.speed}


def servo_command(behind):
    """140 samples of a servo whose command, linear between samples, passes a gear."""
    time = np.arange(140) * 0.04
    command = np.sin(1.7 * time) + 0.5 * np.sin(4.1 * time + 1.0)
    finely = np.linspace(time[0], time[-1], 139 * 20 + 1)
    seen = behind(np.interp(finely, time, command))

    def rate(t, y):
        return [y[1], 25.0 * (np.interp(t, finely, seen) - y[0]) - 4.0 * y[1]]

    return solved_recording(rate, [0.0, 0.0], time, NOISE, seen=("angle",), command=command)


def backlash_output(command):
    """Return the load angle: it is constant until the drive has crossed the gap."""
    load = command.copy()
    for k in range(1, len(load)):
        load[k] = load[k - 1] + np.sign(command[k] - load[k - 1]) * max(abs(command[k] - load[k - 1]) - 0.14, 0.0)
    return load


def dead_zone_output(command):
    return command - np.clip(command, -0.14, 0.14)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("hidden", "name", "size"), [(backlash_output, "backlash", "half_gap"), (dead_zone_output, "dead_zone", "width")]
)
def test_backlash_and_a_dead_zone_are_separable(hidden, name, size):
    diagnosis = diagnose(Servo(), servo_command(hidden), effects=effects_named("backlash", "dead_zone"), **QUICK)
    finding = only_confirmed_finding(diagnosis, name)
    assert value(finding, "share")[0] == pytest.approx(1.0, abs=0.1)
    assert value(finding, size)[0] == pytest.approx(0.14, abs=0.01)
    assert all(alternative.separable for alternative in finding.alternatives)


@pytest.mark.e2e
def test_a_hysteretic_spring_is_named_and_sized():
    """The unloading differs from the catalogue's: three quarters of β, one quarter of β′."""

    def rate(_, y):
        angle, v, z = y
        return [v, -9.0 * math.sin(angle) - 0.05 * v - 2.0 * z, v - 3.0 * abs(v) * z - v * abs(z)]

    recording = solved_recording(rate, [1.2, 0.0, 0.0], np.arange(300) * 0.02, NOISE, seen=("angle",))
    rivals = effects_named("bouc_wen_hysteresis", "coulomb_friction")
    finding = only_confirmed_finding(diagnose(Pendulum(), recording, effects=rivals, **QUICK), "bouc_wen_hysteresis")
    assert value(finding, "stiffness")[0] == pytest.approx(2.0, abs=0.5)
    assert value(finding, "yield_deflection")[0] == pytest.approx(0.25, abs=0.1)
    assert finding.channels == ("rate of speed",)


class Buoy(Dynamics):
    """A float on a spring, driven by a known force; its mass is that of the body without water."""

    states = ("heave", "speed")
    inputs = ("force",)
    parameters = {"drag": Parameter(0.2, lower=0.0)}
    units = {"heave": "m", "speed": "m/s", "force": "m/s²"}
    step = 0.05

    def derivative(self, time, x, u, p):
        return {"heave": x.speed, "speed": u.force - 4.0 * x.heave - p.drag * x.speed}


@pytest.mark.e2e
def test_added_mass_is_named_and_sized():
    time = np.arange(400) * 0.05
    force = np.sin(1.3 * time) + np.sin(2.9 * time)

    def rate(t, y):
        return [y[1], (np.interp(t, time, force) - 4.0 * y[0] - 0.3 * y[1]) / 1.1]

    recording = solved_recording(rate, [0.5, 0.0], time, NOISE, seen=("heave",), force=force)
    rivals = effects_named("added_mass", "cubic_stiffness")
    finding = only_confirmed_finding(diagnose(Buoy(), recording, effects=rivals, **QUICK), "added_mass")
    share, error = value(finding, "share")
    assert share == pytest.approx(0.1 / 1.1, abs=0.01)
    assert 0.0 < error < 0.01


class Ball(Dynamics):
    states = ("x", "y", "vx", "vy")
    parameters = {"drag": Parameter(0.01, lower=0.0)}
    units = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"}
    step = 0.02

    def derivative(self, time, x, u, p):
        speed = torch.sqrt(x.vx.square() + x.vy.square() + 1e-6)
        return {"x": x.vx, "y": x.vy, "vx": -p.drag * speed * x.vx, "vy": -9.81 - p.drag * speed * x.vy}


@pytest.mark.e2e
def test_lift_of_a_spinning_ball_is_named_and_sized():
    """The spin decays."""

    def rate(t, s):
        _, _, vx, vy = s
        speed, lift = math.hypot(vx, vy), 0.18 * math.exp(-t / 10.0)
        return [vx, vy, -0.02 * speed * vx - lift * vy, -9.81 - 0.02 * speed * vy + lift * vx]

    recording = solved_recording(rate, [0.0, 1.0, 25.0, 8.0], np.arange(180) * 0.02, NOISE, seen=("x", "y"))
    rivals = effects_named("magnus_lift", "coupling")
    diagnosis = diagnose(Ball(), recording, effects=rivals, **QUICK)
    assert diagnosis.verdict == "unexplained"  # the lift is not the constant one of the catalogue
    (finding,) = diagnosis.findings
    assert (finding.effect, finding.grade) == ("magnus_lift", "left_out")
    assert value(finding, "turning")[0] == pytest.approx(0.165, abs=0.02)
    assert finding.channels == ("rate of vx", "rate of vy")


def test_buoyancy_leads_the_search_of_all_effects():
    """A sphere, whose displaced volume is not linear in its depth; the refits would be slow."""
    time = np.arange(140) * 0.05
    force = 1.5 * np.sin(1.3 * time) + np.sin(2.9 * time)

    def rate(t, y):
        deep = min(max(0.3 - y[0], 0.0), 0.6)
        lift = 0.4 * deep**2 * (0.9 - deep) / 0.108
        return [y[1], np.interp(t, time, force) - 4.0 * y[0] - 0.3 * y[1] + lift]

    recording = solved_recording(rate, [0.8, 0.0], time, NOISE, seen=("heave",), force=force)
    simulation = Buoy().prepare(recording)
    base = fitted(JointModel(simulation), simulation.start())
    terms = candidate_terms(simulation, (), DYNAMICS)
    tangents = tangents_of(base.model, base.parameters, NoiseSettings(), terms)
    search = linearise(base.model, base.parameters, *base.pseudo(NoiseSettings()), tangents, white=True, drift=False)
    order = search.search.gains(search.series.unsqueeze(-1)).log_p[:, 0].argsort().tolist()
    assert terms[order[0]].effect.id == "buoyancy"
    lift, _ = search.search.estimate(order[0], search.series)
    assert -float(lift) == pytest.approx(0.4, abs=0.15)


class Sinking(Dynamics):
    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": -9.81 - 0.8 * x.speed}


@pytest.mark.e2e
def test_a_submerged_body_has_a_constant_force():
    """Buoyancy is inseparable from any other constant force."""

    def rate(_, y):
        return [y[1], -9.81 - 0.8 * y[1] + 2.0]

    recording = solved_recording(rate, [5.0, 0.0], np.arange(120) * 0.02, NOISE, seen=("height",))
    rivals = effects_named("buoyancy", "constant_force")
    finding = only_confirmed_finding(diagnose(Sinking(), recording, effects=rivals, **QUICK), "constant_force")
    assert [(a.effect, a.separable) for a in finding.alternatives] == [("buoyancy", False)]


# balls dropped from a bridge


class Fall(Dynamics):
    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": -9.81 + 0.0 * x.speed}


def drops_recording(ball):
    """Return both drops of a ball in one table."""
    parts = Recording.read(shared_data("dynamics/falling_balls/ball_drops.csv")).experiments()
    both = [parts[f"{ball}/{k}"] for k in (1, 2)]
    columns = {name: torch.cat([drop[name] for drop in both]) for name in ("time", "height")}
    number = torch.cat([torch.full((len(drop),), float(k)) for k, drop in enumerate(both)])
    return Recording({**columns, "experiment": number}, name=ball)


@pytest.mark.e2e
def test_a_light_ball_has_drag():
    """Short drops do not separate the kinds of drag."""
    diagnosis = diagnose(Fall(), drops_recording("Whiffle_Ball_1"), **QUICK)
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    alike = [rival.effect for rival in finding.alternatives if not rival.separable]
    assert {"linear_drag", "quadratic_drag"} & {finding.effect, *alike}
    assert finding.grade == "left_out"
    assert finding.held_out.outputs["height"].after < 0.1 * finding.held_out.outputs["height"].before


@pytest.mark.e2e
def test_a_heavy_ball_has_no_finding():
    """Its residual is not only noise, but no effect predicts held-out blocks."""
    diagnosis = diagnose(Fall(), drops_recording("Bowling_Ball"), **QUICK)
    assert diagnosis.findings == ()
    assert not any(word in text for text in diagnosis.warnings for word in ("drag", "added_mass"))
