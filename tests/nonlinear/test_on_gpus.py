"""Nonlinear fits in the path of a GPU, forced on the CPU: no batched factorisation, and the same results."""

import torch
from torch import Tensor

from mkc_torch._support.side_by_side import forced
from mkc_torch.nonlinear import NonlinearFit, fit
from tests.linear.test_on_gpus import Factorisations


def decay(theta: Tensor, time: Tensor) -> Tensor:
    return (theta[0] * torch.exp(-theta[1] * time)).unsqueeze(-1)


def fitted() -> NonlinearFit:
    generator = torch.Generator().manual_seed(0)
    time = torch.linspace(0.0, 3.0, 60, dtype=torch.float64).expand(3, -1)
    y = 2.0 * torch.exp(-1.3 * time) + 0.02 * torch.randn(3, 60, dtype=torch.float64, generator=generator)
    y[:, ::7] += 1.0

    def residual(theta: Tensor, data: tuple[Tensor, Tensor]) -> Tensor:
        at, target = data
        return target.unsqueeze(-1) - decay(theta, at)

    return fit(residual, torch.tensor([[1.5, 1.0]]).double().expand(3, 2), data=(time, y))


def test_results_agree_without_a_batched_factorisation():
    expected = fitted()
    with forced(), Factorisations() as recorded:
        found = fitted()
    assert not {name for name in recorded.found if "cholesky" not in name}
    torch.testing.assert_close(found.theta, expected.theta, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(found.covariance, expected.covariance, rtol=1e-5, atol=1e-9)
