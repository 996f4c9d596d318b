"""A simulation of the wrong sign that a flexible form bends near to the recording is not explained by that form."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.pipeline.build import is_flexible
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import FitAssessment, Remainder, conclusion_of, decisions_on_all
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.effects.dynamics.hidden_lag import HiddenLag
from mkc_torch.effects.dynamics.hidden_mode import HiddenMode
from mkc_torch.effects.dynamics.input_delay import InputDelay
from mkc_torch.effects.dynamics.power_law import PowerLaw
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.sensor_clock_drift import SensorClockDrift
from mkc_torch.effects.dynamics.sensor_lag import SensorLag
from mkc_torch.simulation import Dynamics, Parameter

STEP, NOISE = 0.1, 0.01


class Spring(Dynamics):
    """A spring with a damper that a force extends; the spring has the wrong sign, so that it pulls away from rest."""

    states, inputs = ("position",), ("force",)
    parameters = {"stiffness": Parameter(0.2, lower=0.1), "damping": Parameter(1.0, lower=0.1)}
    units = {"position": "m", "force": "N"}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"position": (u.force + p.stiffness * x.position) / p.damping}


def spring_recording(N=160):
    """A spring of 0.8 N/m with a damper of 1.2 N s/m, solved exactly for a held force."""
    random = np.random.default_rng(0)
    force, position = np.repeat(random.uniform(-1.0, 1.0, N // 8), 8), np.zeros(N)
    decay = np.exp(-0.8 * STEP / 1.2)
    for k in range(1, N):
        position[k] = decay * position[k - 1] + (1.0 - decay) * force[k - 1] / 0.8
    columns = {"time": STEP * np.arange(N), "force": force, "position": position + NOISE * random.standard_normal(N)}
    return Recording({name: torch.as_tensor(values) for name, values in columns.items()})


@pytest.fixture(scope="module")
def assessed():
    """The open-loop fits of the simulation without and with a power law."""
    prepared = Spring().prepare(spring_recording()).open_loop()
    alone = fitted(JointModel(prepared), prepared.start())
    (term, *_) = candidate_terms(prepared, (), (PowerLaw(),))
    straight = replace(term, shape={**term.shape, "exponent": 1.0})
    model = JointModel(prepared, (straight,))
    start = torch.cat([alone.parameters, alone.parameters.new_full((1,), 0.8)])
    corrected = fitted(model, start)
    fits = [goodness_of_fit(prepared, fit.residual, {}) for fit in (alone, corrected)]
    return FitAssessment(*fits, None)


@pytest.mark.parametrize(("ratio", "verdict"), [(1.0, "unexplained"), (1e3, "explained")])
def test_a_spring_of_the_wrong_sign_is_not_explained_by_a_power_law(assessed, ratio, verdict):
    ((without,), (with_it,)) = assessed.follows, assessed.corrected
    assert without.explained < 0.49
    assert with_it.explained > 0.98
    limits = EvidenceSettings(correction=ratio)
    on_all = decisions_on_all(assessed, Remainder(), limits, findings=True, flexible=True)
    named = Decision("p_value", "power_law@position", 0.01, 0.05, True, "", 1)
    found = conclusion_of(Trail(decisions=(named, *on_all)))
    assert (found.verdict, found.doubtful) == (verdict, verdict == "unexplained")
    assert ("check signs and units first" in found.first_advice()) == found.doubtful


@pytest.mark.parametrize(
    ("effect", "flexible"),
    [
        (PowerLaw("position"), True),
        (InputDelay(), True),
        (SensorLag(), True),
        (CoulombFriction(), False),
        (QuadraticDrag(), False),
        (HiddenMode(), False),
        (HiddenLag(), False),
        (SensorClockDrift(), False),
    ],
)
def test_general_forms_and_delays_are_flexible_and_a_passive_second_mass_is_not(effect, flexible):
    assert is_flexible(Term(effect, None, {})) is flexible
