"""The kernel of the heteroscedastic loss against the formulas in float64."""

import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from mkc_torch import HeteroscedasticMKCLoss

INF, NAN = math.inf, math.nan
TOLERANCE = {torch.float64: 1e-11, torch.float32: 1e-6, torch.bfloat16: 2e-2, torch.float16: 2e-3}
"""Difference over the greatest number; half precision rounds the gradients twice, and the interpreter cuts them off."""
compiler = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own


def uniform(low, high, *shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=generator)


def data(*shape, dtype=torch.float64, most_d=4.0):
    """Input, target, sigma and d."""
    ranges = ((-6, 6), (-6, 6), (0.06, 6), (0.2, most_d))
    return [uniform(a, b, *shape, seed=i).to(dtype) for i, (a, b) in enumerate(ranges)]


def weights(kind, *shape):
    found = uniform(-0.5, 1.0, *shape, seed=9).clamp(min=0)
    return {"none": None, "weighted": found, "masked": found > 0.2}[kind]


def value_and_gradients(loss, tensors, weight, upstream=1.0):
    """Value, and gradients by input, target, sigma and d."""
    leaves = [tensor.clone().requires_grad_() for tensor in tensors]
    value = loss(*leaves, weight)
    grad = torch.full_like(value, upstream) if isinstance(upstream, float) else upstream.to(value)
    return [entry.detach().cpu().double() for entry in (value, *torch.autograd.grad(value, leaves, grad))]


def assert_agrees(device, tensors, weight=None, bound=30.0, upstream=1.0, **options):
    """The kernel on tensors as they are against the formulas on them in float64."""
    dtype = torch.promote_types(tensors[0].dtype, torch.float32)
    found = value_and_gradients(
        HeteroscedasticMKCLoss(torch.as_tensor(bound, dtype=dtype), impl="triton", **options).to(device),
        [tensor.to(device) for tensor in tensors],
        None if weight is None else weight.to(device),
        upstream,
    )
    expected = value_and_gradients(
        HeteroscedasticMKCLoss(torch.as_tensor(bound, dtype=torch.float64), impl="eager", **options),
        [tensor.double() for tensor in tensors],
        weight,
        upstream,
    )
    tolerance = TOLERANCE[tensors[0].dtype]
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0.0, atol=tolerance * float(other.abs().max()))


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("weighted", ["none", "weighted", "masked"])
def test_value_and_gradients_equal_the_formulas(device, dtype, reduction, weighted):
    shape, upstream = (50, 3), 1700.0 if dtype == torch.float16 else 1.7
    assert_agrees(device, data(*shape, dtype=dtype), weights(weighted, *shape), reduction=reduction, upstream=upstream)


@pytest.mark.parametrize(("bound", "most_d"), [(100.0, 4.0), (4.5, 4.0), (1e6, 0.3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_domain_may_end_on_the_head_or_far_beyond(device, bound, most_d, dtype):
    tensors = data(1500, 1, dtype=dtype, most_d=most_d)
    tensors[2] = torch.exp(uniform(math.log(0.05), math.log(1000.0), 1500, 1, seed=2)).to(dtype)
    assert_agrees(device, tensors, bound=bound)


@pytest.mark.parametrize(("shape", "channel_dim"), [((7, 3), -1), ((2, 3, 4, 5), 1), ((3, 400), 0)])
@pytest.mark.parametrize("reduction", ["none", "mean"])
def test_the_kernel_equals_the_formulas_for_bounds_of_channels(device, shape, channel_dim, reduction):
    bound = torch.tensor([9.0, 40.0, 90.0])
    tensors = data(*shape, dtype=torch.float32)
    assert_agrees(device, tensors, bound=bound, channel_dim=channel_dim, reduction=reduction)
    last = [tensor.movedim(channel_dim, -1).contiguous().movedim(-1, channel_dim) for tensor in tensors]
    mixed = [last[0], tensors[1], last[2], tensors[3]]
    weight = weights("weighted", *shape).select(channel_dim, 0)
    assert_agrees(device, mixed, weight, bound=bound, channel_dim=channel_dim, reduction=reduction)


def test_the_kernel_equals_the_formulas_for_upstream_gradients_per_element_and_mixed_dtypes(device):
    x, y, sigma, d = data(40, 3, dtype=torch.bfloat16)
    tensors = [x, y.float(), sigma.float(), d.float()]
    upstream = uniform(-1.0, 1.0, 40, 3, seed=7)
    for grad in (upstream, upstream[:, :1].expand(40, 3), upstream.T.contiguous().T):
        assert_agrees(device, tensors, reduction="none", upstream=grad)


def test_infinite_sigma_gives_the_gaussian_likelihood(device):
    x, y, _, d = data(6, 3, dtype=torch.float32)
    sigma = torch.full_like(x, INF)
    assert_agrees(device, [x, y, sigma, d], bound=100.0)
    assert_agrees(device, [x, y, sigma, d], bound=5.0)
    found = value_and_gradients(
        HeteroscedasticMKCLoss(1e3, impl="triton").to(device), [t.to(device) for t in (x, y, sigma, d)], None
    )
    assert (found[3] == 0).all()


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("poison", [NAN, -1.0])
def test_masked_elements_affect_neither_value_nor_gradient(device, reduction, poison):
    loss = HeteroscedasticMKCLoss(30.0, reduction=reduction, impl="triton").to(device)
    mask = torch.ones(5, 3, dtype=torch.bool, device=device)
    mask[1, 2] = mask[4, 0] = False
    tensors = [value.to(device) for value in data(5, 3, dtype=torch.float32)]
    expected = value_and_gradients(loss, tensors, mask)
    for tensor in tensors:
        tensor[~mask] = poison
    found = value_and_gradients(loss, tensors, mask)
    assert all(map(torch.equal, found, expected))
    assert all((value[~mask.cpu()] == 0).all() for value in found[1:])
    nothing = value_and_gradients(loss, tensors, torch.zeros(5, device=device))
    assert all((value == 0).all() for value in nothing)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # NumPy's, in the interpreter
@pytest.mark.parametrize("which", range(4))
def test_nan_gives_nan(device, which):
    tensors = [entry.to(device) for entry in data(5, 3, dtype=torch.float32)]
    tensors[which][2, 1] = NAN
    value, *slopes = value_and_gradients(
        HeteroscedasticMKCLoss(100.0, reduction="none", impl="triton").to(device), tensors, None
    )
    for slope in (value, *slopes):
        assert slope[2, 1].isnan()
        assert slope.isnan().sum() == 1


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")  # NumPy's, in the interpreter
@pytest.mark.parametrize("size", [60.0, 1e10, 1e30])
@pytest.mark.parametrize("sigma", [0.05, 2.0, 1000.0, INF])
def test_an_extreme_outlier_leaves_finite_gradients(device, size, sigma):
    tensors = [torch.full((4, 2), v, device=device) for v in (0.0, 0.0, sigma, 0.1)]
    tensors[1][1, 1] = size
    value, *slopes = value_and_gradients(HeteroscedasticMKCLoss(50.0, impl="triton").to(device), tensors, None)
    if sigma < INF:
        assert value.isfinite()
        assert all(slope.isfinite().all() for slope in slopes)
    assert slopes[2].isfinite().all()


def test_repeated_backward_passes_and_second_derivatives_equal_the_formulas(device):
    tensors = data(6, 2, dtype=torch.float64)
    for reduction in ("mean", "none"):
        results = []
        for impl, where in (("triton", device), ("eager", torch.device("cpu"))):
            loss = HeteroscedasticMKCLoss(30.0, reduction=reduction, impl=impl).double().to(where)
            leaves = [tensor.to(where).requires_grad_() for tensor in tensors]
            value = loss(*leaves)
            first = torch.autograd.grad(3.0 * value.sum(), leaves, retain_graph=True)
            kept = [entry.clone() for entry in first]
            second = torch.autograd.grad(2.0 * value.sum(), leaves, retain_graph=True)
            assert all(map(torch.equal, first, kept))
            slopes = torch.autograd.grad(value.sum(), leaves, create_graph=True)
            second_slopes = torch.autograd.grad(sum((slope**2).sum() for slope in slopes), leaves)
            results.append([entry.cpu() for entry in (*first, *second, *slopes, *second_slopes)])
        torch.testing.assert_close(*results, rtol=1e-9, atol=1e-11)


def test_only_required_gradients_are_computed(device):
    loss = HeteroscedasticMKCLoss(30.0, impl="triton").to(device)
    x, y, sigma, d = (value.to(device) for value in data(5, 3, dtype=torch.float32))
    expected = value_and_gradients(loss, [x, y, sigma, d], None)
    d.requires_grad_()
    (found,) = torch.autograd.grad(loss(x, y, sigma, d), d)
    assert torch.equal(found.cpu().double(), expected[4])
    y.requires_grad_()
    (found,) = torch.autograd.grad(loss(x, y, sigma, d), y)
    assert torch.equal(found.cpu().double(), expected[2])
    with torch.no_grad():
        assert loss(x, y, sigma, d).cpu().double() == expected[0]


def test_shared_scales_transforms_and_differentiable_weights_use_the_formulas(device):
    own, other = (HeteroscedasticMKCLoss(30.0, impl=impl).double().to(device) for impl in ("triton", "eager"))
    x, y, sigma, d = (value.to(device) for value in data(5, 3))
    assert torch.equal(own(x, y, sigma[:, :1], d), other(x, y, sigma[:, :1], d))
    weight = torch.ones_like(x).requires_grad_()
    found, expected = (torch.autograd.grad(loss(x, y, sigma, d, weight), weight) for loss in (own, other))
    assert torch.equal(*found, *expected)
    found, expected = (torch.func.grad(loss)(x, y, sigma, d) for loss in (own, other))
    assert torch.equal(found, expected)


# --- behind torch.library


def operands(dtype, weighted, device):
    tensors = [value.to(device).requires_grad_() for value in data(4, 3, dtype=dtype)]
    weight = weights(weighted, 4, 3)
    bound = torch.tensor([9.0, 40.0, 90.0], device=device)
    return (*tensors, None if weight is None else weight.to(device), bound, 1)


@pytest.mark.e2e
@pytest.mark.parametrize(("dtype", "weighted"), [(torch.float32, "weighted"), (torch.float16, "none")])
def test_operators_pass_opcheck(device, dtype, weighted):
    from mkc_torch.losses.kernels import sample_operators as operators

    given = operands(dtype, weighted, device)
    torch.library.opcheck(operators.sample_values, given)
    torch.library.opcheck(operators.reduced_sample_loss, (*given, True, [True, True, True]))
    grad = torch.tensor(2.0, device=device)
    detached = [value.detach() if isinstance(value, torch.Tensor) else value for value in given]
    torch.library.opcheck(operators.sample_slopes, (*detached, True, [True, False, True], grad))


@pytest.mark.e2e
@compiler
@pytest.mark.parametrize("reduction", ["mean", "none"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_compiled_loss_equals_eager(device, reduction, dtype):
    torch.compiler.reset()
    loss = HeteroscedasticMKCLoss(30.0, reduction=reduction, impl="triton").to(device)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    tensors = [value.to(device) for value in data(20, 3, dtype=dtype)]
    weight = weights("weighted", 20, 3).to(device)
    upstream = 100.0 if dtype == torch.float16 else 1.7
    for given in (None, weight):
        found, expected = (value_and_gradients(value, tensors, given, upstream) for value in (compiled, loss))
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)


@compiler
def test_impl_compile_equals_impl_eager(monkeypatch):
    from mkc_torch.losses import heteroscedastic

    torch.compiler.reset()
    compiled = torch.compile(HeteroscedasticMKCLoss._computed, backend="aot_eager")
    monkeypatch.setattr(heteroscedastic, "_compiled", lambda: compiled)
    tensors = data(5, 3)
    found, expected = (
        value_and_gradients(HeteroscedasticMKCLoss(30.0, impl=impl), tensors, None) for impl in ("compile", "eager")
    )
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_fake_cuda_tensors_use_the_operators():
    pytest.importorskip("triton")
    with FakeTensorMode():
        loss = HeteroscedasticMKCLoss(30.0, impl="triton")
        loss.bound = torch.ones((), device="cuda")
        x, y, sigma, d = (torch.ones(4, 3, device="cuda") for _ in range(4))
        assert loss(x, y, sigma, d).device.type == "cuda"
        loss.reduction = "none"
        assert loss(x, y, sigma.double(), d).dtype == torch.float64


def test_an_unknown_implementation_is_refused():
    with pytest.raises(ValueError, match=r"`impl`.*'auto', 'eager', 'compile', 'triton'.*got 'cuda'"):
        HeteroscedasticMKCLoss(30.0, impl="cuda")
