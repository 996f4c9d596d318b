"""The form of an effect compared with a free curve in its place."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.diagnosis.environment import Curve
from mkc_torch.diagnosis.findings.shape import nearest_power, shape_of
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.unknown_rate import UnknownRate
from mkc_torch.simulation import Dynamics, Parameter

SEEDS = range(10)
STEP, N, NOISE = 0.1, 300, 0.01


class Boat(Dynamics):
    """A boat driven by an alternating thrust, without drag."""

    states = ("speed",)
    inputs = ("thrust",)
    outputs = ("speed",)
    units = {"speed": "m/s", "thrust": "m/s²"}
    parameters = {"gain": Parameter(1.0, lower=0.0)}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.thrust}


@functools.cache
def boat_recording(power, seed):
    """Return a recording of a boat against a drag of this power."""
    random = np.random.default_rng(seed)
    thrust = np.repeat(random.uniform(-1.5, 1.5, N // 10), 10)
    time = STEP * np.arange(N)

    def rate(t, v):
        return thrust[min(int(t / STEP), N - 1)] - 0.4 * np.abs(v) ** power * np.sign(v)

    exact = solve_ivp(rate, (0.0, time[-1]), [0.5], t_eval=time, rtol=1e-8, atol=1e-9, max_step=STEP)
    columns = {"time": time, "thrust": thrust, "speed": exact.y[0] + NOISE * random.standard_normal(N)}
    return Recording({name: torch.from_numpy(column) for name, column in columns.items()}, name="boat")


def fit_with(recording, effect):
    """Return the fit with an effect, and all candidates."""
    prepared = Boat().prepare(recording)
    curves = [UnknownRate("own")]
    terms = candidate_terms(prepared, (), [effect, *curves])
    (term,) = [other_term for other_term in terms if other_term.effect is effect]
    model = JointModel(prepared, (term,))
    start = torch.cat([prepared.start(), torch.full((1,), 0.3, dtype=torch.float64)])
    return fitted(model, start), terms


def shape(recording, effect, **settings):
    fit, terms = fit_with(recording, effect)
    return shape_of(fit, 0, terms, EvidenceSettings(**settings))


@pytest.mark.e2e
def test_the_true_form_has_no_better_curve_in_ten_draws():
    found = [shape(boat_recording(2.0, seed), QuadraticDrag()) for seed in SEEDS]
    assert [one.curve for one in found] == [None] * len(found)
    assert [element.formula for element in found] == [""] * len(found)
    assert min(item.p_value for item in found) > 0.01


def test_a_wrong_form_has_a_better_curve_with_a_power_law_as_formula():
    found = shape(boat_recording(2.0, 0), LinearDrag())
    assert found.p_value < 1e-6
    assert found.free_curve_gain > 30.0
    curve = found.curve
    assert (curve.driver, curve.unit, curve.channels) == ("speed", "m/s", ("rate of speed",))
    value, far = curve.value[:, 0], curve.x.abs()
    inside = (far > 0.3) & (far < 0.85 * far.max())
    true = -0.4 * curve.x * curve.x.abs()
    torch.testing.assert_close(value[inside], true[inside], rtol=0.0, atol=0.1)
    assert bool((curve.band > 0.0).all())
    # a polynomial fit of x |x| has an exponent between those of a square and a cube
    assert 1.5 < float(found.formula.split("|^")[1].split()[0]) < 3.0
    assert "sign(speed)" in found.formula


@pytest.mark.e2e
def test_settings_limit_the_gain_and_the_level_of_a_better_curve():
    found = shape(boat_recording(2.0, 0), LinearDrag(), shape_nats=1e4)
    assert found.free_curve_gain > 30.0
    assert found.curve is None
    assert shape(boat_recording(2.0, 0), LinearDrag(), shape_level=0.0).curve is None


def test_a_curve_has_no_shape_test_and_no_effect_has_one_without_curves():
    fit, terms = fit_with(boat_recording(2.0, 0), QuadraticDrag())
    assert shape_of(fit, 0, [term for term in terms if not term.effect.is_curve], EvidenceSettings()) is None
    curve = fit_with(boat_recording(2.0, 0), QuadraticDrag())[1][-1]
    assert curve.effect.is_curve
    model = JointModel(fit.model.prepared, (curve,))
    whole = torch.cat([fit.parameters[: model.base], torch.zeros(model.sizes[0]).double()])
    nameless = dataclasses.replace(fit, model=model, parameters=whole)
    assert shape_of(nameless, 0, terms, EvidenceSettings()) is None


@pytest.mark.parametrize(("noise", "rival"), [(False, True), (True, False)])
def test_a_curve_without_an_open_loop_gain_is_no_rival_of_a_constant_under_process_noise(monkeypatch, noise, rival):
    monkeypatch.setattr("mkc_torch.diagnosis.findings.shape.has_process_noise", lambda _: noise)
    monkeypatch.setattr("mkc_torch.diagnosis.findings.shape.improves_open_loop", lambda *_: False)
    found = shape(boat_recording(2.0, 0), ConstantForce())
    assert (found is not None and found.curve is not None) == rival
    assert shape(boat_recording(2.0, 0), LinearDrag()).curve is not None


def curve_of(values, low=-2.0, driver="speed", band=0.01):
    x = torch.linspace(low, 3.0, 60, dtype=torch.float64)
    value = values(x).unsqueeze(-1)
    return Curve(driver, "m/s", x, value, torch.full_like(value, band), ("rate of speed",), "m/s²")


@pytest.mark.parametrize("power", [0.5, 1.5, 1.7, 2.0, 3.0])
@pytest.mark.parametrize("low", [-2.0, 0.1])
def test_a_power_law_is_found_exactly_in_addition_to_a_straight_line(power, low):
    drawn = curve_of(lambda x: -0.7 * x.abs() ** power * x.sign() + 0.4 * x - 1.2, low)
    assert nearest_power(drawn) == f"-0.7 |speed|^{power:.2g} sign(speed) plus a straight line"


def test_points_of_a_curve_with_a_wide_band_have_little_weight():
    drawn = curve_of(lambda x: -0.7 * x * x.abs())
    far = drawn.x > 2.0
    value, band = drawn.value.clone(), drawn.band.clone()
    value[far], band[far] = 50.0, 1e6
    doubted = dataclasses.replace(drawn, value=value, band=band)
    assert nearest_power(doubted) == nearest_power(drawn)


def test_a_curve_of_nan_has_no_power():
    assert nearest_power(curve_of(lambda x: torch.full_like(x, torch.nan))) == ""
