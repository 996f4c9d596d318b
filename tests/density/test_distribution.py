import copy
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from torch.distributions import (
    AffineTransform,
    Independent,
    TransformedDistribution,
    constraints,
    kl_divergence,
)

from mkc_torch import MKCDistribution
from mkc_torch.functional import log_normalizer, mkc_nll

INF = math.inf
SIGMAS = [0.05, 0.5, 2.0, 10.0, INF]
LENGTHS = [1.0, 10.0, 1e5]
each_shape = [pytest.mark.parametrize("sigma", SIGMAS), pytest.mark.parametrize("length", LENGTHS)]

sampled = settings(derandomize=True, deadline=None, max_examples=25)
sigmas = st.one_of(st.just(INF), st.floats(math.log(0.05), math.log(1e3)).map(math.exp))
scales = st.floats(math.log(1e-3), math.log(1e3)).map(math.exp)
lengths = st.floats(0.0, math.log(1e5)).map(math.exp)


def parametrized_over_shapes(test):
    for mark in each_shape:
        test = mark(test)
    return test


def double(*values, requires_grad=False):
    tensors = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=requires_grad) for v in values)
    return tensors if len(tensors) > 1 else tensors[0]


def distribution(sigma, length, d=1.0, loc=0.0, **options):
    return MKCDistribution(*double(sigma, d, length * d, loc), **options)


def head(u, sigma):
    """The unnormalised density at u = (value - loc) / d."""
    return math.exp(-0.5 * u * u if sigma == INF else sigma**2 * math.expm1(-0.5 * (u / sigma) ** 2))


def integral(f, length):
    """Adaptive quadrature over [0, length], panel by panel away from 0."""
    edges = [0.0]
    while edges[-1] < length:
        edges.append(min(length, max(0.5, 1.5 * edges[-1])))
    return sum(integrate.quad(f, *edge, epsabs=1e-13, epsrel=1e-11)[0] for edge in pairwise(edges))


def cumulative(u, sigma, length):
    share = integral(lambda t: head(t, sigma), abs(u)) / integral(lambda t: head(t, sigma), length)
    return 0.5 + 0.5 * math.copysign(share, u)


# --- density and distribution function


@parametrized_over_shapes
def test_log_prob_is_the_negative_nll(sigma, length):
    p = distribution(sigma, length, d=0.7, loc=1.5)
    value = 1.5 + 0.7 * length * torch.linspace(-0.99, 0.99, 41, dtype=torch.float64)
    torch.testing.assert_close(p.log_prob(value), -mkc_nll(value - 1.5, p.sigma, p.d, p.bound), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(p.log_normalizer(), log_normalizer(p.sigma, p.d, p.bound), rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(p.log_prob(p.mode), -p.log_normalizer())


@sampled
@given(sigma=sigmas, d=scales, length=lengths)
def test_density_integrates_to_one_and_has_the_shape_of_the_definition(sigma, d, length):
    p = distribution(sigma, length, d=d)
    mass = 2 * integral(lambda u: d * math.exp(p.log_prob(double(u * d)).item()), length * (1 - 1e-12))
    assert mass == pytest.approx(1, abs=1e-8)
    for u in (0.3, 0.9 * min(length, 6), 0.99 * length):
        ratio = (p.log_prob(double(u * d)) - p.log_prob(double(0.0))).exp().item()
        assert ratio == pytest.approx(head(u, sigma), rel=1e-9, abs=1e-300)


@parametrized_over_shapes
def test_cdf_equals_quadrature(sigma, length):
    p = distribution(sigma, length, d=2.0, loc=-3.0)
    for u in (-length, -0.6 * length, -min(0.5, 0.3 * length), 0.0, min(2.0, 0.9 * length), 0.5 * length, length):
        found = p.cdf(double(-3.0 + 2.0 * u)).item()
        assert found == pytest.approx(cumulative(u, sigma, length), abs=1e-11)


@parametrized_over_shapes
def test_cdf_rises_from_zero_to_one_and_is_flat_outside_the_domain(sigma, length):
    p = distribution(sigma, length, validate_args=False)
    u = torch.cat([-torch.logspace(2, -3, 300), torch.zeros(1), torch.logspace(-3, 2, 300)]).double() * length / 50
    found = p.cdf(u)
    assert (found.diff() >= -1e-14).all()
    torch.testing.assert_close(found + p.cdf(-u), torch.ones_like(u), rtol=0, atol=1e-15)
    assert p.cdf(double(-length)).item() == pytest.approx(0, abs=1e-15)
    assert p.cdf(double(-2 * length)).item() == pytest.approx(0, abs=1e-15)
    assert p.cdf(double(2 * length)).item() == pytest.approx(1, abs=1e-15)


def test_gradient_of_the_cdf_is_the_density():
    p = distribution(1.5, 8.0, d=0.5)
    value = torch.linspace(-3.9, 3.9, 31, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(p.cdf(value).sum(), value)
    torch.testing.assert_close(slope, p.log_prob(value.detach()).exp(), rtol=1e-10, atol=1e-13)


# --- quantiles


@parametrized_over_shapes
def test_icdf_inverts_the_cdf(sigma, length):
    p = distribution(sigma, length, d=0.3, loc=2.0)
    tails = [1e-12, 1e-9, 1e-6, 1e-3, 0.02]
    probability = double([0.0, *tails, 0.25, 0.4999, 0.5, 0.5001, 0.75, *(1 - t for t in reversed(tails)), 1.0])
    quantile = p.icdf(probability)
    torch.testing.assert_close(p.cdf(quantile), probability, rtol=0, atol=4e-15)
    assert (quantile.diff() > 0).all()
    torch.testing.assert_close(quantile[0], p.loc - p.bound, rtol=1e-15, atol=0)
    torch.testing.assert_close(quantile[-1], p.loc + p.bound, rtol=1e-15, atol=0)
    torch.testing.assert_close(quantile + quantile.flip(0), torch.full_like(quantile, 4.0), rtol=0, atol=4e-4 * 0.3)
    assert quantile[8] == p.loc


@sampled
@given(sigma=sigmas, d=scales, length=lengths, loc=st.floats(-1e3, 1e3))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quantiles_of_zero_and_one_are_ends_of_the_support_and_inside_it(sigma, d, length, loc, dtype):
    p = MKCDistribution(*(torch.tensor(v, dtype=dtype) for v in (sigma, d, length * d, loc)))
    ends = p.icdf(torch.tensor([0.0, 1.0], dtype=dtype))
    torch.testing.assert_close(ends, torch.stack([p.loc - p.bound, p.loc + p.bound]))
    assert p.support.check(ends).all()
    assert p.log_prob(ends).isfinite().all()


@pytest.mark.parametrize("length", [10.0, 100.0, 1e5])
def test_icdf_in_float32_keeps_the_outermost_draws_of_a_gaussian_on_the_head(length):
    p = MKCDistribution(INF, 1.0, length)
    probability = torch.tensor([1e-4, 1e-5, 1 - 1e-5, 1 - 1e-4])
    expected = torch.from_numpy(stats.norm.ppf(probability.double().numpy())).float()
    torch.testing.assert_close(p.icdf(probability), expected, rtol=0, atol=0.02)  # an eps of float32 over the density
    outermost = torch.tensor([2.0**-24, 1 - 2.0**-24])
    assert (p.icdf(outermost).abs() < 8).all()  # the density at 8 is 1e-14 of the peak


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_uniform_draw_of_zero_gives_a_plausible_sample(dtype, monkeypatch):
    p = MKCDistribution(*(torch.tensor(v, dtype=dtype) for v in (INF, 1.0, 1e5)))
    monkeypatch.setattr(torch, "rand", lambda size, **options: torch.zeros(size, **options))
    assert p.rsample((3,)).abs().max() < 40  # float32 draws 0 once in 2^24, and the density at -1e5 is exp(-5e9)


def test_icdf_accepts_any_shape_and_broadcasts():
    p = MKCDistribution(torch.tensor([0.5, 2.0, INF]), 1.0, 10.0)
    assert p.icdf(torch.rand(4, 1)).shape == (4, 3)
    assert p.icdf(torch.tensor(0.3)).shape == (3,)
    assert p.icdf(torch.empty(0, 3)).shape == (0, 3)
    alone = torch.stack([MKCDistribution(s, 1.0, 10.0).icdf(torch.tensor(0.3)) for s in (0.5, 2.0, INF)])
    torch.testing.assert_close(p.icdf(torch.tensor(0.3)), alone)


@pytest.mark.e2e
def test_icdf_of_many_probabilities_equals_icdf_of_few():
    p = distribution(0.4, 20.0)
    probability = torch.linspace(0, 1, 150_001, dtype=torch.float64)
    some = torch.tensor([0, 1, 65_535, 65_536, 75_000, 131_072, 150_000])
    torch.testing.assert_close(p.icdf(probability)[some], p.icdf(probability[some]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("probability", [-1e-3, 1.001, math.nan])
def test_icdf_refuses_values_that_are_not_probabilities(probability):
    with pytest.raises(ValueError, match=r"`value`.*probabilities in \[0, 1\].*at index \(1,\); divide"):
        MKCDistribution(2.0, 1.0, 10.0, validate_args=True).icdf(torch.tensor([0.5, probability]))


@pytest.mark.parametrize("name", ["log_prob", "cdf", "icdf"])
def test_values_that_are_not_tensors_are_refused(name):
    with pytest.raises(TypeError, match=r"`value`.*tensor.*got float; make a tensor of it, torch\.as_tensor"):
        getattr(MKCDistribution(2.0, 1.0, 10.0, validate_args=True), name)(0.5)


@pytest.mark.parametrize("shape", [3, "a", None, (2.5,)])
def test_bad_shapes_of_samples_are_refused(shape):
    for draw in (MKCDistribution(2.0, 1.0, 10.0).rsample, MKCDistribution(2.0, 1.0, 10.0).sample):
        with pytest.raises(TypeError, match=r"`sample_shape`.*shape.*; write \(1000,\)"):
            draw(shape)
    with pytest.raises(TypeError, match=r"`batch_shape`.*shape"):
        MKCDistribution(2.0, 1.0, 10.0).expand(shape)


@pytest.mark.parametrize("name", ["sigma", "d", "bound", "loc"])
@pytest.mark.parametrize("value", ["2", None, torch.ones(1) + 0j])
def test_parameters_that_are_not_numbers_are_refused_by_name(name, value):
    with pytest.raises(TypeError, match=rf"`{name}`.*(a number|real)"):
        MKCDistribution(**{"sigma": 2.0, "d": 1.0, "bound": 10.0, name: value})


# --- samples


@pytest.mark.parametrize(
    ("sigma", "length"), [(0.05, 10.0), (0.5, 3.0), (2.0, 10.0), (2.0, 1e5), (10.0, 20.0), (INF, 1.0), (INF, 1e5)]
)
def test_samples_follow_the_cdf(sigma, length):
    torch.manual_seed(3)
    p = distribution(sigma, length, d=0.4, loc=5.0)
    x = p.sample((20_000,))
    assert p.support.check(x).all()
    assert stats.kstest(x.numpy(), lambda v: p.cdf(torch.from_numpy(v)).numpy()).pvalue > 0.01
    error = math.sqrt(p.variance.item() / len(x))
    assert x.mean().item() == pytest.approx(5.0, abs=4 * error)
    fourth = ((x - 5.0) ** 4).mean().item()
    spread = math.sqrt(max(fourth - p.variance.item() ** 2, 0) / len(x))
    assert ((x - 5.0) ** 2).mean().item() == pytest.approx(p.variance.item(), abs=4 * spread)


def test_samples_in_float32_follow_the_cdf():
    torch.manual_seed(4)
    p = MKCDistribution(1.5, 2.0, 30.0, loc=-1.0)
    x = p.rsample((20_000,))
    assert x.dtype == torch.float32
    assert stats.kstest(x.numpy(), lambda v: p.cdf(torch.from_numpy(v)).numpy()).pvalue > 0.01


def test_samples_have_the_extended_shape_follow_the_seed_and_have_no_gradient_by_default():
    sigma = torch.tensor([1.0, 2.0], requires_grad=True)
    p = MKCDistribution(sigma, torch.ones(3, 1), 10.0)
    assert p.sample().shape == (3, 2)
    assert p.rsample((4, 5)).shape == (4, 5, 3, 2)
    assert p.rsample((0,)).shape == (0, 3, 2)
    assert not p.sample().requires_grad
    assert p.rsample().requires_grad
    torch.manual_seed(7)
    first = p.sample((6,))
    torch.manual_seed(7)
    assert torch.equal(p.sample((6,)), first)


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quantiles_do_not_depend_on_requires_grad(sigma, dtype):
    probability = torch.cat([torch.linspace(0, 1, 101), torch.tensor([1e-6, 1e-5, 1e-4, 1 - 1e-6])]).to(dtype)
    arguments = [torch.tensor(v, dtype=dtype) for v in (sigma, 1.0, 100.0)]
    expected = MKCDistribution(*arguments).icdf(probability)
    leaves = [t.clone().requires_grad_() for t in arguments]
    assert torch.equal(MKCDistribution(*leaves).icdf(probability).detach(), expected)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.5, 8.0])
@pytest.mark.parametrize("length", [1.5, 10.0, 300.0])
def test_gradients_of_icdf_equal_its_finite_differences(sigma, length):
    values = [sigma, 0.7, 0.7 * length, -2.0]
    probability = double([1e-3, 0.05, 0.3, 0.5, 0.6, 0.9, 0.999])

    def quantile(sigma, d, bound, loc, probability):
        return MKCDistribution(sigma, d, bound, loc).icdf(probability)

    leaves = [t.expand(7).clone().requires_grad_() for t in (*double(*values), probability)]
    found = torch.autograd.grad(quantile(*leaves).sum(), leaves)
    for position, name in enumerate(("sigma", "d", "bound", "loc", "probability")):
        step = 1e-4 * (0.02 * torch.minimum(probability, 1 - probability) if name == "probability" else 1.0)
        stencil = torch.zeros(7, dtype=torch.float64)
        for shift, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
            moved = [t.detach() for t in leaves]
            moved[position] = moved[position] + shift * step
            stencil += weight * quantile(*moved) / (12 * step)
        torch.testing.assert_close(found[position], stencil, rtol=1e-6, atol=1e-8, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own forward mode
def test_forward_mode_derivatives_of_icdf_equal_reverse_mode():
    probability, sigma = double([0.01, 0.3, 0.9], 1.2)

    def quantile(sigma):
        return MKCDistribution(sigma, *double(1.0, 10.0), validate_args=False).icdf(probability)

    torch.testing.assert_close(torch.func.jacfwd(quantile)(sigma), torch.func.jacrev(quantile)(sigma))


def test_gradients_of_samples_equal_those_of_the_quantiles_they_came_from():
    leaves = double(1.2, 0.7, 9.0, -2.0, requires_grad=True)
    p = MKCDistribution(*leaves)
    torch.manual_seed(11)
    x = p.rsample((50,))
    found = torch.autograd.grad((x**2).sum(), leaves)
    torch.manual_seed(11)
    uniform = torch.rand(50, dtype=torch.float64)
    expected = torch.autograd.grad((p.icdf(uniform) ** 2).sum(), leaves)
    torch.testing.assert_close(found, expected)
    assert all(g.abs() > 1e-3 for g in found)


def test_gradient_of_the_sampled_second_moment_is_that_of_the_variance():
    torch.manual_seed(5)
    leaves = double(1.2, 0.7, 5.0, requires_grad=True)
    p = MKCDistribution(*leaves)
    parts = torch.stack([(p.rsample((2000,)) ** 2).mean() for _ in range(10)])
    exact = torch.autograd.grad(p.variance, leaves)
    gradients = torch.stack([torch.stack(torch.autograd.grad(m, leaves, retain_graph=True)) for m in parts])
    spread = gradients.std(0) / math.sqrt(10)
    assert ((gradients.mean(0) - torch.stack(exact)).abs() <= 5 * spread).all()


@pytest.mark.parametrize("sigma", [0.3, INF])
def test_gradients_of_icdf_at_the_ends_equal_those_of_the_support(sigma):
    leaves = double(sigma, 0.7, 3.0, -2.0, requires_grad=True)
    for probability, sign in ((0.0, -1.0), (1.0, 1.0)):
        found = torch.autograd.grad(MKCDistribution(*leaves).icdf(double(probability)), leaves)
        torch.testing.assert_close(torch.stack(found), double([0.0, 0.0, sign, 1.0]), rtol=0, atol=1e-9)


# --- moments


@parametrized_over_shapes
def test_mean_variance_and_entropy_equal_quadrature(sigma, length):
    p = distribution(sigma, length, d=0.7, loc=4.0)
    mass = integral(lambda u: head(u, sigma), length)
    second = integral(lambda u: u * u * head(u, sigma), length) / mass
    energy = integral(lambda u: -math.log(head(u, sigma)) * head(u, sigma) if head(u, sigma) else 0.0, length) / mass
    assert p.mean.item() == 4.0
    assert p.variance.item() == pytest.approx(0.49 * second, rel=1e-9)
    assert p.stddev.item() == pytest.approx(0.7 * math.sqrt(second), rel=1e-9)
    assert p.entropy().item() == pytest.approx(energy + math.log(2 * 0.7 * mass), rel=1e-9, abs=1e-11)


def test_moments_are_differentiable():
    leaves = double([0.4, 1.3, 6.0], [0.5, 1.0, 2.0], [4.0, 9.0, 7.0], requires_grad=True)
    for moment in (lambda *a: MKCDistribution(*a).variance, lambda *a: MKCDistribution(*a).entropy()):
        assert torch.autograd.gradcheck(moment, leaves)


# --- the Gaussian limit


@pytest.mark.parametrize("length", [0.5, 1.0, 4.0, 30.0])
def test_infinite_sigma_equals_the_truncated_normal_in_every_method(length):
    p = distribution(INF, length, d=1.7, loc=-0.4)
    exact = stats.truncnorm(-length, length, loc=-0.4, scale=1.7)
    x = np.linspace(-0.999 * length, 0.999 * length, 31) * 1.7 - 0.4
    q = np.array([1e-6, 0.01, 0.3, 0.5, 0.8, 0.999])
    for found, expected in (
        (p.log_prob(torch.from_numpy(x)), exact.logpdf(x)),
        (p.cdf(torch.from_numpy(x)), exact.cdf(x)),
        (p.icdf(torch.from_numpy(q)), exact.ppf(q)),
        (p.mean, exact.mean()),
        (p.variance, exact.var()),
        (p.entropy(), exact.entropy()),
    ):
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-8, atol=1e-9)
    torch.manual_seed(2)
    assert stats.kstest(p.sample((20_000,)).numpy(), exact.cdf).pvalue > 0.01
    assert p.icdf(double(1e-12)).item() == pytest.approx(exact.ppf(1e-12), rel=1e-4)


def test_large_sigma_tends_to_infinite_sigma():
    near, limit = distribution(1e5, 8.0), distribution(INF, 8.0)
    x = torch.linspace(-7.9, 7.9, 21, dtype=torch.float64)
    for method in (lambda p: p.log_prob(x), lambda p: p.cdf(x), lambda p: p.variance, lambda p: p.entropy()):
        torch.testing.assert_close(method(near), method(limit), rtol=1e-6, atol=1e-8)


def test_loc_shifts_and_d_scales_everything():
    standard, moved = distribution(1.3, 6.0), distribution(1.3, 6.0, d=2.0, loc=10.0)
    u, q = torch.linspace(-5.9, 5.9, 13, dtype=torch.float64), torch.linspace(0, 1, 11, dtype=torch.float64)
    torch.testing.assert_close(moved.log_prob(10 + 2 * u), standard.log_prob(u) - math.log(2))
    torch.testing.assert_close(moved.cdf(10 + 2 * u), standard.cdf(u))
    torch.testing.assert_close(moved.icdf(q), 10 + 2 * standard.icdf(q))
    torch.testing.assert_close(moved.mean, standard.mean + 10)
    torch.testing.assert_close(moved.variance, 4 * standard.variance)
    torch.testing.assert_close(moved.entropy(), standard.entropy() + math.log(2))


@pytest.mark.parametrize("sigma", SIGMAS)
def test_float32_agrees_with_float64(sigma):
    x, q = torch.linspace(-18.9, 20.9, 41), torch.linspace(0.01, 0.99, 15)
    single, exact = MKCDistribution(sigma, 0.5, 20.0, loc=1.0), MKCDistribution(*double(sigma, 0.5, 20.0, 1.0))
    for found, expected in (
        (single.log_prob(x), exact.log_prob(x.double())),
        (single.cdf(x), exact.cdf(x.double())),
        (single.icdf(q), exact.icdf(q.double())),
        (single.variance, exact.variance),
        (single.entropy(), exact.entropy()),
    ):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=2e-5)


# --- conventions of torch.distributions


def test_shapes_broadcast_and_expand():
    p = MKCDistribution(torch.tensor([0.5, 2.0, INF]), torch.ones(4, 1), 10.0, loc=1.0)
    assert p.batch_shape == (4, 3)
    assert p.event_shape == ()
    assert p.mean.shape == p.variance.shape == p.entropy().shape == p.log_normalizer().shape == (4, 3)
    assert p.log_prob(torch.zeros(5, 1, 1)).shape == (5, 4, 3)
    wide = p.expand((2, 4, 3))
    assert isinstance(wide, MKCDistribution)
    assert wide.batch_shape == (2, 4, 3)
    x = torch.linspace(-4, 4, 3)
    torch.testing.assert_close(wide.log_prob(x), p.log_prob(x).expand(2, 4, 3))
    torch.testing.assert_close(wide.variance, p.variance.expand(2, 4, 3))
    assert wide.rsample((2,)).shape == (2, 2, 4, 3)
    assert wide._validate_args == p._validate_args
    assert MKCDistribution(2.0, 1.0, 9.0, validate_args=False).expand((2,)).log_prob(torch.tensor(99.0)).tolist() == [
        -INF,
        -INF,
    ]
    scalar = MKCDistribution(2.0, 1.0, 9.0)
    assert scalar.batch_shape == ()
    assert scalar.expand((3,)).batch_shape == (3,)


def test_support_is_the_domain():
    p = MKCDistribution(2.0, 1.0, torch.tensor([3.0, 5.0]), loc=1.0)
    assert isinstance(p.support, type(constraints.interval(0, 1)))
    assert p.support.check(torch.tensor([4.0, 6.0])).tolist() == [True, True]
    assert p.support.check(torch.tensor([-2.1, -4.0])).tolist() == [False, True]
    assert MKCDistribution.support.event_dim == 0
    assert not MKCDistribution.support.is_discrete
    assert p.has_rsample


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sigma", 0.049),
        ("sigma", -1.0),
        ("sigma", math.nan),
        ("d", 0.0),
        ("d", -1.0),
        ("bound", 0.0),
        ("loc", math.nan),
    ],
)
def test_arguments_outside_their_constraints_are_refused(name, value):
    arguments = {"sigma": 1.0, "d": 1.0, "bound": 5.0, "loc": 0.0, name: torch.tensor([1.0, value])}
    assert set(MKCDistribution.arg_constraints) == {"sigma", "d", "bound", "loc"}
    with pytest.raises(ValueError, match=f"parameter {name}"):
        MKCDistribution(**arguments, validate_args=True)  # torch.compile turns the default off permanently


def test_the_smallest_and_the_largest_sigma_are_accepted():
    assert MKCDistribution(torch.tensor([0.05, INF]), 1.0, 5.0, validate_args=True).entropy().isfinite().all()
    assert MKCDistribution(torch.tensor([0.05, INF]).double(), 1.0, 5.0, validate_args=True).entropy().isfinite().all()


def test_values_outside_the_domain_are_refused_or_have_log_density_minus_infinity():
    strict, lax = (MKCDistribution(2.0, 1.0, 5.0, loc=1.0, validate_args=v) for v in (True, False))
    for value in (6.5, -4.5, math.nan):
        with pytest.raises(ValueError, match="to be within the support"):
            strict.log_prob(torch.tensor(value))
        with pytest.raises(ValueError, match="to be within the support"):
            strict.cdf(torch.tensor(value))
    outside = torch.tensor([6.5, -4.5, 1e30, 0.0], requires_grad=True)
    found = lax.log_prob(outside)
    assert found[:3].tolist() == [-INF] * 3
    assert found[3].isfinite()
    (slope,) = torch.autograd.grad(found[3], outside)
    assert slope[:3].tolist() == [0.0] * 3
    assert slope[3] > 0


def test_log_prob_has_gradients_in_every_parameter():
    leaves = double([0.6, 2.0], [0.5, 1.0], [6.0, 8.0], [0.1, -0.3], requires_grad=True)
    value = double([2.0, -5.0], requires_grad=True)
    assert torch.autograd.gradcheck(lambda v, *a: MKCDistribution(*a).log_prob(v), (value, *leaves))
    assert torch.autograd.gradgradcheck(lambda v, *a: MKCDistribution(*a).log_prob(v), (value, *leaves))


def test_kl_divergence_is_not_implemented():
    with pytest.raises(NotImplementedError):
        kl_divergence(MKCDistribution(2.0, 1.0, 5.0), MKCDistribution(2.0, 1.0, 5.0))


def test_independent_and_transformed_distributions_accept_the_distribution():
    base = MKCDistribution(torch.tensor([0.5, 2.0, INF]), 1.0, 10.0)
    joint = Independent(base, 1)
    x = torch.tensor([[0.1, -2.0, 3.0], [5.0, 0.0, 1.0]])
    assert joint.event_shape == (3,)
    torch.testing.assert_close(joint.log_prob(x), base.log_prob(x).sum(-1))
    torch.testing.assert_close(joint.entropy(), base.entropy().sum(-1))
    assert joint.rsample((4,)).shape == (4, 3)
    assert joint.expand((2,)).log_prob(x).shape == (2,)
    moved = TransformedDistribution(base, [AffineTransform(3.0, 2.0)])
    torch.testing.assert_close(moved.log_prob(3 + 2 * x), base.log_prob(x) - math.log(2))
    torch.testing.assert_close(moved.cdf(3 + 2 * x), base.cdf(x))
    torch.testing.assert_close(moved.icdf(torch.tensor(0.8)), 3 + 2 * base.icdf(torch.tensor(0.8)))
    assert moved.rsample((4,)).shape == (4, 3)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))], ids=["deepcopy", "pickle"])
def test_copies_are_equal_and_independent(copied):
    p = distribution([0.5, INF], 10.0, loc=1.0)
    q = copied(p)
    x = double([2.0, -3.0])
    assert torch.equal(q.log_prob(x), p.log_prob(x))
    assert q.batch_shape == p.batch_shape
    assert q.sigma.data_ptr() != p.sigma.data_ptr()


def test_repr_names_the_parameters():
    text = repr(MKCDistribution(2.0, 1.0, 5.0))
    assert text.startswith("MKCDistribution(")
    assert all(name in text for name in ("sigma: 2.0", "d: 1.0", "bound: 5.0", "loc: 0.0"))


@pytest.mark.parametrize("default", [True, False])
@pytest.mark.parametrize("bound", [math.inf, 0.0, -1.0, math.nan])
def test_an_infinite_domain_is_refused_for_any_validation_default_of_torch(bound, default, monkeypatch):
    monkeypatch.setattr(torch.distributions.Distribution, "_validate_args", default)
    with pytest.raises(ValueError, match="parameter bound"):
        MKCDistribution(2.0, 1.0, bound)
