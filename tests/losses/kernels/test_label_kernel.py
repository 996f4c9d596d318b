"""The kernels of generalized cross-entropy against the formulas in float64."""

import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from mkc_torch import GeneralizedCrossEntropyLoss

INF, NAN = math.inf, math.nan
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6, torch.bfloat16: 2e-2, torch.float16: 2e-3}
"""Difference over the greatest number; half precision rounds the gradients twice, and the interpreter cuts them off."""
compiler = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own


def data(rows, classes, dtype=torch.float64, ignored=-100, labels=torch.int64):
    """Logits and labels, of which a third is ignored."""
    generator = torch.Generator().manual_seed(0)
    logits = 3.0 * torch.randn(rows, classes, generator=generator, dtype=torch.float64)
    target = torch.randint(0, classes, (rows,), generator=generator)
    target[1::3] = ignored
    return logits.to(dtype), target.to(labels)


def value_and_gradient(loss, logits, target, upstream=1.0):
    """Value, and gradient by the logits."""
    leaf = logits.clone().requires_grad_()
    value = loss(leaf, target)
    grad = torch.full_like(value, upstream) if isinstance(upstream, float) else upstream.to(value)
    return [entry.detach().cpu().double() for entry in (value, *torch.autograd.grad(value, leaf, grad))]


def assert_agrees(device, logits, target, upstream=1.0, **options):
    """The kernel on logits as they are against the formulas on them in float64."""
    loss = GeneralizedCrossEntropyLoss(impl="triton", **options)
    loss = (loss.double() if logits.dtype == torch.float64 else loss).to(device)
    reference = GeneralizedCrossEntropyLoss(impl="eager", **options).double()
    found = value_and_gradient(loss, logits.to(device), target.to(device), upstream)
    expected = value_and_gradient(reference, logits.double(), target, upstream)
    tolerance = TOLERANCE[logits.dtype]
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0.0, atol=tolerance * float(other.abs().max()))


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("sigma", [0.5, 1.2, INF])
def test_value_and_gradient_equal_the_formulas(device, dtype, reduction, weighted, sigma):
    weight = torch.tensor([1.0, 0.5, 0.0, 2.0, 0.1]) if weighted else None
    upstream = 1700.0 if dtype == torch.float16 else 1.7
    assert_agrees(device, *data(30, 5, dtype), upstream, sigma=sigma, weight=weight, reduction=reduction)


@pytest.mark.parametrize(("rows", "classes"), [(1, 2), (7, 1), (3000, 3), (500, 10), (3, 1000), (2, 4096), (2, 5000)])
def test_the_kernel_equals_the_formulas_for_few_and_many_rows_and_classes(device, rows, classes):
    assert_agrees(device, *data(rows, classes, torch.float32))
    weight = torch.rand(classes, generator=torch.Generator().manual_seed(1))
    assert_agrees(device, *data(rows, classes, torch.float32), weight=weight)


@pytest.mark.parametrize(
    ("labels", "ignored"), [(torch.uint8, 255), (torch.int8, -1), (torch.int16, 1), (torch.int32, 0)]
)
def test_labels_may_have_any_integer_type(device, labels, ignored):
    assert_agrees(device, *data(20, 4, torch.float32, ignored, labels), ignore_index=ignored)


def test_the_kernel_equals_the_formulas_for_upstream_gradients_per_row_and_strided_logits(device):
    logits, target = data(20, 4, torch.float32)
    upstream = torch.randn(20, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for grad in (upstream, upstream[:1].expand(20)):
        assert_agrees(device, logits, target, grad, reduction="none")
    for gaps in (logits.T.contiguous().T, torch.cat([logits, logits], 1)[:, :4], logits[:, :1].expand(20, 4)):
        assert_agrees(device, gaps, target)


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
@pytest.mark.parametrize("classes", [3, 4500])
def test_ignored_rows_affect_neither_value_nor_gradient(device, reduction, classes):
    loss = GeneralizedCrossEntropyLoss(reduction=reduction, impl="triton").to(device)
    logits, target = (value.to(device) for value in data(4, classes, torch.float32))
    expected = value_and_gradient(loss, logits, target)
    logits[target == -100] = NAN
    assert all(map(torch.equal, value_and_gradient(loss, logits, target), expected))
    assert (expected[1][target.cpu() == -100] == 0).all()
    nothing = value_and_gradient(loss, logits, torch.full_like(target, -100))
    assert all((value == 0).all() for value in nothing)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # NumPy's, in the interpreter
@pytest.mark.parametrize("sigma", [0.7, INF])
@pytest.mark.parametrize("classes", [3, 4500])
def test_logits_of_minus_infinity_are_impossible_classes(device, sigma, classes):
    logits, target = data(4, classes, torch.float32)
    logits[:, 1] = -INF  # an impossible class
    target = torch.where(target == -100, target, logits.argmax(1))
    assert_agrees(device, logits, target, sigma=sigma)
    target[0] = 1
    loss = GeneralizedCrossEntropyLoss(sigma, reduction="none", impl="triton").to(device)
    value, slope = value_and_gradient(loss, logits.to(device), target.to(device))
    assert value[0].item() == pytest.approx(sigma**2)
    assert slope.isfinite().all()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # NumPy's, in the interpreter
@pytest.mark.parametrize("bad", [NAN, INF])
@pytest.mark.parametrize("sigma", [1.2, INF])
@pytest.mark.parametrize("classes", [3, 4500])
def test_nan_and_infinite_logits_and_labels_out_of_range_give_nan(device, bad, sigma, classes):
    loss = GeneralizedCrossEntropyLoss(sigma, reduction="none", impl="triton").to(device)
    logits, target = (entry.to(device) for entry in data(4, classes, torch.float32))
    logits[0, 2] = bad
    target[2] = classes
    value, slope = value_and_gradient(loss, logits, target)
    assert value.isnan().tolist() == [True, False, True, False]
    assert slope.isnan().any(1).tolist() == [True, False, True, False]
    loss.reduction = "mean"
    assert loss(logits, target).isnan()


def test_repeated_backward_passes_and_second_derivatives_equal_the_formulas(device):
    logits, target = data(6, 3)
    for reduction in ("mean", "none"):
        results = []
        for impl, where in (("triton", device), ("eager", torch.device("cpu"))):
            loss = GeneralizedCrossEntropyLoss(reduction=reduction, impl=impl).double().to(where)
            leaf = logits.to(where).requires_grad_()
            value = loss(leaf, target.to(where))
            (first,) = torch.autograd.grad(3.0 * value.sum(), leaf, retain_graph=True)
            kept = first.clone()
            (second,) = torch.autograd.grad(2.0 * value.sum(), leaf, retain_graph=True)
            assert torch.equal(first, kept)
            (slope,) = torch.autograd.grad(value.sum(), leaf, create_graph=True)
            second_slopes = torch.autograd.grad((slope**2).sum(), leaf)
            results.append([entry.cpu() for entry in (first, second, slope, *second_slopes)])
        torch.testing.assert_close(*results, rtol=1e-10, atol=1e-12)


def test_setting_sigma_does_not_change_the_gradient_of_an_earlier_forward_pass(device):
    loss = GeneralizedCrossEntropyLoss(impl="triton").to(device)
    logits, target = (entry.to(device) for entry in data(6, 3, torch.float32))
    _, expected = value_and_gradient(loss, logits, target)
    value = loss(logits.requires_grad_(), target)
    loss.sigma = 0.6
    (found,) = torch.autograd.grad(value, logits)
    assert torch.equal(found.cpu().double(), expected)


def test_other_targets_shapes_and_transforms_use_the_formulas(device):
    own, other = (GeneralizedCrossEntropyLoss(impl=impl).double().to(device) for impl in ("triton", "eager"))
    logits, target = (value.to(device) for value in data(6, 4))
    target = target.clamp(min=0)
    for given in (
        (logits, torch.softmax(logits, 1)),
        (logits[0], target[0]),
        (logits.reshape(3, 4, 2), target.reshape(3, 2)),
    ):
        assert torch.equal(own(*given), other(*given))
    found, expected = (torch.func.grad(loss)(logits, target) for loss in (own, other))
    assert torch.equal(found, expected)
    with pytest.raises(ValueError, match="labels `target` of shape"):
        own(logits, target[:2])
    with pytest.raises(TypeError, match="floating-point logits"):
        own(target, target)


# --- behind torch.library


@pytest.mark.e2e
@pytest.mark.parametrize(("dtype", "weighted"), [(torch.float32, True), (torch.float16, False)])
def test_operators_pass_opcheck(device, dtype, weighted):
    from mkc_torch.losses.kernels import label_operators as operators

    logits, target = (value.to(device) for value in data(5, 4, dtype))
    weight = torch.tensor([1.0, 0.5, 2.0, 0.1], device=device) if weighted else None
    kappa = torch.tensor(0.7, device=device)
    given = (logits.clone().requires_grad_(), target, kappa, weight, -100)
    torch.library.opcheck(operators.values_of_labels, given)
    torch.library.opcheck(operators.reduced_label_loss, (*given, True, True))
    grad = torch.tensor(2.0, device=device)
    torch.library.opcheck(operators.slopes_of_labels, (logits, *given[1:], True, grad))


@compiler
@pytest.mark.parametrize("reduction", ["mean", "none"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_compiled_loss_equals_eager(device, reduction, dtype):
    torch.compiler.reset()
    loss = GeneralizedCrossEntropyLoss(reduction=reduction, impl="triton").to(device)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    logits, target = (value.to(device) for value in data(20, 4, dtype))
    found, expected = (value_and_gradient(value, logits, target, 100.0) for value in (compiled, loss))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)


@compiler
def test_impl_compile_equals_impl_eager(monkeypatch):
    from mkc_torch.losses import generalized_cross_entropy

    torch.compiler.reset()
    compiled = torch.compile(GeneralizedCrossEntropyLoss._computed, backend="aot_eager")
    monkeypatch.setattr(generalized_cross_entropy, "_compiled", lambda: compiled)
    found, expected = (
        value_and_gradient(GeneralizedCrossEntropyLoss(impl=impl).double(), *data(5, 3))
        for impl in ("compile", "eager")
    )
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_fake_cuda_tensors_use_the_operators():
    pytest.importorskip("triton")
    with FakeTensorMode():
        loss = GeneralizedCrossEntropyLoss(impl="triton")
        loss.kappa = torch.ones((), device="cuda")
        logits, target = torch.ones(4, 3, device="cuda"), torch.zeros(4, device="cuda", dtype=torch.int64)
        assert loss(logits, target).device.type == "cuda"
        loss.reduction = "none"
        assert loss(logits, target).shape == (4,)


def test_an_unknown_implementation_is_refused():
    with pytest.raises(ValueError, match=r"`impl`.*'auto', 'eager', 'compile', 'triton'.*got 'cuda'"):
        GeneralizedCrossEntropyLoss(impl="cuda")
