"""Standard errors, intervals and tests: identities, influence by refitting, coverage, derivatives."""

import io
import pickle

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from mkc_torch.linear import (
    FixedPointLinear,
    LeastAbsoluteDeviations,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MKCRegression,
    MMRegression,
    ReweightedLeastSquares,
    SRegression,
)
from mkc_torch.linear._estimator import NotFittedError
from mkc_torch.linear._inference import Inference, RobustInference
from tests.draws import normal as sample

ROBUST = [
    MMRegression(),
    SRegression(),
    MEstimator(),
    MEstimator("hampel", scale="proposal2"),
    MEstimator("andrews"),
    MEstimator("welsch"),
    LeastTrimmedSquares(),
    ReweightedLeastSquares(),
    ReweightedLeastSquares("s"),
]
ALL = [*ROBUST, LeastSquares(), FixedPointLinear(sigma=3.0), MKCRegression()]


def short_repr(estimator: Inference) -> str:
    return repr(estimator)[:30]


def line(seed: int, N: int, n: int = 3, *batch: int, outliers: float = 0.0) -> tuple[Tensor, Tensor]:
    """Gaussian errors about coefficients 1, 2, …; outliers are far out in X and one-sided."""
    X = torch.cat([torch.ones(*batch, N, 1, dtype=torch.float64), sample(seed, *batch, N, n - 1)], -1)
    y = torch.matmul(X, torch.arange(1.0, n + 1.0, dtype=torch.float64)) + sample(seed + 1, *batch, N)
    wrong = int(outliers * N)
    X[..., :wrong, 1], y[..., :wrong] = 8.0 + X[..., :wrong, 1], -20.0 + y[..., :wrong]
    return X, y


def with_parameters(estimator: Inference, **parameters: object) -> Inference:
    return type(estimator)(**(estimator.get_params() | parameters))


@pytest.mark.parametrize("estimator", ALL, ids=short_repr)
def test_inference_has_the_shapes_of_the_batch(estimator):
    X, y = line(0, 40, 3, 2, 2)
    fit = with_parameters(estimator).fit(X, y)
    assert fit.covariance_.shape == (2, 2, 3, 3)
    assert fit.dof_.shape == (2, 2)
    assert bool((fit.dof_ == 37).all())
    torch.testing.assert_close(fit.standard_error_.square(), fit.covariance_.diagonal(dim1=-2, dim2=-1))
    assert fit.p_value_.shape == (2, 2, 3)
    ends = fit.confidence_interval(0.9)
    assert ends.shape == (2, 2, 3, 2)
    torch.testing.assert_close(ends.mean(-1), fit.coef_)
    assert fit.mean_interval(X).shape == (2, 2, 40, 2)
    single = with_parameters(estimator).fit(X[1, 0], y[1, 0])
    torch.testing.assert_close(single.covariance_, fit.covariance_[1, 0], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("covariance", ["sandwich", "hac", "homoscedastic"])
@pytest.mark.parametrize("estimator", ROBUST, ids=short_repr)
def test_covariances_are_equivariant(estimator, covariance):
    X, y = line(2, 60, outliers=0.1)
    mix = torch.tensor([[1.0, 0.5, 0.0], [0.0, 30.0, 1.0], [0.0, 2.0, -0.01]], dtype=torch.float64)
    reference = with_parameters(estimator, covariance=covariance, bandwidth=4.0).fit(X, y)
    other = with_parameters(reference).fit(X @ mix, 1e3 * y)
    back = mix @ other.covariance_ @ mix.mT / 1e6
    # the searches start elsewhere, and are converged to half of the digits
    torch.testing.assert_close(back, reference.covariance_, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(other.r_squared_, reference.r_squared_, rtol=1e-4, atol=1e-4)


def test_without_rejections_standard_errors_equal_those_of_least_squares():
    X, y = line(4, 50)
    N, n = X.shape
    plain = LeastSquares().fit(X, y)
    residual = y - X @ plain.coef_
    classical = residual.square().sum() / (N - n) * torch.linalg.inv(X.mT @ X)
    explained = (1 - residual.square().sum() / (y - y.mean()).square().sum()).reshape(1)
    for estimator in (
        MEstimator(tuning=1e6),
        MEstimator("welsch", 1e8),
        LeastTrimmedSquares(h=N),
        ReweightedLeastSquares(threshold=50.0),
    ):
        small = (1.0 + 4.0 * n / N) ** 2 if isinstance(estimator, ReweightedLeastSquares) else 1.0
        expected = small * plain.covariance_
        torch.testing.assert_close(with_parameters(estimator).fit(X, y).covariance_, expected, rtol=1e-6, atol=0.0)
        same = with_parameters(estimator, covariance="homoscedastic").fit(X, y)
        torch.testing.assert_close(same.covariance_, small * classical, rtol=1e-6, atol=0.0)
        torch.testing.assert_close(same.r_squared_, explained, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    "estimator", [MMRegression(), SRegression(), MEstimator("tukey", scale="proposal2")], ids=short_repr
)
def test_the_influence_equals_the_derivative_by_the_weight_of_a_sample(estimator):
    """The errors are skew, so that the scale moves the intercept and its influence is tested too."""
    N, step = 60, 1e-4
    X = torch.cat([torch.ones(N, 1, dtype=torch.float64), sample(6, N, 1)], -1)
    y = X.sum(-1) + torch.exp(0.8 * sample(7, N))
    weight = torch.ones(N, N, dtype=torch.float64) + step * torch.eye(N, dtype=torch.float64)
    plain = with_parameters(estimator).fit(X, y)
    moved = (with_parameters(estimator).fit(X.expand(N, N, 2), y.expand(N, N), weight).coef_ - plain.coef_) / step
    moved = moved - moved.mean(0)  # the scale's denominator N - p grows with every weight
    by_refitting = moved.mT @ moved * N / (N - 2)
    wider = 1.0 + 6.0 * 2 / N if isinstance(estimator, SRegression) else 1.0
    torch.testing.assert_close(plain.covariance_, wider**2 * by_refitting, rtol=0.03, atol=1e-5)


@pytest.mark.parametrize("covariance", ["sandwich", "homoscedastic"])
@pytest.mark.parametrize(
    "estimator", [e for e in ROBUST if not isinstance(e, (LeastTrimmedSquares, ReweightedLeastSquares))], ids=short_repr
)
def test_a_weight_of_two_equals_a_repeated_sample(estimator, covariance):
    X, y = line(8, 50, outliers=0.1)
    weight = torch.ones(50, dtype=torch.float64)
    weight[::4] = 2.0
    weight[1] = 0.0
    repeated = torch.arange(50).repeat_interleave(weight.long())
    weighted = with_parameters(estimator, covariance=covariance).fit(X, y, weight)
    twice = with_parameters(weighted).fit(X[repeated], y[repeated])
    torch.testing.assert_close(weighted.covariance_, twice.covariance_, rtol=1e-3, atol=1e-7)
    torch.testing.assert_close(weighted.dof_, twice.dof_)
    torch.testing.assert_close(weighted.r_squared_, twice.r_squared_, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("estimator", ROBUST, ids=short_repr)
def test_hac_of_no_lags_equals_the_sandwich_and_autocorrelation_increases_it(estimator):
    X, y = line(10, 400, 2)
    plain = with_parameters(estimator).fit(X, y)
    no_lags = with_parameters(estimator, covariance="hac", bandwidth=0.0).fit(X, y)
    torch.testing.assert_close(no_lags.covariance_, plain.covariance_)
    slow = y + 3.0 * torch.sin(torch.arange(400.0) / 30.0)
    independent, series = (
        with_parameters(estimator).fit(X, slow),
        with_parameters(estimator, covariance="hac").fit(X, slow),
    )
    assert float(series.standard_error_[0]) > 1.3 * float(independent.standard_error_[0])


@pytest.mark.e2e
@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.2])
@pytest.mark.parametrize(
    "estimator", [MMRegression(starts=40), MEstimator("tukey"), ReweightedLeastSquares(starts=40)], ids=short_repr
)
def test_confidence_intervals_have_their_nominal_coverage(estimator, outliers):
    """300 draws of 100 samples, outliers far out in X; the 95 % share has a standard deviation of 0.7 %."""
    X, y = line(12, 100, 3, 300, outliers=outliers)
    interval = with_parameters(estimator).fit(X, y).confidence_interval()
    truth = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    covered = ((interval[..., 0] <= truth) & (truth <= interval[..., 1])).double().mean()
    assert 0.925 <= float(covered) <= 0.975


@pytest.mark.parametrize(
    ("estimator", "widest"), [(LeastTrimmedSquares(starts=40), 1.4), (SRegression(starts=40), 1.8)], ids=short_repr
)
def test_standard_errors_of_few_samples_are_near_the_spread_of_draws(estimator, widest):
    """Standard errors are widened for few samples, within limits."""
    X, y = line(5, 80, 4, 200)
    fit = estimator.fit(X, y)
    spread = (fit.coef_ - torch.arange(1.0, 5.0, dtype=torch.float64)).square().mean(0).sqrt()
    ratio = fit.standard_error_.median(0).values / spread
    assert bool(((ratio > 0.85) & (ratio < widest)).all()), ratio


def test_prediction_intervals_add_the_scale_of_the_channel_to_the_error_of_the_mean():
    X, Y = sample(1, 3, 20, 2, 3), sample(2, 3, 20, 2)
    fit = MEstimator().fit(X, Y * torch.tensor([1.0, 9.0]))

    def half_width(interval: Tensor) -> Tensor:
        return 0.5 * (interval[..., 1] - interval[..., 0])

    more = half_width(fit.prediction_interval(X)).square() - half_width(fit.mean_interval(X)).square()
    expected = (fit.scale_ / fit.scale_[:, :1]).square().unsqueeze(-2).expand(-1, 20, -1)
    torch.testing.assert_close(more / more[..., :1, :1], expected)


def test_prediction_intervals_cover_new_inliers():
    X, y = line(14, 200, 3, 100, outliers=0.1)
    fit = MMRegression(starts=40).fit(X, y)
    new_X, new_y = line(99, 200, 3, 100)
    interval = fit.prediction_interval(new_X)
    inside = (interval[..., 0] <= new_y) & (new_y <= interval[..., 1])
    # the scale of the S-estimate is a tenth larger than that of the inliers, because of the outliers
    assert 0.95 <= float(inside.double().mean()) <= 0.985
    mean = fit.mean_interval(new_X)
    truth = torch.matmul(new_X, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    held = (mean[..., 0] <= truth) & (truth <= mean[..., 1])
    assert 0.92 <= float(held.double().mean()) <= 0.97


@pytest.mark.e2e
@pytest.mark.parametrize("covariance", ["sandwich", "hac", "homoscedastic"])
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize(
    "estimator",
    [MMRegression(starts=50), SRegression(starts=50), MEstimator(), MEstimator("welsch", scale="proposal2")],
    ids=short_repr,
)
def test_standard_errors_have_the_derivatives_of_the_fit(estimator, channels, covariance):
    X, Y = 1.0 + sample(16, 30, channels, 3), sample(17, 30, channels)
    estimator = with_parameters(estimator, covariance=covariance, bandwidth=3.0)

    def results(X: Tensor, Y: Tensor) -> tuple[Tensor, ...]:
        fit = estimator.fit(X, Y)
        return fit.coef_, fit.standard_error_, fit.scale_, fit.r_squared_

    inputs = (X.requires_grad_(), Y.requires_grad_())
    assert torch.autograd.gradcheck(results, inputs, fast_mode=True, atol=1e-5)


@pytest.mark.parametrize(
    "estimator", [LeastTrimmedSquares(starts=50), ReweightedLeastSquares(starts=50)], ids=short_repr
)
def test_standard_errors_of_trimmed_fits_are_differentiable(estimator):
    X, y = line(18, 40, outliers=0.1)

    def results(X: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        fit = estimator.fit(X, y)
        return fit.coef_, fit.standard_error_, fit.scale_

    assert torch.autograd.gradcheck(results, (X.requires_grad_(), y.requires_grad_()), fast_mode=True, atol=1e-5)


def test_the_wald_statistic_of_a_coefficient_is_the_square_of_its_t():
    fit = MMRegression().fit(*line(20, 60))
    reference = fit.wald_test([1])
    torch.testing.assert_close(reference.statistic, (fit.coef_[1] / fit.standard_error_[1]).square())
    torch.testing.assert_close(reference.p_value, fit.p_value_[1])
    assert reference.restrictions == 1
    same = fit.wald_test(torch.tensor([0.0, 5.0, 0.0]))
    torch.testing.assert_close(same.p_value, reference.p_value)
    assert float(fit.wald_test([0, 1, -1], value=fit.coef_).p_value) == pytest.approx(1.0)


def test_p_values_are_uniform_where_the_restrictions_hold():
    X, y = line(22, 80, 4, 300)
    test = MMRegression(starts=40).fit(X, y).wald_test([2, 3], value=torch.tensor([3.0, 4.0]))
    assert 0.02 <= float((test.p_value < 0.05).double().mean()) <= 0.09
    assert 0.44 <= float((test.p_value < 0.5).double().mean()) <= 0.58


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([3],), "numbers below 3 but got 3"),
        (([0.5],), "whole number of at least -3"),
        (([1, 1],), "independent but got 2 of rank 1"),
        (([],), "independent but got 0 of rank 0"),
        ((torch.ones(2, 4),), r"of shape \(q, 3\) but got \(2, 4\)"),
        (([0, 1], torch.ones(3)), r"of shape \(2,\) but got \(3,\)"),
    ],
)
def test_invalid_restrictions_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        MMRegression().fit(*line(24, 30)).wald_test(*arguments)


def test_a_summary_is_shown_as_text_html_and_on_a_console():
    X, y = line(26, 60, outliers=0.1)
    frame = pd.DataFrame(X.numpy(), columns=["one", "heat <b>", "[red]drift"])
    fit = MMRegression().fit(frame, pd.Series(y.numpy()))
    summary = fit.summary(level=0.9)
    text = str(summary)
    assert text.splitlines()[0] == "MMRegression of 60 values, 6 with a weight below 0.1"
    assert "90 % interval" in text
    assert [row.name for row in summary.coefficients] == ["one", "heat <b>", "[red]drift"]
    assert summary.coefficients[1].value == float(fit.coef_[1])
    assert summary.coefficients[1].low == float(fit.confidence_interval(0.9)[1, 0])
    page = summary._repr_html_()
    assert "heat &lt;b&gt;" in page
    assert page.count("<tr>") == 4
    console = pytest.importorskip("rich.console").Console(width=200, record=True, file=io.StringIO())
    console.print(summary)
    drawn = console.export_text()
    assert "[red]drift" in drawn
    assert "standard errors by the sandwich" in drawn
    assert fit.summary(["a", "b", "c"]).coefficients[2].name == "c"
    with pytest.raises(ValueError, match="hold 3 names but got 2"):
        fit.summary(["a", "b"])


def test_a_summary_shows_the_selected_problem_of_a_batch():
    fit = SRegression(starts=50).fit(*line(28, 40, 3, 2, 2))
    assert fit.summary(problem=(1, -1)).coefficients[0].value == float(fit.coef_[1, 1, 0])
    for problem in ((), (1,), (2, 0)):
        with pytest.raises(IndexError, match=r"batch \(2, 2\)"):
            fit.summary(problem=problem)


def test_a_summary_of_least_squares_shows_no_scale():
    text = str(LeastSquares().fit(*line(30, 40)).summary())
    assert "scale" not in text
    assert "37 degrees of freedom" in text


@pytest.mark.parametrize("estimator", ROBUST, ids=short_repr)
def test_an_exact_fit_has_tiny_standard_errors_and_no_nan(estimator):
    X, _ = line(32, 40)
    y = X @ torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    y[:5] += 30.0
    fit = with_parameters(estimator).fit(X, y)
    assert bool((fit.standard_error_ < 1e-6).all())
    assert bool(torch.isfinite(fit.p_value_).all())
    flat = with_parameters(estimator).fit(X, torch.zeros(40, dtype=torch.float64))
    assert bool(torch.isfinite(flat.covariance_).all())
    assert not bool(torch.isnan(flat.r_squared_).any())
    assert str(flat.summary())


def test_as_many_coefficients_as_values_have_infinite_errors():
    X, y = line(34, 3)
    assert bool(torch.isinf(SRegression().fit(X, y).covariance_).all())


@pytest.mark.parametrize("estimator", ROBUST, ids=short_repr)
def test_standard_errors_in_float32_agree_and_survive_pickling(estimator):
    X, y = line(36, 80, outliers=0.1)
    double = with_parameters(estimator).fit(X, y)
    single = with_parameters(estimator).fit(X.float(), y.float())
    assert single.standard_error_.dtype == torch.float32
    torch.testing.assert_close(single.standard_error_.double(), double.standard_error_, rtol=0.02, atol=0.0)
    again = pickle.loads(pickle.dumps(double))
    assert torch.equal(again.confidence_interval(), double.confidence_interval())


def test_without_a_constant_column_r_squared_is_about_zero():
    X, y = sample(38, 50, 2), 3.0 + sample(39, 50)
    fit = MEstimator(tuning=1e6).fit(X, y)
    residual = y - X @ fit.coef_
    expected = 1 - residual.square().sum() / y.square().sum()
    torch.testing.assert_close(fit.r_squared_, expected.reshape(1), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    "estimator", [MMRegression, SRegression, MEstimator, LeastTrimmedSquares, ReweightedLeastSquares]
)
def test_bad_arguments_and_unfitted_estimators_are_refused(estimator):
    with pytest.raises(ValueError, match=r"`covariance` .*'sandwich', 'hac' or 'homoscedastic'.* got 'iid'"):
        estimator(covariance="iid")
    with pytest.raises(ValueError, match="`bandwidth`"):
        estimator(bandwidth=-1.0)
    with pytest.raises(ValueError, match="`level`"):
        estimator().fit(*line(40, 30)).confidence_interval(95.0)
    with pytest.raises(NotFittedError):
        estimator().standard_error_
    with pytest.raises(NotFittedError):
        estimator().summary()


def test_an_estimator_without_covariance_has_no_inference():
    assert not isinstance(LeastAbsoluteDeviations(), Inference)
    assert issubclass(MMRegression, RobustInference)


def test_prediction_intervals_of_arrays_equal_those_of_tensors():
    X, y = line(42, 40)
    fit = MMRegression().fit(X.numpy(), y.numpy())
    torch.testing.assert_close(fit.prediction_interval(np.asarray(X)), fit.prediction_interval(X))
