"""Open-loop fits of candidates find an effect that process noise around a poor simulation hides."""

import math

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.search.moves import linear_gains
from mkc_torch.diagnosis.search.own_noise import BEHIND_NATS, BEHIND_SHARE, SHAPES, free_runs
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.effects import DYNAMICS
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter

STEP, SAMPLES, DRAG = 0.05, 240, 0.3


class Cart(Dynamics):
    """A cart driven by a force, without drag."""

    states = ("speed",)
    inputs = ("force",)
    parameters = {"gain": Parameter(1.0, lower=0.0)}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.force}


def recording(drag, noise=0.01, seed=0):
    time = STEP * torch.arange(SAMPLES, dtype=torch.float64)
    force = 1.0 + torch.sin(0.9 * time)
    speed, found, parts = 0.5, [], 50
    for k in range(SAMPLES):
        found.append(speed)
        ahead = force[min(k + 1, SAMPLES - 1)]
        for part in range(parts):
            driving_force = torch.lerp(force[k], ahead, (part + 0.5) / parts)
            speed += STEP / parts * float(driving_force - drag * speed * abs(speed))
    generator = torch.Generator().manual_seed(seed)
    seen = torch.tensor(found, dtype=torch.float64) + noise * torch.randn(SAMPLES, generator=generator).double()
    return Recording({"time": time, "force": force, "speed": seen})


def free_fit(drag):
    prepared = Cart().prepare(recording(drag))
    return fitted(JointModel(prepared), prepared.start())


def all_terms(fit):
    return candidate_terms(fit.model.prepared, (), DYNAMICS)


def test_missing_drag_leads_with_its_size():
    fit = free_fit(DRAG)
    terms = all_terms(fit)
    runs, _ = free_runs(fit, terms, Settings())
    number, best = max(runs, key=lambda run: run[1].log_likelihood)
    by_effect = {terms[n].effect.id: run for n, run in runs}
    assert "quadratic_drag" in by_effect
    drag = by_effect["quadratic_drag"]
    assert float(drag.parameters[-1]) == pytest.approx(DRAG, rel=0.02)
    assert float(drag.residual.std()) == pytest.approx(0.01, rel=0.15)
    assert drag.log_likelihood > best.log_likelihood - 2.0
    assert drag.log_likelihood - fit.log_likelihood > 200.0
    assert best.model.terms[-1].key == terms[number].key


def test_gains_equal_least_squares_within_the_bounds():
    fit = free_fit(DRAG)
    terms = all_terms(fit)
    gains, sizes = linear_gains(fit, terms, Settings().noise)
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
    terms = all_terms(fit)
    gains, sizes = linear_gains(fit, terms, Settings().noise)
    drags = [n for n, term in enumerate(terms) if term.effect.id == "quadratic_drag"]
    assert [gains[n] for n in drags] == [0.0]
    assert [sizes[n].tolist() for n in drags] == [[0.0]]


def test_fits_far_behind_are_dropped():
    fit = free_fit(DRAG)
    terms = all_terms(fit)
    fits, behind = free_runs(fit, terms, Settings())
    assert behind
    assert behind.isdisjoint(terms[number].key for number, _ in fits)
    gains = [run.log_likelihood - fit.log_likelihood for _, run in fits]
    assert min(gains) >= min(max(gains) - BEHIND_NATS, (1.0 - BEHIND_SHARE) * max(gains)) - 1e-6


def test_each_leading_effect_is_fitted_from_its_best_shapes(monkeypatch):
    tried = []

    def fit_of(free, term, size):
        tried.append(term)
        return free

    monkeypatch.setattr("mkc_torch.diagnosis.search.own_noise._fit", fit_of)
    monkeypatch.setattr("mkc_torch.diagnosis.search.own_noise.PHYSICS", 3)
    fit = free_fit(DRAG)
    terms = all_terms(fit)
    free_runs(fit, terms, Settings())
    gains = dict(zip(map(id, terms), linear_gains(fit, terms, Settings().noise)[0], strict=True))
    keys = {term.key for term in tried}
    assert len(keys) == 3
    assert not any(term.effect.is_curve for term in tried)
    for key in keys:
        own = sorted((gains[id(term)] for term in terms if term.key == key), reverse=True)
        assert (
            sorted((gains[id(term)] for term in tried if term.key == key), reverse=True)
            == [gain for gain in own if gain > 0.0][:SHAPES]
        )
