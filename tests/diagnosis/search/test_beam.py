"""The beam search: each set of effects is fitted once in open loop, and the highest score wins."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.score import basis_of, score
from mkc_torch.diagnosis.search import beam as beam_module
from mkc_torch.diagnosis.search.beam import BeamSearch
from mkc_torch.diagnosis.search.candidate import Candidate, in_order, model_key
from mkc_torch.diagnosis.search.move_fits import at_other_values
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import LARGER
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation import Dynamics, Parameter
from tests.diagnosis.cart import DRAG, FRICTION, NOISE, cart_recording, cart_terms, first_term, fit_with, free_fit

SETTINGS = Settings()
NAMES = ("quadratic_drag", "coulomb_friction", "constant_force")


def beam_of(fit: FittedModel, terms: tuple[Term, ...], **limits: int) -> BeamSearch:
    basis = basis_of(fit, len({term.key for term in terms}), {}, SETTINGS)
    return BeamSearch(terms, basis, SETTINGS, {}, **limits)


def start(drag: float, friction: float) -> FittedModel:
    return free_fit(drag, friction, mean=0.0, samples=160)


@functools.cache
def searched(drag: float = 0.0, friction: float = 0.0, names: tuple[str, ...] = NAMES) -> BeamSearch:
    """Return the search for a few effects in a recording of a cart that reverses."""
    fit = start(drag, friction)
    beam = beam_of(fit, cart_terms(fit, *names))
    beam.run(fit)
    return beam


def effects_of(model: Candidate) -> set[str]:
    return {term.effect.id for term in model.fit.model.terms}


def best_value(beam: BeamSearch, *names: str) -> float:
    return max(model.value for model in beam.models.values() if effects_of(model) == set(names))


def test_two_hidden_effects_are_found_and_score_higher_than_each_alone():
    beam = searched(DRAG, FRICTION)
    assert effects_of(beam.best) == {"quadratic_drag", "coulomb_friction"}
    both = best_value(beam, "quadratic_drag", "coulomb_friction")
    assert both == beam.best.value
    assert both > best_value(beam, "quadratic_drag") > best_value(beam)
    assert both > best_value(beam, "coulomb_friction") > best_value(beam)
    fit = beam.best.fit
    sizes = {t.effect.id: float(g) for t, g in zip(fit.model.terms, fit.model.gammas(fit.parameters), strict=True)}
    assert sizes["quadratic_drag"] == pytest.approx(DRAG, rel=0.1)
    assert sizes["coulomb_friction"] == pytest.approx(FRICTION, rel=0.1)
    assert float(fit.residual.std()) == pytest.approx(NOISE, rel=0.2)


@pytest.mark.e2e
def test_a_needless_effect_is_not_in_the_best_model():
    beam = searched(DRAG)
    assert effects_of(beam.best) == {"quadratic_drag"}


def test_without_a_hidden_effect_the_simulation_alone_is_best():
    assert searched().best.fit.model.terms == ()


@pytest.mark.e2e
def test_a_special_case_is_preferred_to_its_general_form():
    beam = searched(0.0, FRICTION, ("coulomb_friction", "stribeck_friction"))
    assert effects_of(beam.best) == {"coulomb_friction"}
    assert best_value(beam, "coulomb_friction") > best_value(beam, "stribeck_friction")


def test_every_model_is_fitted_and_scored_once_for_each_hold(monkeypatch):
    scored = []

    def counted(fit, *others):
        forms = tuple(tuple(term.shape.items()) for term in fit.model.terms)
        scored.append((model_key(fit.model.terms), (tuple(fit.model.prepared.input_hold.items()), forms)))
        return score(fit, *others)

    def refused(*_, **__):
        raise NoFitError("No noise is fitted here.")

    monkeypatch.setattr(beam_module, "score", counted)
    monkeypatch.setattr(beam_module, "fit_with_process_noise", refused)
    fit = start(DRAG, FRICTION)
    beam = beam_of(fit, cart_terms(fit, *NAMES))
    beam.run(fit)
    assert len(beam.models) > 4
    assert len(set(scored)) == len(scored)
    assert {key for key, _ in scored} == set(beam.models)
    assert [model.key for model in beam.models.values()] == list(beam.models)


def test_the_moves_lead_from_the_simulation_alone_to_each_model():
    beam = searched(DRAG, FRICTION)
    first, *others = beam.models.values()
    assert (first.key, first.move) == ((), "")
    assert all(model.move.split()[0] in ("add", "drop", "exchange", "another") for model in others)
    assert "add coulomb_friction@speed" in {model.move for model in others}


@pytest.mark.e2e
def test_the_search_does_not_depend_on_the_order_of_the_candidates():
    beam = searched(DRAG, FRICTION)
    fit = start(DRAG, FRICTION)
    other = beam_of(fit, tuple(reversed(cart_terms(fit, *NAMES))))
    best = other.run(fit)
    assert best.key == beam.best.key
    assert best.value == pytest.approx(beam.best.value, abs=0.01)
    assert set(other.models) == set(beam.models)


@pytest.mark.parametrize("most", [1, 2])
def test_no_more_models_are_tried_than_allowed(most):
    fit = start(DRAG, FRICTION)
    beam = beam_of(fit, cart_terms(fit, "quadratic_drag", "constant_force"), most_models=most)
    beam.run(fit)
    assert len(beam.models) == most


def test_moves_that_the_number_of_models_cuts_off_are_made_while_the_best_is_improved():
    """Of the moves from the best model with one effect, the first part of the search has room for one."""
    fit = start(DRAG, FRICTION)
    names = ("linear_drag", "stribeck_friction", "constant_force", "quadratic_drag", "unknown")
    beam = beam_of(fit, cart_terms(fit, *names), most_models=10, most_terms=3)
    beam.run(fit)
    moves = [model.move for model in beam.models.values()]
    assert "add unknown@speed" in moves[6]
    assert "add quadratic_drag@speed" in moves[7:]
    assert {"quadratic_drag", "stribeck_friction"} < effects_of(beam.best)


def test_no_model_has_more_effects_than_allowed():
    fit = start(DRAG, FRICTION)
    beam = beam_of(fit, cart_terms(fit, "quadratic_drag", "constant_force"), most_terms=1)
    beam.run(fit)
    assert max(len(model.fit.model.terms) for model in beam.models.values()) == 1


@pytest.mark.parametrize(("factor", "scored"), [(0.5, True), (2.0, False)])
def test_an_implausible_size_has_no_score(factor, scored):
    """A constant force many times as large as the recording's rates."""
    alone = start(DRAG, 0.0)
    model = alone.model.with_term(first_term(alone, "constant_force"))
    beam = beam_of(alone, cart_terms(alone, *NAMES))
    size = factor * float(beam.basis.changes[0])
    fit = replace(alone, model=model, parameters=torch.cat([alone.parameters, alone.parameters.new_tensor([size])]))
    candidate = Candidate(fit, score(fit, beam.basis, SETTINGS), "")
    assert (candidate.score is not None) is scored
    assert (candidate.value > -float("inf")) is scored


def stub(effects, value, residual, by_horizon=(0.0, 0.0, 0.0), *, observer=None, place=0):
    """Return a candidate with a residual and a score of three horizons; ``place`` is that of its disturbance."""
    terms = tuple(SimpleNamespace(key=(name, (), "rate of speed"), first=False) for name in effects)
    model = SimpleNamespace(terms=terms, prepared=SimpleNamespace(observer=observer))
    fit = SimpleNamespace(model=model, open_loop=SimpleNamespace(residual=residual))
    noise = SimpleNamespace(components=((place, 1.0, 0.0),))
    return Candidate(fit, SimpleNamespace(value=value, by_horizon=by_horizon, noise=noise), "")


def beam_with(*models):
    basis = SimpleNamespace(largest=[1.0, 1.0], span=[1.0], kappa=1.0)  # one rate and one output
    return BeamSearch((), basis, SETTINGS, {}, {model.key: model for model in models})


@pytest.mark.parametrize(("ratio", "larger"), [(0.98 * LARGER, False), (1.02 * LARGER, True)])
def test_a_model_that_enlarges_the_open_loop_residual_is_not_the_best(ratio, larger):
    """Most of the residual, and so its robust size, is smaller with the effect; a tenth of the samples grows."""
    residual = torch.randn(200, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = 0.5 * residual
    rest = ratio**2 * residual.square().sum() - moved[:180].square().sum()
    moved[180:] = (rest / 20.0).sqrt()
    alone, drag = stub((), 0.0, residual), stub(("drag",), 100.0, moved)
    beam = beam_with(alone, drag)
    assert beam.enlarges(drag) is larger
    assert beam.best is (alone if larger else drag)
    assert not beam.enlarges(alone)


def test_a_residual_is_compared_with_those_of_models_with_a_part_of_the_effects():
    residual = torch.ones(50, 1, dtype=torch.float64)
    alone, drag = stub((), 0.0, residual), stub(("drag",), 10.0, 0.1 * residual)
    lag, both = stub(("lag",), 5.0, 0.5 * residual), stub(("drag", "lag"), 20.0, 0.2 * residual)
    beam = beam_with(alone, drag, lag, both)
    assert not beam.enlarges(lag)  # drag is not a part of it
    assert beam.enlarges(both)
    assert beam.best is drag


@pytest.mark.parametrize(
    ("gains", "observer", "place", "is_best"),
    [
        ((9.0, 9.0, -50.0), "along it", 0, True),
        ((9.0, 1.0, 50.0), "along it", 0, False),  # a gain over one horizon is not clear
        ((9.0, 9.0, -50.0), None, 0, False),  # in open loop the free run is what counts
        ((9.0, 9.0, -50.0), "along it", 1, False),  # a drift of the output predicts a lost stretch
    ],
)
def test_a_model_of_a_sensitive_recording_may_lose_the_free_run_alone(gains, observer, place, is_best):
    residual = torch.ones(50, 1, dtype=torch.float64)
    alone = stub((), 0.0, residual)
    cogs = stub(("cogs",), 10.0, 3.0 * residual, gains, observer=observer, place=place)
    beam = beam_with(alone, cogs)
    assert beam.enlarges(cogs) is not is_best
    assert beam.best is (cogs if is_best else alone)


def test_a_model_that_loses_the_recording_is_not_the_best():
    alone = stub((), 0.0, torch.ones(50, 1, dtype=torch.float64))
    lost = stub(("drag",), 50.0, alone.fit.open_loop.residual)
    lost.fit.open_loop = None
    assert beam_with(alone, lost).best is alone


def test_the_beam_has_the_leading_models_and_those_near_the_best():
    beam = searched(DRAG, FRICTION)
    leading = beam.beam()
    values = [model.value for model in leading]
    assert values == sorted(values, reverse=True)
    assert leading[0].value == max(model.value for model in beam.models.values())
    assert 3 <= len(leading) <= 6


def test_another_order_of_the_effects_is_the_same_model():
    beam = searched(DRAG, FRICTION)
    best = beam.best
    terms = best.fit.model.terms
    other = in_order(best, terms[::-1])
    assert other.fit.model.terms == terms[::-1]
    assert other.key == best.key
    assert other.value == best.value
    torch.testing.assert_close(other.fit.model.residual(other.fit.parameters), best.fit.residual, rtol=0.0, atol=1e-6)
    assert in_order(best, terms) is best


def test_a_given_set_of_effects_is_fitted_from_the_shapes_of_their_grids():
    fit = start(DRAG, FRICTION)
    beam = searched(DRAG, FRICTION)
    groups = [cart_terms(fit, name) for name in ("coulomb_friction", "quadratic_drag")]
    model = beam.fitted_set(groups, fit, "suspected")
    assert model.move == "suspected"
    assert [term.effect.id for term in model.fit.model.terms] == ["coulomb_friction", "quadratic_drag"]
    assert model.value > max(best_value(beam, "coulomb_friction"), best_value(beam, "quadratic_drag"))


class TwoCarts(Dynamics):
    """Two carts that do not touch, driven by the same force."""

    states = ("first", "second")
    inputs = ("force",)
    parameters = {"gain": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"first": p.gain * u.force, "second": p.gain * u.force}


def test_an_effect_of_a_model_is_tried_at_other_places_whatever_its_linear_gain():
    with_friction, without = (cart_recording(0.0, friction, mean=0.0, samples=160) for friction in (FRICTION, 0.0))
    columns = {"time": without["time"], "force": without["force"]}
    recording = Recording({**columns, "first": with_friction["speed"], "second": without["speed"]})
    prepared = TwoCarts().prepare(recording)
    fit = fitted(JointModel(prepared), prepared.start())
    beam = beam_of(fit, cart_terms(fit, "coulomb_friction"))
    beam.run(fit)
    tried = {tuple(sorted(term.port for term in model.fit.model.terms)) for model in beam.models.values()}
    assert ("rate of first", "rate of second") in tried
    assert [term.port for term in beam.best.fit.model.terms] == ["rate of first"]


def test_a_fit_far_from_its_initial_values_is_also_tried_from_there():
    fit = start(DRAG, 0.0)
    assert at_other_values(fit, 5.0) == []
    away = replace(fit, parameters=torch.cat([20.0 * fit.parameters[:1], fit.parameters[1:]]))
    (there,) = at_other_values(away, 5.0)
    torch.testing.assert_close(there.parameters, fit.model.prepared.start())


def test_a_fit_at_a_bound_is_also_tried_from_the_nominal_values():
    fit = start(DRAG, 0.0)
    at_bound = replace(fit, parameters=torch.cat([torch.zeros_like(fit.parameters[:1]), fit.parameters[1:]]))
    (there,) = at_other_values(at_bound, float("inf"))
    assert float(there.parameters[0]) == 1.0


def test_the_models_without_one_of_the_effects_are_known_afterwards():
    fit = start(DRAG, FRICTION)
    beam = beam_of(fit, cart_terms(fit, *NAMES))
    both = fit_with(fit_with(fit, first_term(fit, "coulomb_friction")), first_term(fit, "quadratic_drag"))
    model = Candidate(both, score(both, beam.basis, SETTINGS), "")
    less = beam.with_one_less(model)
    assert [effects_of(other) for other in less] == [{"quadratic_drag"}, {"coulomb_friction"}]
    assert all(beam.models[other.key] is other for other in less)
    again = beam.with_one_less(model)
    assert all(first is second for first, second in zip(less, again, strict=True))


@functools.cache
def searched_without_gains(leads: bool) -> BeamSearch:
    """Return a search in which no addition to a model with effects pays by its linear gain."""
    fit = start(DRAG, FRICTION)
    terms = cart_terms(fit, *NAMES)
    friction = next(term for term in terms if term.effect.id == "coulomb_friction")
    beam = beam_of(fit, terms)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beam_module, "PAYS", 1e6)
        beam.run(fit, (friction,) if leads else ())
    return beam


@pytest.mark.parametrize("leads", [False, True])
def test_a_leader_of_the_screening_is_tried_next_to_the_best_model_whatever_its_linear_gain(leads):
    moves = [model.move for model in searched_without_gains(leads).models.values() if len(effects_of(model)) == 2]
    assert ("add coulomb_friction@speed" in moves) is leads


def test_effects_of_the_best_model_are_exchanged_for_others_of_the_same_channels():
    beam = searched_without_gains(True)
    assert effects_of(beam.best) == {"quadratic_drag", "coulomb_friction"}
    others = [model for model in beam.models.values() if len(effects_of(model)) == 2 and model is not beam.best]
    assert any(model.move.startswith("exchange ") for model in others)


def test_the_typical_size_ignores_outliers():
    residual = torch.ones(50, 1, dtype=torch.float64)
    outliers = residual.clone()
    outliers[:5] = 100.0
    clean, hit = stub((), 0.0, residual), stub((), 0.0, outliers)
    assert clean.log_typical_size == hit.log_typical_size == 0.0
    assert hit.log_size > 3.0
