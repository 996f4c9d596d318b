"""Exact fits: many samples on a hyperplane are an error that reports it; samples near a hyperplane are fitted."""

import math
import pickle

import pytest
import torch
from sklearn.datasets import load_iris
from torch import Tensor

from mkc_torch.covariance import ExactFitError, MinimumCovarianceDeterminant, outlier_map
from mkc_torch.linear import MMRegression
from tests.draws import normal as sample

MCD = MinimumCovarianceDeterminant


def samples_on_a_plane(on: int = 40, N: int = 60) -> Tensor:
    """(N, 3) samples; the first ``on`` fulfil z = 2 x - y + 5."""
    X = sample(0, N, 3)
    X[:on, 2] = 2.0 * X[:on, 0] - X[:on, 1] + 5.0
    return X


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_error_reports_the_plane(dtype):
    X = samples_on_a_plane().to(dtype)
    with pytest.raises(
        ExactFitError, match=r"40 of 60 lie on the hyperplane 0.8165·x0 - 0.4082·x1 - 0.4082·x2 = -2.04"
    ) as caught:
        MCD().fit(X)
    error = caught.value
    expected = torch.tensor([2.0, -1.0, -1.0], dtype=dtype) / math.sqrt(6.0)
    torch.testing.assert_close(error.normal, expected, atol=1e-5, rtol=0)
    assert error.offset == pytest.approx(-5.0 / math.sqrt(6.0), rel=1e-5)
    assert error.samples.tolist() == [True] * 40 + [False] * 20
    assert (error.problem, error.columns) == ((), (0, 1, 2))
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert "take `h` well above 40" in str(error)


def test_a_plane_of_fewer_than_h_samples_is_not_an_exact_fit():
    X = samples_on_a_plane()
    assert float(torch.linalg.eigvalsh(MCD(h=50).fit(X).covariance_).min()) > 0.01
    with pytest.raises(ExactFitError):
        MCD(h=40).fit(X)
    assert torch.isfinite(MCD().fit(samples_on_a_plane(on=20)).distances_).all()


def test_an_exact_fit_in_a_batch_is_reported_by_its_index():
    batch = torch.stack([sample(seed, 60, 3) for seed in range(6)]).unflatten(0, (2, 3))
    batch[1, 2] = samples_on_a_plane()
    with pytest.raises(ExactFitError, match=r"40 of 60 of problem \(1, 2\) lie") as caught:
        MCD().fit(batch)
    assert caught.value.problem == (1, 2)


def test_the_relevant_columns_are_reported_in_any_unit():
    X = samples_on_a_plane() * torch.tensor([1e8, 1.0, 1e-8]) + torch.tensor([1e9, 0.0, 0.0])
    with pytest.raises(ExactFitError, match=r"40 of 60 lie on the hyperplane -2e-16·x0 \+ 1e-08·x1 \+ 1·x2 = -1.5e-07"):
        MCD().fit(X)


def test_a_column_of_equal_values_is_reported():
    # 29 of 50 petals of setosa are 0.2 cm wide
    with pytest.raises(ExactFitError, match=r"29 of 50 lie on the hyperplane 1·x3 = 0.2,"):
        MCD().fit(torch.as_tensor(load_iris().data[:50]))
    X = sample(1, 30, 2)
    X[:, 0] = 7.0
    with pytest.raises(
        ExactFitError, match=r"30 of 30 lie on the hyperplane 1·x0 = 7, .* leave out one of these columns\."
    ):
        MCD().fit(X)


def test_a_plane_of_the_reweighted_samples_is_reported():
    X = samples_on_a_plane()
    assert torch.isfinite(MCD(h=41, reweight=False).fit(X).distances_).all()
    with pytest.raises(
        ExactFitError, match="40 of 60"
    ):  # the single sample off it is far by the distances of the others
        MCD(h=41).fit(X)


@pytest.mark.parametrize("p", [1, 3])
def test_equal_samples_are_reported(p):
    X = sample(2, 30, p)
    X[:20] = 3.0
    with pytest.raises(ExactFitError, match="20 of 30"):
        MCD().fit(X)


def test_samples_near_a_plane_are_fitted_with_a_small_scatter():
    X = samples_on_a_plane(on=60)
    X[:, 2] += 1e-5 * sample(5, 60)
    fit = MCD().fit(X)
    normal = torch.tensor([2.0, -1.0, -1.0], dtype=torch.float64)
    assert 0.4e-5 < float((normal @ fit.covariance_ @ normal).sqrt()) < 2e-5
    assert torch.isfinite(fit.distances_).all()


@pytest.mark.parametrize("far", [1e5, 1e9, 1e20, 1e76])
@pytest.mark.parametrize("how", ["one point", "a cloud"])
def test_far_outliers_are_not_reported_as_a_plane(far, how):
    X = sample(0, 60, 3)
    near = MCD().fit(torch.cat([X[25:], 100.0 + X[:25]]))
    X[:25] = far if how == "one point" else far * sample(3, 25, 3)
    fit = MCD().fit(X)
    assert not fit.weights_[:25].any()
    torch.testing.assert_close(fit.location_, near.location_)


def test_a_far_outlier_in_the_support_is_refused():
    X = sample(0, 60, 3)
    X[0] = 1e30
    with pytest.raises(ValueError, match=r"far outlier but h = .*take a smaller `h`"):
        MCD(1.0).fit(X)
    X[0] = 1e6
    assert float(MCD(1.0, reweight=False).fit(X).location_[0]) == pytest.approx(1e6 / 60, rel=1e-3)


def test_an_indicator_among_predictors_is_reported_by_its_column():
    X = torch.cat([torch.ones(60, 1).double(), sample(0, 60, 2)], 1)
    X[:, 2] = (X[:, 2] > 1.0).double()
    y = X.sum(-1) + 0.1 * sample(1, 60)
    with pytest.raises(ExactFitError, match=r"lie on the hyperplane 1·x2 = 0,"):
        outlier_map(MMRegression().fit(X, y), X, y)
