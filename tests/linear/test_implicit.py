"""Fits as differentiable layers: comparison with unrolled steps and differences of fits, transforms, limits."""

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import grad, gradcheck, gradgradcheck
from torch.func import vmap

from mkc_torch import EllipsoidFit
from mkc_torch.linear import FixedPointLinear, LeastSquares, MKCRegression
from mkc_torch.linear._implicit.refusal import NotDifferentiableError
from tests.draws import normal as sample

# torch's own forward mode
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def leaves(*values: Tensor) -> list[Tensor]:
    return [v.detach().clone().requires_grad_() for v in values]


def line(seed: int, N: int = 40, n: int = 3, batch: tuple[int, ...] = ()) -> tuple[Tensor, Tensor, Tensor]:
    """X, y and weights of one channel; a fifth of y are outliers on both sides."""
    X = sample(seed, *batch, N, n)
    y = X.sum(-1) + 0.3 * sample(seed + 1, *batch, N)
    y[..., : N // 5] += 6.0 * sample(seed + 2, *batch, N // 5)
    return X, y, (0.5 * sample(seed + 3, *batch, N)).exp()


def channels(seed: int, N: int = 50) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """X, Y, weights of values, σ and d of three channels with different scales."""
    d = torch.tensor([0.2, 1.0, 5.0]).double()
    X = sample(seed, N, 3, 4)
    Y = X.sum(-1) + d * sample(seed + 1, N, 3)
    Y[:8] += 20.0
    return X, Y, sample(seed + 2, N, 3).exp(), torch.tensor([1.5, 2.0, 3.0]).double(), d


def fixed_point(X: Tensor, Y: Tensor, weight: Tensor, sigma: Tensor, d: Tensor) -> Tensor:
    return FixedPointLinear(sigma, d).fit(X, Y, weight).coef_


def unrolled(X: Tensor, Y: Tensor, weight: Tensor, sigma: Tensor, d: Tensor, steps: int = 300) -> Tensor:
    """Autograd through (15) from the solution, by explicit sums."""
    coef = FixedPointLinear(sigma.detach(), d.detach()).fit(X.detach(), Y.detach(), weight.detach()).coef_
    for _ in range(steps):
        w = weight * torch.exp(-((Y - X @ coef) ** 2) / (2 * d**2 * sigma**2)) / d**2
        coef = torch.linalg.solve(torch.einsum("ki,kin,kil->nl", w, X, X), torch.einsum("ki,kin,ki->n", w, X, Y))
    return coef


# the fixed point


def test_gradients_equal_those_of_the_unrolled_fixed_point():
    inputs, direction = leaves(*channels(0)), sample(9, 4)
    implicit = grad(fixed_point(*inputs) @ direction, inputs)
    explicit = grad(unrolled(*inputs) @ direction, inputs)
    for ours, theirs in zip(implicit, explicit, strict=True):
        assert float(theirs.abs().max()) > 1e-3
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-9 * float(theirs.abs().max()))


def test_the_hessian_is_that_of_the_loss_and_not_the_gram_matrix_of_the_step():
    X, Y, weight, sigma, d = channels(0)
    leaf = Y.clone().requires_grad_()
    coef = fixed_point(X, leaf, weight, sigma, d)
    (slope,) = grad(coef[0], leaf)
    z2 = ((Y - X @ coef.detach()) / d) ** 2
    w = weight * torch.exp(-z2 / (2 * sigma**2)) / d**2
    curvature_weight = w * (1 - z2 / sigma**2)
    right, wrong = (torch.linalg.inv(torch.einsum("ki,kin,kil->nl", a, X, X)) for a in (curvature_weight, w))
    torch.testing.assert_close(
        slope, torch.einsum("n,kin,ki->ki", right[0], X, curvature_weight), rtol=1e-9, atol=1e-12
    )
    other = torch.einsum("n,kin,ki->ki", wrong[0], X, curvature_weight)
    assert float((slope - other).norm()) > 0.05 * float(slope.norm())


def test_gradients_equal_differences_of_fits_in_both_modes():
    X, y, weight = line(0, N=12, n=2)
    inputs = leaves(X, y, weight, torch.tensor(1.7).double(), torch.tensor(0.6).double())
    assert gradcheck(fixed_point, inputs, check_forward_ad=True, check_batched_grad=True, fast_mode=True)


@pytest.mark.e2e
def test_second_derivatives_equal_differences_of_first_derivatives():
    X, y, weight = line(0, N=10, n=2)
    inputs = leaves(X, y, weight, torch.tensor(1.7).double(), torch.tensor(0.6).double())
    assert gradgradcheck(fixed_point, inputs, check_fwd_over_rev=True, fast_mode=True)


def test_weights_and_predictions_of_a_fixed_point_are_differentiable():
    X, Y, weight, sigma, d = channels(1, N=12)

    def results(*inputs: Tensor) -> tuple[Tensor, ...]:
        fit = FixedPointLinear(*inputs[3:]).fit(*inputs[:3])
        return fit.weights_, fit.predict(inputs[0])

    assert gradcheck(results, leaves(X, Y, weight, sigma, d), fast_mode=True)


def test_derivatives_at_an_infinite_sigma_equal_those_of_weighted_least_squares():
    X, y, weight = line(0)
    inputs = leaves(X, y, weight, torch.tensor(math.inf).double(), torch.tensor(0.7).double())
    slopes = grad(fixed_point(*inputs).square().sum(), inputs)
    root = inputs[2].sqrt()
    explicit = torch.linalg.lstsq(inputs[0] * root.unsqueeze(-1), (inputs[1] * root).unsqueeze(-1)).solution
    expected = grad(explicit.square().sum(), inputs[:3])
    torch.testing.assert_close(slopes[:3], expected, rtol=1e-10, atol=1e-13)
    assert slopes[3].item() == 0.0
    assert slopes[4].abs().item() < 1e-12


def test_gradients_do_not_depend_on_scale_and_collinearity_of_the_columns():
    X, y, weight = line(3, N=30)
    mix = torch.tensor([[1e6, 1.0, 0.0], [0.0, 1e-3, 1.0], [0.0, 0.0, 1.001]]).double()
    straight, mixed = leaves(y, y)
    sigma, d = torch.tensor(2.0).double(), torch.tensor(0.3).double()
    expected = grad(fixed_point(X, straight, weight, sigma, d).sum(), straight)[0]
    coef = fixed_point(X @ mix, mixed, weight, sigma, d)
    torch.testing.assert_close(grad((mix @ coef).sum(), mixed)[0], expected, rtol=1e-7, atol=1e-10)


def test_a_noise_covariance_is_differentiated_through():
    X, Y, weight, _, _ = channels(2)
    factor = torch.tensor([[0.2, 0.0, 0.0], [0.3, 1.0, 0.0], [0.5, -1.0, 5.0]]).double()

    def coef(Y: Tensor, factor: Tensor) -> Tensor:
        return FixedPointLinear(2.0, 1.0, noise_covariance=factor @ factor.mT).fit(X, Y, weight).coef_

    assert gradcheck(coef, leaves(Y, factor), fast_mode=True)


def test_float32_agrees_with_float64():
    X, y, weight = line(0, N=100)
    slopes = []
    for dtype in (torch.float64, torch.float32):
        inputs = leaves(*(v.to(dtype) for v in (X, y, weight)))
        fit = MKCRegression(bound=20.0).fit(*inputs)
        slopes.append([g.double() for g in grad(fit.coef_.sum() + fit.d_.sum(), inputs)])
    for double, single in zip(*slopes, strict=True):
        torch.testing.assert_close(single, double, rtol=0, atol=1e-4 * float(double.abs().max()))


def test_samples_of_weight_0_have_no_influence_but_a_derivative_by_their_weight():
    X, y, weight = line(0)
    weight[:8] = 0.0
    y[0] = 1e6
    inputs = leaves(X, y, weight)
    fit = MKCRegression(bound=1e7).fit(*inputs)
    by_X, by_y, by_weight = grad(fit.coef_.sum() + fit.d_.sum(), inputs)
    assert not bool(by_X[:8].any())
    assert not bool(by_y[:8].any())
    assert bool(torch.isfinite(by_weight).all())
    assert bool((by_weight[1:8] != 0).all())


# MKC-EM


def em_results(*inputs: Tensor) -> tuple[Tensor, ...]:
    fit = MKCRegression(bound=torch.tensor([25.0, 40.0, 80.0]).double()).fit(*inputs)
    return fit.coef_, fit.sigma_, fit.d_, fit.log_likelihood_


@pytest.mark.e2e
def test_gradients_of_the_maximum_equal_differences_of_fits():
    X, Y, weight, _, _ = channels(0, N=40)
    inputs = leaves(X, Y, weight)
    results = em_results(*inputs)
    assert bool((results[1] < 10).all())
    for k, result in enumerate(results):
        direction = sample(k, result.numel()).view_as(result)
        slopes = grad((direction * result).sum(), inputs, retain_graph=True)
        for i, slope in enumerate(slopes):
            along = sample(10 + i, *slope.shape)
            values = []
            for step in (-2e-4, -1e-4, 1e-4, 2e-4):
                moved = [v.detach() for v in inputs]
                moved[i] = moved[i] + step * along
                values.append((direction * em_results(*leaves(*moved))[k]).sum().item())
            difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-4
            assert float((slope * along).sum()) == pytest.approx(difference, rel=1e-6, abs=1e-8)


def test_gradients_of_the_maximum_equal_differences_of_plain_fits():
    X, y, weight = line(0)
    long = MKCRegression(bound=25.0, tol=1e-16, max_iter=3000)
    leaf, along = y.clone().requires_grad_(), sample(4, 40)
    for name in ("coef_", "sigma_", "d_"):
        slope = (grad(getattr(long.fit(X, leaf, weight), name).sum(), leaf)[0] * along).sum()
        high, low = (getattr(long.fit(X, y + step * along, weight), name).sum() for step in (1e-3, -1e-3))
        assert slope.item() == pytest.approx(((high - low) / 2e-3).item(), rel=1e-3)


def em_results_of_one_channel(X: Tensor, y: Tensor, weight: Tensor, bound: Tensor) -> tuple[Tensor, ...]:
    fit = MKCRegression(bound=bound).fit(X, y, weight)
    return fit.coef_, fit.sigma_, fit.d_, fit.log_likelihood_, fit.weights_


@pytest.mark.e2e
def test_derivatives_of_all_results_of_em_pass_gradcheck_in_both_modes():
    X, y, weight = line(0, N=25, n=2)
    inputs = leaves(X, y, weight, torch.tensor([20.0]).double())
    assert 1.0 < em_results_of_one_channel(*inputs)[1].item() < 5.0
    assert gradcheck(em_results_of_one_channel, inputs, check_forward_ad=True, fast_mode=True)


def test_second_derivatives_of_em_pass_gradgradcheck():
    X, y, weight = line(0, N=25, n=2)

    def results(*inputs: Tensor) -> Tensor:
        return torch.cat([v.reshape(-1) for v in em_results_of_one_channel(X, *inputs)[:4]])

    inputs = leaves(y, weight, torch.tensor([20.0]).double())
    assert gradgradcheck(results, inputs, atol=1e-4, rtol=1e-3, fast_mode=True)


def test_gradients_of_em_include_the_change_of_sigma_and_d():
    X, y, weight = line(0)
    leaf, other = leaves(y, y)
    fit = MKCRegression(bound=25.0).fit(X, leaf, weight)
    alone = FixedPointLinear(fit.sigma_.detach(), fit.d_.detach()).fit(X, other, weight)
    torch.testing.assert_close(fit.coef_, alone.coef_, rtol=1e-5, atol=1e-7)
    jointly, separately = grad(fit.coef_[0], leaf)[0], grad(alone.coef_[0], other)[0]
    assert float((jointly - separately).norm()) > 1e-3 * float(jointly.norm())


@pytest.mark.parametrize("name", ["sigma", "d"])
def test_derivatives_by_a_given_sigma_or_d_pass_gradcheck(name):
    X, y, weight = line(0)

    def results(value: Tensor) -> tuple[Tensor, ...]:
        fit = MKCRegression(bound=25.0, **{name: value}).fit(X, y, weight)
        return fit.coef_, fit.sigma_, fit.d_

    value = torch.tensor([{"sigma": 2.0, "d": 0.4}[name]]).double().requires_grad_()
    assert gradcheck(results, [value])
    (own,) = grad(getattr(MKCRegression(bound=25.0, **{name: value}).fit(X, y, weight), f"{name}_").sum(), value)
    assert own.item() == pytest.approx(1.0)


def test_a_domain_from_the_data_is_differentiated_as_a_constant():
    X, y, weight = line(0)
    first, second = leaves(y, y)
    fit = MKCRegression().fit(X, first, weight)
    given = MKCRegression(bound=fit.bound_.detach()).fit(X, second, weight)
    for a, b in ((fit.coef_, given.coef_), (fit.sigma_, given.sigma_), (fit.d_, given.d_)):
        torch.testing.assert_close(grad(a.sum(), first, retain_graph=True), grad(b.sum(), second, retain_graph=True))
    assert not fit.bound_.requires_grad


def test_derivatives_of_a_gaussian_channel_equal_those_of_least_squares():
    X, y = sample(5, 200, 3), 0.3 * sample(6, 200)
    y = y + X.sum(-1)
    leaf, other = leaves(y, y)
    fit = MKCRegression().fit(X, leaf)
    assert bool(torch.isinf(fit.sigma_))
    assert not bool(grad(fit.sigma_.sum(), leaf, retain_graph=True)[0].any())
    plain = LeastSquares().fit(X, other).coef_
    spread = (other - X @ plain).square().mean().sqrt()
    torch.testing.assert_close(grad(fit.coef_.sum() + fit.d_.sum(), leaf), grad(plain.sum() + spread, other))


def test_an_exact_fit_has_derivatives_by_the_fitted_values_and_none_of_d():
    X = torch.stack([torch.ones(10), torch.arange(10.0)], -1).double()
    y = 1 + 2 * X[:, 1]
    y[:4] = 100.0
    y.requires_grad_()
    fit = MKCRegression().fit(X, y)
    assert bool(fit.exact_fit_)
    assert not bool(grad(fit.d_.sum(), y, retain_graph=True)[0].any())
    slope = grad(fit.coef_[1], y)[0]
    assert not bool(slope[:4].any())
    torch.testing.assert_close(slope[4:], torch.linalg.pinv(X[4:])[1], rtol=1e-6, atol=1e-9)


def test_the_centre_of_an_ellipsoid_moves_with_its_points():
    direction = sample(0, 60, 3)
    points = direction / direction.norm(dim=-1, keepdim=True) * torch.tensor([40.0, 50.0, 45.0]).double()
    points = (points + torch.tensor([5.0, -3.0, 8.0]).double() + 0.1 * sample(1, 60, 3)).requires_grad_()
    slope = grad(EllipsoidFit(MKCRegression()).fit(points).center_[0], points)[0]
    # the whole cloud moves, and its centre with it
    torch.testing.assert_close(slope.sum(0), torch.tensor([1.0, 0.0, 0.0]).double(), rtol=0, atol=1e-2)


# transforms


def test_forward_and_reverse_mode_derivatives_agree():
    inputs = channels(0)
    tangents = [sample(20 + i, *v.shape) for i, v in enumerate(inputs)]
    _, forward = torch.func.jvp(fixed_point, inputs, tuple(tangents))
    backward = torch.func.jacrev(fixed_point, argnums=tuple(range(5)))(*inputs)
    expected = sum((j.flatten(1) @ t.flatten() for j, t in zip(backward, tangents, strict=True)), torch.zeros(4))
    torch.testing.assert_close(forward, expected)


def em_scale(X: Tensor, y: Tensor, weight: Tensor) -> Tensor:
    fit = MKCRegression().fit(X, y, weight)
    return torch.cat([fit.coef_, fit.d_])


def graduated_scale(X: Tensor, y: Tensor, weight: Tensor) -> Tensor:
    fit = FixedPointLinear(2.0, 0.3, start=X[:3].sum(-1)).fit(X, y, weight)
    return torch.cat([fit.coef_, fit.weights_.sum(-2)])


@pytest.mark.parametrize("function", [em_scale, graduated_scale])
def test_vmap_equals_a_loop(function):
    X, y, weight = line(0, batch=(4,))
    one_by_one = torch.stack([function(*leaves(*v)) for v in zip(X, y, weight, strict=True)])
    torch.testing.assert_close(vmap(function)(X, y, weight), one_by_one, rtol=1e-8, atol=1e-10)
    nested = vmap(vmap(function))(*(v.unflatten(0, (2, 2)) for v in (X, y, weight)))
    torch.testing.assert_close(nested.flatten(0, 1), one_by_one, rtol=1e-8, atol=1e-10)
    shared = vmap(function, (None, -1, None))(X[0], y.mT, weight[0])
    one_by_one = torch.stack([function(*leaves(X[0], v, weight[0])) for v in y])
    torch.testing.assert_close(shared, one_by_one, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("function", [em_scale, graduated_scale])
def test_gradients_under_vmap_equal_those_of_a_loop(function):
    data = line(0, batch=(3,))
    slope = torch.func.grad(lambda *a: function(*a).square().sum(), argnums=(0, 1, 2))
    together = vmap(slope)(*data)
    for i in range(3):
        alone = slope(*(v[i] for v in data))
        torch.testing.assert_close(tuple(g[i] for g in together), alone, rtol=1e-7, atol=1e-9)


def test_a_batch_and_its_gradients_equal_a_loop():
    X, y, weight = line(0, batch=(2, 3))
    batch = leaves(X[0, 0], y, weight[0])
    coef = FixedPointLinear(2.0, 0.3).fit(*batch).coef_
    assert coef.shape == (2, 3, 3)
    loop = leaves(X[0, 0], y, weight[0])
    rows = [
        FixedPointLinear(2.0, 0.3).fit(loop[0], loop[1][i, j], loop[2][j]).coef_ for i in range(2) for j in range(3)
    ]
    torch.testing.assert_close(coef.flatten(0, 1), torch.stack(rows), rtol=1e-8, atol=1e-10)
    expected = grad(torch.stack(rows).square().sum(), loop)
    torch.testing.assert_close(grad(coef.square().sum(), batch), expected, rtol=1e-8, atol=1e-9)


def test_derivatives_under_vmap_over_bandwidths_equal_those_of_a_loop():
    X, y, _ = line(0)
    sigma = torch.tensor([1.0, 2.0, math.inf]).double()

    def coef(sigma: Tensor) -> Tensor:
        return FixedPointLinear(sigma, 0.3).fit(X, y).coef_

    together = vmap(torch.func.jacrev(coef))(sigma)
    torch.testing.assert_close(together, torch.stack([torch.func.jacrev(coef)(s) for s in sigma]), atol=1e-9, rtol=1e-7)


def test_a_hessian_by_forward_over_reverse_is_symmetric():
    X, y, weight = line(0, N=12, n=2)
    hessian = torch.func.hessian(lambda y: em_scale(X, y, weight).square().sum())(y)
    assert float(hessian.abs().max()) > 1e-3
    torch.testing.assert_close(hessian, hessian.mT, rtol=1e-9, atol=1e-12)


# without derivatives


@pytest.mark.parametrize("estimator", [FixedPointLinear(2.0, 0.3), MKCRegression()])
def test_fits_without_a_gradient_record_no_graph(estimator):
    X, y, weight = line(0)
    plain = estimator.fit(X, y, weight).coef_
    assert not plain.requires_grad
    assert not hasattr(estimator, "differentiable_")
    leaf = X.clone().requires_grad_()
    with torch.no_grad():
        assert torch.equal(estimator.fit(leaf, y, weight).coef_, plain)
    assert not estimator.coef_.requires_grad
    assert not hasattr(estimator, "differentiable_")
    layer = estimator.fit(leaf, y, weight)
    assert bool(layer.differentiable_)
    torch.testing.assert_close(layer.coef_, plain, rtol=1e-5, atol=1e-6)
    assert not layer.covariance_.requires_grad
    assert not layer.history_.requires_grad
    assert not hasattr(estimator.fit(X, y, weight), "differentiable_")


@pytest.mark.parametrize("estimator", [FixedPointLinear(2.0, 0.3), MKCRegression()])
def test_a_fit_with_a_gradient_has_the_results_of_a_plain_fit(estimator):
    X, y, weight = line(0, batch=(2,))
    estimator.fit(X, y, weight)
    plain = {k: v for k, v in vars(estimator).items() if k.endswith("_")}
    estimator.fit(X, y.clone().requires_grad_(), weight)
    for name, value in plain.items():
        ours = getattr(estimator, name)
        if isinstance(value, Tensor):
            assert ours.dtype == value.dtype
            torch.testing.assert_close(ours.detach(), value, rtol=1e-3, atol=1e-4)
        else:
            assert ours == value


# refusals

TWO_CLUSTERS = torch.tensor([-2.0, 2.0]).double().repeat(5)


def mean_between_clusters(y: Tensor) -> FixedPointLinear:
    """A mean that remains halfway between two clusters, at a maximum of the loss."""
    start = torch.zeros(*y.shape[:-1], 1).double()
    return FixedPointLinear(1.0, 1.0, start=start).fit(torch.ones(10, 1).double(), y)


def test_a_maximum_is_refused_when_its_derivative_is_taken():
    (y,) = leaves(TWO_CLUSTERS)
    fit = mean_between_clusters(y)
    assert bool(fit.converged_)
    assert not bool(fit.differentiable_)
    assert fit.coef_.item() == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(NotDifferentiableError, match="strict minimum to differentiate at"):
        fit.coef_.sum().backward()
    with pytest.raises(NotDifferentiableError, match="Hessian"):
        torch.func.jvp(lambda y: mean_between_clusters(y).coef_, (TWO_CLUSTERS,), (torch.ones(10).double(),))
    with pytest.raises(NotDifferentiableError, match="problem 0"):
        vmap(torch.func.grad(lambda y: mean_between_clusters(y).coef_.sum()))(TWO_CLUSTERS.expand(2, 10))


def test_a_derivative_with_a_singular_weighted_gram_matrix_is_refused():
    X = torch.stack([torch.ones(6), torch.arange(6.0)], -1).double()
    y = torch.tensor([0.0, 1e3, -1e3, 4e3, 2e3, -5e3]).double().requires_grad_()
    fit = FixedPointLinear(1.0, 1.0, start=torch.zeros(2).double()).fit(X, y)
    assert not bool(fit.differentiable_)
    with pytest.raises(NotDifferentiableError, match="singular"):
        fit.coef_.sum().backward()


@pytest.mark.parametrize("estimator", [FixedPointLinear(2.0, 0.3, max_iter=2), MKCRegression(max_iter=2)])
def test_a_fit_that_has_not_converged_is_refused(estimator):
    X, y, weight = line(0)
    plain = estimator.fit(X, y, weight).coef_
    fit = estimator.fit(X, y.requires_grad_(), weight)
    assert not bool(fit.converged_)
    torch.testing.assert_close(fit.coef_.detach(), plain, rtol=1e-12, atol=1e-13)
    with pytest.raises(NotDifferentiableError, match=r"a converged fit .* has not converged; raise `max_iter`"):
        fit.coef_.sum().backward()


def test_problems_without_a_derivative_can_be_masked_by_differentiable():
    good = 1.0 + 0.3 * sample(0, 10)
    (y,) = leaves(torch.stack([good, TWO_CLUSTERS]))
    fit = mean_between_clusters(y)
    assert fit.differentiable_.tolist() == [True, False]
    slope = grad(fit.coef_[fit.differentiable_].sum(), y, retain_graph=True)[0]
    (alone,) = leaves(good)
    torch.testing.assert_close(
        slope[0], grad(mean_between_clusters(alone).coef_.sum(), alone)[0], rtol=1e-9, atol=1e-12
    )
    assert not bool(slope[1].any())
    with pytest.raises(NotDifferentiableError, match="problem 1"):
        grad(fit.coef_.sum(), y, retain_graph=True)
    with pytest.raises(NotDifferentiableError, match="problem 1"):
        grad(fit.coef_, y, torch.eye(2).double().unsqueeze(-1), is_grads_batched=True)


def test_bad_data_and_parameters_are_refused():
    X, y, _ = line(0)
    leaf = X.clone().requires_grad_()
    with pytest.raises(ValueError, match="Expected argument `Y` to be finite"):
        MKCRegression().fit(leaf, y * math.nan)
    with pytest.raises(ValueError, match="Expected argument `sample_weight` to be >= 0"):
        FixedPointLinear().fit(leaf, y, -torch.ones(40))
    with pytest.raises(ValueError, match="Expected argument `sigma` to be positive"):
        FixedPointLinear(torch.tensor(-1.0)).fit(leaf, y)


# learning


@pytest.mark.e2e
def test_features_under_a_robust_last_layer_learn_from_contaminated_samples():
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(24, 40, 1, generator=generator, dtype=torch.float64) * 4 - 2
    amplitude = sample(1, 24, 2, 1)
    y = (amplitude[:, 0] * x.squeeze(-1) + amplitude[:, 1] * torch.sin(3 * x).squeeze(-1)) + 0.02 * sample(2, 24, 40)
    y[:, :5] += 8.0
    torch.manual_seed(0)
    features = torch.nn.Sequential(torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3)).double()
    optimiser = torch.optim.SGD(features.parameters(), lr=0.1, momentum=0.9)
    head = FixedPointLinear(2.0, 0.5)
    losses = []
    for _ in range(60):
        # fitted on the first twenty samples, with outliers, and judged on the others
        fit = head.fit(features(x[:, :20]), y[:, :20])
        per_task = (fit.predict(features(x[:, 20:])) - y[:, 20:]).square().mean(-1)
        loss = per_task[fit.differentiable_].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])


def test_sample_weights_are_learned_through_the_fit():
    X, y, _ = line(0, N=60)
    y[:20] += 1.0  # too near for a robust loss to reject
    logits = torch.zeros(60, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.1)
    for _ in range(25):
        coef = FixedPointLinear(3.0, 0.5, start="least_squares").fit(X, y, logits.sigmoid()).coef_
        optimiser.zero_grad()
        (coef - 1.0).square().sum().backward()
        optimiser.step()
    first = FixedPointLinear(3.0, 0.5, start="least_squares").fit(X, y).coef_
    assert float((coef.detach() - 1.0).norm()) < 0.2 * float((first - 1.0).norm())
