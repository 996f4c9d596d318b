"""Newton's method with a trust region: minima of nonconvex functions."""

import torch
from torch import Tensor

from mkc_torch._support.trust_region import Quadratic, minimise


def batched(f):
    """Return a batch of a function with its derivatives by automatic differentiation."""

    def function(point: Tensor, index: Tensor) -> Quadratic:
        return Quadratic(
            torch.func.vmap(f)(point),
            torch.func.vmap(torch.func.grad(f))(point),
            torch.func.vmap(torch.func.jacrev(torch.func.grad(f)))(point),
        )

    return function


def rosenbrock(x: Tensor) -> Tensor:
    return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2


def double_well(x: Tensor) -> Tensor:
    return (x[0] ** 2 - 1) ** 2 + 0.5 * (x[1] - x[0]) ** 2


def ones(count: int) -> Tensor:
    return torch.ones(count, dtype=torch.float64)


def test_the_minimum_of_rosenbrock_is_found_from_many_starts():
    start = torch.tensor([[-1.2, 1.0], [3.0, -3.0], [1.0, 1.0]], dtype=torch.float64)
    minima = minimise(batched(rosenbrock), start, ones(3))
    torch.testing.assert_close(minima.point, torch.ones_like(start), rtol=0, atol=1e-8)
    assert bool(minima.converged.all())
    assert int(minima.n_iter[2]) == 1


def test_each_start_keeps_its_own_minimum_and_a_saddle_is_left():
    start = torch.tensor([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.0]], dtype=torch.float64)  # the last is stationary
    minima = minimise(batched(double_well), start, 0.3 * ones(3))
    torch.testing.assert_close(minima.point.abs(), torch.ones_like(start), rtol=0, atol=1e-8)
    assert minima.point[0, 0] > 0 > minima.point[1, 0]
    assert bool(minima.converged.all())


def test_too_few_steps_are_reported_as_not_converged():
    minima = minimise(batched(rosenbrock), torch.tensor([[-1.2, 1.0]], dtype=torch.float64), ones(1), max_iter=3)
    assert not bool(minima.converged)
    assert int(minima.n_iter) == 3


def test_steps_to_infinite_values_are_rejected():
    def barrier(x: Tensor) -> Tensor:
        return (x - torch.log(x)).sum()

    minima = minimise(batched(barrier), torch.tensor([[5.0], [0.01]], dtype=torch.float64), 100 * ones(2))
    torch.testing.assert_close(minima.point, ones(2).unsqueeze(1), rtol=0, atol=1e-8)


def test_a_constant_function_converges_at_its_start():
    minima = minimise(batched(lambda x: 0.0 * x.sum()), torch.tensor([[2.0, 3.0]], dtype=torch.float64), ones(1))
    assert minima.point.tolist() == [[2.0, 3.0]]
    assert bool(minima.converged)
