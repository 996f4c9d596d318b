"""Jacobians of functions with many values, in batches of directions."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from mkc_torch._support import forward_mode
from mkc_torch._support.forward_mode import directions_at_once, forward_jacobian, forward_tangents
from mkc_torch.nonlinear import _problem, fit

THETA = torch.tensor([0.3, -1.2, 0.7, 2.0, 0.1], dtype=torch.float64)
X = torch.linspace(0.0, 1.0, 1000, dtype=torch.float64)


def wave(theta):
    return (theta[0] * torch.sin(theta[1] * X) + theta[2] * torch.exp(-theta[3] * X) + theta[4]).unsqueeze(-1)


def test_batches_of_directions_give_the_full_jacobian(monkeypatch):
    expected = torch.func.jacrev(wave)(THETA)
    for cells in (1, 1000, 2500, 1_000_000):
        monkeypatch.setattr(forward_mode, "_CELLS", cells)
        torch.testing.assert_close(forward_jacobian(wave, THETA, 1000), expected, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(forward_tangents(wave, 1000)(THETA).movedim(0, -1), expected, rtol=1e-12, atol=1e-12)


def test_short_functions_have_many_directions_in_a_batch():
    assert directions_at_once(1000) >= 100
    assert directions_at_once(10**9) == directions_at_once(10**7) == 1
    assert directions_at_once(0) > 1


def test_memory_of_a_batch_of_tangents_is_bounded(monkeypatch):
    products = []

    class Products(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            made = func(*args, **(kwargs or {}))
            if func is torch.ops.aten.mul.Tensor:
                products.append(made.numel())
            return made

    def largest(work):
        products.clear()
        with Products():
            work()
        return max(products)

    assert largest(lambda: forward_tangents(wave, 1000)(THETA)) >= 5000
    monkeypatch.setattr(forward_mode, "_CELLS", 2000)
    assert largest(lambda: forward_tangents(wave, 1000)(THETA)) == 2000


def test_a_fit_passes_the_number_of_its_residuals(monkeypatch):
    counts = []

    def noted(function, values):
        counts.append(values)
        return forward_tangents(function, values)

    monkeypatch.setattr(_problem, "forward_tangents", noted)
    fit(wave, THETA, max_iter=5, covariance=None)
    assert set(counts) == {1000}
