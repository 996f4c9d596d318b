"""Residuals with many minima: several starts, of which the most likely result is kept, and the explained share."""

import math

import pytest
import torch
from torch import Tensor

from mkc_torch.nonlinear import GaussianPrior, fit

LOW, HIGH = torch.tensor([0.5]).double(), torch.tensor([8.5]).double()


def contaminated_sine(seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x, sin(kx) with noise of 0.1 and one value in ten a gross outlier, k, and a random start."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(62, generator=generator, dtype=torch.float64)
    x, k, start = 6.0 * draw[:60], 1.0 + 7.0 * draw[60:61], 0.5 + 8.0 * draw[61:]
    y = torch.sin(k * x) + 0.1 * torch.randn(60, generator=generator, dtype=torch.float64)
    y[:6] += 5.0 * torch.randn(6, generator=generator, dtype=torch.float64)
    return x, y, k, start


X, Y, K, START = (torch.stack(part) for part in zip(*(contaminated_sine(seed) for seed in range(20)), strict=True))
DATA = {"x": X, "y": Y}


def sine_residual(theta: Tensor, data: dict[str, Tensor]) -> Tensor:
    return (data["y"] - torch.sin(theta * data["x"])).unsqueeze(-1)


def residual_of(seed: int):
    return lambda theta: sine_residual(theta, {"x": X[seed], "y": Y[seed]})


@pytest.fixture(scope="module")
def fit_of_many_starts():
    return fit(sine_residual, START, data=DATA, lower=LOW, upper=HIGH, starts=32)


@pytest.fixture(scope="module")
def fit_of_a_single_start():
    return fit(sine_residual, START, data=DATA, lower=LOW, upper=HIGH)


@pytest.mark.e2e
def test_thirty_two_starts_find_minima_that_a_single_start_misses(fit_of_many_starts, fit_of_a_single_start):
    assert int(((fit_of_a_single_start.theta - K).abs() < 0.05).sum()) <= 8
    assert bool(fit_of_a_single_start.converged.all())
    assert int(((fit_of_many_starts.theta - K).abs() < 0.05).sum()) >= 19
    assert bool(((fit_of_many_starts.agreeing >= 1) & (fit_of_many_starts.agreeing <= 20)).all())
    assert fit_of_many_starts.starts == 32
    assert fit_of_a_single_start.starts == 1
    assert fit_of_a_single_start.agreeing.tolist() == [1] * 20


@pytest.mark.e2e
def test_the_explained_share_distinguishes_the_right_minimum(fit_of_many_starts, fit_of_a_single_start):
    right = (fit_of_a_single_start.theta - K).abs().squeeze(-1) < 0.05
    share = fit_of_a_single_start.explained(Y.unsqueeze(-1)).squeeze(-1)
    assert float(share[~right].max()) < 0.8
    assert float(share[right].min()) > 0.9
    assert float(fit_of_many_starts.explained(Y.unsqueeze(-1)).min()) > 0.9


@pytest.mark.e2e
def test_the_result_equals_a_fit_from_the_best_minimum(fit_of_many_starts):
    again = fit(sine_residual, fit_of_many_starts.theta, data=DATA, lower=LOW, upper=HIGH, graduate=False)
    torch.testing.assert_close(fit_of_many_starts.theta, again.theta, rtol=1e-6, atol=0)
    torch.testing.assert_close(fit_of_many_starts.standard_error(), again.standard_error(), rtol=1e-3, atol=0)
    torch.testing.assert_close(fit_of_many_starts.log_likelihood, again.log_likelihood, rtol=0, atol=1e-6)


@pytest.mark.e2e
def test_a_batch_equals_a_loop_and_equal_seeds_give_equal_results(fit_of_many_starts):
    for seed in (2, 7):
        separate = fit(residual_of(seed), START[seed], lower=LOW, upper=HIGH, starts=32)
        torch.testing.assert_close(separate.theta, fit_of_many_starts.theta[seed], rtol=1e-6, atol=0)
        assert separate.agreeing.dim() == 0


def test_a_given_domain_and_density_are_kept():
    found = fit(residual_of(3), START[3], lower=LOW, upper=HIGH, starts=32, bound=12.0, sigma=2.0, d=0.1)
    assert float((found.theta - K[3]).abs()) < 0.05
    assert (float(found.bound), float(found.sigma), float(found.d)) == pytest.approx((12.0, 2.0, 0.1))


def test_starts_without_bounds_are_drawn_from_the_prior():
    prior = GaussianPrior(torch.tensor([4.5]), torch.tensor([0.2]))
    found = fit(residual_of(3), START[3], prior=prior, starts=32)
    assert float((found.theta - K[3]).abs()) < 0.05


def test_weights_enter_the_choice_of_the_best_result():
    weight = torch.ones(60).double()
    weight[:6] = 0.0
    contaminated = {"x": X[4], "y": torch.where(weight > 0, Y[4], math.nan)}
    found = fit(lambda k: sine_residual(k, contaminated), START[4], weight=weight, lower=LOW, upper=HIGH, starts=32)
    assert float((found.theta - K[4]).abs()) < 0.05


def test_a_start_where_the_residual_is_not_finite_is_ignored():
    x = torch.linspace(0.1, 3.0, 40, dtype=torch.float64)
    y = torch.sqrt(2.0 * x)

    def root(theta):
        return (y - torch.sqrt(theta * x)).unsqueeze(-1)

    found = fit(root, torch.tensor([1.0]).double(), lower=torch.tensor([-9.0]), upper=torch.tensor([9.0]), starts=8)
    assert float(found.theta) == pytest.approx(2.0)


def test_every_start_reaches_a_unique_minimum():
    x = torch.linspace(0.0, 3.0, 50, dtype=torch.float64)
    y = 2.0 * torch.exp(-1.5 * x) + 0.02 * torch.randn(50, generator=torch.Generator().manual_seed(0)).double()
    box = {"lower": torch.tensor([0.5, 0.5]), "upper": torch.tensor([4.0, 3.0])}
    found = fit(lambda a: (y - a[0] * torch.exp(-a[1] * x)).unsqueeze(-1), torch.ones(2).double(), starts=8, **box)
    assert int(found.agreeing) == found.starts == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": 4}, r"`lower` and `upper`, or `prior`, for every parameter with `starts`=4 .* parameters \[0\]"),
        ({"starts": 4, "lower": LOW}, r"neither for the parameters \[0\]"),
        ({"starts": 0}, "`starts` to be a whole number of at least 1 but got 0"),
        ({"starts": 2.5}, "`starts` to be a whole number"),
        ({"starts": 4, "lower": LOW, "upper": HIGH, "seed": -1}, "`seed` to be a whole number of at least 0"),
    ],
)
def test_bad_starts_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        fit(residual_of(0), START[0], **options)


@pytest.mark.parametrize(
    ("target", "error", "message"),
    [
        (torch.ones(59), ValueError, r"`target` of shape \(60, 1\).*\(60,\)"),
        (torch.ones(60), ValueError, "`target` to vary"),
        (torch.full((60,), math.nan), ValueError, "`target` to be finite"),
        ([1.0] * 60, TypeError, "`target` to be"),
    ],
)
def test_invalid_targets_are_refused(target, error, message):
    found = fit(residual_of(0), K[0], covariance=None)
    with pytest.raises(error, match=message):
        found.explained(target)
