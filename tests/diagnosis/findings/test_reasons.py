"""Reasons for a poor fit: a reversed sign, a delayed or idle input, a parameter at its bound."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.findings import reasons
from mkc_torch.diagnosis.findings.reasons import at_ends, reasons_of
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from tests.diagnosis.factory import make_goodness_of_fit
from tests.diagnosis.line import Line
from tests.diagnosis.swing import NOISE, Pendulum, UpsideDown, pendulum_recording

N = 150


@pytest.fixture(autouse=True)
def _single_lag(monkeypatch):
    """Try a single lag, to save time."""
    monkeypatch.setattr(reasons, "LAGS", (5,))


def pendulum_at(recording, stiffness=9.0, damping=0.15, system=Pendulum):
    """Return a pendulum at these parameters, without fitting."""
    prepared = system().prepare(recording)
    theta = prepared.start().clone()
    theta[:2] = torch.tensor([stiffness, damping], dtype=theta.dtype)
    model = JointModel(prepared)
    residual = model.residual(theta).detach()
    unit_scale = theta.new_ones(1)
    return FittedModel(
        model, theta, unit_scale, unit_scale, 3.0 * unit_scale, residual, torch.ones_like(residual), 0.0, True
    )


def reasons_for(fit):
    """Return the reasons for the poor fit of a simulation."""
    known = goodness_of_fit(fit.model.prepared, fit.residual, {})
    return reasons_of([fit], known)


def stated_residual(sentence):
    """Return the residual in rad that a reason states."""
    return float(sentence.split(" the residual is angle ")[1].removesuffix(" rad."))


@pytest.mark.e2e
def test_an_input_of_the_wrong_sign_is_reported():
    text = reasons_for(pendulum_at(pendulum_recording(effect=-1.0, N=N)[0]))
    assert text[0].startswith("With the sign of `torque` reversed, the residual is angle 0.00")
    assert stated_residual(text[0]) == pytest.approx(NOISE, rel=0.2)
    # with its sign reversed it matters
    assert not any("explains nothing" in item for item in text)


@pytest.mark.e2e
def test_a_delayed_input_is_reported_with_its_delay():
    text = reasons_for(pendulum_at(pendulum_recording(late=5, N=N)[0]))
    assert text[0].startswith("With `torque` delayed by 0.25 s, the residual is angle 0.00")
    assert stated_residual(text[0]) == pytest.approx(NOISE, rel=0.2)


@pytest.mark.e2e
def test_a_parameter_of_the_wrong_sign_is_reported_even_outside_its_range():
    text = reasons_for(pendulum_at(pendulum_recording(N=N)[0], system=UpsideDown))
    assert text[0].startswith("With `stiffness` = -")
    assert ", which the bounds exclude, the residual is angle 0.00" in text[0]
    value = float(text[0].split("`stiffness` = ")[1].split(",")[0])
    assert value == pytest.approx(-9.0, abs=0.1)


@pytest.mark.e2e
def test_an_input_without_influence_is_reported():
    recording, _ = pendulum_recording(effect=0.0, N=N)
    text = reasons_for(fitted(JointModel(Pendulum().prepare(recording)), torch.tensor([9.0, 0.15, 0.3, 0.0]).double()))
    assert (
        "`torque` explains nothing in this fit: held at its mean, the residual of angle is at most 3 % larger." in text
    )


@pytest.mark.e2e
def test_an_input_with_influence_is_not_reported():
    """With a fifth of the stiffness missing."""
    text = reasons_for(pendulum_at(pendulum_recording(N=N)[0], stiffness=7.0))
    assert not any("explains nothing" in item for item in text)


@pytest.mark.parametrize(
    ("parameters", "ends"),
    [
        ((0.0, 0.3), ("stiffness",)),
        ((9.0, 0.0), ("damping",)),
        ((0.0, 0.0), ("stiffness", "damping")),
        ((9.0, 1e-4), ()),
    ],
)
def test_parameters_at_a_bound_are_reported(parameters, ends):
    assert at_ends(pendulum_at(pendulum_recording(N=N)[0], *parameters)) == ends


def test_a_parameter_whose_initial_value_is_its_bound_is_not_reported():
    fit = pendulum_at(pendulum_recording(N=N)[0], damping=0.0)
    known = fit.model.prepared.known
    known["damping"] = dataclasses.replace(known["damping"], value=0.0)
    assert at_ends(fit) == ()


def test_a_parameter_at_its_upper_bound_is_reported():
    fit = pendulum_at(pendulum_recording(N=N)[0], stiffness=9.0)
    low, high = fit.model.prepared.bounds
    fit.model.prepared.bounds = low, torch.where(torch.arange(len(high)) == 0, 9.0, high)
    assert at_ends(fit) == ("stiffness",)


def test_a_simulation_without_differential_equations_gets_general_advice():
    line = Line(100)
    fit = fitted(JointModel(line), line.start())
    assert at_ends(fit) == ()
    (text,) = reasons_of([fit], (make_goodness_of_fit(),))
    assert "signs, units and the order of columns" in text


def test_a_parameter_at_its_bound_is_reported_with_its_value():
    found = reasons_for(pendulum_at(pendulum_recording(N=N)[0], damping=0.0))
    assert any(text.startswith("`damping` is fitted to its bound, 0:") for text in found)


@pytest.mark.parametrize(("damping", "words"), [(1e-4, "nearly 0"), (30.0, "at 1e+02 times its start value")])
def test_a_parameter_that_vanishes_or_diverges_is_reported(damping, words):
    found = reasons_for(pendulum_at(pendulum_recording(N=N)[0], damping=damping))
    assert any(text.startswith(f"The open-loop fit is best with `damping` {words}") for text in found)


def test_without_a_remedy_the_advice_is_to_compare_columns():
    prepared = Pendulum().prepare(pendulum_recording(N=N)[0])
    (text,) = reasons_for(fitted(JointModel(prepared), prepared.start()))
    assert text.startswith("No other start, sign or delay of an input improves the fit: compare columns")
