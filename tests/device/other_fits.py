"""Nonlinear fits, covariances, ellipsoids and implicit derivatives on a device, compared with those of the CPU."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.covariance import MinimumCovarianceDeterminant
from mkc_torch.linear import MKCRegression
from mkc_torch.nonlinear import fit as nonlinear_fit
from tests.device.small_fits import problems

TOLERANCE = 1e-6
"""Largest difference from the CPU's result, in units of its largest element."""

CPU = torch.device("cpu")


def _points(device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    unit = torch.randn(8, 150, 3, dtype=torch.float64, generator=generator)
    noise = 0.2 * torch.randn(unit.shape, dtype=torch.float64, generator=generator)
    on_sphere = unit / torch.linalg.vector_norm(unit, dim=-1, keepdim=True)
    return (on_sphere * torch.tensor([40.0, 50.0, 60.0]) + noise).to(device)


def _decay(device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    time = torch.linspace(0.0, 3.0, 60, dtype=torch.float64).expand(8, -1)
    y = 2.0 * torch.exp(-1.3 * time) + 0.02 * torch.randn(8, 60, dtype=torch.float64, generator=generator)
    y[:, ::7] += 1.0

    def residual(theta: Tensor, data: tuple[Tensor, Tensor]) -> Tensor:
        return (data[1] - theta[0] * torch.exp(-theta[1] * data[0])).unsqueeze(-1)

    start = torch.tensor([[1.5, 1.0]], dtype=torch.float64, device=device).expand(8, 2)
    found = nonlinear_fit(residual, start, data=(time.to(device), y.to(device)))
    return torch.cat([found.theta, found.covariance.flatten(1)], -1)


def _derivatives(device: torch.device) -> Tensor:
    X, y = problems(device, 4, 60, 3)
    return torch.autograd.functional.jacobian(lambda t: MKCRegression().fit(X, t).coef_.sum(0), y)


def _ellipsoids(device: torch.device) -> Tensor:
    fit = EllipsoidFit().fit(_points(device))
    return torch.cat([fit.center_, fit.semi_axes_, fit.center_se_], -1)


WORK: dict[str, Callable[[torch.device], Tensor]] = {
    "nonlinear fits": _decay,
    "ellipsoids": _ellipsoids,
    "covariance determinant": lambda device: MinimumCovarianceDeterminant().fit(_points(device)).covariance_,
    "derivatives of coefficients": _derivatives,
}


def print_other_fits(device: torch.device) -> bool:
    """Print the largest relative difference of each result; whether all are below the limit."""
    right = True
    for name, work in WORK.items():
        expected, found = work(CPU), work(device)
        apart = float((found.cpu() - expected).abs().max() / expected.abs().max())
        right = right and apart <= TOLERANCE and found.device.type == device.type
        print(f"  {name:30}{apart:10.1e} of {TOLERANCE:.0e}", flush=True)
    return right
