"""Backward elimination: needless findings are dropped, findings worth their penalty stay."""

import dataclasses
import functools
import types

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.process_noise import noise_of_fit
from mkc_torch.diagnosis.search import own_noise
from mkc_torch.diagnosis.search.own_noise import needless_terms, priced, without
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.effects.dynamics.stribeck_friction import StribeckFriction
from tests.diagnosis.swing import candidates, fitted_pendulum


@functools.cache
def with_effects(*names):
    """Return the fit of a pendulum with hidden quadratic drag, with these effects."""
    base = fitted_pendulum("slow", drag=0.4).fit
    terms = candidates(base, DYNAMICS)
    model, start = base.model, base.parameters
    for name in names:
        term = next(t for t in terms if t.effect.id == name and t.port == "rate of rate")
        model = model.with_term(term)
        start = torch.cat([start, start.new_zeros(model.size - len(start))])
    return fitted(model, start, base.bound, graduate=False)


def test_a_needless_effect_is_dropped_and_the_true_one_stays():
    fit = with_effects("constant_force", "quadratic_drag")
    assert needless_terms(fit, {}, Settings()) == (0,)
    less = without(fit, (0,), {}, Settings())
    assert [term.effect.id for term in less.model.terms] == ["quadratic_drag"]
    (drag,) = less.model.gammas(less.parameters)[0].tolist()
    assert drag == pytest.approx(0.4, abs=0.15)


def test_a_single_effect_is_never_dropped():
    assert needless_terms(with_effects("quadratic_drag"), {}, Settings()) == ()


def test_without_removes_two_effects_at_once():
    fit = with_effects("constant_force", "quadratic_drag")
    less = without(fit, (0, 1), {}, Settings())
    assert less.model.terms == ()
    assert len(less.parameters) == len(fit.parameters) - 2


@pytest.mark.parametrize(("together", "needless"), [(-3.0, (0, 2)), (30.0, ())])
def test_two_jointly_needless_effects_are_removed_together(monkeypatch, together, needless):
    """Each pays its penalty given the other two; 0 and 2 together do not."""
    losses = {(0,): 40.0, (1,): 90.0, (2,): 25.0, (0, 1): 130.0, (0, 2): together, (1, 2): 120.0}
    monkeypatch.setattr(own_noise, "_loss", lambda _fit, numbers, *_: losses[numbers])
    monkeypatch.setattr(own_noise, "run_parallel", lambda works, *_: [work() for work in works])
    terms = [placed(drag) for drag in (LinearDrag, QuadraticDrag, CoulombFriction)]
    assert needless_terms(fit_of(terms), {}, Settings()) == needless


@pytest.mark.parametrize(("port", "needless"), [("rate of speed", (0,)), ("rate of angle", ())])
def test_a_general_form_and_its_special_case_at_one_place_are_not_two_findings(monkeypatch, port, needless):
    """Both pay their penalty; the weaker goes, unless they act on different states."""
    losses = {(0,): 20.0, (1,): 90.0, (2,): 15.0, (0, 1): 130.0, (0, 2): 50.0, (1, 2): 120.0}
    monkeypatch.setattr(own_noise, "_loss", lambda _fit, numbers, *_: losses[numbers])
    monkeypatch.setattr(own_noise, "run_parallel", lambda works, *_: [work() for work in works])
    terms = [placed(StribeckFriction), placed(CoulombFriction, port), placed(QuadraticDrag)]
    assert needless_terms(fit_of(terms), {}, Settings()) == needless


def placed(effect, port="rate of speed"):
    return types.SimpleNamespace(effect=effect(), port=port)


def fit_of(terms):
    return types.SimpleNamespace(model=types.SimpleNamespace(terms=terms, prepared=None))


def test_each_disturbance_of_a_fit_has_its_penalty():
    fit, settings = with_effects("quadratic_drag"), Settings()
    count = len(noise_of_fit(fit, {}).selected.disturbances)
    assert count > 0
    assert fit.log_likelihood - priced(fit, settings) == pytest.approx(count * settings.noise.disturbance_gain)
    free = dataclasses.replace(settings, noise=dataclasses.replace(settings.noise, disturbance_gain=0.0))
    assert priced(fit, free) == pytest.approx(fit.log_likelihood)
