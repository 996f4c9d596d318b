"""The ceiling: a smooth correction by all columns, scored on held-out blocks."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.held_out import Evidence, blocks_of, gain_interval, held_out
from mkc_torch.diagnosis.evidence.remaining import Ceiling, _answerable, ceiling, remaining
from mkc_torch.diagnosis.evidence.smooth_curves import curves_of, legendre, smooth_tangents
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Driver, Term, find_drivers
from mkc_torch.diagnosis.settings import ConfirmationSettings, DriverSettings, EvidenceSettings
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.simulation.tumbling import tumbling

N = 1500
TIME = np.arange(N) / 50.0
LOAD = np.sin(2.0 * np.pi * TIME / 3.7) + 0.4 * np.sin(2.0 * np.pi * TIME / 0.83)
GAIN = np.array([0.5, -0.4, 0.6])
NOISE = 0.4


def walks(count, seed=0, size=N):
    """Return random walks that do not influence the sensor, as columns."""
    random = np.random.default_rng(seed)
    return {f"column_{k}": np.cumsum(random.standard_normal(size)) for k in range(count)}


def outliers(seed=3, share=0.1):
    random = np.random.default_rng(seed)
    return 15.0 * random.standard_normal((N, 3)) * (random.random((N, 1)) < share)


def fitted_case(sensor=0.0, *, use="norm", seed=0, **columns):
    """Return the fit of the simulation without effects, the drivers and the blocks."""
    recording = tumbling(N, noise=NOISE, sensor=sensor + outliers(seed + 3), seed=seed, attitude=True, **columns)
    simulation = Magnetometer(use=use)
    prepared = simulation.prepare(recording)
    fit = fitted(JointModel(prepared), prepared.start())
    return (
        fit,
        find_drivers(prepared.recording, simulation.columns, DriverSettings()).drivers,
        blocks_of(N, 3, ConfirmationSettings()),
    )


def lower_end_of_gain(better, worse, blocks):
    difference = better.log_likelihood - worse.log_likelihood
    return gain_interval(difference, blocks.block, torch.Generator().manual_seed(0))[1][0]


def sensor_change(trace):
    return GAIN * trace[:, None]


@pytest.fixture(scope="module")
def ceiling_of_noise():
    fit, drivers, blocks = fitted_case(load=LOAD, **walks(4))
    return held_out(fit, blocks), ceiling(fit.model, fit, drivers, blocks), blocks


@pytest.mark.parametrize("curve", [lambda x: 2.0 * x, lambda x: 4.0 * x**3 - 2.0 * x, lambda x: np.sin(3.0 * x)])
def test_the_ceiling_includes_a_nonlinear_effect_of_a_column(curve, ceiling_of_noise):
    fit, drivers, blocks = fitted_case(sensor_change(curve(LOAD)), load=LOAD, **walks(4))
    found, alone = ceiling(fit.model, fit, drivers, blocks), held_out(fit, blocks)
    assert found.columns == ("load",)
    assert lower_end_of_gain(found.evidence, alone, blocks) > 0.05
    # nearly as good as on a recording without an effect
    nothing = float(ceiling_of_noise[0].log_likelihood.mean())
    assert float(found.evidence.log_likelihood.mean()) == pytest.approx(nothing, abs=0.1)
    assert float(found.evidence.d[0]) == pytest.approx(NOISE, rel=0.15)


def test_the_ceiling_includes_an_effect_on_a_vector_with_a_prior():
    fit, drivers, blocks = fitted_case(sensor_change(LOAD), use="attitude", load=LOAD, **walks(4))
    found = ceiling(fit.model, fit, drivers, blocks)
    assert found.columns == ("load",)
    assert found.evidence.residual.shape == (N, 3)
    np.testing.assert_allclose(found.evidence.d, NOISE, rtol=0.15)


def test_the_ceiling_includes_a_drift_without_a_column():
    fit, drivers, blocks = fitted_case(4.0 * sensor_change(np.tanh(TIME / 10.0)), load=LOAD)
    found = ceiling(fit.model, fit, drivers, blocks)
    assert found.columns == ()
    assert lower_end_of_gain(found.evidence, held_out(fit, blocks), blocks) > 0.1


def test_the_ceiling_of_noise_has_no_columns_and_no_gain(ceiling_of_noise):
    alone, found, _ = ceiling_of_noise
    assert found.columns == ()
    assert float(found.evidence.log_likelihood.mean()) == pytest.approx(float(alone.log_likelihood.mean()), abs=0.003)


def test_sixty_unrelated_columns_gain_nothing_on_held_out_blocks():
    fit, drivers, blocks = fitted_case(**walks(60, seed=1))
    found = ceiling(fit.model, fit, drivers, blocks)
    difference = found.evidence.log_likelihood - held_out(fit, blocks).log_likelihood
    assert float(difference.mean()) < 0.005


def test_the_driver_is_selected_among_sixty_unrelated_columns():
    fit, drivers, blocks = fitted_case(sensor_change(LOAD), **walks(60, seed=1), load=LOAD)
    found = ceiling(fit.model, fit, drivers, blocks)
    assert found.columns == ("load",)
    tangents = smooth_tangents(
        fit.model, fit.parameters, curves_of(drivers, N), fit.weights / fit.d.square(), blocks
    ).tangents
    assert tangents.shape[-1] <= 300


def test_the_ceiling_given_a_model_is_that_of_its_residual():
    """The model parameters are refitted with the curves, so columns already in the model gain nothing."""
    fit, drivers, blocks = fitted_case(sensor_change(LOAD), load=LOAD, **walks(2))
    effect = next(e for e in CATALOGUE if e.id == "driver_offset")
    model = fit.model.with_term(Term(effect, next(d for d in drivers if d.columns == ("load",)), {}))
    corrected = fitted(model, torch.cat([fit.parameters, torch.zeros(3, dtype=torch.float64)]), fit.bound)
    assert ceiling(fit.model, corrected, drivers, blocks).columns == ("load",)
    with_model = ceiling(model, corrected, drivers, blocks)
    assert with_model.columns == ()
    assert float(with_model.evidence.log_likelihood.mean()) == pytest.approx(
        float(held_out(corrected, blocks).log_likelihood.mean()), abs=0.003
    )


def line_and_drivers(count):
    generator = torch.Generator().manual_seed(5)
    line = Line(600)
    columns = torch.randn(600, count, generator=generator, dtype=torch.float64)
    columns[:, 0] = torch.sin(4.0 * line.time * line.time)
    names = [f"column_{k}" for k in range(count)]
    drivers = [Driver((name,), "any", c.unsqueeze(-1), torch.zeros(1), ("",)) for name, c in zip(names, columns.T)]  # noqa: B905
    line.measured = line.measured + 8.0 * (columns[:, :1] * torch.tensor([1.0])).cumsum(0) / 600
    return line, drivers


@pytest.mark.e2e
@pytest.mark.parametrize("count", [2, 30])
def test_the_ceiling_at_a_port_that_is_not_pointwise_includes_the_driver(count):
    """With all columns as candidates, and with a preselection of candidates by reverse mode."""
    line, drivers = line_and_drivers(count)
    fit, blocks = fitted(JointModel(line), line.start()), blocks_of(600, 3, ConfirmationSettings())
    found = ceiling(fit.model, fit, drivers, blocks)
    assert "column_0" in found.columns
    level = stats.norm(0.0, 0.1).logpdf(found.evidence.residual.numpy()).sum(-1).mean()
    assert float(found.evidence.log_likelihood.mean()) == pytest.approx(level, abs=0.1)
    np.testing.assert_allclose(found.evidence.d, 0.1, atol=0.015)


def test_held_out_samples_do_not_influence_their_prediction():
    line, corrupted, blocks = Line(300), Line(300), blocks_of(300, 1, ConfirmationSettings())
    hidden = ~blocks.train[2]
    corrupted.measured[hidden] += 0.7
    first = fitted(JointModel(line), line.start())
    second = fitted(JointModel(corrupted), first.parameters, first.bound, graduate=False)
    before, after = (ceiling(fit.model, fit, (), blocks).evidence for fit in (first, second))
    seen = blocks.fold == 2
    torch.testing.assert_close(
        after.residual[seen] - before.residual[seen], torch.full_like(before.residual[seen], 0.7), rtol=0.0, atol=0.1
    )
    assert after.left_out == pytest.approx(held_out(first, blocks).left_out)


def test_curves_are_legendre_polynomials():
    x = np.linspace(-3.0, 5.0, 101)
    expected = np.stack([np.polynomial.Legendre.basis(k)((x - 1.0) / 4.0) for k in range(1, 6)], -1)
    found = legendre(torch.as_tensor(x).unsqueeze(-1), 5)[:, 0]
    np.testing.assert_allclose(found, expected - expected.mean(0), atol=1e-12)


@pytest.mark.e2e
def test_a_diagnosis_has_a_ceiling_and_warns_of_the_remaining_trend_along_a_column():
    recording = tumbling(N, noise=NOISE, sensor=sensor_change(LOAD) + outliers(), load=LOAD, **walks(2))
    found = diagnose(Magnetometer(), recording, surrogates=19, max_findings=0)
    assert found.verdict == "unexplained"
    assert found.ceiling.rmse < 0.8 * found.corrected.rmse
    assert found.ceiling.log_likelihood > found.corrected.log_likelihood + 0.1
    assert len([w for w in found.warnings if "smooth trend along load" in w]) == 1


@pytest.fixture(scope="module", params=range(5))
def drifting_offset(request):
    """Return a drifting offset, and columns that drift in the same way but independently of it."""
    random = np.random.default_rng(100 + request.param)
    offset = 2.0 * NOISE * np.cumsum(random.standard_normal((N, 3)), 0) / np.sqrt(N)
    fit, drivers, blocks = fitted_case(offset, seed=request.param, **walks(5, seed=request.param))
    return fit, drivers, blocks, ceiling(fit.model, fit, drivers, blocks)


def test_drifting_noise_is_not_reported_as_remaining(drifting_offset):
    fit, drivers, blocks, alone = drifting_offset
    corrected = held_out(fit, blocks)
    assert lower_end_of_gain(alone.evidence, corrected, blocks) > 0.0
    assert remaining(alone, corrected, fit, drivers, blocks, 0, EvidenceSettings()) == ()


def test_a_drifting_column_that_matters_is_distinguished_from_drifting_noise():
    random = np.random.default_rng(7)
    offset = NOISE * np.cumsum(random.standard_normal((N, 3)), 0) / np.sqrt(N)
    fit, drivers, blocks = fitted_case(offset + sensor_change(LOAD), load=LOAD, **walks(3, seed=7))
    alone = ceiling(fit.model, fit, drivers, blocks)
    assert "load" in remaining(alone, held_out(fit, blocks), fit, drivers, blocks, 0, EvidenceSettings())


def ceiling_with_gain(gain, columns=("load",)):
    noise = 0.1 * torch.randn(N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    nothing = torch.zeros(5, 0)
    return Ceiling(Evidence(gain + noise, nothing, nothing, nothing, nothing, 0.2), columns)


@pytest.mark.parametrize(
    ("gain", "by_time", "columns", "text"),
    [
        (0.05, 0.0, ("load",), ("load",)),
        (0.005, 0.0, ("load",), ()),  # too small to matter
        (0.05, 0.05, ("load",), ()),
        (0.05, 0.0, (), ()),
        (-0.05, 0.0, ("load",), ()),
    ],
)
def test_a_remaining_column_has_a_minimum_gain_above_that_of_time(monkeypatch, gain, by_time, columns, text):
    monkeypatch.setattr("mkc_torch.diagnosis.evidence.remaining.ceiling", lambda *_: ceiling_with_gain(by_time, ()))
    fit = SimpleNamespace(model=SimpleNamespace(terms=()))
    assert (
        remaining(
            ceiling_with_gain(gain, columns),
            ceiling_with_gain(0.0).evidence,
            fit,
            (),
            blocks_of(N, 3, ConfirmationSettings()),
            0,
            EvidenceSettings(),
        )
        == text
    )


@pytest.mark.parametrize(("residual", "usable"), [(5.0, True), (2e38, False), (math.nan, False)])
def test_the_ceiling_starts_from_the_baseline_if_the_final_parameters_diverge(residual, usable):
    model = SimpleNamespace(size=1, residual=lambda _: torch.tensor([[0.1], [residual]]))
    base = SimpleNamespace(model=model)
    final = SimpleNamespace(parameters=torch.tensor([1.0, 2.0]), bound=torch.tensor([1.0]))
    assert _answerable(base, final) is (final if usable else base)
