"""A pass over the rows by a Triton kernel has the sums of torch; on a GPU, or by Triton's interpreter on the CPU."""

import math

import pytest
import torch
from torch import Tensor

from mkc_torch.linear import MKCRegression, _large, _rows
from mkc_torch.linear._blocks import Density
from mkc_torch.linear._rows import Rows
from tests.triton_interpreter import skip_without_interpreter

pytest.importorskip("triton")
from mkc_torch.linear import _fused_pass

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(autouse=True)
def _skip_without_interpreter():
    if DEVICE == "cpu" and not _fused_pass._KERNEL.is_interpreted:
        pytest.skip("the kernel was imported before TRITON_INTERPRET=1 was set")
    if DEVICE == "cpu":
        skip_without_interpreter()


def sample(n: int, rows: int = 150) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(n)
    X = torch.randn(rows, n, generator=generator, dtype=torch.float64)
    X[:, 0] = 1.0
    y = X.sum(-1) + 0.3 * torch.randn(rows, generator=generator, dtype=torch.float64)
    y[: rows // 10] += 20.0
    return X, y


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(
    ("kappa", "n", "dtype"),
    [(0.0, 9, torch.float64), (1e-6, 1, torch.float64), (0.3, 9, torch.float32), (0.3, 20, torch.float64)],
)
def test_sums_by_the_kernel_equal_those_of_torch(kappa, n, dtype, weighted):
    X, y = (v.to(dtype) for v in sample(n))
    X = torch.cat([X, X], -1)[:, :n]  # rows that are apart in memory
    weight = (torch.arange(len(y)) % 3).to(dtype) if weighted else None
    beta = torch.full((n,), 0.9, dtype=torch.float64)
    density = Density(torch.tensor([kappa]).double(), torch.tensor([0.4]).double())
    rows = Rows(X[:, None], y[:, None], None if weight is None else weight[:, None])
    expected_weights, weights = torch.empty_like(rows.Y), torch.empty_like(rows.Y, device=DEVICE)
    expected = rows.evaluate(beta, density, with_curvature=True, with_range=True, weights=expected_weights)
    # differences of the second derivative by a small κ lose digits in either order
    tolerance = 1e-7 if 0.0 < kappa < 1e-3 else 1e-9
    moved = (X.to(DEVICE), y.to(DEVICE), None if weight is None else weight.to(DEVICE))
    for with_curvature in (False, True):
        found = _fused_pass.fused_pass(*moved, beta, density, with_curvature=with_curvature, weights=weights)
        assert (found.curvature is not None) == with_curvature
        fields = zip(
            (*found.total, *(found.curvature or ()), *(found.extent or ())),
            (*expected.total, *((expected.curvature or ()) if with_curvature else ()), *(expected.extent or ())),
            strict=True,
        )
        for mine, other in fields:
            torch.testing.assert_close(mine, other, rtol=tolerance, atol=tolerance * max(1.0, float(other.abs().max())))
        torch.testing.assert_close(weights.cpu(), expected_weights)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_fit_by_the_kernel_equals_the_fit_by_torch(dtype, monkeypatch):
    X, y = (v.to(dtype) for v in sample(4, rows=6000))
    monkeypatch.setattr(_large, "LARGE", 6000)
    plain = MKCRegression().fit(X, y)
    passes = []
    kernel = _fused_pass.fused_pass
    monkeypatch.setattr(_rows, "runs_kernel", lambda rows: rows.frame is None)
    monkeypatch.setattr(_fused_pass, "fused_pass", lambda *a, **k: passes.append(a) or kernel(*a, **k))
    fit = MKCRegression().fit(X.to(DEVICE), y.to(DEVICE))
    assert len(passes) >= 4
    tolerance = 1e-7 if dtype == torch.float64 else 1e-5
    for name in ("coef_", "sigma_", "d_", "bound_", "weights_", "covariance_", "log_likelihood_"):
        mine, other = getattr(fit, name).cpu(), getattr(plain, name)
        torch.testing.assert_close(mine, other, rtol=tolerance, atol=tolerance * float(other.abs().max()))
    assert not math.isinf(float(fit.sigma_))
