"""The GPU path of fits, forced on the CPU: no batched factorisation, few host reads, the results of the CPU path."""

import contextlib
import copy

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mkc_torch._support.side_by_side import forced
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.covariance import MinimumCovarianceDeterminant
from mkc_torch.linear import (
    LeastMedianOfSquares,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MinimumEntropy,
    MKCRegression,
    RankDeficientError,
    Ridge,
)
from mkc_torch.linear._estimator import LinearEstimator
from tests.estimators import estimators

ESTIMATORS = [
    *(make() for make in estimators(0.2).values()),
    Ridge(1.0),
    MEstimator("huber", scale="proposal2"),
    MinimumEntropy("renyi"),
]


def sample(problems: int, N: int = 30, n: int = 3) -> tuple[Tensor, Tensor]:
    """Problems of N samples with every fifth target wrong, about a tenth of them hard."""
    generator = torch.Generator().manual_seed(1)
    X = torch.randn(problems, N, n, dtype=torch.float64, generator=generator)
    X[..., 0] = 1.0
    y = X.sum(-1) + 0.1 * torch.randn(problems, N, dtype=torch.float64, generator=generator)
    y[:, ::5] += 5.0
    return X, y


FACTORISATIONS = ("linalg_qr", "geqrf", "linalg_eigh", "linalg_svd", "linalg_lstsq", "linalg_pinv", "linalg_cholesky")


class Factorisations(TorchDispatchMode):
    """Records the names of batched factorisations; a single matrix counts as no batch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1].lstrip("_")
        if name.startswith(FACTORISATIONS) and args[0].dim() > 2 and args[0].shape[:-2].numel() > 1:
            self.found.add(name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_fits_use_no_batched_factorisation(estimator: LinearEstimator):
    X, y = sample(4)
    with forced(), Factorisations() as recorded:
        estimator.fit(X, y)
    assert recorded.found == set()


def test_the_recorder_detects_a_batched_factorisation():
    with Factorisations() as recorded:
        LeastSquares().fit(*sample(4))
        LeastTrimmedSquares().fit(*sample(4))
    assert {"linalg_qr", "linalg_pinv"} <= recorded.found


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_the_gpu_path_agrees_with_the_cpu_path(estimator: LinearEstimator, weighted):
    X, y = sample(6, 40, 3)
    weight = 0.5 + torch.rand(6, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    weight[0, :3] = 0.0
    expected = copy.copy(estimator).fit(X, y, weight if weighted else None)
    with forced():
        found = copy.copy(estimator).fit(X, y, weight if weighted else None)
    if isinstance(estimator, LeastMedianOfSquares):
        # rounding decides which of the values on the edge of a Chebyshev fit the next step uses
        torch.testing.assert_close(found.objective_, expected.objective_, rtol=0.15, atol=0.0)
    else:
        torch.testing.assert_close(found.coef_, expected.coef_, rtol=1e-6, atol=1e-6)


def test_nearly_dependent_columns_are_fitted_and_dependent_ones_refused():
    X, y = sample(5)
    X[3, :, 2] = X[3, :, 1] + 1e-9 * X[3, :, 2]
    expected = LeastSquares().fit(X, y).coef_
    with forced():
        found = LeastSquares().fit(X, y).coef_
    torch.testing.assert_close(found[:3], expected[:3])
    torch.testing.assert_close((X @ found.unsqueeze(-1))[3], (X @ expected.unsqueeze(-1))[3], rtol=1e-5, atol=1e-5)
    X[3, :, 2] = X[3, :, 1]
    with forced(), pytest.raises(RankDeficientError, match=r"columns \[1, 2\] are linearly dependent"):
        LeastSquares().fit(X, y)
    X[3, :, 2] = 0.0
    with forced(), pytest.raises(RankDeficientError, match="Column 2 of `X` is zero"):
        LeastSquares().fit(X, y)


def test_many_float32_rows_keep_their_rank():
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(1 << 21, 5, generator=generator)
    y = X.sum(-1) + 0.1 * torch.randn(1 << 21, generator=generator)
    with forced():
        fit = LeastSquares().fit(X, y)
    torch.testing.assert_close(fit.coef_, torch.ones(5), rtol=0.0, atol=1e-3)
    X[:, 4] = X[:, 0] + X[:, 1]
    with forced(), pytest.raises(RankDeficientError):
        LeastSquares().fit(X, y)


READS = ("local_scalar_dense", "nonzero", "is_nonzero", "unique", "unique2", "masked_select", "equal")


class HostReads(TorchDispatchMode):
    """Counts operations that make the host wait for values of the device."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1].lstrip("_")
        masks = name in ("index", "index_put") and any(i is not None and i.dtype == torch.bool for i in args[1])
        self.count += masks or name in READS
        return func(*args, **(kwargs or {}))


def host_reads_of(estimator: LinearEstimator, X: Tensor, y: Tensor) -> int:
    with forced(), HostReads() as reads:
        estimator.fit(X, y)
    return reads.count


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=repr)
def test_host_reads_are_few_and_do_not_grow_with_the_number_of_problems(estimator: LinearEstimator):
    few, many = host_reads_of(estimator, *sample(2)), host_reads_of(estimator, *sample(60))
    steps = int(torch.as_tensor(getattr(estimator, "n_iter_", 0)).max())
    # each pseudo-inverse reads whether Cholesky's factor is enough, in place of hundreds of operations;
    # least median of squares counts its refits, each with exchanges of its own
    constant = 70 if isinstance(estimator, LeastMedianOfSquares) else 36
    assert many <= 0.25 * steps + constant
    assert many <= few + 0.25 * steps + 10 or constant == 70


def points_on_ellipsoids(problems: int, N: int = 150) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    unit = torch.randn(problems, N, 3, dtype=torch.float64, generator=generator)
    unit = unit / torch.linalg.vector_norm(unit, dim=-1, keepdim=True)
    noise = 0.2 * torch.randn(problems, N, 3, dtype=torch.float64, generator=generator)
    return unit * torch.tensor([40.0, 50.0, 60.0]) + noise


def test_ellipsoids_need_no_batched_factorisation_and_no_read_for_each():
    expected = EllipsoidFit().fit(points_on_ellipsoids(4))
    with forced(), Factorisations() as recorded, HostReads() as reads:
        fit = EllipsoidFit().fit(points_on_ellipsoids(4))
    with forced(), HostReads() as more:
        EllipsoidFit().fit(points_on_ellipsoids(40))
    assert recorded.found == set()
    assert more.count <= reads.count + 10
    for name in ("center_", "semi_axes_", "rotation_", "calibration_matrix_", "center_se_", "root_se_"):
        torch.testing.assert_close(getattr(fit, name), getattr(expected, name), rtol=1e-7, atol=1e-9)
    assert len(fit.coverage_) == 4
    assert [c.fraction for c in fit.coverage_] == [c.fraction for c in expected.coverage_]
    assert fit.coverage_[1:3] == [fit.coverage_[1], fit.coverage_[2]]


def test_an_ellipsoid_of_too_few_directions_is_refused_by_its_number():
    points = points_on_ellipsoids(4)
    cap = 0.3 * points[2] / 50.0 + torch.tensor([0.0, 0.0, 1.0])
    points[2] = 50.0 * cap / torch.linalg.vector_norm(cap, dim=-1, keepdim=True)
    messages = []
    for path in (contextlib.nullcontext, forced):
        with path(), pytest.raises(NotIdentifiableError) as caught:
            EllipsoidFit().fit(points)
        messages.append(str(caught.value))
    assert messages[0].startswith("Problem 2: Not identifiable")
    assert messages[1][:60] == messages[0][:60]


@pytest.mark.parametrize("estimator", [LeastSquares(), MKCRegression()], ids=repr)
def test_derivatives_of_an_ellipsoid_equal_those_of_the_cpu_path(estimator):
    def matrix(points: Tensor) -> Tensor:
        return EllipsoidFit(estimator).fit(points).calibration_matrix_.flatten()

    points = points_on_ellipsoids(1, 30)[0]
    expected = torch.autograd.functional.jacobian(matrix, points)
    with forced():
        found = torch.autograd.functional.jacobian(matrix, points)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


def test_implicit_derivatives_need_no_batched_factorisation():
    X, y = sample(4)
    expected = torch.autograd.functional.jacobian(lambda t: MKCRegression().fit(X, t).coef_, y)
    with forced(), Factorisations() as recorded:
        found = torch.autograd.functional.jacobian(lambda t: MKCRegression().fit(X, t).coef_, y)
    assert recorded.found == set()
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_covariance_determinant_needs_no_batched_eigenvalues_and_agrees():
    points = points_on_ellipsoids(3, 60)
    points[:, :10] += 500.0
    expected = MinimumCovarianceDeterminant().fit(points)
    with forced(), Factorisations() as recorded:
        fit = MinimumCovarianceDeterminant().fit(points)
    assert not {name for name in recorded.found if "cholesky" not in name}
    torch.testing.assert_close(fit.covariance_, expected.covariance_)
