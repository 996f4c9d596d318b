"""An unnamed force: its curve, its code, and its detection."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.effects.context import Context
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.unknown_rate import DEGREE, UnknownRate
from tests.diagnosis.test_dynamics_diagnosis import NOISE, Pendulum, pendulum_recording

REACH = 1.5
GAMMA = torch.tensor([0.3, -0.7, 0.2, 0.5], dtype=torch.float64)

FORMS = ("own", "position", "difference")


@pytest.fixture
def context():
    angle = torch.linspace(-2.0, 2.0, 41, dtype=torch.float64)
    signal = torch.stack([angle, 3.0 * angle, 0.3 * angle.cos()], -1)
    parts = {"own": "speed", "position": "angle", "surroundings": "wind"}
    names = ("angle", "speed", "wind")
    return Context(angle, angle.new_zeros(41, 0), (), signal, "rad/s²", ("speed",), names, parts, {"position": "rad"})


def argument_of_curve(context, of):
    return context.part("own") - context.part("surroundings") if of == "difference" else context.part(of)


@pytest.mark.parametrize("of", FORMS)
def test_curve_is_a_legendre_series_and_constant_beyond_its_reach(context, of):
    effect = UnknownRate(of)
    found = effect.change(GAMMA, {f"reach_of_{of}": REACH}, context)[:, 0]
    inside = np.clip(argument_of_curve(context, of).numpy() / REACH, -1.0, 1.0)
    expected = np.polynomial.legendre.legval(inside, [0.0, *GAMMA.tolist()])
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12, atol=1e-14)
    assert len(GAMMA) == DEGREE


@pytest.mark.parametrize("of", FORMS)
def test_code_equals_the_curve(context, of):
    effect, shape = UnknownRate(of), {f"reach_of_{of}": REACH}
    names = {part: part for part in ("own", "position", "surroundings")}
    (line,) = effect.code(GAMMA.tolist(), shape, names)
    values = {part: context.part(part) for part in names}
    torch.testing.assert_close(eval(line, {"torch": torch}, values), effect.change(GAMMA, shape, context)[:, 0])


@pytest.fixture(scope="module")
def diagnosis():
    """Return the diagnosis of a pendulum with a hidden force of constant sign, by the square of its speed."""
    recording = pendulum_recording(lambda _, speed: 0.12 * speed**2)
    # the curve's mean over the speeds is 0, so the force is a constant and a curve
    effects = (LinearDrag(), QuadraticDrag(), ConstantForce(), UnknownRate("own"), UnknownRate("position"))
    return diagnose(Pendulum(), recording, effects=effects, surrogates=39, max_findings=2)


@pytest.mark.e2e
def test_a_force_outside_the_catalogue_is_found_as_unknown(diagnosis):
    assert diagnosis.verdict == "unexplained"
    constant, finding = diagnosis.findings
    assert (constant.effect, finding.effect) == ("constant_force", "unknown")
    assert finding.channels == ("rate of speed",)
    assert finding.held_out.confidence_interval[0] > 0.0
    assert finding.held_out.rmse_before > 1.5 * NOISE
    assert finding.held_out.rmse_after < finding.held_out.rmse_before
    assert [p.name for p in finding.parameters][:1] == ["legendre_1"]
    assert "; δ(rate of speed) = " in finding.equation


@pytest.mark.e2e
def test_model_is_restored_with_the_same_curve(diagnosis):
    again = DiagnosedModel.from_json(diagnosis.model.to_json(), simulation=Pendulum())
    assert again.terms[1].effect.plot_axis == diagnosis.model.terms[1].effect.plot_axis == "own"
    assert again.terms[1].shape == diagnosis.model.terms[1].shape
