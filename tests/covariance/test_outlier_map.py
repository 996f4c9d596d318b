"""The outlier map: published kinds, refusals, and what the picture shows."""

import re
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from mkc_torch.covariance import MinimumCovarianceDeterminant, OutlierMap, SampleKind, outlier_map
from mkc_torch.covariance._picture_labels import Box, free_place, ranges, together
from mkc_torch.linear import (
    LeastSquares,
    LeastTrimmedSquares,
    MMRegression,
    NotFittedError,
    ReweightedLeastSquares,
    SRegression,
)
from tests.literature import DATA_SETS


def found(of: OutlierMap, kind: SampleKind) -> list[int]:
    """Rows counted from 1, as they are published."""
    return [int(i) + 1 for i in (of.kind == kind).nonzero()]


def mapped(name: str, estimator=None) -> OutlierMap:
    X, y = DATA_SETS[name]()
    return outlier_map((estimator or MMRegression()).fit(X, y), X, y)


@pytest.fixture
def pyplot():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    yield pyplot
    pyplot.close("all")


# kinds


@pytest.mark.parametrize(
    "estimator", [LeastTrimmedSquares(), SRegression(), MMRegression()], ids=lambda e: type(e).__name__
)
def test_of_hawkins_bradu_and_kass_ten_are_bad_and_four_are_good(estimator):
    of = mapped("hbk", estimator)  # Rousseeuw & van Zomeren (1990), figure 4
    assert found(of, SampleKind.BAD_LEVERAGE) == list(range(1, 11))
    assert found(of, SampleKind.GOOD_LEVERAGE) == list(range(11, 15))
    assert found(of, SampleKind.VERTICAL_OUTLIER) == []


def test_of_stackloss_four_is_vertical_and_twentyone_is_bad():
    of = mapped("stackloss", ReweightedLeastSquares("lms"))  # Rousseeuw & van Zomeren (1990), figure 3
    assert found(of, SampleKind.VERTICAL_OUTLIER) == [4]
    assert found(of, SampleKind.BAD_LEVERAGE) == [1, 3, 21]
    assert 2 in found(of, SampleKind.GOOD_LEVERAGE)


def test_of_the_stars_the_giants_are_bad():
    assert found(mapped("stars_cyg"), SampleKind.BAD_LEVERAGE) == [11, 20, 30, 34]


def test_the_calls_from_belgium_are_vertical():
    of = mapped("telef")
    assert found(of, SampleKind.VERTICAL_OUTLIER) == list(range(15, 22))
    assert found(of, SampleKind.GOOD_LEVERAGE) == found(of, SampleKind.BAD_LEVERAGE) == []


def test_its_numbers_are_residuals_over_the_scale_and_robust_distances():
    X, y = DATA_SETS["stackloss"]()
    fit = MMRegression().fit(X, y)
    of = outlier_map(fit, X, y)
    torch.testing.assert_close(of.residuals, (y - fit.predict(X)) / fit.scale_)
    torch.testing.assert_close(of.distances, MinimumCovarianceDeterminant().fit(X[:, 1:]).distances_)
    assert of.columns == (1, 2, 3)
    assert (of.residual_cutoff, of.distance_cutoff) == (2.5, pytest.approx(3.0575, abs=1e-4))
    other = outlier_map(fit, X, y, estimator=MinimumCovarianceDeterminant(0.75), residual_cutoff=2.24, cutoff=0.99)
    torch.testing.assert_close(other.distances, MinimumCovarianceDeterminant(0.75).fit(X[:, 1:]).distances_)
    assert (other.residual_cutoff, other.distance_cutoff) == (2.24, pytest.approx(3.3682, abs=1e-4))


def test_constant_columns_are_left_out_wherever_they_are():
    X, y = DATA_SETS["salinity"]()
    fit = MMRegression().fit(X, y)
    last = X[:, [1, 2, 3, 0]]
    of = outlier_map(MMRegression().fit(last, y), last, y)
    assert of.columns == (0, 1, 2)
    torch.testing.assert_close(of.distances, outlier_map(fit, X, y).distances)


def test_a_batch_has_the_maps_of_its_problems():
    X, y = DATA_SETS["hbk"]()
    Y = torch.stack([y, y.flip(0), 2.0 * y])
    one = outlier_map(LeastTrimmedSquares().fit(X, Y), X, Y)
    own = outlier_map(LeastTrimmedSquares().fit(X.expand(3, 75, 4), Y), X.expand(3, 75, 4), Y)
    assert one.kind.shape == own.kind.shape == (3, 75)
    for b in range(3):
        alone = outlier_map(LeastTrimmedSquares().fit(X, Y[b]), X, Y[b])
        for many in (one, own):
            torch.testing.assert_close(many.residuals[b], alone.residuals, rtol=1e-6, atol=1e-8)
            torch.testing.assert_close(many.distances[b], alone.distances)
            assert torch.equal(many.kind[b], alone.kind)
    with pytest.raises(ValueError, match=r"map of one problem but this one has shape \(3, 75\)"):
        one.plot()


def test_arrays_are_taken_and_the_estimator_given_stays_unfitted():
    X, y = DATA_SETS["stackloss"]()
    fit, scatter = MMRegression().fit(X, y), MinimumCovarianceDeterminant()
    of = outlier_map(fit, X.numpy(), y.numpy(), estimator=scatter)
    assert torch.equal(of.kind, outlier_map(fit, X, y).kind)
    with pytest.raises(NotFittedError):
        _ = scatter.location_


# refusals


def test_what_gives_no_map_is_refused():
    X, y = DATA_SETS["stackloss"]()
    fit = MMRegression().fit(X, y)
    line = X[:, 1:] @ torch.ones(3, dtype=torch.float64)
    exact = MMRegression().fit(X, y)
    exact.scale_ = torch.zeros(1, dtype=torch.float64)
    two = torch.stack([X, X])
    two[1, :, 2] = 3.0
    for arguments, error, told in (
        ((MMRegression, X, y), TypeError, "`fit` to be a fitted estimator of mkc_torch.linear but got the class"),
        ((MMRegression(), X, y), NotFittedError, "MMRegression has no `coef_` yet"),
        ((LeastSquares().fit(X, y), X, y), ValueError, "one `scale_` for each problem but LeastSquares has none"),
        ((fit, X[:, 1:], y), ValueError, "`X` of shape (*, N, 4), as many columns as the fit has coefficients"),
        ((fit, X, y[:-1]), ValueError, "with `Y` (*, N), but got (21, 4) and (20,)"),
        ((fit, X.float(), y.float()), TypeError, "of the dtype of the fit, torch.float64, but got torch.float32"),
        ((fit, X, y.long()), TypeError, "`Y` to be a real floating-point tensor but got torch.int64"),
        ((fit, torch.full_like(X, np.nan), y), ValueError, "`X` to be finite"),
        ((exact, X, line), ValueError, "a fit with residuals but its scale is 0"),
        ((MMRegression().fit(X[:, :1], y), X[:, :1], y), ValueError, "one column of `X` that is not constant"),
        ((MMRegression().fit(two[:, :, [0, 1, 3]], y.expand(2, 21)), two[:, :, :3], y), ValueError, "column 2 of `X`"),
    ):
        with pytest.raises(error, match=re.escape(told)):
            outlier_map(*arguments)
    for options, told in (({"residual_cutoff": 0.0}, "`residual_cutoff`"), ({"cutoff": 2.0}, "`cutoff`")):
        with pytest.raises(ValueError, match=told):
            outlier_map(fit, X, y, **options)
    with pytest.raises(TypeError, match="`estimator` to be an MCD"):
        outlier_map(fit, X, y, estimator=fit)


def test_several_channels_have_no_map():
    X, y = DATA_SETS["stackloss"]()
    fit = MMRegression().fit(X.unsqueeze(-2).expand(21, 2, 4), torch.stack([y, y.flip(0)], -1))
    with pytest.raises(ValueError, match="fitted to several channels"):
        outlier_map(fit, X, y)


# the picture


@pytest.mark.usefixtures("pyplot")
def test_the_picture_shows_every_sample_in_its_region():
    of = mapped("hbk")
    ax = of.plot()
    shown = {text.get_text() for text in ax.get_legend().get_texts()}
    assert shown == {"61 regular", "0 vertical outliers", "4 good leverage points", "10 bad leverage points"}
    points = [part.get_offsets() for part in ax.collections if part.get_offsets().shape[0] > 1]
    drawn = np.concatenate([np.asarray(part) for part in points])
    expected = torch.stack([of.distances, of.residuals], -1).numpy()
    assert {tuple(row) for row in np.round(expected, 9)} <= {tuple(row) for row in np.round(drawn, 9)}
    assert {"0–9", "10–12", "13"} <= {text.get_text() for text in ax.texts}
    heights = sorted(float(line.get_ydata()[0]) for line in ax.lines if line.get_ydata()[0] == line.get_ydata()[1])
    assert heights == [-2.5, 2.5]
    assert any(float(line.get_xdata()[0]) == of.distance_cutoff for line in ax.lines)
    assert ax.get_xlabel() == "robust distance of the predictors"


def test_it_is_drawn_where_it_is_told_with_as_many_labels(pyplot):
    figure, (left, right) = pyplot.subplots(1, 2)
    of = mapped("telef")
    assert of.plot(left) is left
    assert of.plot(right, labels=0) is right
    assert {text.get_text() for text in left.texts} >= {"17", "18", "19", "20"}
    assert not right.texts
    figure.canvas.draw()


@pytest.mark.usefixtures("pyplot")
def test_a_map_without_outliers_is_drawn_too():
    x = torch.linspace(-1.0, 1.0, 30).double()
    X, y = torch.stack([torch.ones(30).double(), x], -1), x + 0.1 * torch.cos(40.0 * x)
    ax = outlier_map(MMRegression().fit(X, y), X, y).plot()
    assert not ax.texts
    assert ax.get_xlim()[1] > 2.24


def test_without_matplotlib_the_picture_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "mkc_torch.covariance._outlier_picture", raising=False)
    with pytest.raises(ImportError, match=r"drawn with matplotlib; .*mkc-torch\[cli\]"):
        mapped("telef").plot()


def test_labels_are_short():
    assert ranges([3, 1, 2, 7]) == "1–3, 7"
    assert ranges([5, 4]) == "4, 5"
    assert ranges(range(0, 40, 2)) == "0, 2, 4, 6, 8 +15"
    assert ranges([*range(10), 20, 22, 24, 26, 28, 30]) == "0–9, 20, 22, 24, 26 +2"


def test_points_that_are_linked_by_short_ways_share_a_label():
    page = np.array([[0.0, 0.0], [100.0, 0.0], [10.0, 0.0], [20.0, 5.0], [101.0, 30.0]])
    assert [sorted(group) for group in together(page, [1, 0, 2, 3, 4])] == [[1], [0, 2, 3], [4]]


def test_a_label_meets_nothing_or_is_left_out():
    point: Tensor = np.array([[50.0, 50.0]])
    above = free_place(point, "7", 8.0, [])
    assert above.middle[1] > 50.0
    below = free_place(point, "7", 8.0, [above])
    assert below.middle[1] < 50.0
    assert not below.meets(above)
    assert free_place(point, "7", 8.0, [Box(0.0, 0.0, 100.0, 100.0)]) is None
