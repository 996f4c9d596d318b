"""Refused and accepted arguments of the minimum covariance determinant."""

import re

import numpy as np
import pytest
import torch

from mkc_torch.covariance import ExactFitError, MinimumCovarianceDeterminant
from mkc_torch.linear import NotFittedError
from tests.covariance.reference import SETS

MCD = MinimumCovarianceDeterminant
GOOD = torch.randn(30, 3, generator=torch.Generator().manual_seed(0)).double()


def with_value(value):
    X = GOOD.clone()
    X[4, 1] = value
    return X


@pytest.mark.parametrize(
    ("X", "error", "message"),
    [
        (GOOD.long(), TypeError, "`X` to be a real floating-point tensor but got torch.int64; convert it, X.float()"),
        (GOOD.to(torch.complex64), TypeError, "`X` to be a real floating-point tensor but got torch.complex64"),
        (GOOD.half(), TypeError, "`X` of dtype float32 or float64 but got torch.float16"),
        ([[1.0]], TypeError, "`X` to be a tensor or an array but got list; make a tensor of it, torch.as_tensor(X)"),
        (None, TypeError, "`X` to be a tensor or an array but got NoneType"),
        (GOOD.numpy().astype(str), TypeError, "`X` to hold real numbers but got text"),
        (GOOD.numpy().astype(complex), TypeError, "`X` to hold real numbers but got complex128"),
        (GOOD[:, 0], ValueError, "`X` of shape (*, N, p) but got (30,); for a single column pass X.unsqueeze(-1)"),
        (GOOD[:0], ValueError, "`X` of shape (*, N, p) but got (0, 3)"),
        (GOOD[:, :0], ValueError, "`X` of shape (*, N, p) but got (30, 0)"),
        (GOOD[:4], ValueError, "at least 5 samples for a scatter of 3 columns but got 4"),
        (GOOD.mT, ValueError, "at least 32 samples for a scatter of 30 columns but got 3; add samples"),
        (with_value(np.nan), ValueError, "`X` to be finite but got 1 values that are not, the first at index (4, 1)"),
        (with_value(np.inf), ValueError, "`X` to be finite but got 1 values that are not, the first at index (4, 1)"),
        (with_value(1e90), ValueError, "`X` of a magnitude of at most 1e+77 but got 1e+90; choose another unit"),
        (GOOD * 1e-170, ValueError, "`X` with variances in the range of torch.float64"),
        (GOOD.float() * 1e-30, ValueError, "`X` with variances in the range of torch.float32"),
    ],
)
def test_bad_samples_are_refused(X, error, message):
    with pytest.raises(error, match=re.escape(message)):
        MCD().fit(X)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"support_fraction": 0.4}, ValueError, "`support_fraction` to be in [0.5, 1] but got 0.4"),
        ({"support_fraction": "half"}, TypeError, "`support_fraction` to be a number in [0.5, 1] but got 'half'"),
        ({"support_fraction": 0.5, "h": 20}, ValueError, "`support_fraction` or `h` but got both"),
        ({"h": 20.0}, ValueError, "`h` to be a whole number of at least 1 but got 20.0"),
        ({"reweight": 1}, TypeError, "`reweight` to be True or False but got 1"),
        ({"cutoff": 1.0}, ValueError, "`cutoff` to be in (0, 1) but got 1"),
        ({"consistency": "both"}, ValueError, "`consistency` to be 'share' or 'cutoff' but got 'both'"),
        ({"starts": 0}, ValueError, "`starts` to be a whole number of at least 1 but got 0"),
        ({"seed": None}, ValueError, "`seed` to be a whole number but got None"),
    ],
)
def test_bad_parameters_are_refused(options, error, message):
    with pytest.raises(error, match=re.escape(message)):
        MCD(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"h": 16}, "`h` between 17, (N + p + 1) // 2, and the 30 samples but got 16"),
        ({"h": 31}, "`h` between 17, (N + p + 1) // 2, and the 30 samples but got 31"),
        ({"cutoff": 1e-9}, "`cutoff` to leave more than 3 samples but only 0 are within it; raise it"),
    ],
)
def test_parameters_that_do_not_fit_the_samples_are_refused(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MCD(**options).fit(GOOD)


def test_other_samples_must_have_the_columns_of_the_fit():
    fit = MCD().fit(torch.stack([GOOD, 2.0 * GOOD]))
    for bad, message in (
        (GOOD[:, :2], "shape (*, M, 3) but got (30, 2); pass the columns of the fit"),
        (GOOD[0], "shape (*, M, 3) but got (3,)"),
        (GOOD.expand(3, 30, 3), "batch dimensions of `X` and `location_` that broadcast but got (3,) and (2,)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            fit.mahalanobis(bad)


def test_attributes_before_fit_raise_not_fitted():
    with pytest.raises(NotFittedError, match=r"no `covariance_` yet; call fit\(X\) first"):
        _ = MCD().covariance_
    with pytest.raises(NotFittedError, match=r"call fit\(X\) first"):
        MCD().mahalanobis(GOOD)
    assert repr(MCD(0.75)).startswith("MinimumCovarianceDeterminant(support_fraction=0.75, h=None, reweight=True")


def read_only(array):
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "make",
    [
        lambda a: a,
        lambda a: read_only(a.copy()),
        np.asfortranarray,
        lambda a: a[::-1][::-1],
        lambda a: a.astype(">f8"),
        lambda a: pytest.importorskip("polars").DataFrame(a),
        lambda a: pytest.importorskip("pandas").DataFrame(a),
    ],
    ids=["array", "read-only", "columns first", "a view", "other bytes", "polars", "pandas"],
)
def test_arrays_and_data_frames_are_accepted(make):
    fit = MCD().fit(make(GOOD.numpy()))
    assert torch.equal(fit.covariance_, MCD().fit(GOOD).covariance_)
    assert torch.equal(fit.mahalanobis(make(GOOD.numpy())), fit.mahalanobis(GOOD))


def test_arrays_of_other_numbers_become_floats():
    whole = np.round(100.0 * GOOD.numpy()).astype(int)
    assert torch.equal(MCD().fit(whole).covariance_, MCD().fit(torch.as_tensor(whole).double()).covariance_)
    assert MCD().fit(GOOD.numpy().astype(np.float32)).covariance_.dtype == torch.float32


def test_the_given_samples_are_not_modified():
    X = SETS["hbk"]()
    before = X.clone()
    MCD().fit(X)
    assert torch.equal(X, before)
    assert issubclass(ExactFitError, ValueError)
