"""The test for heavy tails: its rate of false rejections, its power, and the share of errors beyond three scales."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.stats import chi2, norm
from torch import Tensor

from mkc_torch import MKCDistribution, fit_density
from mkc_torch.density import ChannelTails, Tails, assess_tails
from mkc_torch.density.likelihood import DensityState, energy_derivatives, normaliser_derivatives
from mkc_torch.density.tails import GAUSSIAN_BELOW, _share_beyond, percent_with_error, time_series_tails
from tests.draws import normal, uniform

FIELDS = [f.name for f in dataclasses.fields(Tails)]


def with_outliers(seed: int, share: float, *shape: int) -> Tensor:
    """Standard normal errors, each replaced with probability ``share`` by a uniform error within ±20."""
    wrong = uniform(seed + 1, *shape) < share
    return torch.where(wrong, 40.0 * uniform(seed + 2, *shape) - 20.0, normal(seed, *shape))


def mkc_draws(sigma: float, bound: float, seed: int, *shape: int) -> tuple[Tensor, float]:
    """Draws of the MKC density of scale 1, and its exact probability beyond 3 d."""
    density = MKCDistribution(*(torch.tensor(v, dtype=torch.float64) for v in (sigma, 1.0, bound)))
    exact = 2.0 * float(density.cdf(torch.tensor(-3.0, dtype=torch.float64)))
    grid = torch.linspace(-bound, bound, 20_001, dtype=torch.float64)
    # faster than icdf
    return torch.from_numpy(np.interp(uniform(seed, *shape), density.cdf(grid), grid)), exact


def field_values(tails: Tails) -> list[float]:
    return [float(getattr(tails, name)) for name in FIELDS]


# the test


def test_the_critical_value_is_the_five_per_cent_point_of_the_mixture():
    assert 0.5 * chi2.sf(GAUSSIAN_BELOW, 1) == pytest.approx(0.05, abs=2e-4)


@pytest.mark.parametrize(("count", "draws", "most"), [(30, 400, 0.05), (500, 400, 0.06), (2000, 150, 0.09)])
def test_gaussian_residuals_are_rejected_in_no_more_than_five_per_cent_of_draws(count, draws, most):
    tails = assess_tails(normal(0, draws, count, 1), bound=10.0)
    assert float((~tails.is_gaussian).double().mean()) <= most


@pytest.mark.parametrize("share", [0.02, 0.05, 0.3])
def test_outliers_are_detected_as_heavy_tails(share):
    tails = assess_tails(with_outliers(0, share, 200, 500, 1), bound=20.0)
    assert float((~tails.is_gaussian).double().mean()) > 0.95


@pytest.mark.parametrize("error", [2.0 * uniform(0, 500, 1) - 1.0, torch.ones(50, 1), torch.sign(normal(0, 300, 1))])
def test_tails_lighter_than_a_gaussians_are_not_rejected(error):
    tails = assess_tails(error)
    assert bool(tails.is_gaussian)
    assert float(tails.likelihood_ratio) == 0.0


def test_the_ratio_is_twice_the_difference_of_log_likelihoods_on_the_same_domain():
    error = torch.stack([with_outliers(0, 0.05, 300), normal(3, 300)], -1)
    for bound in (20.0, 60.0):
        mkc, gaussian = fit_density(error, bound=bound), fit_density(error, bound=bound, sigma=math.inf)
        tails = assess_tails(error, bound=bound)
        expected = 600.0 * (mkc.log_likelihood - gaussian.log_likelihood)
        torch.testing.assert_close(tails.likelihood_ratio, expected, rtol=1e-9, atol=1e-8)
        torch.testing.assert_close((tails.sigma, tails.d), (mkc.sigma, mkc.d), rtol=1e-5, atol=0)
        torch.testing.assert_close(tails.bound, mkc.bound)


def test_the_verdict_depends_on_the_ratio_alone():
    tails = assess_tails(normal(1, 300, 100, 1), bound=12.0)
    assert bool((tails.is_gaussian == (tails.likelihood_ratio < GAUSSIAN_BELOW)).all())
    # a finite sigma alone is not evidence of a heavy tail
    assert float(torch.isfinite(tails.sigma[tails.is_gaussian]).double().mean()) > 0.2


# the share beyond 3 d


@pytest.mark.parametrize(("sigma", "bound"), [(1.5, 10.0), (2.0, 10.0), (2.5, 40.0)])
@pytest.mark.parametrize("count", [200, 1000])
def test_the_share_is_within_two_errors_of_the_exact_one_in_95_per_cent_of_draws(sigma, bound, count):
    error, exact = mkc_draws(sigma, bound, 0, 200, count, 1)
    tails = assess_tails(error, bound=bound)
    covered = (tails.share_beyond - exact).abs() <= 1.96 * tails.share_error
    assert 0.90 <= float(covered.double().mean()) <= 0.99
    # the reported errors equal the observed errors
    assert float(tails.share_error.mean() / tails.share_beyond.std()) == pytest.approx(1.0, abs=0.15)


def test_an_undetected_tail_is_mostly_within_two_errors():
    error, exact = mkc_draws(3.5, 10.0, 0, 300, 500, 1)
    tails = assess_tails(error, bound=10.0)
    assert 0.3 < float(tails.is_gaussian.double().mean()) < 0.8
    covered = (tails.share_beyond - exact).abs() <= 2.0 * tails.share_error
    assert float(covered.double().mean()) > 0.8


def test_the_share_is_computed_from_the_fitted_density():
    error = with_outliers(4, 0.1, 400, 1)
    tails = assess_tails(error, bound=25.0)
    density = MKCDistribution(tails.sigma, tails.d, tails.bound)
    torch.testing.assert_close(tails.share_beyond, 2.0 * density.cdf(-3.0 * tails.d), rtol=1e-10, atol=0)
    assert float(tails.share_observed) == float((error.abs() > 3.0 * tails.d).double().mean())


def test_the_share_of_a_gaussian_verdict_is_the_gaussian_share():
    tails = assess_tails(normal(1, 20, 400, 1), bound=10.0)
    share = tails.share_beyond[tails.is_gaussian]
    torch.testing.assert_close(share, torch.full_like(share, 2.0 * norm.sf(3.0)), rtol=1e-6, atol=0)
    assert bool((tails.share_error > 0).all())
    # a Gaussian truncated at 2.5 standard deviations has no mass beyond 3
    narrow = assess_tails(normal(1, 400, 1).clamp(-2.0, 2.0), bound=2.3)
    assert field_values(narrow)[1:4] == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("sigma", "length"), [(1.2, 12.0), (2.5, 8.0), (6.0, 15.0)])
def test_the_error_equals_the_delta_method_with_the_expected_information(sigma, length):
    kappa, log_d, log_bound = (torch.tensor([v], dtype=torch.float64) for v in (sigma**-2, 0.0, math.log(length)))
    at = torch.cat([kappa, log_d]).requires_grad_()
    d = torch.exp(at[1])
    share = 2.0 * MKCDistribution(at[0].rsqrt(), d, length).cdf(-3.0 * d)
    (slope,) = torch.autograd.grad(share, at)
    # the mean Hessian of the negative log-likelihood over quantiles, which represent the density
    quantiles = MKCDistribution(sigma, 1.0, length).icdf((torch.arange(50_000).double() + 0.5) / 50_000)
    energy = energy_derivatives(quantiles.unsqueeze(-1), None, kappa, log_d)
    total = [float(a + b) for a, b in zip(energy, normaliser_derivatives(kappa, log_d, log_bound), strict=True)]
    information = torch.tensor([[total[3], total[4]], [total[4], total[5]]], dtype=torch.float64)
    expected = (slope @ torch.linalg.solve(100.0 * information, slope)).sqrt()

    state = DensityState(kappa, log_d, log_bound, log_d - 9.0, log_d, log_d)
    _, error = _share_beyond(state, torch.tensor([100.0], dtype=torch.float64))
    assert float(error) == pytest.approx(float(expected), rel=2e-3)


# channels, batches, weights, dtypes, units


def test_channels_and_batches_are_assessed_independently():
    error = torch.stack([with_outliers(5 * k, 0.03 * k, 150) for k in range(6)]).reshape(2, 3, 150).mT
    tails = assess_tails(error, bound=torch.tensor([20.0, 30.0, 40.0], dtype=torch.float64))
    for name in FIELDS:
        assert getattr(tails, name).shape == (2, 3)
    for i in range(2):
        for k in range(3):
            alone = assess_tails(error[i, :, k : k + 1], bound=20.0 + 10.0 * k)
            assert field_values(alone) == pytest.approx(
                [float(getattr(tails, name)[i, k]) for name in FIELDS], rel=1e-4
            )


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_float32_residuals_give_the_float64_numbers_as_float32(share):
    error = with_outliers(0, share, 400, 2).float()
    single, double = assess_tails(error, bound=20.0), assess_tails(error.double(), bound=20.0)
    for name in FIELDS:
        first, other = getattr(single, name), getattr(double, name)
        assert first.dtype == (torch.bool if name == "is_gaussian" else torch.float32)
        torch.testing.assert_close(first.double(), other.double(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("factor", [1e-12, 1e9])
def test_the_test_does_not_depend_on_the_unit_of_the_residuals(factor):
    error = with_outliers(0, 0.05, 300, 1)
    first, other = assess_tails(error, bound=20.0), assess_tails(factor * error, bound=factor * 20.0)
    assert float(other.d) == pytest.approx(factor * float(first.d), rel=1e-6)
    for name in ("likelihood_ratio", "share_beyond", "share_error", "share_observed", "sigma", "count"):
        assert float(getattr(other, name)) == pytest.approx(float(getattr(first, name)), rel=1e-5), name


def test_a_weight_of_zero_leaves_a_residual_out():
    error = with_outliers(0, 0.05, 300, 1)
    junk = torch.cat([error, torch.full((80, 1), 1e4, dtype=torch.float64)])
    weight = torch.cat([torch.ones(300), torch.zeros(80)]).unsqueeze(-1)
    assert field_values(assess_tails(junk, weight)) == pytest.approx(field_values(assess_tails(error)), rel=1e-6)


def test_the_scale_of_weights_is_irrelevant_and_uneven_weights_reduce_the_count():
    error, weight = with_outliers(0, 0.05, 400, 1), uniform(7, 400, 1)
    tails = assess_tails(error, weight, bound=20.0)
    assert float(tails.count) == pytest.approx(float(weight.sum() ** 2 / weight.square().sum()))
    assert field_values(assess_tails(error, 1e5 * weight, bound=20.0)) == pytest.approx(field_values(tails), rel=1e-5)


def test_weighted_gaussian_residuals_are_rejected_in_no_more_than_five_per_cent_of_draws():
    error, weight = normal(2, 300, 400, 1), uniform(7, 300, 400, 1)
    tails = assess_tails(error, weight, bound=10.0)
    assert float((~tails.is_gaussian).double().mean()) <= 0.06


def test_fewer_independent_residuals_give_a_smaller_ratio():
    error = with_outliers(0, 0.05, 400, 1)
    whole, quarter = assess_tails(error, bound=20.0), assess_tails(error, bound=20.0, count=100.0)
    assert float(quarter.likelihood_ratio) == pytest.approx(0.25 * float(whole.likelihood_ratio))
    assert float(quarter.share_error) == pytest.approx(2.0 * float(whole.share_error))
    assert float(quarter.count) == 100.0


def test_arrays_are_accepted():
    error = with_outliers(0, 0.05, 300, 1)
    assert field_values(assess_tails(np.asarray(error), np.ones((300, 1)))) == pytest.approx(
        field_values(assess_tails(error))
    )


# the result of fit_density


def test_the_tails_of_a_density_fit_equal_their_assessment():
    error = torch.stack([with_outliers(0, 0.05, 300), normal(3, 300)], -1)
    weight = uniform(7, 300, 1)
    fit = fit_density(error, weight=weight, bound=25.0, d_min=0.01)
    assert fit.tails is fit.tails
    expected = assess_tails(error, weight, bound=25.0, d_min=0.01)
    for name in FIELDS:
        torch.testing.assert_close(getattr(fit.tails, name), getattr(expected, name))
    torch.testing.assert_close(fit.tails.bound, fit.bound)
    torch.testing.assert_close((fit.tails.sigma, fit.tails.d), (fit.sigma, fit.d), rtol=1e-5, atol=0)
    # the ratio compares free fits, whatever was fixed
    fixed = fit_density(error, weight=weight, bound=25.0, d_min=0.01, sigma=math.inf)
    torch.testing.assert_close(fixed.tails.likelihood_ratio, expected.likelihood_ratio)


def test_the_tails_use_a_copy_of_the_fitted_residuals():
    error = with_outliers(0, 0.05, 300, 1).requires_grad_()
    fit, expected = fit_density(error), assess_tails(error)
    with torch.no_grad():
        error.zero_()  # as if the caller overwrote its buffer
    assert field_values(fit.tails) == field_values(expected)
    assert not fit.tails.share_beyond.requires_grad


def test_a_density_fit_does_not_print_its_residuals():
    assert "_residuals" not in repr(fit_density(normal(0, 50, 1)))


# time series


def autoregressive(seed: int, phi: float, draws: int, count: int) -> Tensor:
    """Gaussian series of lag-one correlation ``phi`` and variance 1, (draws, count)."""
    white = normal(seed, draws, count)
    series = [white[:, 0]]
    for k in range(1, count):
        series.append(phi * series[-1] + math.sqrt(1.0 - phi * phi) * white[:, k])
    return torch.stack(series, -1)


def test_autocorrelated_gaussian_series_are_rejected_in_no_more_than_five_per_cent_of_draws():
    series = autoregressive(0, 0.9, 80, 1000)
    unadjusted = assess_tails(series.unsqueeze(-1), bound=10.0).is_gaussian
    assert float((~unadjusted).double().mean()) > 0.07
    rejected = sum(not channel.is_gaussian for channel in time_series_tails(series.mT))
    assert rejected <= 4


def test_outliers_of_an_autocorrelated_series_are_detected_as_heavy_tails():
    series = autoregressive(0, 0.9, 4, 1000)
    hit = uniform(3, 4, 1000) < 0.02
    found = time_series_tails(torch.where(hit, series + 8.0 * normal(5, 4, 1000), series).mT)
    assert not any(channel.is_gaussian for channel in found)


def test_an_exact_fit_has_no_tails():
    assert time_series_tails(torch.stack([normal(0, 50), torch.zeros(50).double()], -1)) == ()


# texts


def test_the_text_is_gaussian_or_the_share_of_errors_beyond_three_scales():
    error = torch.stack([normal(4, 500), with_outliers(0, 0.1, 500)], -1)
    tails = assess_tails(error, bound=20.0)
    gaussian, heavy = str(tails).splitlines()
    assert gaussian == "channel 0: Gaussian"
    share = percent_with_error(float(tails.share_beyond[1]), float(tails.share_error[1]))
    assert heavy == f"channel 1: heavy-tailed: {share} of the errors beyond 3 d (0.27 % if Gaussian)"
    assert str(assess_tails(error[:, :1], bound=20.0)) == "Gaussian"
    assert tails.channels[1].share_beyond == float(tails.share_beyond[1])


def test_the_verdict_of_plain_numbers_equals_that_of_the_tensors():
    assert ChannelTails(2.7, 0.0027, 0.001).is_gaussian
    assert not ChannelTails(2.72, 0.01, 0.001).is_gaussian
    assert str(ChannelTails(9.0, 0.0, 0.0)) == "heavy-tailed, on a domain that ends within 3 d"


@pytest.mark.parametrize(
    ("share", "error", "text"),
    [
        (0.041, 0.006, "4.1 ± 0.6 %"),
        (0.5, 0.11, "50 ± 11 %"),
        (0.0031, 1e-9, "0.3100 ± 0.0000 %"),
        (0, 0, "0.0 ± 0.0 %"),
    ],
)
def test_a_share_is_written_to_the_first_digit_of_its_error(share, error, text):
    assert percent_with_error(share, error) == text


# degenerate data


def test_a_channel_of_zeros_is_refused_by_its_number():
    error = torch.stack([normal(0, 50), torch.zeros(50).double()], -1)
    message = r"`error` with a residual .* not 0 in every channel .* in channel 1; an exact fit has no tails, leave"
    with pytest.raises(ValueError, match=message):
        assess_tails(error)
    fit = fit_density(error)
    with pytest.raises(ValueError, match=message):
        _ = fit.tails
    # only the zero residual has weight
    with pytest.raises(ValueError, match="channel 0"):
        assess_tails(torch.tensor([[0.0], [1.0]]), torch.tensor([[1.0], [0.0]]))


@pytest.mark.parametrize(
    "error",
    [
        torch.cat([1e-9 * normal(1, 400, 1), normal(0, 40, 1)]),
        torch.cat([torch.zeros(60, 1).double(), normal(0, 1, 1)]),
        torch.cat([normal(0, 400, 1), torch.full((4, 1), 1e9).double()]),
        normal(0, 2, 1),
        1e-170 * normal(0, 100, 1),
        1e100 * normal(0, 100, 1),
    ],
)
def test_degenerate_residuals_give_finite_numbers(error):
    tails = assess_tails(error)
    for name in FIELDS:
        assert not bool(getattr(tails, name).isnan().any()), name
    for name in ("likelihood_ratio", "share_error", "d"):
        assert bool(getattr(tails, name).isfinite().all()), name
    assert 0.0 <= float(tails.share_beyond) <= 1.0


def test_interpolated_residuals_are_heavy_tailed_with_the_share_of_the_others():
    tails = assess_tails(torch.cat([1e-9 * normal(1, 400, 1), normal(0, 40, 1)]), bound=10.0)
    assert not bool(tails.is_gaussian)
    assert float(tails.share_beyond) == pytest.approx(40 / 440, abs=2 * float(tails.share_error))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0.0}, r"`count` to be positive and finite but got 0\.0"),
        ({"count": 101.0}, r"`count` to be at most the number of residuals, 100, but got 101; .* leave it out"),
        ({"count": torch.ones(3)}, r"`count` to be a number or of shape \(m,\)"),
        ({"bound": 0.1}, "`bound` to be at least two robust scales"),
        ({"d_min": 1e9}, "`d_min` below the half-width"),
        ({"weight": torch.zeros(100, 1)}, "`weight` .* positive somewhere in every channel"),
        ({"error": normal(0, 100)}, r"`error` .* error\[:, None\]"),
        ({"error": normal(0, 100, 1) * math.nan}, "`error` to be finite"),
    ],
)
def test_arguments_out_of_range_are_refused_with_a_remedy(arguments, message):
    with pytest.raises(ValueError, match=message):
        assess_tails(**{"error": normal(0, 100, 2), **arguments})


def test_integers_are_refused():
    with pytest.raises(TypeError, match=r"`error` .* got torch\.int64"):
        assess_tails(torch.ones(10, 1, dtype=torch.int64))
