"""An effect with a parameter for each part is simplified to a shared parameter unless held-out blocks prefer it."""

import math
from dataclasses import replace

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.io.model import DiagnosedModel, model_of
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.pipeline.simpler_form import simplified
from mkc_torch.diagnosis.search.estimate import estimate
from mkc_torch.diagnosis.settings import ConfirmationSettings, NamingSettings, NoiseSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics, Parameter

EFFECTS = {effect.id: effect for effect in DYNAMICS}
N, FINE, STEP, NOISE = 400, 20, 0.1, 0.01


class Bodies(Dynamics):
    """Two heated bodies without exchange and with sensors without lag."""

    states = ("left", "right")
    inputs = ("heat",)
    parameters = {"loss": Parameter(0.5, lower=0.0), "gain": Parameter(1.0, lower=0.0)}
    units = {"left": "K", "right": "K"}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"left": p.gain * u.heat - p.loss * x.left, "right": 0.5 * p.gain * u.heat - p.loss * x.right}


def bodies_recording(exchange=(0.0, 0.0), share=(0.0, 0.0), lag=0.4, seed=0):
    """Return a recording of two bodies with exchange and sensor lags, integrated independently."""
    generator = torch.Generator().manual_seed(seed)
    heat = torch.rand(N // 20, generator=generator, dtype=torch.float64).repeat_interleave(20)
    step = STEP / FINE
    left, right, shown = 1.0, 2.0, [1.0, 2.0]
    rows = []
    for now in heat.tolist():
        rows.append([(1.0 - s) * x + s * y for s, x, y in zip(share, (left, right), shown, strict=True)])
        for _ in range(FINE):
            away = right - left
            left, right = (
                left + step * (0.8 * now - 0.4 * left + exchange[0] * away),
                right + step * (0.4 * now - 0.4 * right - exchange[1] * away),
            )
            shown = [y + step / lag * (x - y) for x, y in zip((left, right), shown, strict=True)]
    values = torch.tensor(rows, dtype=torch.float64)
    values = values + NOISE * torch.randn(N, 2, generator=generator, dtype=torch.float64)
    time = STEP * torch.arange(N, dtype=torch.float64)
    return Recording({"time": time, "heat": heat, "left": values[:, 0], "right": values[:, 1]})


def fit_of(recording, *effects, start=0.3):
    """Return the joint fit with these effects, as a search finds them, and its evidence."""
    prepared = Bodies().prepare(recording)
    terms = [candidate_terms(prepared, (), (effect,))[0] for effect in effects]
    terms = [replace(t, shape={"lag": 0.5}) if t.effect.id == "sensor_lag" else t for t in terms]
    model = JointModel(prepared, terms)
    base = fitted(JointModel(prepared), prepared.start())
    more = base.parameters.new_full((model.size - model.base,), start)
    fit = fitted(model, torch.cat([base.parameters, more]), base.bound)
    blocks = blocks_of(N, 1, ConfirmationSettings())
    return fit, held_out(fit, blocks), blocks


def accept_all(_fit, _evidence):
    return True


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 1])
def test_equal_sensor_lags_are_simplified_to_a_shared_lag(seed):
    fit, evidence, blocks = fit_of(bodies_recording(share=(1.0, 1.0), seed=seed), EFFECTS["sensor_lag"])
    assert fit.model.sizes == (2,)
    simple, after = simplified(fit, evidence, blocks, accept_all, NamingSettings())
    assert simple.model.sizes == (1,)
    lag = simple.model.terms[0].shape["lag"]  # fitted again
    assert lag != 0.5
    assert float(simple.parameters[-1]) * lag == pytest.approx(0.4, abs=0.02)
    assert after.parameters.shape == (5, simple.model.size)
    assert float(simple.residual.square().mean().sqrt()) == pytest.approx(NOISE, rel=0.1)


@pytest.mark.e2e
def test_different_sensor_lags_keep_separate_shares():
    fit, evidence, blocks = fit_of(bodies_recording(share=(1.0, 0.0)), EFFECTS["sensor_lag"])
    kept, after = simplified(fit, evidence, blocks, accept_all, NamingSettings())
    assert kept is fit
    assert after is evidence
    assert fit.parameters[-2:].tolist() == pytest.approx([1.0, 0.0], abs=0.2)


@pytest.mark.e2e
@pytest.mark.parametrize(("exchange", "size"), [((0.2, 0.2), 1), ((0.3, 0.1), 2)])
def test_a_symmetric_exchange_is_simplified_to_a_shared_coefficient(exchange, size):
    fit, evidence, blocks = fit_of(bodies_recording(exchange), EFFECTS["coupling"], start=0.1)
    simple, _ = simplified(fit, evidence, blocks, accept_all, NamingSettings())
    assert simple.model.sizes == (size,)
    assert simple.parameters[-size:].tolist() == pytest.approx(list(exchange[:size]), abs=0.02)


@pytest.mark.e2e
def test_a_simpler_form_that_is_rejected_as_a_finding_is_not_used():
    fit, evidence, blocks = fit_of(bodies_recording((0.2, 0.2)), EFFECTS["coupling"], start=0.1)
    asked = []

    def never(other, after):
        asked.append((other.model.sizes, len(after.log_likelihood)))
        return False

    assert simplified(fit, evidence, blocks, never, NamingSettings()) == (fit, evidence)
    assert asked == [((1,), N)]


@pytest.mark.e2e
def test_an_earlier_effect_is_simplified_in_the_presence_of_a_later_one():
    fit, evidence, blocks = fit_of(
        bodies_recording((0.3, 0.1), (1.0, 1.0)), EFFECTS["sensor_lag"], EFFECTS["coupling"], start=0.2
    )
    simple, _ = simplified(fit, evidence, blocks, accept_all, NamingSettings())
    assert simple.model.sizes == (1, 2)
    assert simple.parameters[simple.model.base :].tolist() == pytest.approx([1.0, 0.3, 0.1], abs=0.1)


def test_an_effect_without_a_simpler_form_is_unchanged():
    fit, evidence, blocks = fit_of(bodies_recording(), EFFECTS["linear_drag"], start=0.0)
    assert simplified(fit, evidence, blocks, accept_all, NamingSettings()) == (fit, evidence)


@pytest.mark.e2e
def test_a_model_with_a_simpler_form_is_restored_from_json():
    recording = bodies_recording((0.2, 0.2))
    simple, _ = simplified(*fit_of(recording, EFFECTS["coupling"], start=0.1), accept_all, NamingSettings())
    model = model_of(estimate(simple, NoiseSettings()).fit, Bodies())
    again = DiagnosedModel.from_json(model.to_json(), simulation=Bodies())
    torch.testing.assert_close(again(recording)["left"], model(recording)["left"])


def test_every_simpler_form_has_fewer_parameters():
    nested = [effect for effect in DYNAMICS if effect.simpler is not None]
    assert {effect.id for effect in nested} == {"coupling", "sensor_lag", "sensor_clock_drift"}
    prepared = Bodies().prepare(bodies_recording())
    for effect in nested:
        (term, *_) = candidate_terms(prepared, (), (effect,))
        context = term.context(prepared, prepared.signals(prepared.start(), {})[term.port])
        simple = replace(term, effect=effect.simpler)
        one, two = simple.size(context), term.size(context)
        assert (one, two) == (1, 2)


class Slide(Dynamics):
    """A slide under a force of alternating sign, without friction."""

    states = ("place", "speed")
    inputs = ("force",)
    units = {"place": "m", "speed": "m/s", "force": "N"}
    parameters = {"gain": Parameter(1.0, lower=0.0), "spring": Parameter(1.0, lower=0.0)}
    input_hold = "held"

    def derivative(self, time, x, u, p):
        return {"place": x.speed, "speed": p.gain * u.force - p.spring * x.place}


def test_load_dependent_friction_without_load_dependence_is_simplified_to_dry_friction():
    time = STEP * torch.arange(N, dtype=torch.float64)
    force = torch.sin(0.7 * time)
    place, speed, places = 0.0, 0.0, []
    for now in force.tolist():
        places.append(place)
        for _ in range(FINE):
            speed += STEP / FINE * (now - place - 0.2 * math.tanh(speed / 0.01))
            place += STEP / FINE * speed
    noise = 0.005 * torch.randn(N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prepared = Slide().prepare(
        Recording({"time": time, "force": force, "place": torch.tensor(places).double() + noise})
    )
    (*_, term) = candidate_terms(prepared, (), (EFFECTS["load_dependent_friction"],))  # the steepest
    base = fitted(JointModel(prepared), prepared.start())
    fit = fitted(base.model.with_term(term), torch.cat([base.parameters, torch.zeros(2).double()]), base.bound)
    blocks = blocks_of(N, 1, ConfirmationSettings())
    simple, _ = simplified(fit, held_out(fit, blocks), blocks, accept_all, NamingSettings())
    (found,) = simple.model.terms
    assert (found.effect.id, found.port) == ("coulomb_friction", "rate of speed")
    assert found.key in {t.key for t in candidate_terms(prepared, (), DYNAMICS)}
    assert float(simple.parameters[-1]) == pytest.approx(0.2, rel=0.1)
