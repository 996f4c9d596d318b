"""A servo whose play and wrong zero a softer servo imitates: fits by logarithms, and effects at the given values."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.pipeline.chains import chains_to_test
from mkc_torch.diagnosis.score import basis_of, is_implausible
from mkc_torch.diagnosis.search.at_given_values import add_at_given_values, instead_of_numbers
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate
from mkc_torch.diagnosis.search.move_fits import fitted_without
from mkc_torch.diagnosis.search.moves import additions, with_wide_grid
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import IMPLAUSIBLE
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.simulation import Parameter, Stepper
from mkc_torch.simulation.dynamics.flow import changes_by_inputs
from mkc_torch.simulation.logarithms import Logarithms
from mkc_torch.simulation.names import Names
from tests.simulation.stepped.models import Equations
from tests.simulation.stepped.test_stepper import recording_of

SETTINGS = Settings()
STIFFNESS, INERTIA, GAP, ZERO = 60.0, 0.03, 0.02, 0.01


class Servo(Stepper):
    """A joint that a servo holds at a commanded angle."""

    states, inputs, time_step = ("angle", "speed"), ("command",), 0.01
    positions, forces = {"angle": "speed"}, {"moment": "speed"}
    units = {"angle": "rad", "speed": "rad/s", "command": "rad", "moment": "N m"}
    parameters = {"stiffness": Parameter(STIFFNESS, lower=0.0, unit="N m/rad", uncertainty=math.log(2.0) * STIFFNESS)}

    def step(self, x, u, tau, p, dt):
        angle, speed = x.T
        moment = p.stiffness * (u[:, 0] - angle) + tau[:, 0] - 1.5 * speed
        speed = speed + dt * moment / INERTIA
        return np.stack([angle + dt * speed, speed], 1)


def followed(gap=0.0, zero=0.0, noise=1e-4, stiffness=STIFFNESS, samples=300):
    """A recording of the servo: its command is a chirp."""
    rng = np.random.default_rng(0)
    time = 0.02 * np.arange(samples)
    command = 0.15 * np.sin(2.0 * np.pi * (0.2 + 0.12 * time) * time)
    model, state, held, angles = Servo(), np.zeros((1, 2)), 0.0, []
    p = type("Names", (), {"stiffness": stiffness})
    for u in command:
        held = max(u - gap, min(u + gap, held))
        angles.append(state[0, 0])
        for _ in range(2):
            state = model.step(state, np.array([[held]]), np.zeros((1, 1)), p, model.time_step)
    angle = np.array(angles) + zero + noise * rng.normal(size=samples)
    return Recording(
        {name: torch.tensor(value) for name, value in (("time", time), ("command", command), ("angle", angle))}
    )


def terms_of(prepared, *names):
    return tuple(candidate_terms(prepared, (), [effect for effect in CATALOGUE if effect.id in names]))


def test_the_zero_and_the_scale_of_a_sensor_are_effects_of_a_simulation_that_steps():
    prepared = Servo().prepare(followed())
    found = {(term.effect.id, term.port) for term in terms_of(prepared, "offset", "gain")}
    assert found == {("offset", "output angle"), ("gain", "output angle")}
    assert terms_of(Equations().prepare(recording_of()), "offset", "gain") == ()
    theta = prepared.given
    for term in terms_of(prepared, "offset", "gain"):
        model = JointModel(prepared, [term])
        moved = prepared.residual(theta, {}) - model.residual(torch.cat([theta, theta.new_tensor([0.3])]))
        simulated = prepared.measured - prepared.residual(theta, {})
        expected = torch.full_like(moved, 0.3) if term.effect.id == "offset" else 0.3 * simulated
        torch.testing.assert_close(moved, expected, rtol=0, atol=1e-9)


def test_coordinates_and_parameters_are_inverse_and_the_prior_is_of_a_factor():
    prior = GaussianPrior(torch.tensor([8.0, 0.0]), torch.tensor([1.0 / 16.0, 0.0]))
    free = torch.tensor([torch.inf, torch.inf])
    logarithms = Logarithms(torch.tensor([True, False]), prior, (torch.tensor([0.0, -torch.inf]), free))
    theta = torch.tensor([3.0, -2.0])
    torch.testing.assert_close(logarithms.parameters(logarithms.of(theta)), theta)
    # a standard deviation of half the mean: twice and half the value are as likely
    twice, half = (logarithms.log_prior(torch.tensor([value, 5.0])) for value in (16.0, 4.0))
    assert twice == pytest.approx(half, rel=1e-5)
    assert twice == pytest.approx(-0.5 * (math.log(2.0) / 0.5) ** 2, rel=1e-5)
    # 0 is not lost
    assert logarithms.of(torch.tensor([0.0, 0.0])).isfinite().all()


def test_a_stiffness_is_fitted_by_its_logarithm_from_far_away():
    prepared = Servo().prepare(followed(stiffness=25.0))
    model = JointModel(prepared)
    assert model.logarithms is not None
    assert model.logarithms.places.tolist() == [True, False, False]
    for start in (200.0, 6.0):
        found = fitted(model, torch.tensor([start, 0.0, 0.0], dtype=torch.float64), graduate=False)
        assert float(found.parameters[0]) == pytest.approx(25.0, rel=0.01)
    assert JointModel(Equations().prepare(recording_of())).logarithms is None


def test_the_changes_by_inputs_are_those_of_the_command():
    prepared = Servo().prepare(followed())
    command = prepared.acting(prepared.given, {}).inputs[:, 0]
    away = (command - command.median()).abs().quantile(0.99)
    assert prepared.disturbable == ("speed",)
    assert changes_by_inputs(prepared, prepared.given) == pytest.approx([float(STIFFNESS * away / INERTIA)], rel=1e-6)


@pytest.mark.parametrize(("share", "implausible"), [(0.9, False), (1.1, True)])
def test_a_force_that_the_servo_overcomes_is_plausible(share, implausible):
    """It is larger than ten times the recording's accelerations, as the servo's moment is."""
    prepared = Servo().prepare(followed())
    alone = fitted(JointModel(prepared), prepared.start())
    (term,) = terms_of(prepared, "constant_force")
    basis, most = basis_of(alone, 10, {}, SETTINGS), changes_by_inputs(prepared, alone.parameters)
    assert float(most[0]) > IMPLAUSIBLE * basis.largest[0]
    force = alone.parameters.new_tensor([share * INERTIA * float(most[0])])
    moved = replace(alone, model=alone.model.with_term(term), parameters=torch.cat([alone.parameters, force]))
    assert is_implausible(moved, basis) is implausible


def searched(recording, away):
    """A beam with the models that are chosen at the given values; the stiffness of its start is off by a factor."""
    prepared = Servo().prepare(recording)
    terms = terms_of(prepared, "backlash", "offset", "input_lag", "cubic_stiffness")
    alone = fitted(JointModel(prepared), prepared.start())
    beam = BeamSearch(terms, basis_of(alone, 4, {}, SETTINGS), SETTINGS, {})
    beam.keep([Candidate(alone, beam.score_of(alone), "")])
    theta = alone.parameters.clone()
    theta[0] = away * STIFFNESS
    start = replace(alone, parameters=theta, residual=alone.model.residual(theta).detach())
    beam.at_given = add_at_given_values(beam, start, terms)
    return beam


def test_play_and_a_wrong_zero_are_chosen_where_the_fitted_servo_is_far_too_soft():
    beam = searched(followed(gap=GAP, zero=ZERO), away=0.1)
    model = max(beam.models.values(), key=lambda other: other.value)
    assert {term.effect.id for term in model.fit.model.terms} == {"backlash", "offset"}
    gammas = model.fit.model.gammas(model.fit.parameters)
    sizes = {term.effect.id: gamma for term, gamma in zip(model.fit.model.terms, gammas, strict=True)}
    shapes = {term.effect.id: term.shape for term in model.fit.model.terms}
    assert float(sizes["offset"]) == pytest.approx(ZERO, abs=5e-4)
    assert float(sizes["backlash"]) == pytest.approx(1.0, abs=0.05)
    assert shapes["backlash"]["half_gap"] == pytest.approx(GAP, rel=0.05)
    assert float(model.fit.parameters[0]) == pytest.approx(STIFFNESS, rel=0.1)
    assert model.move == "choose effects at the given values"
    # each effect explains nearly all that the other leaves, so a fit without it needs a wider domain
    assert all(fitted_without(model.fit, number) is not None for number in range(2))
    chain = chains_to_test(beam)[0]
    assert [len(step.fit.model.terms) for step in chain] == [1, 2]
    assert chain[-1].key == model.key


def test_nothing_is_chosen_at_the_given_values_near_them():
    assert list(searched(followed(gap=GAP, zero=ZERO), away=0.9).models) == [()]


def test_gains_leave_out_the_parameters_that_are_held():
    """With all held, the gain of an offset is that of a mean."""
    prepared = Servo().prepare(followed(zero=0.01, noise=0.01))
    theta = prepared.given
    prepared.bounds = theta, theta
    model, (term,) = JointModel(prepared), terms_of(prepared, "offset")
    alone = fitted(model, theta, graduate=False, squares=True)
    residual = model.residual(theta)[:, 0]
    explained = residual.square().sum() / (residual - residual.mean()).square().sum()
    (addition,) = additions(alone, (term,), SETTINGS.noise)
    assert addition.gain == pytest.approx(0.5 * len(residual) * math.log(float(explained)), rel=1e-6)
    assert float(addition.starts[0][1]) == pytest.approx(float(residual.mean()), rel=1e-6)


def replaced(stiffness):
    """The model with effects in place of the fitted stiffness, and the model with the play alone."""
    prepared = Servo().prepare(followed(gap=GAP, stiffness=stiffness))
    terms = terms_of(prepared, "backlash", "input_lag", "input_delay")
    play = replace(next(term for term in terms if term.effect.id == "backlash"), shape={"half_gap": GAP})
    start = torch.cat([prepared.given, prepared.given.new_ones(1)])
    start[0] = stiffness
    final = fitted(JointModel(prepared, [play]), start, graduate=False)
    beam = BeamSearch(terms, basis_of(final, 3, {}, SETTINGS), SETTINGS, {})
    return instead_of_numbers(beam, final, with_wide_grid(terms, prepared)), final


def test_a_late_command_takes_the_place_of_a_servo_that_is_far_too_soft():
    found, final = replaced(STIFFNESS / 15.0)
    assert found is not None
    assert found.values == {"stiffness": STIFFNESS}
    fit = found.model.fit
    assert float(fit.parameters[0]) == pytest.approx(STIFFNESS, rel=1e-9)
    play, *more = fit.model.terms
    assert play.effect.id == "backlash"
    assert {term.effect.id for term in more} <= {"input_lag", "input_delay"}
    # a servo without inertia follows late by the ratio of its damping to its stiffness
    late = sum(sum(term.shape.values()) for term in more)
    assert late == pytest.approx(1.5 / (STIFFNESS / 15.0) - 1.5 / STIFFNESS, rel=0.3)
    assert found.model.log_size < float(final.residual.square().mean().sqrt().log()) + 1.0


def test_effects_that_suit_the_unlikely_number_alone_are_left_out():
    beam = searched(followed(gap=GAP, zero=ZERO), 0.1)
    found = beam.at_given
    assert found is not None
    assert {term.effect.id for term in found.model.fit.model.terms} >= {"backlash", "offset"}
    assert float(found.model.fit.parameters[0]) == pytest.approx(STIFFNESS)
    spring = next(term for term in beam.terms if term.effect.id == "cubic_stiffness")
    soft = beam.models[()].fit
    theta = torch.cat([soft.parameters, soft.parameters.new_zeros(1)])
    theta[0] = 0.1 * STIFFNESS
    model = soft.model.with_term(spring)
    final = replace(soft, model=model, parameters=theta, residual=model.residual(theta).detach())
    assert instead_of_numbers(beam, final, beam.terms) is found


def test_nothing_takes_the_place_of_a_likely_number():
    assert replaced(STIFFNESS)[0] is None


@pytest.mark.e2e
def test_effects_in_place_of_an_unlikely_number_are_named():
    effects = [effect for effect in CATALOGUE if effect.id in ("backlash", "input_lag")]
    recording = followed(gap=GAP, stiffness=STIFFNESS / 15.0, samples=150)
    found = diagnose(Servo(), recording, effects=effects, surrogates=19, seed=0)
    assert [finding.effect for finding in found.findings] == ["backlash"]
    (check,) = found.checks
    begin = "With `stiffness` at 60, the value given, the search finds backlash on the input command (half gap 0.0"
    assert begin in check.sentence
    assert " and input lag on the input command (lag " in check.sentence


def test_a_parameter_is_the_same_at_all_samples():
    """So a recorded column drives none, and the ports have none."""
    assert not [name for name in Servo().prepare(followed()).ports if name.startswith("parameter")]
    x, u = (Names(**{name: torch.zeros(5) for name in names}) for names in (Servo.states, Servo.inputs))
    p = Names(stiffness=torch.full((5,), STIFFNESS))
    with pytest.raises(ValueError, match=r"expected \(p,\), a number for each, got \(1, 5\)"):
        Servo().derivative(torch.zeros(5), x, u, p)


@pytest.mark.e2e
def test_a_recorded_column_next_to_the_command_stops_no_search():
    own = followed(gap=GAP)
    columns = {name: own[name] for name in ("time", "command", "angle")}
    recording = Recording({**columns, "temperature": 20.0 + torch.sin(own["time"])})
    found = diagnose(Servo(), recording, quick=True, effects=[e for e in CATALOGUE if e.id in ("backlash", "gain")])
    assert not [warning for warning in found.warnings if "internal error" in warning]
