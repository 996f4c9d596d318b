"""The density and the loss of Li et al. (2023) against independent values: (17), Theorem 1 and Corollary 1.

    python examples/paper/density.py

The normaliser's oracle is the series Z = 2 L exp(-σ²) + sqrt(2π) σ Σ_k Pois(k; σ²) k^(-1/2) erf(sqrt(k/2) L/σ), k ≥ 1;
its gradients are integrated by SciPy's adaptive quadrature.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.integrate import quad
from scipy.special import erf, gammaln
from scipy.stats import norm

from mkc_torch import MKCLoss
from mkc_torch.density.energy import energy
from mkc_torch.density.normalizer import log_partition

LENGTHS = np.concatenate([np.linspace(1, 12, 12), np.logspace(1.2, 7, 12)])
KAPPAS = np.concatenate([[0.0], np.logspace(-3, math.log10(400), 40)])


def series(kappa: float, length: float) -> float:
    """Z for kappa = 0 or kappa ≥ 1e-3."""
    if kappa == 0:
        return float(math.sqrt(2 * math.pi) * (1 - 2 * norm.sf(length)))
    s2 = 1 / kappa
    k = np.arange(1, int(s2 + 40 * math.sqrt(s2) + 60))
    poisson = np.exp(k * math.log(s2) - s2 - gammaln(k + 1))
    head = math.sqrt(2 * math.pi * s2) * np.sum(poisson / np.sqrt(k) * erf(np.sqrt(k / 2) * length / math.sqrt(s2)))
    return float(2 * length * math.exp(-s2) + head)


def slope(kappa: float, length: float) -> float:
    """d log Z / d kappa for kappa > 0: minus the mean of dE/dkappa, with what is flat on the tail taken out."""

    def excess(u: float) -> float:
        q, x = 0.5 * u * u, 0.5 * kappa * u * u
        first = (-math.expm1(-x) / kappa - q * math.exp(-x)) / kappa
        return first * math.exp(math.expm1(-x) / kappa) - flat

    flat = math.exp(-1 / kappa) / kappa**2
    end = min(length, max(9.0, 12.0 / math.sqrt(kappa)))
    head = quad(excess, 0, end, points=[end / 16, end / 4], epsabs=0, epsrel=1e-12, limit=400)[0]
    return 2 * (length * flat + head) / series(kappa, length)


def normaliser_errors(dtype: torch.dtype) -> float:
    grid = [(k, a) for k in KAPPAS for a in LENGTHS]
    expected = np.log([series(k, a) for k, a in grid])
    kappa, length = torch.tensor(grid, dtype=dtype).unbind(-1)
    return float(np.abs(np.expm1(log_partition(kappa, length).double().numpy() - expected)).max())


def slope_errors() -> float:
    grid = [(k, a) for k in KAPPAS[1::3] for a in LENGTHS[::3]]
    kappa, length = torch.tensor(grid, dtype=torch.float64).unbind(-1)
    found = torch.func.grad(lambda k: log_partition(k, length).sum())(kappa).numpy()
    expected = np.array([slope(k, a) for k, a in grid])
    return float(np.abs(found / expected - 1).max())


def edge_errors() -> float:
    """d log Z / d length against 2 exp(-energy(length)) / Z, where it exceeds 1e-6."""
    grid = [(k, a) for k in KAPPAS for a in LENGTHS]
    kappa, length = torch.tensor(grid, dtype=torch.float64).unbind(-1)
    found = torch.func.grad(lambda a: log_partition(kappa, a).sum())(length)
    expected = torch.exp(math.log(2) - energy(length, kappa)) / torch.tensor([series(k, a) for k, a in grid])
    return float((found / expected - 1).abs()[expected > 1e-6].max())


def gaussian_difference() -> tuple[float, float]:
    """Largest difference to weighted least squares and to GaussianNLLLoss at sigma = inf, over value and gradients."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(1000, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    y = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
    d = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)

    def difference(a: list[torch.Tensor], b: list[torch.Tensor]) -> float:
        return max(float((p - q).detach().abs().max()) for p, q in zip(a, b, strict=True))

    energy = MKCLoss(3, sigma=math.inf, d=d, learn_sigma=False, learn_d=False).double()(x, y)
    squares = (0.5 * ((x - y) / d) ** 2).mean()
    wls = difference([energy, *torch.autograd.grad(energy, x)], [squares, *torch.autograd.grad(squares, x)])
    loss = MKCLoss(3, sigma=math.inf, d=d, bound=1e3, learn_sigma=False).double()
    scale = loss.d.detach().requires_grad_()
    gaussian = torch.nn.GaussianNLLLoss(full=True)(x, y, scale.square().expand(1000, 3))
    value = loss(x, y)
    assert loss.raw_d is not None
    d_input, d_raw = torch.autograd.grad(value, [x, loss.raw_d], retain_graph=True)
    # by the chain rule, so that both gradients are with respect to d
    d_scale = d_raw / torch.autograd.grad(loss.d.sum(), loss.raw_d)[0]
    return wls, difference([value, d_input, d_scale], [gaussian, *torch.autograd.grad(gaussian, [x, scale])])


def main() -> None:
    wls, gaussian = gaussian_difference()
    table = Table(title="worst error over kappa = 1/sigma² in {0} and [0.001, 400], a/d in [1, 1e7]")
    table.add_column("")
    table.add_column("worst", justify="right")
    for name, error in (
        ("Z, relative, float64", normaliser_errors(torch.float64)),
        ("Z, relative, float32", normaliser_errors(torch.float32)),
        ("d log Z / d kappa, relative, float64", slope_errors()),
        ("d log Z / d (a/d), relative where it exceeds 1e-6, float64", edge_errors()),
        ("sigma = inf against weighted least squares, value and gradient", wls),
        ("sigma = inf against GaussianNLLLoss, value and gradients", gaussian),
    ):
        table.add_row(name, f"{error:.1e}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
