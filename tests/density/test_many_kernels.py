"""Several kernels per channel: held-out likelihood, normaliser, equivariance, and bad arguments."""

import math

import pytest
import torch
from scipy import stats

from mkc_torch import MKCDistribution, fit_density, fit_kernels


def student_t_sample(seed, freedom, count=4000):
    return torch.as_tensor(stats.t(freedom).rvs(count, random_state=seed)).unsqueeze(-1)


def contaminated_sample(seed, count=4000):
    g = torch.Generator().manual_seed(seed)
    error = torch.randn(count, 1, generator=g, dtype=torch.float64)
    error[: count // 5] = 40.0 * torch.rand(count // 5, 1, generator=g, dtype=torch.float64) - 20.0
    return error


def single_kernel_likelihood(learned, other, bound):
    fit = fit_density(learned, bound=bound)
    return float(MKCDistribution(fit.sigma, fit.d, fit.bound).log_prob(other).mean())


@pytest.mark.parametrize("freedom", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("seed", [10, 11])
def test_held_out_likelihood_of_a_decreasing_tail_is_near_the_truth_and_above_a_flat_tail(freedom, seed):
    learned, other = student_t_sample(seed, freedom), student_t_sample(seed + 100, freedom)
    bound = 1.001 * float(torch.cat([learned, other]).abs().max())
    several = float(fit_kernels(learned, bound=bound).log_prob(other).mean())
    truth = float(stats.t(freedom).logpdf(other).mean())
    assert several == pytest.approx(truth, abs=5e-3)
    assert several > single_kernel_likelihood(learned, other, bound) + (0.02 if freedom < 3.0 else 0.005)


@pytest.mark.parametrize("seed", [0, 1])
def test_on_uniform_outliers_and_gaussian_errors_the_likelihood_equals_that_of_a_single_kernel(seed):
    normal = torch.randn(4000, 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    for error, bound in ((contaminated_sample(seed), 20.0), (normal, 10.0)):
        order = torch.randperm(4000, generator=torch.Generator().manual_seed(seed))
        learned, other = error[order[:2000]], error[order[2000:]]
        first = single_kernel_likelihood(learned, other, bound)
        assert float(fit_kernels(learned, bound=bound).log_prob(other).mean()) == pytest.approx(first, abs=0.01)


def test_the_density_integrates_to_one_over_its_domain():
    error = torch.cat([student_t_sample(0, 1.0), contaminated_sample(1)], -1)
    fit = fit_kernels(error)
    for k in range(2):
        place = torch.linspace(0.0, math.asinh(1e3 * float(fit.bound[k])), 100_001, dtype=torch.float64)
        size = (place.sinh() / 1e3).unsqueeze(-1).expand(-1, 2)
        mass = torch.trapezoid(fit.log_prob(size)[:, k].exp(), size[:, k])
        assert 2.0 * float(mass) == pytest.approx(1.0, abs=1e-6)


def test_the_depths_maximise_the_likelihood():
    error = student_t_sample(3, 2.0, 500)
    fit = fit_kernels(error, bound=60.0)
    # the fit adds an error at the bound
    counted = torch.cat([error, fit.bound.unsqueeze(0)])

    def likelihood(depth):
        size = torch.linspace(0.0, 60.0, 60_001, dtype=torch.float64).unsqueeze(-1)
        other = type(fit)(fit.bandwidth, (depth,), fit.bound, fit.log_normalizer, fit.log_likelihood)
        norm = torch.log(2.0 * torch.trapezoid(torch.exp(-other.energy(size))[:, 0], size[:, 0]))
        return float(-(other.energy(counted).mean() + norm))

    best = likelihood(fit.depth[0])
    for seed in range(20):
        stretch = 0.3 * torch.randn(len(fit.depth[0]), generator=torch.Generator().manual_seed(seed)).double()
        assert likelihood(fit.depth[0] * stretch.exp() + 0.01 * stretch.abs()) < best + 1e-6


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_density_is_equivariant_to_the_unit(unit):
    error = student_t_sample(2, 2.0, 1000)
    first, other = fit_kernels(error), fit_kernels(unit * error)
    torch.testing.assert_close(first.log_prob(error), other.log_prob(unit * error) + math.log(unit))
    assert float(first.log_likelihood) == pytest.approx(float(first.log_prob(error).mean()), abs=1e-3)


def test_channels_are_fitted_independently():
    both = torch.cat([student_t_sample(0, 1.0), 7.0 * student_t_sample(1, 5.0)], -1)
    fit = fit_kernels(both)
    for k in range(2):
        alone = fit_kernels(both[:, k : k + 1])
        torch.testing.assert_close(fit.log_prob(both)[:, k], alone.log_prob(both[:, k : k + 1])[:, 0])


def test_residuals_of_exactly_zero_do_not_make_a_spike():
    error = student_t_sample(0, 3.0)
    error[:1200] = 0.0
    assert float(fit_kernels(error).log_prob(torch.zeros(1, 1)).exp()) < 100.0


@pytest.mark.parametrize(
    ("error", "bound", "match"),
    [
        (torch.zeros(5), None, r"shape \(N >= 2, m\)"),
        (torch.zeros(1, 1), None, r"shape \(N >= 2, m\)"),
        (torch.tensor([[1.0], [math.nan]]), None, "leave out residuals that are not finite"),
        (torch.tensor([[0.0], [0.0], [0.0], [1.0]]), None, "a robust scale above 0"),
        (torch.tensor([[-1.0], [1.0], [2.0]]), 3.0, "at least four robust scales"),
        (torch.tensor([[-1.0], [1.0], [2.0]]), torch.tensor([90.0, 90.0]), r"a number or of shape \(1,\)"),
        (torch.tensor([[-1.0], [1.0], [2.0]]), 1e200, "beyond which squares overflow"),
    ],
)
def test_residuals_without_a_density_are_refused(error, bound, match):
    with pytest.raises(ValueError, match=match):
        fit_kernels(error, bound=bound)


def test_a_bound_of_a_single_channel_applies_to_all():
    both = torch.cat([student_t_sample(0, 1.0), student_t_sample(1, 1.0)], -1)
    shared, separate = (fit_kernels(both, bound=torch.full((count,), 90.0)) for count in (1, 2))
    assert shared.bound.tolist() == separate.bound.tolist() == [90.0, 90.0]


def test_there_is_a_kernel_for_every_octave_up_to_the_bound():
    bandwidth = fit_kernels(student_t_sample(0, 2.0), bound=300.0).bandwidth[0]
    torch.testing.assert_close(bandwidth[1:-1], 2.0 * bandwidth[:-2])
    assert 150.0 < float(bandwidth[-2]) <= 300.0
    assert math.isinf(float(bandwidth[-1]))
