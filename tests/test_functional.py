import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, special
from torch.autograd import forward_ad, gradcheck, gradgradcheck
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

from mkc_torch.density.energy import KAPPA_MAX, energy, inverse_square
from mkc_torch.density.normalizer import log_partition
from mkc_torch.functional import log_normalizer, mkc_energy, mkc_nll, mkc_weight

# torch's own forward mode scripts its decompositions when it is first entered
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

INF = math.inf
KAPPAS = [0.0, *np.logspace(-8, math.log10(400), 40).tolist()]
LENGTHS = np.logspace(0, 7, 22).tolist()

sampled = settings(derandomize=True, deadline=None, max_examples=25)
sigmas = st.one_of(st.just(INF), st.floats(math.log(0.05), math.log(1e4)).map(math.exp))
scales = st.floats(math.log(1e-3), math.log(1e3)).map(math.exp)
lengths = st.floats(0.0, math.log(1e5)).map(math.exp)


def double(*values, requires_grad=False):
    tensors = tuple(torch.tensor(v, dtype=torch.float64, requires_grad=requires_grad) for v in values)
    return tensors if len(tensors) > 1 else tensors[0]


def series_partition(kappa, length):
    """The Poisson sum of the normaliser, 2 L exp(-s²) + sqrt(2 pi) s sum_k Pois(k; s²) k^(-1/2) erf(sqrt(k / 2) L / s).

    The probabilities come from their ratios, outwards from the mode, and are scaled to the sum 1: gammaln would lose
    eight digits at s² = 1e8.
    """
    if kappa == 0:
        return math.sqrt(2 * math.pi) * special.erf(length / math.sqrt(2))
    mean = 1 / kappa
    spread = math.sqrt(mean)
    k = np.arange(max(0, math.floor(mean - 12 * spread - 40)), math.ceil(mean + 12 * spread + 60) + 1, dtype=float)
    log_p = np.concatenate([[0.0], np.cumsum(-np.log1p((k[1:] - mean) / mean))])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    k, p = k[k > 0], p[k > 0]
    head = np.sum(p / np.sqrt(k) * special.erf(np.sqrt(k / 2) * length / spread))
    return 2 * length * math.exp(-mean) + math.sqrt(2 * math.pi) * spread * head


def exact_energy(z, kappa):
    q = 0.5 * np.square(np.asarray(z, dtype=float))
    return q if kappa == 0 else -np.expm1(-kappa * q) / kappa


def exact_energy_dkappa(z, kappa):
    """-P(2, kappa z²/2) / kappa², P being the regularised incomplete gamma function."""
    q = 0.5 * np.square(np.asarray(z, dtype=float))
    return -0.5 * q * q if kappa == 0 else -special.gammainc(2, kappa * q) / kappa**2


def integral(f, length):
    """Adaptive quadrature of an even function over [-length, length], panel by panel away from the middle."""
    edges = [0.0]
    while edges[-1] < length:
        edges.append(min(length, max(0.5, 1.5 * edges[-1])))
    return 2 * sum(integrate.quad(f, a, b, epsabs=0, epsrel=1e-10)[0] if f(b) > 0 else 0.0 for a, b in pairwise(edges))


# --- the normaliser


@pytest.mark.parametrize(
    ("sigma", "length", "printed"),
    [(3, 10, 2.63477783032318), (0.5, 5, 8.05514758922922), (3, 1000, 2.87913647470049)],
)
def test_partition_has_the_printed_reference_values(sigma, length, printed):
    assert math.isclose(series_partition(sigma**-2, length), printed, rel_tol=1e-14)
    assert math.isclose(log_partition(*double(sigma**-2, length)).exp().item(), printed, rel_tol=1e-12)
    assert math.isclose(log_normalizer(*double(sigma, 2.0, 2.0 * length)).exp().item(), 2 * printed, rel_tol=1e-12)


def test_partition_equals_the_poisson_series_over_the_whole_range():
    expected = double([[series_partition(k, length) for length in LENGTHS] for k in KAPPAS])
    kappa, length = double(KAPPAS, LENGTHS)
    found = log_partition(kappa[:, None], length).exp()
    assert ((found / expected - 1).abs() <= 1e-9).all()


def test_partition_keeps_the_precision_of_float32():
    kappa, length = double(KAPPAS, LENGTHS)
    kappa, length = kappa.float(), length.float()
    expected = log_partition(kappa.double()[:, None], length.double())
    found = log_partition(kappa[:, None], length)
    assert found.dtype == torch.float32
    assert ((found.double() - expected).abs() <= 5e-6).all()


def test_partition_gradients_equal_quadrature_of_the_derivative():
    for k in KAPPAS[::3]:
        for size in LENGTHS[::3]:
            kappa, length = double(k, size, requires_grad=True)
            by_kappa, by_length = torch.autograd.grad(log_partition(kappa, length), (kappa, length))
            z = series_partition(k, size)
            slope = integral(lambda u, k=k: -exact_energy_dkappa(u, k) * np.exp(-exact_energy(u, k)), size) / z
            edge = 2 * math.exp(-exact_energy(size, k)) / z
            assert by_kappa.item() == pytest.approx(slope, rel=1e-6, abs=0)
            # the head ends where less than 1e-13 of the density's peak is left
            assert by_length.item() == pytest.approx(edge, rel=1e-6, abs=1e-12)


def test_log_normalizer_gradients_equal_differences_of_the_series():
    sigma, d, bound = 1.3, 0.7, 9.0

    def series(sigma, d, bound):
        return math.log(d * series_partition(sigma**-2, bound / d))

    def slope(f, x, h=1e-3):
        return (8 * (f(x + h) - f(x - h)) - (f(x + 2 * h) - f(x - 2 * h))) / (12 * h)

    leaves = double(sigma, d, bound, requires_grad=True)
    found = torch.stack(torch.autograd.grad(log_normalizer(*leaves), leaves))
    expected = double(
        [
            slope(lambda s: series(s, d, bound), sigma),
            slope(lambda s: series(sigma, s, bound), d),
            slope(lambda b: series(sigma, d, b), bound),
        ]
    )
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=0)


def test_normalizer_of_many_channels_equals_a_loop():
    sigma, d, bound = double([0.05, 0.4, 3.0, 50.0, INF], [0.2, 3.0, 1.0, 7.0, 0.01], [1.0, 40.0, 1e5, 8.0, 1.0])
    together = log_normalizer(sigma, d, bound)
    alone = torch.stack([log_normalizer(*each) for each in zip(sigma, d, bound, strict=True)])
    torch.testing.assert_close(together, alone, rtol=1e-15, atol=1e-15)
    assert log_normalizer(sigma, d, bound[:, None]).shape == (5, 5)


@pytest.mark.parametrize("length", [0.3, 1.0, 8.0])
def test_normalizer_of_infinite_sigma_equals_that_of_the_truncated_gaussian(length):
    expected = math.log(0.5 * math.sqrt(2 * math.pi) * special.erf(length / math.sqrt(2)))
    assert log_normalizer(*double(INF, 0.5, 0.5 * length)).item() == pytest.approx(expected, abs=1e-12)


# --- the energy


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_energy_of_infinite_sigma_equals_half_the_square(dtype):
    z = torch.cat([torch.linspace(-9, 9, 61, dtype=dtype), torch.tensor([1e-15, 1e-3, 1e6, 1e15], dtype=dtype)])
    e = (2 * z).requires_grad_()
    sigma, d = torch.tensor(INF, dtype=dtype), torch.tensor(2.0, dtype=dtype, requires_grad=True)
    value = mkc_energy(e, sigma, d)
    by_e, by_d = torch.autograd.grad(value.sum(), (e, d))
    assert torch.equal(value, 0.5 * z * z)
    assert torch.equal(by_e, z / 2)
    torch.testing.assert_close(by_d, -(z * z).sum() / 2)
    assert torch.equal(mkc_weight(e, sigma, d), torch.ones_like(z))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_energy_of_infinite_sigma_has_gradient_zero_in_sigma(dtype):
    e = torch.tensor([0.0, 1e-3, 1.0, 40.0, 1e6], dtype=dtype, requires_grad=True)
    sigma = torch.full((5,), INF, dtype=dtype, requires_grad=True)
    d, bound = torch.ones(5, dtype=dtype, requires_grad=True), torch.full((5,), 1e7, dtype=dtype, requires_grad=True)
    gradients = torch.autograd.grad(mkc_nll(e, sigma, d, bound).sum(), (e, sigma, d, bound))
    assert all(g.isfinite().all() for g in gradients)
    assert torch.equal(gradients[0], e.detach())
    assert torch.equal(gradients[1], torch.zeros_like(e))


@sampled
@given(z=st.floats(-50, 50), kappa=st.floats(-12, -6).map(lambda p: 10**p))
def test_energy_tends_to_half_the_square_and_its_kappa_gradient_to_an_eighth_of_the_fourth_power(z, kappa):
    at_zero, near = double(0.0, kappa, requires_grad=True)
    for k in (at_zero, near):
        x = k.item() * z * z / 2
        value = energy(double(z), k)
        (slope,) = torch.autograd.grad(value, k)
        assert value.item() == pytest.approx(z * z / 2, rel=x + 1e-14)
        assert slope.item() == pytest.approx(-(z**4) / 8, rel=2 * x + 1e-14)


def test_energy_and_its_gradients_equal_scipy_over_fifteen_decades_of_kappa():
    z = np.concatenate([np.logspace(-3, 3, 49), -np.logspace(-3, 3, 7)])
    for k in KAPPAS:
        leaf, kappa = double(z.tolist(), k, requires_grad=True)
        value = energy(leaf, kappa)
        (by_z,) = torch.autograd.grad(value.sum(), leaf, retain_graph=True)
        by_kappa = vmap(lambda zi, kappa=kappa: grad(energy, argnums=1)(zi, kappa))(leaf)
        torch.testing.assert_close(value.detach(), double(exact_energy(z, k).tolist()), rtol=1e-13, atol=0)
        torch.testing.assert_close(by_z, double((z * np.exp(-0.5 * k * z * z)).tolist()), rtol=1e-12, atol=1e-300)
        expected = double(exact_energy_dkappa(z, k).tolist())
        torch.testing.assert_close(by_kappa.detach(), expected, rtol=1e-12, atol=0)


def test_energy_in_float32_is_right_where_one_minus_exp_is_zero():
    error, sigma = torch.ones(()), torch.tensor(1e4)
    assert mkc_energy(error, sigma, 1.0).item() == pytest.approx(0.5, rel=1e-6)
    assert (1e8 * (1 - torch.exp(-0.5 / sigma**2))).item() == 0  # the trap


@pytest.mark.parametrize("x", [16, *range(17, 81, 7), 80])
def test_energy_in_float32_has_the_gradient_of_float64_where_that_of_expm1_vanishes(x):
    single = torch.tensor(math.sqrt(2 * x), dtype=torch.float32)
    exact = grad(energy)(single.double(), double(1.0))
    found = grad(energy)(single, torch.tensor(1.0))
    assert found.dtype == torch.float32
    assert found.item() > 0
    assert found.item() == pytest.approx(exact.item(), rel=5e-7 * x)  # exp(-x) loses x rounding errors
    assert mkc_weight(single, 1.0, 1.0).item() == pytest.approx(math.exp(-(single.item() ** 2) / 2), rel=5e-7 * x)


def test_energy_in_float32_has_the_kappa_gradient_of_float64():
    z, kappa = torch.logspace(-3, 3, 31), torch.tensor(KAPPAS, dtype=torch.float32)[:, None]
    slope = vmap(vmap(grad(energy, argnums=1), (0, None)), (None, 0))
    found, exact = slope(z, kappa[:, 0]), slope(z.double(), kappa[:, 0].double())
    torch.testing.assert_close(found.double(), exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("error", [1e15, 1e20, -1e20, 1e30])
@pytest.mark.parametrize("sigma", [0.05, 3.0, 1e4])
def test_huge_errors_give_the_flat_tail_and_zero_gradient(error, sigma, dtype):
    e, s, d, bound = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in (error, sigma, 1.0, 100.0))
    value = mkc_energy(e, s, d)
    by_e, by_sigma, by_d = torch.autograd.grad(value, (e, s, d))
    assert value.item() == pytest.approx(sigma**2, rel=1e-6)
    assert by_e.item() == 0
    assert by_sigma.item() == pytest.approx(2 * sigma, rel=1e-5)
    assert by_d.item() == 0
    assert mkc_weight(e, s, d).item() == 0
    assert all(g.isfinite() for g in torch.autograd.grad(mkc_nll(e, s, d, bound), (e, s, d, bound)))


@pytest.mark.parametrize("error", [1e15, 1e20, 1e30])
def test_huge_errors_at_infinite_sigma_have_gradient_zero_in_sigma(error):
    sigma = torch.tensor(INF, requires_grad=True)
    (slope,) = torch.autograd.grad(mkc_energy(torch.tensor(error), sigma, 1.0), sigma)
    assert slope.item() == 0


@pytest.mark.parametrize("sigma", [0.05, 3.0, 1e4, INF])
def test_huge_errors_have_a_finite_hessian_in_float64(sigma):
    arguments = double([1e20, -1e30, 0.0, 5.0], sigma, 2.0)
    for block in torch.func.hessian(lambda *a: mkc_energy(*a).sum(), argnums=(0, 1, 2))(*arguments):
        assert all(b.isfinite().all() for b in block)


@sampled
@given(sigma=sigmas, d=scales, error=st.floats(-1e6, 1e6))
def test_energy_lies_between_zero_and_both_of_its_limits(sigma, d, error):
    value = mkc_energy(*double(error, sigma, d)).item()
    assert 0 <= value <= sigma**2 * (1 + 1e-15)
    assert value <= 0.5 * (error / d) ** 2 * (1 + 1e-15)
    assert value == mkc_energy(*double(-error, sigma, d)).item()


@sampled
@given(sigma=sigmas, d=scales, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_energy_is_monotonic_and_weight_antitonic_in_the_absolute_error(sigma, d, dtype):
    e = torch.cat([torch.zeros(1, dtype=dtype), torch.logspace(-4, 4, 200, dtype=dtype)])
    value, weight = mkc_energy(e, sigma, d), mkc_weight(e, sigma, d)
    ulp = 4 * torch.finfo(dtype).eps
    assert (value.diff() >= -ulp * value[1:]).all()
    assert (weight.diff() <= ulp * weight[1:]).all()
    assert ((weight >= 0) & (weight <= 1)).all()
    assert value[0] == 0
    assert weight[0] == 1


@sampled
@given(sigma=sigmas, d=scales, z=st.floats(-30, 30))
def test_weight_is_the_factor_of_the_gradient_of_the_energy(sigma, d, z):
    e = double(z * d, requires_grad=True)
    (slope,) = torch.autograd.grad(mkc_energy(e, sigma, d), e)
    expected = mkc_weight(e.detach(), sigma, d) * e.detach() / d**2
    torch.testing.assert_close(slope, expected, rtol=1e-11, atol=1e-300)


@sampled
@given(sigma=sigmas, d=scales, length=lengths)
def test_nll_is_that_of_a_density_that_integrates_to_one(sigma, d, length):
    bound = length * d
    norm = log_normalizer(*double(sigma, d, bound)).item()

    def density(u):  # in units of d
        return d * math.exp(-mkc_nll(*double(u * d, sigma, d, bound)).item())

    edges = [0.0]
    while edges[-1] < length:
        edges.append(min(length, max(1.0, 2 * edges[-1])))
    mass = sum(integrate.quad(density, *edge, epsrel=1e-9)[0] for edge in pairwise(edges))
    assert 2 * mass == pytest.approx(1, abs=1e-7)
    assert mkc_nll(*double(0.0, sigma, d, bound)).item() == pytest.approx(norm, rel=1e-14)


def test_nll_beyond_the_bound_stays_finite_and_falls_back_towards_it():
    e = double([-30.0, 30.0], requires_grad=True)
    value = mkc_nll(e, double(5.0), double(1.0), double(10.0))
    (slope,) = torch.autograd.grad(value.sum(), e)
    assert value.isfinite().all()
    assert slope[0] < 0 < slope[1]


# --- transforms

AT = [0.3, -2.0, 7.0], [0.6, 2.0, 9.0], [0.5, 1.0, 3.0], [20.0, 8.0, 3.5]
FUNCTIONS = {
    "energy": (lambda e, sigma, d, bound: mkc_energy(e, sigma, d) + 0 * bound),
    "weight": (lambda e, sigma, d, bound: mkc_weight(e, sigma, d) + 0 * bound),
    "log_normalizer": (lambda e, sigma, d, bound: log_normalizer(sigma, d, bound) + 0 * e),
    "nll": mkc_nll,
}
each_function = pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS.keys())


@each_function
@pytest.mark.parametrize("fast", [True, False])
def test_functions_pass_gradcheck(function, fast):
    leaves = double(*AT, requires_grad=True)
    assert gradcheck(function, leaves, fast_mode=fast, check_forward_ad=True, check_batched_grad=not fast)
    assert gradgradcheck(function, leaves, fast_mode=fast)


@pytest.mark.parametrize("fast", [True, False])
def test_the_energy_passes_gradcheck_at_and_near_kappa_zero(fast):
    def shifted(z, offset):  # differences need room on both sides of kappa = 0.1, and near zero
        return energy(z, offset)

    z, kappa = double([0.5, -3.0, 2.0], [1e-3, 1e-2, 0.1], requires_grad=True)
    assert gradcheck(shifted, (z, kappa), fast_mode=fast, check_forward_ad=True)
    assert gradgradcheck(shifted, (z, kappa), fast_mode=fast)
    zero = double([0.0, 0.0, 0.0])
    assert gradcheck(lambda z: energy(z, zero), (z,), fast_mode=fast, check_forward_ad=True)
    assert gradgradcheck(lambda z: energy(z, zero), (z,), fast_mode=fast)


def test_functions_pass_gradcheck_where_sigma_is_infinite():
    e, d, bound = double(AT[0], AT[2], AT[3], requires_grad=True)
    assert gradcheck(lambda e, d, bound: mkc_nll(e, INF, d, bound), (e, d, bound), check_forward_ad=True)
    assert gradgradcheck(lambda e, d, bound: mkc_nll(e, INF, d, bound), (e, d, bound))


@pytest.mark.parametrize(("a", "b"), [((3,), ()), ((), (3,)), ((2, 1), (3,)), ((2, 3), (1, 1))])
def test_functions_pass_gradcheck_with_broadcast_arguments(a, b):
    z = torch.linspace(-2.5, 3.0, math.prod(a), dtype=torch.float64).reshape(a).requires_grad_()
    kappa = torch.linspace(0.2, 1.5, math.prod(b), dtype=torch.float64).reshape(b).requires_grad_()
    assert gradcheck(energy, (z, kappa), check_forward_ad=True, check_batched_grad=True)
    assert gradgradcheck(energy, (z, kappa))


@each_function
def test_jvp_equals_backward(function):
    arguments = double(*AT)
    tangents = double([1.0, 0.5, -2.0], [0.1, -0.3, 0.2], [0.4, 0.1, -0.1], [1.0, 2.0, -1.0])
    value, tangent = jvp(function, arguments, tangents)
    leaves = [a.clone().requires_grad_() for a in arguments]
    expected = function(*leaves)
    gradients = torch.autograd.grad(expected.sum(), leaves)
    torch.testing.assert_close(value, expected.detach())
    torch.testing.assert_close(tangent, sum(g * t for g, t in zip(gradients, tangents, strict=True)))


def test_forward_ad_duals_carry_the_tangent_of_one_argument_alone():
    z, kappa = double([0.3, -2.0, 7.0], [0.0, 0.5, 3.0])
    for position, exact in ((0, lambda z, k: z * np.exp(-0.5 * k * z * z)), (1, exact_energy_dkappa)):
        with forward_ad.dual_level():
            duals = [z, kappa]
            duals[position] = forward_ad.make_dual(duals[position], torch.ones_like(z))
            tangent = forward_ad.unpack_dual(energy(*duals)).tangent
        expected = double([float(exact(a, k)) for a, k in zip(z.tolist(), kappa.tolist(), strict=True)])
        torch.testing.assert_close(tangent, expected)


@each_function
def test_vmap_over_samples_with_their_own_sigma_and_d_equals_broadcasting(function):
    e = torch.linspace(-6, 6, 5, dtype=torch.float64)[:, None].expand(5, 3)
    sigma, d, bound = double(AT[1], AT[2], AT[3])
    expected = function(e, sigma, d, bound)
    torch.testing.assert_close(vmap(function, (0, None, None, None))(e, sigma, d, bound), expected)
    torch.testing.assert_close(vmap(function, (1, 0, 0, 0), out_dims=1)(e, sigma, d, bound), expected)
    nested = vmap(vmap(function, (0, None, None, None)), (1, 0, 0, 0), out_dims=1)
    torch.testing.assert_close(nested(e, sigma, d, bound), expected)
    slopes = vmap(vmap(grad(function, argnums=(0, 1, 2)), (0, None, None, None)), (1, 0, 0, 0), out_dims=1)
    leaves = [t.clone().requires_grad_() for t in torch.broadcast_tensors(e, sigma, d)]
    gradients = torch.autograd.grad(function(*leaves, bound).sum(), leaves)
    torch.testing.assert_close(slopes(e, sigma, d, bound), gradients)


@each_function
def test_jacrev_jacfwd_and_hessian_agree(function):
    e, sigma, d, bound = double(*AT)
    backwards = jacrev(function, argnums=(0, 1, 2, 3))(e, sigma, d, bound)
    forwards = jacfwd(function, argnums=(0, 1, 2, 3))(e, sigma, d, bound)
    torch.testing.assert_close(backwards, forwards)

    def total(e, sigma, d):
        return function(e, sigma, d, bound).sum()

    curvature = hessian(total, argnums=(0, 1, 2))(e, sigma, d)
    twice_backwards = jacrev(jacrev(total, argnums=(0, 1, 2)), argnums=(0, 1, 2))(e, sigma, d)
    torch.testing.assert_close(curvature, twice_backwards)
    torch.testing.assert_close(curvature[0][1], curvature[1][0].T)
    assert any(block.abs().max() > 1e-3 for row in curvature for block in row)


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_compiled_nll_equals_eager_in_value_and_gradient():
    compiled = torch.compile(mkc_nll, fullgraph=True)
    for sigma in (AT[1], [INF, 0.05, 1e4]):
        leaves = double(AT[0], sigma, AT[2], AT[3], requires_grad=True)
        expected, found = mkc_nll(*leaves), compiled(*leaves)
        torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
        torch.testing.assert_close(
            torch.autograd.grad(found.sum(), leaves),
            torch.autograd.grad(expected.sum(), leaves),
            rtol=1e-11,
            atol=1e-13,
        )


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_compiled_energy_in_float32_is_right_where_one_minus_exp_is_zero():
    e = torch.linspace(0.5, 3.0, 64)  # long enough for vector instructions
    sigma = torch.full_like(e, 1e4)
    found = torch.compile(mkc_energy, fullgraph=True)(e, sigma, 1.0)
    torch.testing.assert_close(found, 0.5 * e * e, rtol=1e-5, atol=0)


# --- dtypes, numbers, shapes


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
    e, d = torch.tensor([0.01, -2.0, 30.0, 6e4], dtype=dtype), torch.tensor(0.5, dtype=dtype)
    sigma, bound = torch.tensor(3.0, dtype=dtype), torch.tensor(6e4, dtype=dtype)
    for function, arguments in (
        (mkc_energy, (e, sigma, d)),
        (mkc_weight, (e, sigma, d)),
        (log_normalizer, (sigma, d, bound)),
        (mkc_nll, (e, sigma, d, bound)),
    ):
        found = function(*arguments)
        assert found.dtype == torch.float32
        assert torch.equal(found, function(*(a.float() for a in arguments)))
    leaf = e.clone().requires_grad_()
    (slope,) = torch.autograd.grad(mkc_energy(leaf, sigma, d).sum(), leaf)
    assert slope.dtype == dtype
    assert slope.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_autocast_changes_nothing(dtype):
    arguments = [torch.tensor(v, dtype=dtype) for v in AT]
    for function in (mkc_nll, lambda e, s, d, b: mkc_weight(e, s, d) + log_normalizer(s, d, b)):
        leaves = [a.clone().requires_grad_() for a in arguments]
        expected = function(*leaves)
        gradients = torch.autograd.grad(expected.sum(), leaves)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = function(*leaves)
        assert found.dtype == expected.dtype
        assert torch.equal(found, expected)
        assert all(map(torch.equal, torch.autograd.grad(found.sum(), leaves), gradients))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_python_numbers_equal_tensors(dtype):
    e = torch.tensor(AT[0], dtype=dtype)
    tensors = [torch.tensor(v, dtype=dtype) for v in (2, 0.3, 50)]
    for function, count in ((mkc_energy, 2), (mkc_weight, 2), (mkc_nll, 3)):
        found = function(e, *(2, 0.3, 50)[:count])
        assert found.dtype == dtype
        assert torch.equal(found, function(e, *tensors[:count]))
    assert log_normalizer(2, 0.3, 50).dtype == torch.get_default_dtype()
    torch.testing.assert_close(log_normalizer(2, 0.3, 50).to(dtype), log_normalizer(*tensors))


def test_a_float64_scalar_keeps_its_digits_with_a_float32_tensor():
    assert mkc_energy(double(1.0), torch.tensor(0.5), 0.1).item() == pytest.approx(0.25 * -math.expm1(-200), rel=1e-15)


def test_integer_errors_are_computed_in_float32():
    found = mkc_energy(torch.tensor([0, 1, 100]), 2.0, 1.0)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, mkc_energy(torch.tensor([0.0, 1.0, 100.0]), 2.0, 1.0))


def test_sigma_and_d_of_each_sample_broadcast_against_the_errors():
    e = torch.linspace(-5, 5, 24, dtype=torch.float64).reshape(4, 3, 2)
    sigma = torch.linspace(0.3, 4, 4, dtype=torch.float64)[:, None, None]
    d, bound = double([[0.5], [1.0], [2.0]], [7.0, 9.0])
    for function, arguments in ((mkc_energy, (e, sigma, d)), (mkc_nll, (e, sigma, d, bound))):
        found = function(*arguments)
        assert found.shape == (4, 3, 2)
        full = torch.broadcast_tensors(*arguments)
        for index in ((0, 0, 0), (3, 1, 1), (2, 2, 0)):
            assert found[index].item() == pytest.approx(function(*(t[index] for t in full)).item(), rel=1e-14)
    assert mkc_energy(e[0, 0], sigma[:, 0], d[:1, 0]).shape == (4, 2)


def test_an_empty_batch_gives_an_empty_result():
    assert mkc_nll(torch.empty(0, 3), 2.0, torch.ones(3), 10.0).shape == (0, 3)


@pytest.mark.parametrize("position", [0, 1, 2, 3])
def test_complex_values_are_refused(position):
    arguments = [torch.ones(2) for _ in range(4)]
    arguments[position] = arguments[position].to(torch.complex64)
    with pytest.raises(TypeError, match=r"real .*got .*torch\.complex64"):
        mkc_nll(*arguments)


def test_kappa_max_is_the_inverse_square_of_the_smallest_sigma():
    assert inverse_square(double(0.05)).item() == pytest.approx(KAPPA_MAX, rel=1e-14)
    assert inverse_square(double(INF)).item() == 0


# --- what is refused, and where


POINTWISE = [mkc_energy, mkc_weight]
LIKELIHOOD = [lambda _, **p: log_normalizer(**p), mkc_nll]


def call_with(function, **changed):
    parameters = {"sigma": 2.0, "d": 1.0} | ({} if function in POINTWISE else {"bound": 5.0}) | changed
    return function(torch.tensor([0.5, 1.0]), **parameters)


@pytest.mark.parametrize("function", [*POINTWISE, *LIKELIHOOD])
@pytest.mark.parametrize("name", ["sigma", "d", "bound"])
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, -INF])
@pytest.mark.parametrize("kind", [float, torch.tensor, lambda v: torch.tensor([1.0, v], requires_grad=True)])
def test_parameters_out_of_range_are_refused_by_name(function, name, bad, kind):
    if name == "bound" and function in POINTWISE:
        return
    with pytest.raises(ValueError, match=rf"`{name}`.*(positive and finite|in \[.*inf\])"):
        call_with(function, **{name: kind(bad)})


@pytest.mark.parametrize("function", [*POINTWISE, *LIKELIHOOD])
def test_an_infinite_scale_or_domain_is_refused_and_an_infinite_bandwidth_is_the_gaussian(function):
    assert bool(call_with(function, sigma=INF).isfinite().all())
    for name in ("d", "bound"):
        if name == "d" or function not in POINTWISE:
            with pytest.raises(ValueError, match=rf"`{name}`.*positive and finite.*got inf"):
                call_with(function, **{name: INF})


def test_the_normaliser_accepts_the_rounded_smallest_sigma():
    for function in LIKELIHOOD:
        call_with(function, sigma=torch.tensor(KAPPA_MAX).rsqrt() * (1 - 1e-6))
        with pytest.raises(ValueError, match=r"`sigma`.*\[0\.05, inf\].*got 0\.04"):
            call_with(function, sigma=0.04)
    assert call_with(mkc_energy, sigma=0.001).tolist() == pytest.approx([1e-6, 1e-6])


@pytest.mark.parametrize("function", [*POINTWISE, *LIKELIHOOD])
def test_parameters_are_not_checked_under_vmap(function):
    sigma = torch.tensor([[2.0, -2.0], [1.0, 3.0]])
    found = vmap(lambda s: call_with(function, sigma=s))(sigma)
    torch.testing.assert_close(found, torch.stack([call_with(function, sigma=s.abs()) for s in sigma]))


@pytest.mark.e2e
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_compiled_code_checks_parameters_that_are_numbers():
    compiled = torch.compile(mkc_nll, fullgraph=True)
    error = torch.linspace(-3.0, 3.0, 7)
    torch.testing.assert_close(compiled(error, 2.0, 1.0, 5.0), mkc_nll(error, 2.0, 1.0, 5.0))
    with pytest.raises(ValueError, match=r"`sigma`.*in"):
        torch.compile(mkc_nll)(error, -2.0, 1.0, 5.0)
    tensors = torch.tensor([2.0]), torch.tensor([1.0]), torch.tensor([5.0])
    torch.testing.assert_close(compiled(error, *tensors), mkc_nll(error, *tensors))


@pytest.mark.parametrize("function", [*POINTWISE, *LIKELIHOOD])
def test_parameters_that_are_not_numbers_are_refused_by_name(function):
    for value in ("2", None, 2j):
        with pytest.raises(TypeError, match=r"`sigma`.*number"):
            call_with(function, sigma=value)


def test_errors_and_arguments_of_the_primitives_must_be_tensors():
    for error in (np.ones(2), [1.0, 2.0]):
        with pytest.raises(TypeError, match=r"`error`.*real tensor.*torch\.as_tensor\(error\)"):
            mkc_energy(error, 1.0, 1.0)
    with pytest.raises(TypeError, match=r"`kappa`.*tensor.*got float"):
        energy(torch.ones(2), 1.0)
    with pytest.raises(TypeError, match=r"`length`.*tensor.*got float"):
        log_partition(torch.ones(2), 1.0)
    assert mkc_energy(torch.tensor([math.nan, 1.0]), 2.0, 1.0).isnan().tolist() == [True, False]
