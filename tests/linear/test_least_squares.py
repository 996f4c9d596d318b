"""Least squares and ridge: equal to LAPACK and scikit-learn, for every form of input."""

import pytest
import torch
from sklearn.linear_model import LinearRegression
from sklearn.linear_model import Ridge as SklearnRidge
from torch import Tensor

from mkc_torch.linear import LeastSquares, RankDeficientError, Ridge
from mkc_torch.linear._estimator import LinearEstimator, NotFittedError
from tests.draws import normal as sample
from tests.literature import DATA_SETS, REFERENCE


def lstsq(X: Tensor, y: Tensor) -> Tensor:
    return torch.linalg.lstsq(X, y.unsqueeze(-1)).solution.squeeze(-1)


@pytest.mark.parametrize("name", REFERENCE)
def test_least_squares_gives_the_published_coefficients(name):
    expected = torch.tensor(REFERENCE[name].least_squares, dtype=torch.float64)
    torch.testing.assert_close(LeastSquares().fit(*DATA_SETS[name]()).coef_, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_least_squares_equals_lstsq(batch):
    X, y = sample(0, *batch, 30, 4), sample(1, *batch, 30)
    fit = LeastSquares().fit(X.unsqueeze(-2), y.unsqueeze(-1))
    assert fit.coef_.shape == (*batch, 4)
    torch.testing.assert_close(fit.coef_, lstsq(X, y), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(fit.weights_, torch.ones(*batch, 30, 1, dtype=torch.float64))


def test_weighted_least_squares_equals_scikit_learn():
    X, y, weight = sample(0, 40, 3), sample(1, 40), sample(2, 40).exp()
    expected = LinearRegression(fit_intercept=False).fit(X.numpy(), y.numpy(), weight.numpy()).coef_
    torch.testing.assert_close(LeastSquares().fit(X, y, weight).coef_, torch.from_numpy(expected))


def test_channels_share_the_coefficients():
    X, Y = sample(0, 20, 3, 5), sample(1, 20, 3)
    torch.testing.assert_close(LeastSquares().fit(X, Y).coef_, lstsq(X.reshape(60, 5), Y.flatten()))


def test_weights_of_values_differ_between_channels():
    X, Y, weight = sample(0, 20, 3, 5), sample(1, 20, 3), sample(2, 20, 3).exp()
    root = weight.sqrt().flatten()
    expected = lstsq(X.reshape(60, 5) * root.unsqueeze(-1), Y.flatten() * root)
    torch.testing.assert_close(LeastSquares().fit(X, Y, weight).coef_, expected)


def test_weights_of_samples_apply_to_all_channels():
    X, Y, weight = sample(0, 20, 3, 5), sample(1, 20, 3), sample(2, 20).exp()
    by_value = LeastSquares().fit(X, Y, weight.unsqueeze(-1).expand(20, 3))
    torch.testing.assert_close(LeastSquares().fit(X, Y, weight).coef_, by_value.coef_)
    assert not torch.allclose(LeastSquares().fit(X, Y).coef_, by_value.coef_)


def test_a_shared_design_equals_a_loop_over_targets():
    X, Y = sample(0, 30, 4), sample(1, 2, 5, 30)
    fit = LeastSquares().fit(X, Y)
    assert fit.coef_.shape == (2, 5, 4)
    torch.testing.assert_close(fit.coef_, lstsq(X.expand(2, 5, 30, 4), Y))


@pytest.mark.parametrize("zeros", [False, True])
def test_a_batch_of_weights_broadcasts_against_a_single_problem(zeros):
    X, y, weight = sample(0, 30, 2), sample(1, 30), sample(2, 3, 30).exp()
    if zeros:
        weight[0, :10] = 0.0
    fit = LeastSquares().fit(X, y, weight)
    assert fit.coef_.shape == (3, 2)
    for i in range(3):
        torch.testing.assert_close(fit.coef_[i], LeastSquares().fit(X, y, weight[i]).coef_)


def test_batch_equals_loop():
    X, y = sample(0, 4, 30, 3), sample(1, 4, 30)
    fit = LeastSquares().fit(X, y)
    for i in range(4):
        torch.testing.assert_close(fit.coef_[i], LeastSquares().fit(X[i], y[i]).coef_, rtol=1e-12, atol=1e-12)


def test_columns_of_very_different_size_are_exact():
    scale = torch.tensor([1e-8, 1.0, 1e3, 1e8], dtype=torch.float64)
    X, y = sample(0, 50, 4), sample(1, 50)
    fit = LeastSquares().fit(X * scale, y)
    torch.testing.assert_close(fit.coef_ * scale, lstsq(X, y), rtol=1e-9, atol=1e-9)


def test_weight_zero_equals_removal():
    X, y = sample(0, 30, 3), sample(1, 30)
    weight = (torch.arange(30) % 3 > 0).double()
    y[::3] = 1e6
    torch.testing.assert_close(LeastSquares().fit(X, y, weight).coef_, lstsq(X[weight > 0], y[weight > 0]))


def test_weight_two_equals_repetition():
    X, y = sample(0, 30, 3), sample(1, 30)
    weight = 1.0 + (torch.arange(30) % 2).double()
    repeated = lstsq(X.repeat_interleave(weight.long(), 0), y.repeat_interleave(weight.long()))
    torch.testing.assert_close(LeastSquares().fit(X, y, weight).coef_, repeated)


def test_float32_stays_float32():
    X, y = sample(0, 30, 3), sample(1, 30)
    fit = LeastSquares().fit(X.float(), y.float())
    assert fit.coef_.dtype == fit.weights_.dtype == torch.float32
    torch.testing.assert_close(fit.coef_.double(), lstsq(X, y), rtol=1e-5, atol=1e-5)


def test_the_gradient_by_the_targets_passes_gradcheck():
    X, y = sample(0, 8, 2), sample(1, 8).requires_grad_()
    assert torch.autograd.gradcheck(lambda y: LeastSquares().fit(X, y).coef_, (y,))


@pytest.mark.parametrize("alpha", [0.0, 1e-3, 1.0, 50.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_ridge_equals_scikit_learn(alpha, weighted):
    X, y, weight = sample(0, 40, 3), sample(1, 40), sample(2, 40).exp() if weighted else None
    oracle = SklearnRidge(alpha=alpha, fit_intercept=False, solver="svd", tol=1e-14)
    expected = oracle.fit(X.numpy(), y.numpy(), None if weight is None else weight.numpy()).coef_
    fit = Ridge(alpha=alpha).fit(X, y, weight)
    torch.testing.assert_close(fit.coef_, torch.from_numpy(expected), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(fit.weights_, torch.ones_like(y).unsqueeze(-1))


def test_ridge_of_dependent_columns_shares_the_coefficient():
    column, y = sample(0, 20, 1), sample(1, 20)
    coef = Ridge(alpha=2.0).fit(column.expand(20, 2), y).coef_
    expected = float(column[:, 0] @ y) / (2 * float(column[:, 0] @ column[:, 0]) + 2.0)
    torch.testing.assert_close(coef, torch.full((2,), expected, dtype=torch.float64))


def test_ridge_fits_fewer_values_than_coefficients():
    X, y = sample(0, 3, 6), sample(1, 3)
    expected = X.mT @ torch.linalg.solve(X @ X.mT + 0.5 * torch.eye(3, dtype=X.dtype), y)
    torch.testing.assert_close(Ridge(alpha=0.5).fit(X, y).coef_, expected)


def test_ridge_of_a_zero_column_gives_it_no_coefficient():
    X, y = sample(0, 10, 2) * torch.tensor([1.0, 0.0]).double(), sample(1, 10)
    assert float(Ridge(alpha=1.0).fit(X, y).coef_[1]) == 0.0


def test_ridge_without_penalty_refuses_dependent_columns():
    column = sample(0, 20, 1)
    with pytest.raises(RankDeficientError, match=r"columns \[0, 1\]"):
        Ridge(alpha=0.0).fit(column.expand(20, 2), sample(1, 20))


def test_ridge_of_channels_and_batches_solves_the_normal_equations():
    X, Y = sample(0, 4, 20, 3, 5), sample(1, 4, 20, 3)
    fit = Ridge(alpha=1.5).fit(X, Y)
    assert fit.weights_.shape == Y.shape
    flat = X.reshape(4, 60, 5)
    gram = flat.mT @ flat + 1.5 * torch.eye(5, dtype=X.dtype)
    expected = torch.linalg.solve(gram, (flat.mT @ Y.reshape(4, 60, 1)).squeeze(-1))
    torch.testing.assert_close(fit.coef_, expected)


@pytest.mark.parametrize("alpha", [-1.0, float("nan")])
def test_ridge_refuses_a_bad_alpha(alpha):
    with pytest.raises(ValueError, match=rf"`alpha` .*>= 0.*finite.* got {alpha}"):
        Ridge(alpha=alpha)


@pytest.mark.parametrize(
    ("x_shape", "y_shape"),
    [((30, 4), (30,)), ((2, 30, 4), (2, 30)), ((30, 3, 4), (30, 3)), ((2, 30, 3, 4), (2, 30, 3)), ((30, 4), (5, 30))],
)
def test_predict_has_the_shape_of_the_targets(x_shape, y_shape):
    X, coef = sample(0, *x_shape), sample(1, 4)
    Y = torch.matmul(X, coef).expand(y_shape)
    for estimator in (LeastSquares(), Ridge(alpha=0.0)):
        fit = estimator.fit(X, Y)
        assert fit.weights_.shape in (y_shape, (*y_shape, 1))
        torch.testing.assert_close(fit.predict(X), Y, rtol=1e-10, atol=1e-10)


def test_predict_accepts_another_number_of_samples():
    X, coef = sample(0, 2, 30, 3, 4), sample(1, 4)
    fit = LeastSquares().fit(X, torch.matmul(X, coef))
    new = sample(2, 2, 7, 3, 4)
    torch.testing.assert_close(fit.predict(new), torch.matmul(new, coef))


def test_predict_refuses_another_number_of_columns():
    fit = LeastSquares().fit(sample(0, 30, 4), sample(1, 30))
    with pytest.raises(ValueError, match=r"`X` .*4 columns.* got 3"):
        fit.predict(sample(0, 30, 3))


@pytest.mark.parametrize("estimator", [LeastSquares(), Ridge()])
@pytest.mark.parametrize("name", ["coef_", "weights_"])
def test_result_before_fit_raises_not_fitted(estimator, name):
    with pytest.raises(NotFittedError, match=rf"{type(estimator).__name__} has no `{name}` yet; call fit"):
        getattr(estimator, name)
    assert not hasattr(estimator, name)


def test_an_unknown_attribute_does_not_raise_not_fitted():
    with pytest.raises(AttributeError, match="no attribute 'slope'") as raised:
        LeastSquares().slope
    assert not isinstance(raised.value, NotFittedError)


def test_predict_before_fit_raises_not_fitted():
    with pytest.raises(NotFittedError, match="call fit"):
        LeastSquares().predict(sample(0, 3, 2))


@pytest.mark.parametrize(
    ("estimator", "text"),
    [(LeastSquares(), "LeastSquares(covariance='sandwich', bandwidth=None)"), (Ridge(alpha=0.25), "Ridge(alpha=0.25)")],
)
def test_repr_shows_the_parameters(estimator: LinearEstimator, text: str):
    assert repr(estimator) == text


def test_fit_returns_the_estimator():
    for estimator in (LeastSquares(), Ridge()):
        assert estimator.fit(sample(0, 5, 2), sample(1, 5)) is estimator
