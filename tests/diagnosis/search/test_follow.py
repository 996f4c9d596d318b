"""An effect with which the simulation follows far better is mentioned where a disturbance is as likely."""

import importlib
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.effects.dynamics.linear_drag import LinearDrag
from mkc_torch.effects.dynamics.power_law import PowerLaw
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag

search = importlib.import_module("mkc_torch.diagnosis.search.with_process_noise")
search_notes = importlib.import_module("mkc_torch.diagnosis.pipeline.search_notes")


def fit(effect, residual, log_likelihood):
    term = SimpleNamespace(effect=effect, columns=(), shape={})
    model = SimpleNamespace(terms=(term,), sizes=(1,))
    shown = residual * torch.linspace(-1.0, 1.0, 200, dtype=torch.float64).unsqueeze(-1)
    return SimpleNamespace(model=model, residual=shown, log_likelihood=log_likelihood)


FREE = fit(None, 4.0, 0.0)


@pytest.mark.parametrize(("residual", "mentioned"), [(0.7, True), (2.0, False)])
def test_an_effect_is_mentioned_if_little_of_the_open_loop_residual_is_left(residual, mentioned):
    drag = fit(QuadraticDrag(), residual, 300.0)
    assert search._follow(FREE, [(0, drag)]) == ((drag,) if mentioned else ())
    assert search._follow(None, [(0, drag)]) == ()
    assert search._follow(FREE, []) == ()


def test_the_most_likely_comes_first_and_a_general_form_is_left_out():
    drag, linear, power = (fit(QuadraticDrag(), 0.7, 290.0), fit(LinearDrag(), 0.7, 300.0), fit(PowerLaw(), 0.7, 310.0))
    assert search._follow(FREE, [(0, drag), (1, linear), (2, power)]) == (linear, drag)
    assert search._follow(FREE, [(2, power)]) == (power,)


def test_the_warning_names_the_effects_and_the_remedy():
    follow = fit(LinearDrag(), 0.7, 300.0), fit(QuadraticDrag(), 0.7, 290.0)
    (warning,) = search_notes._as_good_as_a_disturbance(SimpleNamespace(follow=follow, p_value=0.2))
    assert "linear_drag or quadratic_drag would explain" in warning
    assert "p = 0.2" in warning
    assert "--together" in warning
    assert search_notes._as_good_as_a_disturbance(SimpleNamespace(follow=())) == []
