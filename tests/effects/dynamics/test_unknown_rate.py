"""A force without a name: the curve itself, its line of Python, and that it is found where nothing else will do."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.files.model import DiagnosedModel
from mkc_torch.diagnosis.model.grid import candidate_terms
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.context import Context
from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.unknown_rate import NUMBERS, UnknownRate, spline_within
from tests.diagnosis.test_dynamics_diagnosis import NOISE, Pendulum, swung

GAMMA = torch.tensor([0.3, -0.7, 0.2, 0.5, -0.4, 0.1], dtype=torch.float64)
FORMS = ("own", "position", "difference")


def ends(of, lowest=-1.5, highest=2.5):
    return {f"lowest_of_{of}": lowest, f"highest_of_{of}": highest}


@pytest.fixture
def context():
    angle = torch.linspace(-4.0, 4.0, 81, dtype=torch.float64)
    signal = torch.stack([angle, 1.5 * angle, 0.3 * angle.cos()], -1)
    parts = {"own": "speed", "position": "angle", "surroundings": "wind"}
    names, units = ("angle", "speed", "wind"), {"position": "rad", "own": "rad/s"}
    return Context(angle, angle.new_zeros(81, 0), (), signal, "rad/s²", ("speed",), names, parts, units)


def along(context, of):
    if of == "difference":
        return context.part("own") - context.part("surroundings")
    return context.part(of)


@pytest.mark.parametrize("of", FORMS)
def test_the_curve_is_of_cubic_splines_and_goes_on_as_a_constant(context, of):
    """Against scipy's, with the knots of a clamped spline."""
    found = UnknownRate(of).change(GAMMA, ends(of), context)[:, 0]
    places = 0.5 - 2.0 * np.cos(np.pi * np.arange(5) / 4)
    spline = BSpline(np.concatenate([[-1.5] * 3, places, [2.5] * 3]), np.insert(GAMMA.numpy(), 3, 0.0), 3)
    expected = spline(np.clip(along(context, of).numpy(), -1.5, 2.5))
    np.testing.assert_allclose(found.numpy(), expected, rtol=0.0, atol=1e-12)
    assert len(GAMMA) == NUMBERS


@pytest.mark.parametrize("of", FORMS)
def test_its_line_of_python_is_the_curve(context, of):
    effect, shape = UnknownRate(of), ends(of)
    parts = ("own", "position", "surroundings")
    (line,) = effect.code(GAMMA.tolist(), shape, {part: part for part in parts})
    values = {part: context.part(part) for part in parts}
    written = eval(line, {"spline_within": spline_within}, values)
    torch.testing.assert_close(written, effect.change(GAMMA, shape, context)[:, 0])


def test_a_range_without_width_is_no_curve(context):
    """As that of a state of which nothing is known beforehand."""
    for signal in (context.signal, 0.0 * context.signal):
        seen = replace(context, signal=signal)
        slope = torch.func.jacfwd(UnknownRate("own").change)(GAMMA, ends("own", 0.0, 0.0), seen)
        assert bool(slope.isfinite().all())


def test_it_follows_what_acts_near_one_end_of_the_range_alone():
    """The push of a ground below, at least twice as well as a polynomial of as many numbers over the same range."""
    height = 0.2 + 1.3 * torch.linspace(0.0, 1.0, 1301, dtype=torch.float64)
    push = 9.81 / (1.0 - 0.0055 / height.square()) - 9.81
    unit = torch.eye(NUMBERS, dtype=torch.float64)
    constant = torch.ones_like(height)
    splines = torch.stack([constant, *(spline_within(height, 0.2, 1.5, one) for one in unit)], -1)
    powers = torch.stack([(height / 1.5) ** k for k in range(NUMBERS + 1)], -1)

    def left(design):
        return (push - design @ torch.linalg.lstsq(design, push.unsqueeze(-1)).solution[:, 0]).square().mean().sqrt()

    assert 2.0 * float(left(splines)) < float(left(powers))
    assert float(left(splines)) < 0.03 * float(push.std())


def test_the_range_is_that_of_the_recording():
    time = torch.arange(0.0, 6.0, 0.05, dtype=torch.float64)
    recording = Recording({"time": time, "angle": 0.5 + 0.3 * torch.cos(3.0 * time)})
    terms = candidate_terms(Pendulum().prepare(recording), (), DYNAMICS)
    (curve,) = [term for term in terms if term.effect.id == "unknown" and term.effect.along == "position"]
    assert curve.shape == {
        "lowest_of_position": pytest.approx(0.2, abs=0.01),
        "highest_of_position": pytest.approx(0.8),
    }


@pytest.fixture(scope="module")
def diagnosis():
    """A push to one side that grows with the square of the speed, whichever way the pendulum swings."""
    recording = swung(lambda _, speed: 0.12 * speed**2)
    # a catalogue that has forces along the motion alone
    effects = (LinearDrag(), QuadraticDrag(), UnknownRate("own"), UnknownRate("position"))
    return diagnose(Pendulum(), recording, effects=effects, surrogates=19, max_findings=1)


def test_a_force_that_is_in_no_catalogue_is_found_without_a_name(diagnosis):
    assert diagnosis.verdict == "unexplained"
    (finding,) = diagnosis.findings
    assert finding.effect == "unknown"
    assert finding.channels == ("rate of speed",)
    assert finding.held_out.confidence_interval[0] > 0.0
    assert finding.held_out.rmse_before > 1.5 * NOISE
    assert finding.held_out.rmse_after < finding.held_out.rmse_before
    assert [p.name for p in finding.parameters][:1] == ["height_1"]
    assert "; δ(rate of speed) = " in finding.equation


def test_its_model_comes_back_with_the_same_curve(diagnosis):
    again = DiagnosedModel.from_json(diagnosis.model.to_json(), simulation=Pendulum())
    assert again.terms[0].effect.along == diagnosis.model.terms[0].effect.along
    assert again.terms[0].shape == diagnosis.model.terms[0].shape
