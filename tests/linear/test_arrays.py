"""Fits of NumPy arrays and data frames equal fits of tensors of the same numbers; the results are tensors."""

import numpy as np
import pytest
import torch

from mkc_torch.linear import LeastSquares, MEstimator, NotFittedError, ReweightedLeastSquares
from tests.linear.test_arguments import each_estimator, make_estimator, sample

pd = pytest.importorskip("pandas")
pl = pytest.importorskip("polars")

NAMES = ("a", "b")


def data():
    X = sample(0, 30, 2)
    return X, X.sum(-1) + 0.1 * sample(1, 30), sample(2, 30).abs() + 0.5


def as_frame(kind, X):
    return kind({name: column.numpy() for name, column in zip(NAMES, X.unbind(-1), strict=True)})


@each_estimator
def test_arrays_give_the_fit_of_tensors(kind):
    X, y, weight = data()
    want = make_estimator(kind).fit(X, y, weight)
    got = make_estimator(kind).fit(X.numpy(), y.numpy(), weight.numpy())
    assert torch.equal(got.coef_, want.coef_)
    assert torch.equal(got.predict(X.numpy()), want.predict(X))
    assert "feature_names_in_" not in vars(got)


@each_estimator
@pytest.mark.parametrize("library", [pd, pl], ids=["pandas", "polars"])
def test_frames_give_the_fit_of_tensors_and_keep_their_column_names(kind, library):
    X, y, weight = data()
    want = make_estimator(kind).fit(X, y, weight)
    frame = as_frame(library.DataFrame, X)
    got = make_estimator(kind).fit(frame, library.Series(y.numpy()), library.Series(weight.numpy()))
    assert torch.equal(got.coef_, want.coef_)
    assert got.feature_names_in_ == NAMES
    assert torch.equal(got.predict(frame), want.predict(X))
    assert torch.equal(got.predict(X), want.predict(X))
    with pytest.raises(ValueError, match=r"columns .*`a`, `b`.* got `b`, `a`"):
        got.predict(frame[["b", "a"]])
    assert "feature_names_in_" not in vars(got.fit(X, y))
    with pytest.raises(NotFittedError):
        got.feature_names_in_


def test_arrays_given_with_tensors_take_the_dtype_of_the_tensors():
    X, y, weight = data()
    fit = LeastSquares().fit(X.float(), y.numpy(), weight.numpy())
    assert fit.coef_.dtype == torch.float32
    assert fit.predict(X.numpy()).dtype == torch.float32
    assert LeastSquares().fit(X.float().numpy(), y).coef_.dtype == torch.float64
    # the weights are irrelevant here
    assert LeastSquares().fit(X.numpy(), y.numpy(), weight.float()).coef_.dtype == torch.float64


def test_gradients_reach_a_tensor_given_with_an_array():
    X, y, _ = data()
    X.requires_grad_()
    MEstimator().fit(X, y.numpy()).coef_.sum().backward()
    assert bool((X.grad != 0).any())


def test_integer_and_boolean_arrays_are_converted_to_floats():
    X = np.stack([np.ones(10, dtype=int), np.arange(10)], -1)
    torch.testing.assert_close(
        LeastSquares().fit(X, 1 + 2 * X[:, 1]).coef_, torch.tensor([1.0, 2.0], dtype=torch.float64)
    )


def test_targets_in_a_frame_of_one_column_are_one_channel():
    X, y, _ = data()
    fit = LeastSquares().fit(X, pd.DataFrame({"y": y.numpy()}))
    assert torch.equal(fit.coef_, LeastSquares().fit(X, y).coef_)
    assert fit.predict(X).shape == (30,)
    with pytest.raises(ValueError, match=r"one channel is Y\.squeeze\(-1\)"):
        LeastSquares().fit(X, y.unsqueeze(-1).numpy())


def test_arrays_of_several_channels_and_problems_give_the_fit_of_tensors():
    X, Y = sample(0, 4, 30, 2, 3), sample(1, 4, 30, 2)
    assert torch.equal(LeastSquares().fit(X.numpy(), Y.numpy()).coef_, LeastSquares().fit(X, Y).coef_)


def test_missing_values_of_a_frame_are_reported_by_column():
    X, y, _ = data()
    frame = as_frame(pd.DataFrame, X).astype("Float64")
    frame.loc[3:5, "b"] = pd.NA
    with pytest.raises(ValueError, match=r"column `b` .*`X` .* 3 missing of 30"):
        LeastSquares().fit(frame, y)
    with pytest.raises(TypeError, match=r"column `kind` of argument `X` .* text, .*'x'"):
        LeastSquares().fit(as_frame(pd.DataFrame, X).assign(kind="x"), y)
    with pytest.raises(ValueError, match="`Y` to be finite but got nan"):
        LeastSquares().fit(X, np.full(30, np.nan))


@each_estimator
def test_get_params_and_set_params_round_trip(kind):
    estimator = make_estimator(kind)
    params = estimator.get_params()
    assert repr(make_estimator(kind).set_params(**params)) == repr(estimator)
    with pytest.raises(ValueError, match=f"parameters of {kind.__name__}, .* but got `nothing`"):
        estimator.set_params(nothing=1)


def test_an_invalid_parameter_leaves_all_parameters_unchanged():
    estimator = MEstimator().set_params(psi="tukey", max_iter=7)
    assert (estimator.psi, estimator.max_iter) == ("tukey", 7)
    with pytest.raises(ValueError, match=r"`max_iter` .*at least 1"):
        estimator.set_params(psi="huber", max_iter=0)
    assert (estimator.psi, estimator.max_iter) == ("tukey", 7)


def test_set_params_reaches_parameters_of_a_nested_estimator():
    inner = MEstimator()
    outer = ReweightedLeastSquares(inner)
    assert outer.get_params()["start__max_iter"] == 500
    assert "start__max_iter" not in outer.get_params(deep=False)
    outer.set_params(start__max_iter=7, threshold=3.0)
    assert (outer.start.max_iter, outer.threshold, inner.max_iter) == (7, 3.0, 500)
    with pytest.raises(ValueError, match=r"`start` .*estimator.*seed.* got 'lts'"):
        outer.set_params(start="lts", start__seed=1)
