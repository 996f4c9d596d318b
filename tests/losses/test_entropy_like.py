"""H of residuals: definition, derivatives, edge cases, and minima over any model."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor, nn

from mkc_torch import LELoss, least_entropy_like
from mkc_torch.linear import LeastEntropyLike
from mkc_torch.losses.entropy_like import entropy_like, orthogonal_starts
from tests.literature import hbk

FORWARD_MODE = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")  # torch's own


def sample(seed: int, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def entropy_by_definition(r: np.ndarray) -> float:
    """(40)-(42) of the paper, summed over single residuals."""
    D = float((r**2).sum())
    if D == 0:
        return 0.0
    return -sum(v**2 / D * math.log(v**2 / D) for v in r.ravel().tolist() if v != 0) / math.log(r.size)


def gradient_by_formula(r: np.ndarray) -> np.ndarray:
    """(52) of the paper, by the residuals."""
    D = (r**2).sum()
    q = r**2 / D
    jacobian = np.diag(2 * r / D) - np.outer(r**2, 2 * r) / D**2
    return -((1 + np.log(q)) @ jacobian) / math.log(r.size)


# value


@pytest.mark.parametrize("seed", range(3))
def test_the_value_follows_the_definition(seed):
    r = sample(seed, 5, 7)
    assert float(entropy_like(r)) == pytest.approx(entropy_by_definition(r.numpy()), rel=1e-13)
    torch.testing.assert_close(
        entropy_like(r, 0),
        torch.tensor([entropy_by_definition(c) for c in r.numpy().T], dtype=r.dtype),
        rtol=1e-13,
        atol=0,
    )
    torch.testing.assert_close(entropy_like(r, (0, 1)), entropy_like(r), rtol=1e-14, atol=0)
    torch.testing.assert_close(entropy_like(r, -1), entropy_like(r.T, 0), rtol=1e-14, atol=0)


def test_the_value_reaches_its_bounds_0_and_1():
    assert float(entropy_like(torch.tensor([3.0, -3.0, 3.0, 3.0]))) == pytest.approx(1.0)
    assert float(entropy_like(torch.tensor([0.0, 7.0, 0.0]))) == 0.0
    assert float(entropy_like(torch.zeros(4))) == 0.0
    assert float(entropy_like(torch.tensor([2.0]))) == 0.0
    assert float(entropy_like(torch.tensor(2.0))) == 0.0
    assert 0.0 < float(entropy_like(sample(0, 100))) < 1.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [-1.0, 1e-30, 1e-36, 1e30, 1e37])
def test_the_value_does_not_depend_on_the_scale(scale, dtype):
    r = sample(1, 50, dtype=dtype).clamp(-4, 4).requires_grad_()
    scaled = (r.detach() * scale).requires_grad_()
    h, same = entropy_like(r), entropy_like(scaled)
    assert same.item() == pytest.approx(h.item(), rel=1e-6)
    (g,), (gs,) = torch.autograd.grad(h, r), torch.autograd.grad(same, scaled)
    torch.testing.assert_close(gs.double() * scale, g.double(), rtol=2e-4, atol=1e-7)


def test_subnormal_residuals_count_as_zero():
    r = torch.tensor([1e-41, 2e-41, -1e-41], requires_grad=True)
    h = entropy_like(r)
    assert h == 0.0
    assert float(torch.autograd.grad(h, r)[0].abs().max()) == 0.0


def test_float32_is_accurate_over_a_million_residuals():
    r = sample(2, 1_000_000)
    r[:1000] *= 1e6
    assert float(entropy_like(r.float())) == pytest.approx(float(entropy_like(r)), rel=2e-6)


# derivatives


@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_equals_the_papers_formula(seed):
    r = sample(seed, 12).requires_grad_()
    (gradient,) = torch.autograd.grad(entropy_like(r), r)
    np.testing.assert_allclose(gradient.numpy(), gradient_by_formula(r.detach().numpy()), rtol=1e-10, atol=1e-13)


@FORWARD_MODE
def test_gradcheck_to_second_order_and_in_forward_mode():
    r, w = sample(3, 4, 3).requires_grad_(), sample(4, 4, 3).abs().add(0.5).requires_grad_()
    torch.autograd.gradcheck(entropy_like, (r,), check_forward_ad=True, check_batched_grad=True)
    torch.autograd.gradcheck(lambda r, w: entropy_like(r, 0, w), (r, w), check_forward_ad=True)
    torch.autograd.gradgradcheck(entropy_like, (r,), atol=1e-5)


def test_derivatives_at_zero_residuals_are_limits_of_nearby_derivatives():
    r = torch.tensor([0.0, 1.0, -2.0, 0.0], dtype=torch.float64, requires_grad=True)
    (g,) = torch.autograd.grad(entropy_like(r), r, create_graph=True)
    assert g[0] == 0 == g[3]
    near = gradient_by_formula(np.array([1e-12, 1.0, -2.0, 1e-12]))
    np.testing.assert_allclose(g.detach().numpy(), near, rtol=0, atol=1e-9)
    second = torch.autograd.functional.hessian(entropy_like, r.detach())
    assert bool(torch.isfinite(second).all())
    assert second[0, 0] > 100  # grows like -log r²
    nearby = torch.autograd.functional.hessian(entropy_like, torch.tensor([1e-9, 1.0, -2.0, 1e-9]).double())
    torch.testing.assert_close(second[1:3, 1:3], nearby[1:3, 1:3], rtol=1e-6, atol=1e-6)


def test_the_gradient_of_all_zero_residuals_and_of_a_single_residual_is_zero():
    for r in (torch.zeros(5, 2), torch.tensor([[3.0, 0.0]]), torch.tensor([4.0])):
        r = r.double().requires_grad_()
        assert entropy_like(r) == 0.0
        assert float(torch.autograd.grad(entropy_like(r), r)[0].abs().max()) == 0.0


@FORWARD_MODE
def test_vmap_equals_a_loop_and_jvp_equals_the_gradient():
    r, t = sample(5, 6, 9), sample(6, 6, 9)
    torch.testing.assert_close(torch.func.vmap(entropy_like)(r), entropy_like(r, 1), rtol=1e-14, atol=0)
    w = sample(7, 6, 9).abs()
    torch.testing.assert_close(
        torch.func.vmap(lambda r, w: entropy_like(r, weight=w))(r, w), entropy_like(r, 1, w), rtol=1e-14, atol=0
    )
    _, along = torch.func.jvp(entropy_like, (r,), (t,))
    assert float(along) == pytest.approx(float((torch.func.grad(entropy_like)(r) * t).sum()), rel=1e-10)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_compiled_loss_equals_eager():
    loss = LELoss(dim=0)
    compiled = torch.compile(loss, fullgraph=True, dynamic=True, backend="aot_eager")
    for N in (5, 8):
        x, y, w = sample(N, N, 3).requires_grad_(), sample(N + 1, N, 3), sample(N + 2, N, 3).abs() + 0.5
        torch.testing.assert_close(compiled(x, y, w), loss(x, y, w), rtol=1e-12, atol=0)
        slopes = [torch.autograd.grad(f(x, y, w), x)[0] for f in (compiled, loss)]
        torch.testing.assert_close(*slopes, rtol=1e-10, atol=1e-12)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
def test_without_weights_the_loss_compiles_to_a_single_graph():
    torch.compiler.reset()
    x, y = sample(0, 20, 1), sample(1, 20, 1)
    torch.testing.assert_close(torch.compile(LELoss(), fullgraph=True, backend="eager")(x, y), LELoss()(x, y))
    torch.testing.assert_close(torch.compile(entropy_like, fullgraph=True, backend="eager")(x), entropy_like(x))


# weights


def test_a_weight_equals_repetition():
    r = sample(8, 6)
    counts = torch.tensor([1, 3, 0, 2, 1, 5])
    r_seen = r.clone()
    r_seen[2] = math.nan
    again = r.repeat_interleave(counts)
    for w in (counts, counts.double()):
        assert float(entropy_like(r_seen, weight=w)) == pytest.approx(float(entropy_like(again)), rel=1e-13)


def test_masked_residuals_have_no_influence():
    r = sample(9, 6).requires_grad_()
    bad = torch.cat([r, torch.tensor([math.nan, math.inf, 1e300]).double()])
    mask = torch.arange(9) < 6
    h = entropy_like(bad, weight=mask)
    assert float(h.detach()) == pytest.approx(float(entropy_like(r).detach()), rel=1e-13)
    assert bool(torch.isfinite(torch.autograd.grad(h, r)[0]).all())
    assert entropy_like(bad, weight=torch.zeros(9, dtype=torch.bool)) == 0.0
    assert float(entropy_like(bad.detach(), weight=torch.arange(9) == 3)) == 0.0


def test_weights_that_sum_to_one_are_refused():
    with pytest.raises(ValueError, match="multiply the weights"):
        entropy_like(sample(0, 4), weight=torch.full((4,), 0.25))


def test_unmasked_residuals_that_are_not_finite_are_refused():
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match=r"`residual`.*finite.*got 1.*\(1,\)\. Leave them out by a weight"):
            entropy_like(torch.tensor([1.0, bad, 2.0]))
    for residual in ("a", [1.0, 2.0], np.ones(3)):
        with pytest.raises(TypeError, match=r"`residual`.*real tensor"):
            entropy_like(residual)
    assert float(entropy_like(torch.tensor([1, 1, 1]))) == pytest.approx(1.0)


# the loss


def test_the_loss_does_not_depend_on_the_units_of_channels():
    x, y = sample(10, 40, 3), sample(11, 40, 3)
    each = LELoss(dim=0, reduction="none")(x, y)
    torch.testing.assert_close(each, entropy_like(x - y, 0), rtol=1e-14, atol=0)
    torch.testing.assert_close(LELoss(dim=0)(x, y), each.mean(), rtol=1e-14, atol=0)
    torch.testing.assert_close(LELoss(dim=0, reduction="sum")(x, y), each.sum(), rtol=1e-14, atol=0)
    units = torch.tensor([1e-6, 1.0, 1e6]).double()
    torch.testing.assert_close(LELoss(dim=0)(x * units, y * units), each.mean(), rtol=1e-10, atol=0)
    assert repr(LELoss(dim=0)) == "LELoss(dim=0, reduction='mean')"


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
    x, y = sample(12, 64, dtype=dtype), sample(13, 64, dtype=dtype)
    h = LELoss()(x, y)
    assert h.dtype == torch.float32
    assert torch.equal(h, LELoss()(x.float(), y.float()))


def test_autocast_changes_nothing():
    x, y = sample(14, 64, dtype=torch.float32).requires_grad_(), sample(15, 64, dtype=torch.float32)
    expected = LELoss()(x, y)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = LELoss()(x, y)
    assert torch.equal(found, expected)
    assert found.dtype == torch.float32
    layer = nn.Linear(2, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert LELoss()(layer(torch.ones(4, 2)), torch.zeros(4, 3)).dtype == torch.float32


def test_bad_arguments_of_the_loss_are_refused():
    x = torch.ones(3)
    for given, error, match in (
        ((x, torch.ones(4)), ValueError, "of the same shape"),
        ((x, torch.tensor([1.0, math.nan, 2.0])), ValueError, "finite"),
        ((x.long(), x), TypeError, "floating"),
        ((torch.ones(0), torch.ones(0)), ValueError, "at least one"),
        ((torch.tensor([1.0, math.nan, 2.0]), x), ValueError, "`input` to be finite but got 1"),
        ((torch.tensor([1.0, math.inf, 2.0]), x), ValueError, "`input` to be finite but got 1"),
        ((x.numpy(), x), TypeError, "`input` to be a real floating-point tensor but got ndarray"),
        ((x, x, -torch.ones(3)), ValueError, "`weight` to be >= 0 and finite but got -1"),
        ((x, x, torch.tensor([1.0, math.nan, 1.0])), ValueError, "`weight` to be >= 0 and finite but got nan"),
        ((x, x, [1.0, 1.0, 1.0]), TypeError, "`weight` to be a tensor"),
        (
            (torch.ones(3, 2), torch.ones(3, 2), torch.ones(3)),
            ValueError,
            r"\(3, 2\) but got \(3,\); .*unsqueeze\(-1\)",
        ),
    ):
        with pytest.raises(error, match=match):
            LELoss()(*given)
    with pytest.raises(ValueError, match="reduction"):
        LELoss(reduction="median")
    for dim in ("a", 1.5, (0, "a")):
        with pytest.raises(TypeError, match=r"`dim`.*dimension, several, or None"):
            LELoss(dim=dim)
        with pytest.raises(TypeError, match=r"`dim`.*dimension, several, or None"):
            entropy_like(x, dim)
    for dim in (7, (0, 0), (0, -1)):
        with pytest.raises(ValueError, match=r"`dim`.*dimensions of the residuals \(3,\), each once"):
            LELoss(dim=dim)(x, 2 * x)
    masked = LELoss()(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.0, math.nan, 0.0]), torch.tensor([1.0, 0.0, 1.0]))
    assert bool(torch.isfinite(masked))


def test_a_network_trained_with_the_loss_ignores_outliers():
    x = sample(16, 200, 2)
    y = x @ torch.tensor([1.0, -2.0]).double() + 0.05 * sample(17, 200)
    y[:30] = 20.0 + sample(18, 30)
    layer = nn.Linear(2, 1, bias=False).double()
    with torch.no_grad():
        layer.weight.copy_(torch.linalg.lstsq(x, y.unsqueeze(1)).solution.T)
    optimiser = torch.optim.LBFGS(layer.parameters(), max_iter=100, line_search_fn="strong_wolfe")
    loss = LELoss()

    def closure():
        optimiser.zero_grad()
        value = loss(layer(x).squeeze(-1), y)
        value.backward()
        return value

    optimiser.step(closure)
    torch.testing.assert_close(layer.weight[0].detach(), torch.tensor([1.0, -2.0]).double(), rtol=0, atol=0.1)


# starts and minima of any residual


@pytest.mark.parametrize("theta", [(62.92, 2.03, 11.02, -29.03), (0.0, 0.0, 5.0), (-3.0,), (1.0, 1.0), (0.0, 0.0)])
def test_starts_are_orthogonal_and_of_equal_length(theta):
    theta = torch.tensor(theta, dtype=torch.float64)
    starts = orthogonal_starts(theta)
    assert torch.equal(starts[0], theta)
    expected = theta.square().sum() * torch.eye(len(theta), dtype=theta.dtype)
    torch.testing.assert_close(starts @ starts.T, expected, rtol=1e-12, atol=1e-11)


def test_batched_starts_equal_single_starts():
    theta = sample(19, 4, 3, 5)
    starts = orthogonal_starts(theta)
    assert starts.shape == (4, 3, 5, 5)
    torch.testing.assert_close(starts[2, 1], orthogonal_starts(theta[2, 1]), rtol=1e-12, atol=1e-12)


def test_minima_on_a_linear_residual_equal_the_linear_estimator():
    X, y = hbk()
    X = X[:, 1:]
    fit = LeastEntropyLike().fit(X, y)
    found = least_entropy_like(lambda t: y - X @ t, torch.linalg.lstsq(X, y).solution)
    torch.testing.assert_close(found.starts, fit.starts_, rtol=1e-9, atol=1e-9)
    assert bool(found.converged.all())
    torch.testing.assert_close(found.best, fit.coef_, rtol=1e-6, atol=1e-7)
    for theta, h in zip(found.theta, found.entropy, strict=True):
        gap = (fit.minima_ - theta).abs().amax(-1)
        assert float(gap.min()) < 1e-6
        assert float(fit.minima_entropy_[gap.argmin()]) == pytest.approx(float(h), abs=1e-12)


def decay(t: Tensor, x: Tensor) -> Tensor:
    return t[0] * torch.exp(-t[1] * x) + t[2]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_curve_fitted_to_outliers_is_at_the_minimum_of_scipy(dtype):
    x = torch.linspace(0, 4, 120, dtype=dtype)
    truth = torch.tensor([3.0, 1.2, 0.5], dtype=dtype)
    y = decay(truth, x) + 0.02 * sample(20, 120, dtype=dtype)
    y[::6] += 4.0 + sample(21, 20, dtype=dtype)
    starts = torch.tensor([[2.0, 1.0, 1.0], [4.0, 0.8, 0.0]], dtype=dtype)
    found = least_entropy_like(lambda t: y - decay(t, x), starts)
    torch.testing.assert_close(found.best, truth, rtol=0, atol=0.1)
    xn, yn = x.double().numpy(), y.double().numpy()
    best = minimize(
        lambda t: entropy_by_definition(yn - t[0] * np.exp(-t[1] * xn) - t[2]),
        found.best.double().numpy(),
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 2000},
    )
    h = float(found.entropy.min())
    assert h <= best.fun + 4 * torch.finfo(dtype).eps
    if dtype == torch.float64:
        np.testing.assert_allclose(found.best.numpy(), best.x, rtol=0, atol=1e-5)


@pytest.mark.e2e
def test_a_network_is_fitted_as_a_function_of_its_parameters():
    torch.manual_seed(0)
    model = nn.Sequential(nn.Linear(1, 3), nn.Tanh(), nn.Linear(3, 1)).double()
    x = torch.linspace(-2, 2, 150, dtype=torch.float64).unsqueeze(1)
    clean = torch.tanh(2 * x) - 0.5 * x
    y = clean + 0.01 * sample(22, 150, 1)
    y[::5] += 3.0 + 0.3 * sample(23, 30, 1)
    shapes = {k: v.shape for k, v in model.named_parameters()}

    def unpack(theta: Tensor) -> dict[str, Tensor]:
        parts = theta.split([s.numel() for s in shapes.values()])
        return {k: v.reshape(s) for (k, s), v in zip(shapes.items(), parts, strict=True)}

    def residual(theta: Tensor) -> Tensor:
        return y - torch.func.functional_call(model, unpack(theta), (x,))

    optimiser = torch.optim.LBFGS(model.parameters(), max_iter=200, line_search_fn="strong_wolfe")

    def closure():
        optimiser.zero_grad()
        value = nn.functional.l1_loss(model(x), y)
        value.backward()
        return value

    optimiser.step(closure)
    start = nn.utils.parameters_to_vector(model.parameters()).detach()
    found = least_entropy_like(residual, start.unsqueeze(0), max_iter=300)
    assert float(found.entropy) < float(entropy_like(residual(start)))
    error = y - residual(found.best) - clean
    assert float(error.abs().median()) < 0.03


def test_an_exact_fit_has_entropy_zero():
    x = torch.linspace(0, 1, 9, dtype=torch.float64)
    found = least_entropy_like(lambda t: x - t * x, torch.ones(1, dtype=torch.float64))
    assert float(found.entropy) == 0.0
    assert found.best.tolist() == [1.0]
    assert bool(found.converged)


def test_weight_zero_equals_removal_for_any_residual():
    X, y = hbk()
    mask = torch.arange(75) >= 14
    found = least_entropy_like(lambda t: y - X @ t, torch.linalg.lstsq(X, y).solution, weight=mask)
    without = least_entropy_like(lambda t: y[14:] - X[14:] @ t, found.starts)
    torch.testing.assert_close(found.theta, without.theta, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.entropy, without.entropy, rtol=1e-12, atol=0)


def test_bad_starts_are_refused():
    def residual(t: Tensor) -> Tensor:
        return torch.log(t) * torch.arange(1.0, 5.0)

    for starts, error, match in (
        (torch.ones(2, 2, 2), ValueError, "shape"),
        (torch.tensor([math.nan]), ValueError, "finite but got NaN"),
        (torch.ones(1).long(), TypeError, "float32"),
        (torch.tensor([[-1.0]]), ValueError, "at start 0"),
    ):
        with pytest.raises(error, match=match):
            least_entropy_like(residual, starts)


def test_bad_arguments_are_refused():
    x = torch.arange(1.0, 5.0)
    start = torch.ones(1, 1)

    def residual(t: Tensor) -> Tensor:
        return x - t[0]

    for arguments, options, error, match in (
        ((3, start), {}, TypeError, "`residual` to be a function of the parameters but got int; write lambda"),
        ((residual, start), {"tol": "a"}, TypeError, "`tol` to be a number"),
        ((residual, start), {"tol": -1.0}, ValueError, "`tol` to be >= 0"),
        ((residual, start), {"max_iter": 0}, ValueError, "`max_iter` to be a whole number of at least 1 but got 0"),
        ((residual, start), {"weight": -torch.ones(4)}, ValueError, "`weight` to be >= 0"),
        ((residual, start), {"weight": [1.0] * 4}, TypeError, "`weight` to be a tensor"),
    ):
        with pytest.raises(error, match=match):
            least_entropy_like(*arguments, **options)
