"""The moves of the model search: additions by linear gain, wider grids, special cases and orders in series."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms, candidates_of
from mkc_torch.diagnosis.search.moves import (
    STARTS,
    Addition,
    additions,
    at_size_zero,
    in_other_orders,
    linear_gains,
    local_maxima,
    one_form_each,
    special_cases,
    with_wide_grid,
)
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from mkc_torch.effects import CATALOGUE
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics, Parameter, Stepper
from tests.diagnosis.cart import DRAG, FRICTION, SAMPLES, STEP, Cart, cart_terms, first_term, fit_with, free_fit

NOISE_SETTINGS = NoiseSettings()
GENERATOR = torch.Generator().manual_seed(0)


def test_the_hidden_drag_is_the_first_addition_with_its_size():
    fit = free_fit(DRAG)
    found = additions(fit, cart_terms(fit, "quadratic_drag", "dead_zone", "constant_force"), NOISE_SETTINGS)
    assert found[0].key[0] == "quadratic_drag"
    gains = [addition.gain for addition in found]
    assert gains == sorted(gains, reverse=True)
    ((_, size),) = found[0].starts
    assert 0.0 < float(size) < DRAG  # the trajectory is far from linear in the drag
    assert float(fit_with(fit, found[0].starts[0][0]).parameters[-1]) == pytest.approx(DRAG, rel=0.02)


def test_the_hidden_friction_is_the_first_addition_of_a_cart_that_reverses():
    fit = free_fit(friction=FRICTION, mean=0.0)
    names = ("coulomb_friction", "quadratic_drag", "constant_force", "dead_zone")
    found = additions(fit, cart_terms(fit, *names), NOISE_SETTINGS)
    assert found[0].key[0] == "coulomb_friction"
    assert {addition.key[0] for addition in found} == set(names)


def test_effects_that_a_model_has_are_not_added_again():
    fit = free_fit(DRAG)
    terms = cart_terms(fit, "quadratic_drag", "linear_drag")
    with_drag = fit_with(fit, first_term(fit, "quadratic_drag"))
    assert [addition.key[0] for addition in additions(with_drag, terms, NOISE_SETTINGS)] == ["linear_drag"]
    assert additions(with_drag, cart_terms(fit, "quadratic_drag"), NOISE_SETTINGS) == []


def test_an_effect_starts_from_its_best_shapes():
    fit = free_fit(DRAG)
    terms = cart_terms(fit, "dead_zone", "input_lag")
    gains = dict(zip(map(id, terms), linear_gains(fit, terms, NOISE_SETTINGS)[0], strict=True))
    for addition in additions(fit, terms, NOISE_SETTINGS):
        own = [gains[id(term)] for term, _ in addition.starts]
        assert own == sorted(own, reverse=True)
        assert 1 <= len(own) <= STARTS
        assert addition.gain == own[0] == max(gains[id(term)] for term in terms if term.key == addition.key)


def test_gains_equal_least_squares_within_the_bounds():
    fit = free_fit(DRAG)
    terms = cart_terms(fit)
    gains, sizes = linear_gains(fit, terms, NOISE_SETTINGS)
    assert len(gains) == len(sizes) == len(terms)
    for term, gain, size in zip(terms, gains, sizes, strict=True):
        assert gain >= 0.0
        assert bool(((size >= term.effect.lower) & (size <= term.effect.upper)).all())
    place = [term.effect.id for term in terms].index("linear_drag")
    model = fit.model.with_term(terms[place])
    start = torch.cat([fit.parameters, torch.zeros(1, dtype=torch.float64)])
    columns = torch.func.jacfwd(model.residual)(start).flatten(0, 1)
    left = torch.linalg.lstsq(columns, fit.residual.flatten().unsqueeze(-1)).solution
    after = fit.residual.flatten() - columns @ left[:, 0]
    own = columns[:, :-1]
    before = fit.residual.flatten()
    before = before - own @ torch.linalg.lstsq(own, before.unsqueeze(-1)).solution[:, 0]
    expected = 0.5 * SAMPLES * math.log(float(before.square().sum() / after.square().sum()))
    assert gains[place] == pytest.approx(expected, rel=1e-3)
    assert sizes[place].tolist() == pytest.approx([-float(left[-1])], rel=1e-3)


def test_drag_of_the_wrong_sign_gains_nothing():
    fit = free_fit(-0.03)
    gains, sizes = linear_gains(fit, cart_terms(fit, "quadratic_drag"), NOISE_SETTINGS)
    assert gains == [0.0]
    assert [size.tolist() for size in sizes] == [[0.0]]


class Fall(Dynamics):
    states, outputs = ("height", "speed"), ("height",)
    parameters = {"gravity": Parameter(9.8, lower=9.7, upper=9.9)}

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": -p.gravity}


def test_an_effect_that_acts_as_a_parameter_does_is_not_added():
    """A constant force would undo the bounds of gravity."""
    time = torch.arange(200, dtype=torch.float64) * 0.01
    height = -4.0 * time.square() + 0.1 * time.pow(3)
    recording = Recording({"time": time, "height": height + 1e-3 * torch.randn(200, generator=GENERATOR).double()})
    prepared = Fall().prepare(recording)
    fit = fitted(JointModel(prepared), prepared.start())
    effects = [effect for effect in CATALOGUE if effect.id in ("constant_force", "linear_drag")]
    _, terms = candidates_of(Fall(), prepared, effects, Settings().drivers)
    gains = linear_gains(fit, terms, NOISE_SETTINGS)[0]
    by_id = {term.effect.id: gain for term, gain in zip(terms, gains, strict=True)}
    assert by_id["constant_force"] == -math.inf
    assert by_id["linear_drag"] > 0.0
    assert [addition.key[0] for addition in additions(fit, terms, NOISE_SETTINGS)] == ["linear_drag"]
    forces = [term for term in terms if term.effect.id == "constant_force"]
    ((term, size),) = at_size_zero(fit, forces).starts
    assert (term, size.tolist()) == (forces[0], [0.0])


def shaped(**shape):
    return SimpleNamespace(shape=shape)


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        ([1.0, 5.0, 3.0, 2.0, 4.0], [1, 4]),
        ([9.0, 0.0, 8.0, 0.0, 7.0, 0.0, 6.0], [0, 2, 4]),
        ([1.0], [0]),
        ([2.0, 3.0], [1]),
    ],
)
def test_neighbours_of_a_better_shape_on_the_grid_are_left_out(gains, expected):
    assert local_maxima([shaped(width=0.1 * k) for k in range(len(gains))], gains) == expected


def test_two_shapes_are_neighbours_if_one_number_differs_by_a_step():
    terms = [shaped(width=width, softness=softness) for width in (0.1, 0.2) for softness in (0.0, 1.0)]
    assert local_maxima(terms, [4.0, 1.0, 2.0, 3.0]) == [0, 3]


def test_an_effect_without_a_shape_has_one_start():
    assert local_maxima([shaped()], [3.0]) == [0]


def test_lags_span_two_samples_to_a_third_of_the_run_in_ratios_of_two():
    fit = free_fit(DRAG)
    terms = cart_terms(fit, "input_lag")
    lags = [float(term.shape["lag"]) for term in with_wide_grid(terms, fit.model.prepared)]
    assert {term.key for term in with_wide_grid(terms, fit.model.prepared)} == {term.key for term in terms}
    # a lag of one sample only changes what the input does between two samples
    assert lags[0] == pytest.approx(2.0 * STEP)
    assert [after / lag for lag, after in pairwise(lags)] == pytest.approx([2.0] * (len(lags) - 1))
    assert lags[-1] <= STEP * (SAMPLES - 1) / 3.0 < 2.0 * lags[-1]


def test_lags_of_several_runs_end_at_a_third_of_the_longest():
    time = STEP * torch.arange(150, dtype=torch.float64)
    columns = {"time": time, "force": torch.sin(time), "speed": 1.0 - torch.cos(time)}
    run = (torch.arange(150) >= 90).double()
    prepared = Cart().prepare(Recording({**columns, "experiment": run}))
    fit = fitted(JointModel(prepared), prepared.start())
    lags = [float(term.shape["lag"]) for term in with_wide_grid(cart_terms(fit, "input_lag"), prepared)]
    assert lags[-1] <= STEP * 89 / 3.0 < 2.0 * lags[-1]


@pytest.mark.parametrize(("mean", "offset"), [(4.0, True), (0.0, False)])
def test_levels_of_a_signal_far_from_zero_are_also_tried_within_its_range(mean, offset):
    fit = free_fit(mean=mean, samples=120)
    terms = cart_terms(fit, "dead_zone")
    wide = with_wide_grid(terms, fit.model.prepared)
    assert {id(term) for term in terms} <= {id(term) for term in wide}
    force = fit.model.prepared.ports["input force"].sizes["own"]
    more = [float(term.shape["width"]) for term in wide if id(term) not in {id(t) for t in terms}]
    assert bool(more) is offset
    assert all(force.lowest < width < force.highest for width in more)


def test_each_special_case_is_found_once_in_both_directions_at_the_same_channels():
    fit = free_fit(friction=FRICTION, mean=0.0)
    terms = cart_terms(fit, "coulomb_friction", "stribeck_friction", "quadratic_drag")
    dry, stribeck = first_term(fit, "coulomb_friction"), first_term(fit, "stribeck_friction")
    prepared = fit.model.prepared
    assert len([term for term in terms if term.effect.id == "coulomb_friction"]) > 1
    assert [term.effect.id for term in special_cases(stribeck, terms, prepared)] == ["coulomb_friction"]
    assert [term.effect.id for term in special_cases(dry, terms, prepared)] == ["stribeck_friction"]
    assert special_cases(first_term(fit, "quadratic_drag"), terms, prepared) == []


class Strip(Dynamics):
    """A body whose drag may depend on a recorded temperature, and whose input may be late by a flow."""

    states, inputs, parameters = ("speed",), ("force",), {"drag": Parameter(0.4, unit="1/s")}

    def derivative(self, time, x, u, p):
        return {"speed": u.force - p.drag * x.speed}


def strip_terms():
    time = torch.arange(60, dtype=torch.float64) * 0.1
    columns = {"time": time, "force": time.sin(), "speed": time.cos(), "temperature": 20.0 + 3.0 * (0.7 * time).sin()}
    recording = Recording({**columns, "flow": 2.0 + (0.4 * time).cos()})
    prepared = Strip().prepare(recording)
    return prepared, candidates_of(Strip(), prepared, CATALOGUE, Settings().drivers)[1]


def test_forms_of_a_dependence_on_a_column_are_exchanged_for_one_another():
    prepared, terms = strip_terms()

    def exchanged(name):
        (term, *_) = [t for t in terms if t.effect.id == name and t.columns != ("flow",)]
        return {(other.effect.id, *other.columns) for other in special_cases(term, terms, prepared)}

    forms = {f"driver_parameter{form}" for form in ("", "_quadratic", "_arrhenius")}
    for form in forms:
        assert exchanged(form) == {(other, "temperature") for other in forms - {form}}
    assert exchanged("input_delay") == {("input_transport_delay", "flow")}


@pytest.mark.parametrize(
    ("gains", "chosen"),
    [
        ((10.0, 10.0, 10.0), {"driver_parameter"}),
        ((10.0, 30.0, 10.0), {"driver_parameter_quadratic"}),
        ((None, 30.0, 10.0), set()),
    ],
)
def test_one_form_of_a_dependence_is_added(gains, chosen):
    _, terms = strip_terms()
    names = ("driver_parameter", "driver_parameter_quadratic", "driver_parameter_arrhenius")
    worth = {name: gain for name, gain in zip(names, gains, strict=True) if gain is not None}
    worth["input_transport_delay"] = 99.0  # without its special case among the additions
    columns = {name: ("flow",) if name == "input_transport_delay" else ("temperature",) for name in worth}
    first = {name: next(t for t in terms if (t.effect.id, t.columns) == (name, columns[name])) for name in worth}
    found = [Addition(((first[name], torch.zeros(1)),), gain) for name, gain in worth.items()]
    kept = one_form_each(found, lambda addition: addition.gain)
    assert {addition.starts[0][0].effect.id for addition in kept} == chosen


def test_an_effect_in_series_with_a_lag_has_another_order():
    fit = free_fit(DRAG)
    dead_zone, lag, delay = (first_term(fit, name) for name in ("dead_zone", "input_lag", "input_delay"))
    drag = first_term(fit, "quadratic_drag")

    def orders(*terms):
        model = JointModel(fit.model.prepared, terms, fit.model.near)
        return [
            [(term.effect.id, term.first) for term in other] for other in in_other_orders(SimpleNamespace(model=model))
        ]

    assert orders(dead_zone, lag) == [[("dead_zone", True), ("input_lag", False)]]
    assert orders(drag, lag) == []  # at the rate, not in series with the input
    assert orders(dead_zone, delay) == []  # a delay commutes with a static effect
    assert orders(dead_zone) == []


class Map(Stepper):
    """A population that is chaotic for a growth near 4: its trajectory is finite, its derivatives overflow."""

    states, inputs, time_step = ("population",), (), 1.0
    parameters = {"growth": Parameter(2.0, lower=0.0, upper=4.0)}

    def step(self, x, u, tau, p, dt):
        return p.growth * x * (1.0 - x)


def test_a_model_without_finite_derivatives_adds_no_effect():
    generator = torch.Generator().manual_seed(0)
    population = 0.5 + 1e-3 * torch.randn(3000, dtype=torch.float64, generator=generator)
    time = torch.arange(3000, dtype=torch.float64)
    prepared = Map().prepare(Recording({"time": time, "population": population}))
    terms = candidate_terms(prepared, (), CATALOGUE)
    stable = fitted(JointModel(prepared), prepared.start())
    assert additions(stable, terms, NOISE_SETTINGS)
    chaotic = torch.tensor([3.99, 0.3], dtype=torch.float64)
    residual = stable.model.residual(chaotic).detach()
    assert bool(residual.isfinite().all())
    unstable = replace(stable, parameters=chaotic, residual=residual)
    with pytest.raises(NoFitError, match="no finite derivative by growth"):
        tangents_of(unstable.model, chaotic, NOISE_SETTINGS)
    assert additions(unstable, terms, NOISE_SETTINGS) == []
