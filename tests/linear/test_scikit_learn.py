"""The regressor for scikit-learn: scikit-learn's own checks and tools, and equality with the wrapped estimator."""

import numpy as np
import pytest
import torch

pytest.importorskip("sklearn")

from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import parametrize_with_checks

from mkc_torch.linear import (
    LeastEntropyLike,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MKCRegression,
    MMRegression,
    RankDeficientError,
    ReweightedLeastSquares,
    Ridge,
)
from mkc_torch.linear.scikit_learn import ScikitLearnRegressor
from tests.linear.test_arguments import ESTIMATORS, each_estimator, make_estimator

CHECKED = [
    MMRegression(starts=50),
    MEstimator(),
    LeastTrimmedSquares(starts=50),
    ReweightedLeastSquares(starts=50),
    LeastSquares(),
    MKCRegression(),
    LeastEntropyLike(),
]
each_checked = pytest.mark.parametrize("estimator", CHECKED, ids=lambda estimator: type(estimator).__name__)


def expected_failures(_):
    return {
        "check_sample_weight_equivalence_on_dense_data": "has 30 features of 15 samples, which do not determine the "
        "coefficients; test_integer_weights_equal_repetition does the same with enough samples"
    }


@parametrize_with_checks([ScikitLearnRegressor(inner) for inner in CHECKED], expected_failed_checks=expected_failures)
def test_the_estimator_checks_of_scikit_learn_pass(estimator, check):
    check(estimator)


def test_only_an_estimator_that_may_miss_clean_data_has_the_tag_of_a_poor_score():
    tagged = [kind for kind in ESTIMATORS if poor_score(ScikitLearnRegressor(make_estimator(kind)))]
    assert tagged == [LeastEntropyLike]
    assert not poor_score(ScikitLearnRegressor())


def poor_score(regressor):
    return regressor.__sklearn_tags__().regressor_tags.poor_score


def data(count=60, outliers=12):
    random = np.random.default_rng(0)
    X = random.normal(size=(count, 3))
    y = 1.0 + X @ [1.0, -2.0, 0.5] + 0.1 * random.normal(size=count)
    y[:outliers] += 30.0
    return X, y


def with_intercept(X):
    return torch.from_numpy(np.column_stack([X, np.ones(len(X))])).unsqueeze(-2)


@each_estimator
def test_results_equal_those_of_the_wrapped_estimator(kind):
    X, y = data()
    fit = ScikitLearnRegressor(make_estimator(kind)).fit(X, y)
    inner = make_estimator(kind).fit(with_intercept(X), torch.from_numpy(y).unsqueeze(-1))
    np.testing.assert_array_equal(fit.coef_, inner.coef_[:-1].numpy())
    assert fit.intercept_ == inner.coef_[-1].item()
    np.testing.assert_array_equal(fit.weights_, inner.weights_[:, 0].numpy())
    assert hasattr(fit, "scale_") == hasattr(inner, "scale_")
    if hasattr(inner, "scale_"):
        assert fit.scale_ == inner.scale_.item()
    np.testing.assert_allclose(fit.predict(X), inner.predict(with_intercept(X)).squeeze(-1).numpy(), rtol=0, atol=1e-12)


def test_without_an_intercept_least_squares_equals_that_of_scikit_learn():
    X, y = data(outliers=0)
    for fit_intercept in (True, False):
        ours = ScikitLearnRegressor(LeastSquares(), fit_intercept=fit_intercept).fit(X, y)
        theirs = LinearRegression(fit_intercept=fit_intercept).fit(X, y)
        np.testing.assert_allclose(ours.coef_, theirs.coef_)
        np.testing.assert_allclose(ours.intercept_, theirs.intercept_)
    assert ours.intercept_ == 0.0


def test_the_default_is_robust_to_outliers():
    X, y = data()
    fit = ScikitLearnRegressor().fit(X, y)
    np.testing.assert_allclose([*fit.coef_, fit.intercept_], [1.0, -2.0, 0.5, 1.0], atol=0.1)
    assert (fit.weights_[:12] == 0).all()
    assert (fit.weights_[12:] > 0.1).all()


def test_float32_stays_float32():
    X, y = data()
    fit = ScikitLearnRegressor().fit(X.astype(np.float32), y)
    assert fit.coef_.dtype == fit.predict(X.astype(np.float32)).dtype == np.float32


@each_checked
def test_integer_weights_equal_repetition(estimator):
    X, y = data()
    # total weight as large as the number of samples, by which least trimmed squares chooses its share
    weight = np.arange(len(y)) % 3
    weighted = ScikitLearnRegressor(estimator).fit(X, y, sample_weight=weight)
    repeated = ScikitLearnRegressor(estimator).fit(X.repeat(weight, axis=0), y.repeat(weight))
    np.testing.assert_allclose(weighted.predict(X), repeated.predict(X), rtol=1e-5, atol=1e-6)


def test_the_regressor_works_in_a_pipeline_a_grid_search_and_cross_validation():
    X, y = data(outliers=0)
    pipeline = make_pipeline(StandardScaler(), ScikitLearnRegressor(MMRegression(starts=20)))
    assert cross_val_score(pipeline, X, y, cv=3).min() > 0.99
    name = "scikitlearnregressor__estimator__efficiency"
    search = GridSearchCV(pipeline, {name: [0.85, 0.95]}, cv=3).fit(X, y)
    assert search.best_params_[name] in (0.85, 0.95)
    assert search.best_estimator_[-1].estimator.efficiency == search.best_params_[name]
    kinds = GridSearchCV(ScikitLearnRegressor(), {"estimator": [LeastSquares(), Ridge(1e6)]}, cv=3).fit(X, y)
    assert isinstance(kinds.best_params_["estimator"], LeastSquares)


@pytest.mark.parametrize("kind", ESTIMATORS)
def test_nested_parameters_are_cloned_and_set(kind):
    regressor = ScikitLearnRegressor(make_estimator(kind), fit_intercept=False)
    copy = clone(regressor)
    assert copy.estimator is not regressor.estimator
    assert repr(copy) == repr(regressor)
    inner = {name for name in regressor.get_params() if name.startswith("estimator__")}
    assert inner == {f"estimator__{name}" for name in regressor.estimator.get_params()}
    assert isinstance(regressor._repr_html_(), str)


def test_a_nested_parameter_is_checked_when_it_is_set():
    regressor = ScikitLearnRegressor(MMRegression())
    regressor.set_params(estimator__efficiency=0.85)
    assert regressor.estimator.efficiency == 0.85
    with pytest.raises(ValueError, match="`efficiency` to be in"):
        regressor.set_params(estimator__efficiency=2.0)


def test_feature_names_are_stored_and_checked():
    X, y = data()
    frame = pytest.importorskip("pandas").DataFrame(X, columns=["a", "b", "c"])
    fit = ScikitLearnRegressor().fit(frame, y)
    assert fit.feature_names_in_.tolist() == ["a", "b", "c"]
    with pytest.raises(ValueError, match="feature names"):
        fit.predict(frame[["c", "b", "a"]])


def test_a_fit_with_another_estimator_removes_earlier_results():
    X, y = data()
    fit = ScikitLearnRegressor(MMRegression()).fit(X, y)
    assert fit.scale_ > 0
    assert not hasattr(fit.set_params(estimator=LeastSquares()).fit(X, y), "scale_")


def test_unfitted_wrong_or_underdetermined_estimators_are_refused():
    X, y = data()
    with pytest.raises(NotFittedError):
        ScikitLearnRegressor().predict(X)
    for estimator in (LinearRegression(), "mm", MMRegression):
        with pytest.raises(TypeError, match=r"`estimator` .*mkc_torch\.linear.* got"):
            ScikitLearnRegressor(estimator).fit(X, y)
    with pytest.raises(ValueError, match="minimum of 2 is required"):
        ScikitLearnRegressor().fit(X[:1], y[:1])
    with pytest.raises(ValueError, match=r"at least 4 .*4 coefficients.* got 3 samples"):
        ScikitLearnRegressor().fit(X[:3], y[:3])
    X[:, 1] = 2.0
    with pytest.raises(RankDeficientError, match=r"columns \[1, 3\] .* Column 3 is the constant column"):
        ScikitLearnRegressor().fit(X, y)
    with pytest.raises(ValueError, match="`sample_weight` to be >= 0"):
        ScikitLearnRegressor().fit(*data(), sample_weight=-np.ones(60))
