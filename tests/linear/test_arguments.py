"""Invalid arguments are refused by the constructor, with the argument's name and a remedy."""

import inspect
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from mkc_torch import linear
from mkc_torch.linear import (
    FixedPointLinear,
    GeneralizedMaximumEntropy,
    LeastEntropyLike,
    LeastMedianOfSquares,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MinimumEntropy,
    MKCRegression,
    ReweightedLeastSquares,
    Ridge,
)

INF, NAN = math.inf, math.nan
ESTIMATORS = [
    getattr(linear, name)
    for name in linear.__all__
    if isinstance(getattr(linear, name), type) and hasattr(getattr(linear, name), "fit")
]
each_estimator = pytest.mark.parametrize("kind", ESTIMATORS)


def make_estimator(kind, **options):
    return kind(10.0, **options) if kind is GeneralizedMaximumEntropy else kind(**options)


def sample(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def estimators_with_argument(name):
    """The estimators whose constructor has this argument."""
    return [kind for kind in ESTIMATORS if name in inspect.signature(kind).parameters]


def test_every_estimator_is_covered():
    assert len(ESTIMATORS) == 14
    assert len(estimators_with_argument("seed")) >= 8


@pytest.mark.parametrize("name", ["max_iter", "starts", "seed"])
@pytest.mark.parametrize("value", ["a", 2.5, None, True])
def test_counts_must_be_whole_numbers(name, value):
    for kind in estimators_with_argument(name):
        if (name == "starts" and value is None and kind is ReweightedLeastSquares) or kind is LeastEntropyLike:
            continue
        with pytest.raises(ValueError, match=f"Expected argument `{name}` to be a whole number.* but got"):
            make_estimator(kind, **{name: value})


@pytest.mark.parametrize("name", ["max_iter", "starts"])
def test_counts_must_be_at_least_one(name):
    for kind in estimators_with_argument(name):
        if (kind, name) != (LeastEntropyLike, "starts"):
            with pytest.raises(ValueError, match=rf"`{name}` .*at least 1 .*got 0; "):
                make_estimator(kind, **{name: 0})


@pytest.mark.parametrize("value", [-1.0, NAN, INF])
def test_tolerances_out_of_range_are_refused(value):
    for kind in estimators_with_argument("tol"):
        with pytest.raises(ValueError, match=r"`tol` to be .* but got"):
            make_estimator(kind, tol=value)
        with pytest.raises(TypeError, match=r"`tol` to be a number .* but got 'a'"):
            make_estimator(kind, tol="a")


@pytest.mark.parametrize("kind", [FixedPointLinear, MKCRegression])
@pytest.mark.parametrize("name", ["sigma", "d", "bound"])
@pytest.mark.parametrize("value", [-1.0, 0.0, NAN, torch.tensor([1.0, -1.0]), [1.0, -1.0]])
def test_parameters_of_the_density_out_of_range_are_refused(kind, name, value):
    if name == "bound" and kind is FixedPointLinear:
        return
    with pytest.raises(ValueError, match=rf"`{name}` to be (positive|in \[0\.05, inf\]).* but got"):
        kind(**{name: value})
    with pytest.raises(TypeError, match=rf"`{name}` .*number.*tensor.* got 'a'"):
        kind(**{name: "a"})


def test_sigma_below_its_limit_is_refused_where_the_density_is_normalised():
    FixedPointLinear(sigma=0.01)
    with pytest.raises(ValueError, match=r"`sigma` .*\[0\.05, inf\].* got 0\.01; .*None"):
        MKCRegression(sigma=0.01)


def test_parameters_mapped_by_vmap_are_not_checked():
    X, y = sample(0, 30, 2), sample(1, 30)
    sigma = torch.tensor([1.0, 2.0]).double()
    found = torch.func.vmap(lambda s: FixedPointLinear(sigma=s).fit(X, y).coef_)(sigma)
    torch.testing.assert_close(found[1], FixedPointLinear(sigma=2.0).fit(X, y).coef_)


@pytest.mark.parametrize("kind", [FixedPointLinear, MKCRegression, MEstimator, MinimumEntropy])
@pytest.mark.parametrize("value", ["ols", 3, np.ones(2), [1.0, 2.0], torch.tensor([NAN, 1.0]), torch.tensor(1.0)])
def test_invalid_starts_are_refused(kind, value):
    with pytest.raises(ValueError, match=r"`start` to be .*coefficients.* but got") as refused:
        kind(start=value)
    assert ("torch.as_tensor(start)" in str(refused.value)) == isinstance(value, (np.ndarray, list))


@pytest.mark.parametrize("kind", [LeastMedianOfSquares, LeastTrimmedSquares])
def test_a_coverage_below_one_is_refused(kind):
    assert kind(h=np.int64(20)).h == 20
    for h in (-1, 0):
        with pytest.raises(ValueError, match=rf"`h` .*at least 1 .*got {h}"):
            kind(h=h)
    for h in ("a", 2.5, True):
        with pytest.raises(TypeError, match=r"`h` .*whole number.* got"):
            kind(h=h)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Ridge("a"), TypeError, "`alpha` to be a number >= 0 and finite but got 'a'"),
        (lambda: LeastSquares(bandwidth="a"), TypeError, "`bandwidth` to be a number >= 0"),
        (lambda: LeastSquares(bandwidth=-1), ValueError, "`bandwidth` to be >= 0 and finite but got -1"),
        (lambda: MEstimator(["huber"]), ValueError, "`psi` to be one of 'huber'"),
        (lambda: ReweightedLeastSquares(["lts"]), ValueError, "`start` to be 'lts', 'lms', 's' or an estimator but"),
        (lambda: ReweightedLeastSquares(Ridge), ValueError, r"got the class Ridge; pass an instance, Ridge\(\)"),
        (lambda: ReweightedLeastSquares(threshold="a"), TypeError, "`threshold` to be a number"),
        (lambda: LeastEntropyLike("a"), TypeError, "`start` to be a tensor but got str"),
        (lambda: LeastEntropyLike([1.0]), TypeError, r"`start` .* got list; .*torch\.as_tensor\(start\)"),
        (lambda: LeastEntropyLike(torch.tensor([NAN])), ValueError, "`start` of finite values .* got NaN or infinity"),
        (lambda: LeastEntropyLike(starts=torch.ones(3)), ValueError, r"`starts` .* \(\*, S, n\) but got \(3,\)"),
        (lambda: MinimumEntropy(bandwidth="a"), TypeError, "`bandwidth` to be a number or a tensor of numbers"),
        (lambda: GeneralizedMaximumEntropy("a"), TypeError, "`coef_support` to be a number positive and finite"),
        (lambda: GeneralizedMaximumEntropy([-1.0, 1.0]), TypeError, r"torch\.as_tensor\(coef_support\)"),
        (lambda: GeneralizedMaximumEntropy(1.0, "a"), TypeError, "`error_support` to be a number"),
        (
            lambda: FixedPointLinear(noise_covariance=[[1.0]]),
            TypeError,
            "`noise_covariance` to be a tensor but got list",
        ),
        (
            lambda: FixedPointLinear(noise_covariance=torch.ones(2, 3)),
            ValueError,
            r"of shape \(m, m\) but got \(2, 3\)",
        ),
        (
            lambda: FixedPointLinear(noise_covariance=-torch.eye(2)),
            ValueError,
            "symmetric and positive definite but got",
        ),
    ],
)
def test_invalid_arguments_are_refused_by_the_constructor_with_a_remedy(make, error, message):
    with pytest.raises(error, match=message):
        make()


@each_estimator
def test_errors_for_data_of_another_type_name_the_conversion(kind):
    X, y = sample(0, 30, 2), sample(1, 30)
    with pytest.raises(TypeError, match=r"`X` .* got list; .*torch\.as_tensor\(X\)"):
        make_estimator(kind).fit(X.tolist(), y)
    with pytest.raises(TypeError, match=r"`Y` .* got torch\.int64; .*Y\.float\(\)"):
        make_estimator(kind).fit(X, y.long())
    with pytest.raises(TypeError, match=r"`sample_weight` .*tensor.*array.* got list; .*tensor"):
        make_estimator(kind).fit(X, y, [1.0] * 30)
    with pytest.raises(TypeError, match=r"share dtype and device .*; use Y"):
        make_estimator(kind).fit(X, y.float())


def test_data_are_checked_before_whitening():
    with pytest.raises(TypeError, match=r"`X` .* but got list"):
        FixedPointLinear(noise_covariance=torch.eye(2)).fit(torch.ones(5, 2, 3).tolist(), torch.ones(5, 2))


@pytest.mark.parametrize(
    ("x_shape", "y_shape", "remedy"),
    [
        ((1000,), (1000,), r"\(1000,\) and \(1000,\); one column is X\[:, None\]"),
        ((1000, 3), (1000, 1), r"\(1000, 3\) and \(1000, 1\); one channel is Y\.squeeze\(-1\)"),
        ((3, 1000), (1000,), r"\(3, 1000\) and \(1000,\); a sample is a row of X, so try X\.mT"),
        ((1000, 3), (999,), r"\(1000, 3\) and \(999,\)\."),
    ],
)
def test_errors_for_wrong_shapes_name_the_remedy(x_shape, y_shape, remedy):
    with pytest.raises(ValueError, match=remedy):
        LeastSquares().fit(sample(0, *x_shape), sample(1, *y_shape))


@each_estimator
def test_predict_checks_type_dtype_and_columns_against_the_fit(kind):
    X, y = sample(0, 30, 2), sample(1, 30)
    fit = make_estimator(kind).fit(X, y)
    assert fit.predict(X).shape == (30,)
    with pytest.raises(TypeError, match=r"`X` .* but got list"):
        fit.predict(X.tolist())
    with pytest.raises(TypeError, match=r"`X` of the dtype .* of the fit, torch\.float64 .* but got torch\.float32"):
        fit.predict(X.float())
    with pytest.raises(ValueError, match=r"`X` .*2 columns.* got 3; "):
        fit.predict(sample(0, 30, 3))


def test_prediction_of_other_batch_dimensions_is_refused():
    fit = LeastSquares().fit(sample(0, 4, 30, 2), sample(1, 4, 30))
    assert fit.predict(sample(2, 4, 7, 2)).shape == (4, 7)
    with pytest.raises(ValueError, match=r"`X` and `coef_` .*broadcast.* got \(3,\) and \(4,\)"):
        fit.predict(sample(2, 3, 7, 2))
