"""Properties of all linear estimators, a test for each property: equivariance, weights, order, batches, exact fits.

A new estimator is one line of ``CASES``; a property that it lacks is named there with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from mkc_torch.linear import (
    FixedPointLinear,
    GeneralizedMaximumEntropy,
    LeastAbsoluteDeviations,
    LeastEntropyLike,
    LeastMedianOfSquares,
    LeastSquares,
    LeastTrimmedSquares,
    MEstimator,
    MinimumEntropy,
    MKCRegression,
    MMRegression,
    RankDeficientError,
    ReweightedLeastSquares,
    Ridge,
    SRegression,
)
from mkc_torch.linear._estimator import LinearEstimator
from tests.draws import normal as sample

N, n = 20, 3
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Case:
    """An estimator for a given number of samples, and the properties that it lacks, each with the reason."""

    name: str
    make: Callable[[int], LinearEstimator]
    without: dict[str, str] = field(default_factory=dict)
    robust: bool = True  # the exact fit of 70 % of the samples is found


PENALTY = {
    "regression": "the penalty shrinks towards 0",
    "affine": "the penalty is in the units of the columns",
    "exact": "the penalty shrinks towards 0",
}
GIVEN_SCALE = {"scale": "d is in the unit of Y"}
GIVEN_BANDWIDTH = {"scale": "the bandwidth is in the unit of Y"}
SEARCHED_BANDWIDTH = {
    "repetition": "the bandwidth follows from the scale of a start, the best of some elemental sets",
    "order": "the bandwidth follows from the scale of a start, the best of some elemental sets",
}
OWN_STARTS = {
    "regression": "its minima are equivariant, the starts (50) and (51) from which they are sought are not",
    "affine": "its minima are equivariant, the starts (50) and (51) from which they are sought are not",
}
PRIOR = {
    "regression": "coefficients shrink to the middle of their support",
    "scale": "the support of the coefficients is in the unit of Y",
    "affine": "the support of the coefficients is in their units",
    "exact": "coefficients shrink to the middle of their support",
}
DETERMINED_BY_PRIOR = ("ridge", "maximum entropy")  # dependent columns are allowed

CASES = [
    Case("least squares", lambda _: LeastSquares(), robust=False),
    Case("ridge", lambda _: Ridge(alpha=2.0), without=PENALTY, robust=False),
    Case("least absolute deviations", lambda _: LeastAbsoluteDeviations()),
    Case("fixed point", lambda _: FixedPointLinear(sigma=2.0, d=0.2), without=GIVEN_SCALE),
    Case("MKC-EM", lambda _: MKCRegression()),
    Case("M huber", lambda _: MEstimator("huber")),
    Case("M hampel", lambda _: MEstimator("hampel")),
    Case("M tukey", lambda _: MEstimator("tukey")),
    Case("M andrews", lambda _: MEstimator("andrews")),
    Case("M welsch", lambda _: MEstimator("welsch")),
    Case("M huber, proposal 2", lambda _: MEstimator("huber", scale="proposal2"), robust=False),
    Case("M tukey, proposal 2", lambda _: MEstimator("tukey", scale="proposal2"), robust=False),
    Case("least median of squares", lambda N: LeastMedianOfSquares(3 * N // 5)),
    Case("largest residual", lambda N: LeastMedianOfSquares(N), robust=False),
    Case("least trimmed squares", lambda N: LeastTrimmedSquares(3 * N // 5)),
    Case("reweighted, from lms", lambda N: ReweightedLeastSquares(LeastMedianOfSquares(3 * N // 5))),
    Case("reweighted, from lts", lambda N: ReweightedLeastSquares(LeastTrimmedSquares(3 * N // 5))),
    Case("S", lambda _: SRegression()),
    Case("S, breakdown 0.4", lambda _: SRegression(breakdown=0.4)),
    Case("MM", lambda _: MMRegression()),
    Case("minimum entropy", lambda _: MinimumEntropy(), without=SEARCHED_BANDWIDTH),
    Case("minimum entropy, renyi", lambda _: MinimumEntropy("renyi"), without=SEARCHED_BANDWIDTH),
    Case("minimum entropy, symmetric", lambda _: MinimumEntropy(location="symmetric"), without=SEARCHED_BANDWIDTH),
    Case("minimum entropy, h = 0.2", lambda _: MinimumEntropy(bandwidth=0.2), without=GIVEN_BANDWIDTH),
    Case("minimum entropy, renyi, h = 0.2", lambda _: MinimumEntropy("renyi", bandwidth=0.2), without=GIVEN_BANDWIDTH),
    Case("least entropy-like", lambda _: LeastEntropyLike(), without=OWN_STARTS, robust=False),
    Case("maximum entropy", lambda _: GeneralizedMaximumEntropy(20.0), without=PRIOR, robust=False),
]


def cases_with_property(prop: str, *, robust: bool = False) -> list[object]:
    return [pytest.param(c, id=c.name) for c in CASES if prop not in c.without and (c.robust or not robust)]


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request) -> torch.dtype:
    return request.param


def data(seed: int = 0, dtype: torch.dtype = torch.float64, device: torch.device = CPU) -> tuple[Tensor, Tensor]:
    """X with an intercept column, y = X 1 + noise, and every fifth target far off."""
    X = torch.cat([torch.ones(N, 1).double(), sample(seed, N, n - 1)], 1)
    y = X.sum(-1) + 0.1 * sample(seed + 1, N)
    y[::5] += 5.0 + sample(seed + 2, N // 5)
    return X.to(device, dtype), y.to(device, dtype)


def close(got: Tensor, expected: Tensor) -> None:
    tolerance = 2e-6 if got.dtype == torch.float64 else 5e-3
    torch.testing.assert_close(got, expected, rtol=tolerance, atol=tolerance * float(expected.abs().max()))


def fitted(case: Case, X: Tensor, y: Tensor, weight: Tensor | None = None) -> LinearEstimator:
    return case.make(y.shape[-1]).fit(X, y, weight)


def scale_of(fit: LinearEstimator) -> Tensor | None:
    return fit.scale_ if hasattr(fit, "scale_") else None


@pytest.mark.parametrize("case", cases_with_property("regression"))
def test_regression_equivariance(case, dtype, device):
    X, y = data(dtype=dtype, device=device)
    shift = sample(5, n).to(device, dtype)
    close(fitted(case, X, y + X @ shift).coef_, fitted(case, X, y).coef_ + shift)


@pytest.mark.parametrize("factor", [-2.5, 1e3])
@pytest.mark.parametrize("case", cases_with_property("scale"))
def test_scale_equivariance(case, factor, dtype, device):
    X, y = data(dtype=dtype, device=device)
    fit, scaled = fitted(case, X, y), fitted(case, X, factor * y)
    close(scaled.coef_, factor * fit.coef_)
    close(scaled.weights_, fit.weights_)
    if scale_of(fit) is not None:
        close(scaled.scale_, abs(factor) * fit.scale_)


@pytest.mark.parametrize("case", cases_with_property("affine"))
def test_affine_equivariance(case, dtype, device):
    X, y = data(dtype=dtype, device=device)
    A = (sample(6, n, n) * torch.tensor([1e-2, 1.0, 1e2])).to(device, dtype)
    close(A @ fitted(case, X @ A, y).coef_, fitted(case, X, y).coef_)


@pytest.mark.parametrize("case", cases_with_property("repetition"))
def test_integer_weights_equal_repetition(case, dtype, device):
    X, y = data(30, dtype, device)  # d above its least, which depends on the coverage of the start
    count = 1 + torch.arange(N, device=device) % 2
    weighted = fitted(case, X, y, count.to(device, dtype))
    repeated = fitted(case, X.repeat_interleave(count, 0), y.repeat_interleave(count))
    close(weighted.coef_, repeated.coef_)
    if scale_of(weighted) is not None:
        close(weighted.scale_, repeated.scale_)


@pytest.mark.parametrize("case", cases_with_property("order"))
def test_the_fit_does_not_depend_on_the_order_of_samples(case, dtype, device):
    X, y = data(dtype=dtype, device=device)
    order = torch.randperm(N, generator=torch.Generator().manual_seed(5)).to(device)
    fit, moved = fitted(case, X, y), fitted(case, X[order], y[order])
    close(moved.coef_, fit.coef_)
    close(moved.weights_, fit.weights_[order])


@pytest.mark.parametrize("case", cases_with_property("batch"))
def test_batch_equals_loop(case, dtype, device):
    problems = [data(10 * s, dtype, device) for s in range(4)]
    X = torch.stack([p[0] for p in problems]).reshape(2, 2, N, 1, n)
    y = torch.stack([p[1] for p in problems]).reshape(2, 2, N, 1)
    together = case.make(N).fit(X, y)
    assert together.coef_.shape == (2, 2, n)
    assert together.weights_.shape == (2, 2, N, 1)
    for i, (X_i, y_i) in enumerate(problems):
        close(together.coef_[i // 2, i % 2], fitted(case, X_i, y_i).coef_)


@pytest.mark.parametrize("case", cases_with_property("exact"))
def test_an_exact_fit_is_found(case, dtype, device):
    X, _ = data(dtype=dtype, device=device)
    coef = torch.tensor([1.0, -2.0, 3.0], dtype=dtype, device=device)
    fit = fitted(case, X, X @ coef)
    torch.testing.assert_close(fit.coef_, coef, rtol=0, atol=1e4 * torch.finfo(dtype).eps)
    assert bool(torch.isfinite(fit.weights_).all())
    if scale_of(fit) is not None:
        assert float(fit.scale_) < 1e5 * torch.finfo(dtype).eps


@pytest.mark.parametrize("case", cases_with_property("exact", robust=True))
def test_an_exact_fit_of_seventy_per_cent_is_found(case, dtype, device):
    X, _ = data(dtype=dtype, device=device)
    coef = torch.tensor([1.0, -2.0, 3.0], dtype=dtype, device=device)
    y = X @ coef
    y[:6] += 5.0 + sample(9, 6).to(device, dtype)
    fit = fitted(case, X, y)
    torch.testing.assert_close(fit.coef_, coef, rtol=0, atol=1e5 * torch.finfo(dtype).eps)
    assert bool(torch.isfinite(fit.weights_).all())


@pytest.mark.parametrize("case", cases_with_property("zero"))
def test_targets_of_zero_give_coefficients_of_zero(case, dtype, device):
    fit = fitted(case, data(dtype=dtype, device=device)[0], torch.zeros(N, dtype=dtype, device=device))
    assert fit.coef_.tolist() == [0.0] * n
    assert bool(torch.isfinite(fit.weights_).all())


@pytest.mark.parametrize("case", cases_with_property("channels"))
def test_channels_share_the_coefficients(case, device):
    X = torch.stack([data(0, device=device)[0], 2.0 * data(20, device=device)[0]], -2)
    Y = X.sum(-1) + 0.1 * sample(30, N, 2).to(device)
    Y[::5, 0] += 5.0
    fit = case.make(N).fit(X, Y)
    assert fit.coef_.shape == (n,)
    assert fit.weights_.shape == (N, 2)
    limit = 0.15 if case.robust else 1.5
    assert float((fit.coef_ - 1.0).abs().max()) < limit


@pytest.mark.parametrize("case", cases_with_property("dtype"))
def test_float32_stays_float32_and_agrees_with_float64(case, device):
    X, y = data(device=device)
    fit = fitted(case, X.float(), y.float())
    assert fit.coef_.dtype == fit.weights_.dtype == torch.float32
    torch.testing.assert_close(fit.coef_.double(), fitted(case, X, y).coef_, rtol=5e-3, atol=5e-3)


@pytest.mark.parametrize("case", cases_with_property("rank"))
def test_nan_dependent_columns_and_too_few_samples_are_refused(case, device):
    X, y = data(device=device)
    estimator = case.make(N)
    bad = y.clone()
    bad[3] = float("nan")
    with pytest.raises(ValueError, match=r"`Y` to be finite but got nan"):
        estimator.fit(X, bad)
    if case.name not in DETERMINED_BY_PRIOR:
        with pytest.raises(RankDeficientError, match="linearly dependent"):
            estimator.fit(torch.cat([X, X[:, :1]], 1), y)
        with pytest.raises(ValueError, match=r"at least 3 .*3 coefficients"):
            estimator.fit(X[:2], y[:2])
