"""The normaliser in NumPy equals the normaliser in PyTorch, in value and derivatives, over the whole range."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mkc_torch.density._numpy_normalizer import is_few, log_partition_and_slopes
from mkc_torch.density.energy import energy
from mkc_torch.density.head import HEAD_TOLERANCE, head_rule_constants
from mkc_torch.density.normalizer import _log_partition_and_slopes, log_partition


def numpy_normalizer(kappa, length):
    return log_partition_and_slopes(kappa, length, *(value.numpy() for value in head_rule_constants()), HEAD_TOLERANCE)


@given(
    kappa=st.one_of(st.just(0.0), st.floats(1e-12, 400.0), st.floats(1e-4, 1e-2)),
    length=st.floats(1e-3, 1e7),
)
def test_the_numpy_normaliser_equals_that_of_torch(kappa, length):
    expected = _log_partition_and_slopes(
        *(torch.tensor(value, dtype=torch.float64) for value in (kappa, length)), energy
    )
    for value, other in zip(numpy_normalizer(np.asarray(kappa), np.asarray(length)), expected, strict=True):
        assert float(value) == pytest.approx(float(other), rel=1e-10, abs=1e-12)


def test_numpy_and_torch_give_the_same_gradients():
    kappa = torch.tensor([0.0, 1e-6, 0.01, 0.5, 30.0, 400.0], dtype=torch.float64)
    length = torch.tensor([5.0, 3.0, 50.0, 20.0, 100.0, 1000.0], dtype=torch.float64)

    def gradients(repeats):
        """Gradients of the first six channels, among copies of them."""
        inputs = [entry.repeat(repeats).requires_grad_() for entry in (kappa, length)]
        assert is_few(*(entry.detach() for entry in inputs)) == (repeats == 1)
        value = log_partition(*inputs)
        return [value.detach()[:6], *(g[:6] for g in torch.autograd.grad(value.sum(), inputs))]

    for entry, other in zip(gradients(1), gradients(20), strict=True):
        torch.testing.assert_close(entry, other, rtol=1e-11, atol=1e-13)


def test_single_precision_keeps_its_dtype():
    value = log_partition(torch.full((4,), 0.1), torch.full((4,), 100.0))
    assert value.dtype == torch.float32
    double = log_partition(torch.full((4,), 0.1).double(), torch.full((4,), 100.0).double())
    torch.testing.assert_close(value.double(), double, rtol=1e-6, atol=1e-7)


def test_tensors_under_a_transform_use_torch():
    seen = []
    torch.vmap(lambda value: seen.append(is_few(value)) or value)(torch.ones(3, 2))
    assert seen == [False]
    assert is_few(torch.ones(2))
    assert not is_few(torch.ones(1000))
    assert not is_few(torch.nn.Parameter(torch.ones(2)))
