"""Alternatives that a recording cannot distinguish have the parameters of their own fit in place of the finding."""

import json

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.findings.alternatives import adds_nothing
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.parts import EffectParameter
from mkc_torch.effects import CATALOGUE
from mkc_torch.report.diagnosis.findings import fitted_sizes, rivals
from mkc_torch.simulation import Dynamics, Parameter

DRAG = 0.01
"""Coefficient of the hidden quadratic drag, in 1/m."""

FORMS = [effect for effect in CATALOGUE if effect.id in ("linear_drag", "quadratic_drag")]


class Sledge(Dynamics):
    """A sledge that slides out on level ice, without air."""

    states = ("speed",)
    outputs = ("speed",)
    units = {"speed": "m/s"}
    parameters = {"friction": Parameter(0.05, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"speed": -9.81 * p.friction + 0.0 * x.speed}


def sledge_recording(seed):
    """Return three runs from 8 to 4 m/s, in which linear and quadratic drag are nearly collinear."""
    random, tables = np.random.default_rng(seed), []
    time = np.arange(0.0, 4.0, 0.05)
    for run, start in enumerate((8.0, 8.1, 8.2)):
        exact = solve_ivp(lambda _, v: -0.8 - DRAG * v * abs(v), (0.0, 4.0), [start], t_eval=time, rtol=1e-9)
        tables.append(np.stack([np.full(80, run), time, exact.y[0] + 0.15 * random.standard_normal(80)]))
    run, time, speed = np.concatenate(tables, axis=1)
    return Recording(
        {"experiment": torch.from_numpy(run), "time": torch.from_numpy(time), "speed": torch.from_numpy(speed)}
    )


@pytest.fixture(scope="module")
def diagnosis():
    return diagnose(Sledge(), sledge_recording(1), effects=FORMS, surrogates=19, max_findings=1)


@pytest.mark.e2e
def test_alternatives_have_the_parameters_of_their_own_fit(diagnosis):
    (finding,) = diagnosis.findings
    (other,) = finding.alternatives
    assert {finding.effect, other.effect} == {"linear_drag", "quadratic_drag"}
    assert not other.separable
    sizes = {each.effect: each.parameters[0] for each in (finding, other)}
    quadratic, linear = sizes["quadratic_drag"], sizes["linear_drag"]
    assert (quadratic.unit, linear.unit) == ("1/m", "1/s")
    assert quadratic.value == pytest.approx(DRAG, abs=2.5 * quadratic.standard_error)
    assert quadratic.standard_error < 0.5 * DRAG
    # the slope of the parabola at the middle speed
    assert linear.value == pytest.approx(2.0 * quadratic.value * 6.0, rel=0.3)


@pytest.mark.e2e
def test_parameters_of_alternatives_are_in_the_file_and_in_the_text(diagnosis):
    (finding,) = diagnosis.findings
    (other,) = finding.alternatives
    (written,) = json.loads(diagnosis_to_json(diagnosis))["findings"][0]["alternatives"]
    assert written["parameters"][0]["value"] == other.parameters[0].value
    assert fitted_sizes(other).startswith("drag ")
    assert rivals(finding, sizes=True).endswith(f"with {fitted_sizes(other)}")
    assert fitted_sizes(other) not in rivals(finding)


@pytest.mark.parametrize(
    ("share", "error", "of_shape", "nothing"),
    [
        (1e-4, 2e-4, False, True),
        (-1e-4, 2e-4, False, True),
        (3e-4, 2e-4, False, False),
        (1e-4, None, False, False),
        (1e-4, 2e-4, True, False),
    ],
)
def test_a_general_form_adds_nothing_if_its_other_sizes_are_zero_within_their_errors(share, error, of_shape, nothing):
    friction = EffectParameter("friction", 0.4, 0.01, "rad/s2")
    more = EffectParameter("share_of_load", share, error, "", of_shape=of_shape)
    assert adds_nothing({"friction"}, [friction, more]) is nothing
    assert not adds_nothing({"friction"}, [friction])
    assert not adds_nothing({"friction"}, ())
