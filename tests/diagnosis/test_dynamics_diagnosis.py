"""Physics hidden in differential equations has to be named; the truth is made by scipy, with formulas of its own."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.simulation import Dynamics, Parameter
from tests.shared_data import shared_data

QUICK = {"surrogates": 19, "max_findings": 1}
NOISE = 0.01


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": 8.0, "damping": Parameter(0.1, lower=0.0, unit="1/s")}  # noqa: RUF012
    units = {"angle": "rad", "speed": "rad/s"}  # noqa: RUF012

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


def spoilt(values, size, seed):
    """With normal noise, and one sample in twenty thirty times as far off."""
    random = np.random.default_rng(seed)
    bad = random.random(values.shape) < 0.05
    return values + size * (1.0 + 29.0 * bad) * random.standard_normal(values.shape)


def swung(hidden, seed=0):
    """600 samples of a damped pendulum's angle, with what is hidden in its equation."""
    time = np.arange(600) * 0.02

    def rate(_, y):
        return [y[1], -9.0 * math.sin(y[0]) - 0.05 * y[1] + hidden(*y)]

    exact = solve_ivp(rate, (0.0, time[-1]), [1.2, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=0.02)
    angle = spoilt(exact.y[0], NOISE, seed)
    return Recording({"time": torch.from_numpy(time), "angle": torch.from_numpy(angle)}, name="swing")


def value(finding, name):
    """Of a parameter, with its error."""
    (one,) = [p for p in finding.parameters if p.name == name]
    return one.value, one.standard_error


def explained(diagnosis, effect):
    """The one finding of a diagnosis, named as it should be, and confirmed by unseen blocks."""
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    assert finding.effect == effect
    assert finding.p_value <= 0.05
    assert finding.held_out.confidence_interval[0] > 0.0
    assert finding.held_out.rmse_after < finding.held_out.rmse_before
    return finding


@pytest.mark.parametrize(("size", "seed"), [(0.2, 0), (0.05, 2)])
def test_air_drag_is_named_and_sized(size, seed):
    """Of a body whose flow turns laminar at small speeds."""
    recording = swung(lambda _, v: -size * v * math.hypot(v, 0.1), seed)
    finding = explained(diagnose(Pendulum(), recording, **QUICK), "quadratic_drag")
    drag, error = value(finding, "drag")
    assert drag == pytest.approx(size, abs=0.015)
    assert 0.0 < error < 0.01
    assert finding.held_out.rmse_after == pytest.approx(NOISE, rel=0.25)
    assert finding.held_out.rmse_before > 1.2 * NOISE


def test_dry_friction_is_named_and_sized():
    """With a jump that is smoothed by another function."""
    diagnosis = diagnose(Pendulum(), swung(lambda _, v: -0.3 * 2.0 / math.pi * math.atan(v / 0.002)), **QUICK)
    finding = explained(diagnosis, "coulomb_friction")
    assert value(finding, "friction")[0] == pytest.approx(0.3, abs=0.03)
    assert finding.held_out.rmse_after == pytest.approx(NOISE, rel=0.25)
    assert finding.alternatives[0].effect == "stribeck_friction"


@pytest.mark.parametrize("seed", [0, 1])
def test_where_nothing_is_hidden_nothing_is_found(seed):
    diagnosis = diagnose(Pendulum(), swung(lambda _, __: 0.0, seed), **QUICK)
    assert diagnosis.verdict == "adequate"
    assert diagnosis.findings == ()
    assert diagnosis.corrected.rmse == pytest.approx(NOISE, rel=0.25)
    assert dict(zip(("stiffness", "damping"), diagnosis.model.theta.tolist(), strict=False)) == pytest.approx(
        {"stiffness": 9.0, "damping": 0.05}, abs=0.02
    )


class Tanks(Dynamics):
    """Two tanks that are thought to be apart."""

    states = ("upper", "lower")
    inputs = ("pump",)
    parameters = {"inflow": Parameter(1.0, lower=0.0), "drain": Parameter(0.3, lower=0.0)}  # noqa: RUF012
    units = {"upper": "m", "lower": "m"}  # noqa: RUF012
    between = "held"

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"upper": p.inflow * u.pump - p.drain * x.upper, "lower": -p.drain * x.lower}


def filled(leak, seed=0):
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
    upper, lower = spoilt(np.array(levels).T, 0.02, seed)
    columns = {"time": np.arange(400) * step, "pump": pump, "upper": upper, "lower": lower}
    return Recording({name: torch.from_numpy(column) for name, column in columns.items()}, name="tanks")


def test_a_pipe_between_two_tanks_is_named_and_sized():
    finding = explained(diagnose(Tanks(), filled(0.15), **QUICK), "coupling")
    exchange, error = value(finding, "exchange")
    assert exchange == pytest.approx((0.15, 0.15), abs=0.03)
    assert max(error) < 0.03
    assert finding.held_out.rmse_after == pytest.approx(0.02, rel=0.25)


def test_two_tanks_apart_are_adequate():
    assert diagnose(Tanks(), filled(0.0), **QUICK).verdict == "adequate"


# balls dropped from a bridge


class Fall(Dynamics):
    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}  # noqa: RUF012

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"height": x.speed, "speed": -9.81 + 0.0 * x.speed}


def dropped(ball):
    """Both drops of a ball in one table."""
    parts = Recording.read(shared_data("dynamics/falling_balls/ball_drops.csv")).experiments()
    both = [parts[f"{ball}/{k}"] for k in (1, 2)]
    columns = {name: torch.cat([one[name] for one in both]) for name in ("time", "height")}
    number = torch.cat([torch.full((len(one),), float(k)) for k, one in enumerate(both)])
    return Recording({**columns, "experiment": number}, name=ball)


def test_a_light_ball_is_braked_by_the_air():
    diagnosis = diagnose(Fall(), dropped("Whiffle_Ball_1"), **QUICK)
    assert diagnosis.verdict == "explained"
    (finding,) = diagnosis.findings
    assert finding.effect in ("linear_drag", "quadratic_drag")
    drag, error = value(finding, "drag")
    assert drag > 10.0 * error
    assert finding.held_out.rmse_after < 0.1 * finding.held_out.rmse_before


def test_a_heavy_ball_is_not():
    assert diagnose(Fall(), dropped("Bowling_Ball"), **QUICK).verdict == "adequate"
