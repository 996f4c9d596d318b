"""Clocks of sensors are computed along the open loop only: an observer's trajectory would read the recording ahead."""

import functools

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise, has_process_noise, with_noise_around
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.joint_likelihood import joint_likelihood
from mkc_torch.diagnosis.search.tangents import open_loop_tangents, tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import DYNAMICS, resampled
from mkc_torch.effects.dynamics.sensor_clock_drift import SensorClockDrift
from tests.diagnosis.swing import Pendulum, candidates, fitted_pendulum, fitted_under_noise, pendulum_recording

CLOCK = SensorClockDrift()


class Free(Pendulum):
    """A pendulum without a torque."""

    inputs = ()

    def derivative(self, time, x, u, p):
        return {"angle": x.rate, "rate": -p.stiffness * torch.sin(x.angle) - p.damping * x.rate}


class Restarted(Pendulum):
    restart_after = 2.0


@functools.cache
def under_noise():
    fit = fitted_pendulum("slow").fit
    assert has_process_noise(fit)
    return fit


def clocks(fit):
    return candidate_terms(fit.model.prepared, (), (CLOCK,))


def test_columns_are_changes_of_the_open_loop_at_finite_rates():
    fit = under_noise()
    prepared = fit.model.prepared.open_loop()
    output = prepared.simulated(fit.parameters, {})
    terms = clocks(fit)
    assert len(terms) == 14
    for term, column in zip(terms, open_loop_tangents(fit.model, fit.parameters, terms), strict=True):
        rate = term.shape["tried_rate"]
        moved = resampled(output[:, 0], prepared.time, 0.01 * rate) - output[:, 0]
        torch.testing.assert_close(column[:, 0, 0], -moved / rate, rtol=1e-6, atol=1e-9)


def test_columns_do_not_depend_on_the_recorded_output():
    fit = under_noise()
    recording = pendulum_recording("slow")[0]
    other = Recording({**recording.columns, "angle": recording["angle"].flip(0)})
    model = JointModel(Pendulum().prepare(other).with_input_hold({"torque": "held"}))
    terms = clocks(fit)
    own = open_loop_tangents(fit.model, fit.parameters, terms)
    for one, two in zip(own, open_loop_tangents(model, fit.parameters, terms), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-6, atol=1e-9)


def test_along_an_observer_a_clock_changes_nothing():
    fit = under_noise()
    for column in tangents_of(fit.model, fit.parameters, NoiseSettings(), clocks(fit)).candidates:
        assert not bool(column.any())


def test_a_model_with_a_clock_has_no_process_noise():
    free = fitted_pendulum("slow").free
    model = free.model.with_term(Term(CLOCK, None, {"tried_rate": 0.5}))
    moved = type(free)(**{**vars(free), "model": model, "parameters": torch.cat([free.parameters, torch.ones(1)])})
    assert fit_with_process_noise(moved, {}, NoiseSettings()).fit is moved
    assert with_noise_around(moved, {}, NoiseSettings()) is moved


@pytest.mark.parametrize("system", [Free, Restarted])
def test_no_clock_is_tried_without_inputs_or_with_restarts(system):
    prepared = system().prepare(pendulum_recording()[0])
    assert not candidate_terms(prepared, (), (CLOCK,))


def test_a_clock_does_not_lead_where_process_noise_follows_an_unrelated_output():
    """Changes along the trajectory of the observer would read the recording ahead, and gain more than the others."""
    recording = pendulum_recording(seed=1)[0]
    other = pendulum_recording(seed=2)[0]["angle"]
    fit = fitted_under_noise(Recording({**recording.columns, "angle": other})).fit
    assert has_process_noise(fit)
    terms = candidates(fit, DYNAMICS)
    settings = NoiseSettings()
    tangents = tangents_of(fit.model, fit.parameters, settings, terms)
    counts = fit.pseudo(settings)[1]
    found = joint_likelihood(fit, terms, tangents, counts, 0, torch.Generator(), level=0.05, quick=True)
    of_clocks = torch.tensor([term.effect.id == CLOCK.id for term in terms])
    gain = found.gain - found.dof
    assert float(gain[of_clocks].max()) < 0.5 * float(gain[~of_clocks].max())
