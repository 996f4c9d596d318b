"""Goodness of fit of each output: sizes, shares, noise floors and trivial predictions."""

import math
from types import SimpleNamespace

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, pooled, poor_fits, size_of
from mkc_torch.simulation import Magnetometer, Static
from mkc_torch.simulation.ports import Port
from tests.diagnosis.factory import make_goodness_of_fit

N = 4000
TIME = torch.arange(N, dtype=torch.float64) / 50.0
WAVE = torch.sin(TIME).unsqueeze(-1)


def randn(*size, seed=0):
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def prepared_stub(measured, channels=("angle",), unit="rad"):
    recording = SimpleNamespace(names=channels)
    return SimpleNamespace(
        measured=measured, channels=channels, unit=unit, ports={}, recording=recording, recorded=None, time=TIME
    )


def fit_of(measured, residual, declared=None, **more):
    return goodness_of_fit(prepared_stub(measured, **more), residual, declared or {})


def test_the_size_of_normal_noise_is_its_standard_deviation():
    values = randn(N, 2) * torch.tensor([0.3, 20.0], dtype=torch.float64)
    torch.testing.assert_close(size_of(values), torch.tensor([0.3, 20.0]).double(), rtol=0.04, atol=0.0)


def test_the_size_clips_outliers_at_two_and_a_half_standard_deviations():
    values = randn(N, 1)
    clean = float(size_of(values))
    values[:40] = 1000.0
    share = 40 / N
    assert float(size_of(values)) == pytest.approx(clean * (1.0 + 0.5 * share * 6.25), rel=0.03)


def test_the_size_of_a_mostly_zero_series_is_its_root_mean_square():
    values = torch.zeros(N, 1).double()
    values[:100] = 2.0
    assert float(size_of(values)) == pytest.approx(2.0 * (100 / N) ** 0.5)
    assert float(size_of(torch.zeros(N, 1).double())) == 0.0


def test_an_offset_counts_in_the_residual_but_not_in_the_variation():
    fit = fit_of(5.0 + WAVE, torch.full((N, 1), 0.1).double())[0]
    assert fit.residual == pytest.approx(0.1, rel=0.02)
    assert fit.variation == pytest.approx(0.5**0.5, rel=0.02)


@pytest.mark.parametrize(("size", "share"), [(0.1, 0.98), (0.5**0.5, 0.0), (1.0, -1.0)])
def test_the_explained_share_is_negative_if_the_mean_is_better(size, share):
    fit = fit_of(WAVE, size * randn(N, 1))[0]
    assert fit.explained == pytest.approx(share, abs=0.08)


def test_each_output_has_its_own_sizes_and_unit():
    parts = {"angle": "rad", "speed": "rad/s"}
    port = Port(("angle", "speed"), "", carries=("angle", "speed"), parts={k: k for k in parts}, part_units=parts)
    prepared = prepared_stub(torch.cat([WAVE, 100.0 * WAVE], -1), ("angle", "speed"), "")
    prepared.ports = {"output": port}
    fit, other = goodness_of_fit(prepared, torch.cat([0.7 * WAVE, 10.0 * WAVE], -1), {})
    assert (fit.output, fit.unit, other.output, other.unit) == ("angle", "rad", "speed", "rad/s")
    assert fit.explained == pytest.approx(0.51, abs=0.01)
    assert other.explained == pytest.approx(0.99, abs=0.01)
    assert other.residual == pytest.approx(10.0 * 0.5**0.5, rel=0.02)
    assert poor_fits((fit, other), 0.6) == (fit,)


def test_the_floor_is_that_of_the_recorded_samples_whatever_the_residual():
    measured = WAVE + 0.02 * randn(N, 1)
    for residual in (0.02 * randn(N, 1), 2.0 * WAVE, 30.0 * WAVE.cumsum(0)):
        fit = fit_of(measured, residual)[0]
        assert fit.floor_source == "samples"
        assert fit.noise_floor == pytest.approx(0.02, rel=0.1)


def test_coarse_quantisation_sets_the_floor():
    fit = fit_of((WAVE * 20.0).round() / 20.0, 0.3 * WAVE)[0]
    assert fit.floor_source == "quantisation"
    assert fit.noise_floor == pytest.approx(0.05 / 12.0**0.5)
    assert fit.seen_noise == pytest.approx(0.05)


def test_fine_quantisation_does_not_set_the_floor():
    fit = fit_of(((WAVE + 0.1 * randn(N, 1)) * 20.0).round() / 20.0, 0.3 * WAVE)[0]
    assert (fit.noise_floor, fit.floor_source) == (pytest.approx(0.1, rel=0.06), "samples")
    assert fit.seen_noise == fit.noise_floor


def test_a_declared_floor_overrides_estimates():
    measured = torch.cat([WAVE, WAVE], -1) + 0.1 * randn(N, 2)
    fit, other = fit_of(measured, 0.3 * randn(N, 2), {"rate": 0.001}, channels=("angle", "rate"), unit="")
    assert (fit.noise_floor, fit.floor_source) == (pytest.approx(0.1, rel=0.1), "samples")
    assert (other.noise_floor, other.floor_source) == (0.001, "declared")


def test_the_floor_of_samples_in_no_order_of_time_is_unknown():
    """A static model of a shuffled table: its samples scatter far more than its residual."""
    shuffled = WAVE[torch.randperm(N, generator=torch.Generator().manual_seed(0))]
    assert math.isnan(fit_of(shuffled, 0.01 * randn(N, 1))[0].noise_floor)


def test_residuals_of_trivial_predictions():
    fit = fit_of(7.0 + WAVE, 0.1 * randn(N, 1))[0]
    assert fit.rmse_of_mean == pytest.approx(float(WAVE.std()), rel=0.02)
    assert fit.rmse_of_last_value == pytest.approx(float(WAVE.diff(dim=0).square().mean().sqrt()), rel=0.02)


@pytest.mark.parametrize("lost", [None, torch.full((N, 1), torch.nan).double()])
def test_a_diverging_simulation_explains_nothing(lost):
    fit = fit_of(WAVE + 0.02 * randn(N, 1), lost)[0]
    assert fit.explained == 0.0
    assert fit.residual == fit.variation == pytest.approx(0.5**0.5, rel=0.02)
    # the noise is estimated from the recording itself
    assert fit.noise_floor == pytest.approx(0.02, rel=0.1)


def test_a_constant_output_is_not_explained():
    fit = fit_of(torch.full((N, 1), 3.0).double(), 0.1 * randn(N, 1))[0]
    assert (fit.variation, fit.explained) == (0.0, 0.0)


def test_the_variation_of_a_length_is_that_of_isotropic_readings():
    scattered = 30.0 * randn(N, 3)
    left = torch.linalg.vector_norm(scattered, dim=-1, keepdim=True)
    fit = fit_of(scattered, left - left.mean(), channels=("norm",), unit="µT")[0]
    assert fit.output == "norm"
    assert fit.variation == pytest.approx(float(left.std()), rel=0.03)
    assert fit.explained == pytest.approx(0.0, abs=0.08)
    turning = torch.cat([TIME.sin().unsqueeze(-1), TIME.cos().unsqueeze(-1), 0.0 * WAVE], -1) * 50.0
    assert fit_of(turning, 0.5 * randn(N, 1), channels=("norm",), unit="µT")[0].explained > 0.99


def test_without_a_recorded_column_for_each_output_there_is_no_goodness_of_fit():
    assert fit_of(randn(N, 3), randn(N, 2), channels=("a", "b")) == ()


def test_an_output_of_unknown_share_is_a_poor_fit():
    known = make_goodness_of_fit(explained=0.95)
    assert poor_fits((known, make_goodness_of_fit(explained=torch.nan)), 0.5)[0] is not known
    assert poor_fits((known,), 0.95) == ()


def test_the_floor_is_at_least_the_quantisation():
    rounded = ((20.0 + 5.0 * WAVE + 0.001 * randn(N, 1)) * 10.0).round() / 10.0
    fit = fit_of(rounded, 0.3 * WAVE)[0]
    assert (fit.noise_floor, fit.floor_source) == (pytest.approx(0.1 / 12.0**0.5), "quantisation")


def test_the_floor_of_computed_values_is_unknown():
    assert math.isnan(fit_of(WAVE, 0.3 * WAVE)[0].noise_floor)
    assert fit_of(WAVE, 0.3 * WAVE, {"angle": 1e-6})[0].noise_floor == 1e-6


def test_pooled_shares_count_negative_shares_as_zero():
    known = (
        make_goodness_of_fit(explained=0.8),
        make_goodness_of_fit(explained=0.4),
        make_goodness_of_fit(explained=-3.0),
    )
    assert pooled(known) == pytest.approx(0.4)
    assert pooled(known, -1.0) == pytest.approx(0.2 / 3.0)
    assert pooled(()) == 0.0


QUATERNION = ("q_w", "q_x", "q_y", "q_z")


def smooth(count, seed):
    g = torch.Generator().manual_seed(seed)
    rate, phase = 0.3 + 2.0 * torch.rand(4, count, generator=g), 6.0 * torch.rand(4, count, generator=g)
    return torch.sin(TIME[:600, None, None] * 2.5 * rate + phase).sum(1)


def turning_sensor(*, yaw=False, field=None):
    """Return a recorded attitude, and a rotated field of 50 µT; or another field."""
    attitude = smooth(4, 1)
    if yaw:
        turns = TIME[:600]
        tilts = 0.02 * torch.sin(3.0 * turns), 0.02 * torch.cos(2.3 * turns)
        attitude = torch.stack([torch.cos(turns), *tilts, torch.sin(turns)], -1)
    attitude = attitude / attitude.norm(dim=-1, keepdim=True)
    w, v = attitude[:, :1], -attitude[:, 1:]
    ambient = torch.tensor([20.0, 5.0, -43.0]).double().expand(600, 3)
    seen = ambient + 2.0 * torch.linalg.cross(v, torch.linalg.cross(v, ambient) + w * ambient)
    seen = (seen if field is None else field) + 0.3 * randn(600, 3)
    columns = {"time": 2.5 * TIME[:600]} | dict(zip(("mag_x", "mag_y", "mag_z"), seen.unbind(-1), strict=True))
    return columns, dict(zip(QUATERNION, attitude.unbind(-1), strict=True))


def verdict_of(simulation, columns):
    return diagnose(simulation, Recording(columns), effects=(), surrogates=19)


def test_a_field_unrelated_to_the_attitude_is_unfit():
    columns, attitude = turning_sensor(field=20.0 * smooth(3, 5))
    result = verdict_of(Magnetometer(), columns | attitude)
    assert pooled(result.environment.goodness_of_fit) < 0.35
    assert result.verdict == "unfit"


def test_a_sensor_that_hardly_tilts_has_a_good_fit_in_all_axes():
    columns, attitude = turning_sensor(yaw=True)
    result = verdict_of(Magnetometer(), columns | attitude)
    assert {fit.variation for fit in result.environment.goodness_of_fit} == {
        result.environment.goodness_of_fit[0].variation
    }
    assert all(fit.explained > 0.99 for fit in result.environment.goodness_of_fit)
    assert result.verdict == "adequate"


@pytest.mark.parametrize(("useful", "expected"), [(True, "adequate"), (False, "unfit")])
def test_a_static_vector_is_adequate_if_it_follows_the_recording_and_else_unfit(useful, expected):
    class Vector(Static):
        inputs, outputs, parameters = ("a",), ("x", "y", "z"), {"k": 1.0}

        def output(self, time, u, p):
            return {"x": p.k * u.a, "y": -p.k * u.a, "z": p.k * u.a**2}

    a = smooth(1, 3)
    seen = torch.cat([2.0 * a, -2.0 * a, 2.0 * a**2], -1) if useful else smooth(3, 8)
    seen = seen + 0.05 * randn(600, 3)
    columns = {"time": 2.5 * TIME[:600], "a": a[:, 0]} | dict(zip("xyz", seen.unbind(-1), strict=True))
    assert verdict_of(Vector(), columns).verdict == expected
