"""The outlier map: published classifications, bad arguments, and the picture."""

import re
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from mkc_torch.covariance import MinimumCovarianceDeterminant, OutlierMap, SampleKind, outlier_map
from mkc_torch.covariance._picture_labels import Box, free_place, linked_groups, ranges
from mkc_torch.linear import (
    LeastSquares,
    LeastTrimmedSquares,
    MMRegression,
    NotFittedError,
    ReweightedLeastSquares,
    SRegression,
)
from tests.literature import DATA_SETS


def rows_of_kind(of: OutlierMap, kind: SampleKind) -> list[int]:
    """Rows counted from 1, as published."""
    return [int(i) + 1 for i in (of.kind == kind).nonzero()]


def map_of(name: str, estimator=None) -> OutlierMap:
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
def test_hawkins_bradu_kass_has_ten_bad_and_four_good_leverage_points(estimator):
    of = map_of("hbk", estimator)  # Rousseeuw & van Zomeren (1990), figure 4
    assert rows_of_kind(of, SampleKind.BAD_LEVERAGE) == list(range(1, 11))
    assert rows_of_kind(of, SampleKind.GOOD_LEVERAGE) == list(range(11, 15))
    assert rows_of_kind(of, SampleKind.VERTICAL_OUTLIER) == []


def test_stackloss_has_vertical_outlier_4_and_bad_leverage_point_21():
    of = map_of("stackloss", ReweightedLeastSquares("lms"))  # Rousseeuw & van Zomeren (1990), figure 3
    assert rows_of_kind(of, SampleKind.VERTICAL_OUTLIER) == [4]
    assert rows_of_kind(of, SampleKind.BAD_LEVERAGE) == [1, 3, 21]
    assert 2 in rows_of_kind(of, SampleKind.GOOD_LEVERAGE)


def test_the_giant_stars_are_bad_leverage_points():
    assert rows_of_kind(map_of("stars_cyg"), SampleKind.BAD_LEVERAGE) == [11, 20, 30, 34]


def test_the_calls_from_belgium_are_vertical_outliers():
    of = map_of("telef")
    assert rows_of_kind(of, SampleKind.VERTICAL_OUTLIER) == list(range(15, 22))
    assert rows_of_kind(of, SampleKind.GOOD_LEVERAGE) == rows_of_kind(of, SampleKind.BAD_LEVERAGE) == []


def test_the_map_has_residuals_over_the_scale_and_robust_distances():
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


def test_constant_columns_are_left_out_at_any_position():
    X, y = DATA_SETS["salinity"]()
    fit = MMRegression().fit(X, y)
    last = X[:, [1, 2, 3, 0]]
    of = outlier_map(MMRegression().fit(last, y), last, y)
    assert of.columns == (0, 1, 2)
    torch.testing.assert_close(of.distances, outlier_map(fit, X, y).distances)


def test_the_map_of_a_batch_equals_the_maps_of_its_problems():
    X, y = DATA_SETS["hbk"]()
    Y = torch.stack([y, y.flip(0), 2.0 * y])
    single = outlier_map(LeastTrimmedSquares().fit(X, Y), X, Y)
    own = outlier_map(LeastTrimmedSquares().fit(X.expand(3, 75, 4), Y), X.expand(3, 75, 4), Y)
    assert single.kind.shape == own.kind.shape == (3, 75)
    for b in range(3):
        alone = outlier_map(LeastTrimmedSquares().fit(X, Y[b]), X, Y[b])
        for many in (single, own):
            torch.testing.assert_close(many.residuals[b], alone.residuals, rtol=1e-6, atol=1e-8)
            torch.testing.assert_close(many.distances[b], alone.distances)
            assert torch.equal(many.kind[b], alone.kind)
    with pytest.raises(ValueError, match=r"map of a single problem.*got a batch of shape \(3,\)"):
        single.plot()


def test_arrays_are_accepted_and_the_given_estimator_stays_unfitted():
    X, y = DATA_SETS["stackloss"]()
    fit, scatter = MMRegression().fit(X, y), MinimumCovarianceDeterminant()
    of = outlier_map(fit, X.numpy(), y.numpy(), estimator=scatter)
    assert torch.equal(of.kind, outlier_map(fit, X, y).kind)
    with pytest.raises(NotFittedError):
        _ = scatter.location_


# bad arguments


def test_bad_arguments_are_refused():
    X, y = DATA_SETS["stackloss"]()
    fit = MMRegression().fit(X, y)
    line = X[:, 1:] @ torch.ones(3, dtype=torch.float64)
    exact = MMRegression().fit(X, y)
    exact.scale_ = torch.zeros(1, dtype=torch.float64)
    two = torch.stack([X, X])
    two[1, :, 2] = 3.0
    for arguments, error, message in (
        ((MMRegression, X, y), TypeError, "`fit` to be a fitted estimator of mkc_torch.linear but got the class"),
        ((MMRegression(), X, y), NotFittedError, "MMRegression has no `coef_` yet"),
        ((LeastSquares().fit(X, y), X, y), ValueError, "a `scale_` for each problem but LeastSquares has none"),
        ((fit, X[:, 1:], y), ValueError, "`X` of shape (*, N, 4), as many columns as the fit has coefficients"),
        ((fit, X, y[:-1]), ValueError, "with `Y` (*, N), but got (21, 4) and (20,)"),
        ((fit, X.float(), y.float()), TypeError, "of the dtype of the fit, torch.float64, but got torch.float32"),
        ((fit, X, y.long()), TypeError, "`Y` to be a real floating-point tensor but got torch.int64"),
        ((fit, torch.full_like(X, np.nan), y), ValueError, "`X` to be finite"),
        ((exact, X, line), ValueError, "a fit of positive scale but got scale 0"),
        ((MMRegression().fit(X[:, :1], y), X[:, :1], y), ValueError, "one column of `X` that is not constant"),
        ((MMRegression().fit(two[:, :, [0, 1, 3]], y.expand(2, 21)), two[:, :, :3], y), ValueError, "column 2 of `X`"),
    ):
        with pytest.raises(error, match=re.escape(message)):
            outlier_map(*arguments)
    for options, message in (({"residual_cutoff": 0.0}, "`residual_cutoff`"), ({"cutoff": 2.0}, "`cutoff`")):
        with pytest.raises(ValueError, match=message):
            outlier_map(fit, X, y, **options)
    with pytest.raises(TypeError, match=r"`estimator`.*MCD"):
        outlier_map(fit, X, y, estimator=fit)


def test_a_fit_of_several_channels_is_refused():
    X, y = DATA_SETS["stackloss"]()
    fit = MMRegression().fit(X.unsqueeze(-2).expand(21, 2, 4), torch.stack([y, y.flip(0)], -1))
    with pytest.raises(ValueError, match="fitted to several channels"):
        outlier_map(fit, X, y)


# the picture


@pytest.mark.usefixtures("pyplot")
def test_the_plot_shows_every_sample_in_its_region():
    of = map_of("hbk")
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


def test_the_map_is_drawn_on_given_axes_with_the_given_number_of_labels(pyplot):
    figure, (left, right) = pyplot.subplots(1, 2)
    of = map_of("telef")
    assert of.plot(left) is left
    assert of.plot(right, labels=0) is right
    assert {text.get_text() for text in left.texts} >= {"17", "18", "19", "20"}
    assert not right.texts
    figure.canvas.draw()


@pytest.mark.usefixtures("pyplot")
def test_a_map_without_outliers_can_be_drawn():
    x = torch.linspace(-1.0, 1.0, 30).double()
    X, y = torch.stack([torch.ones(30).double(), x], -1), x + 0.1 * torch.cos(40.0 * x)
    ax = outlier_map(MMRegression().fit(X, y), X, y).plot()
    assert not ax.texts
    assert ax.get_xlim()[1] > 2.24


def test_without_matplotlib_the_error_names_the_package_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "mkc_torch.covariance._outlier_picture", raising=False)
    with pytest.raises(ImportError, match=r"drawn with matplotlib; .*mkc-torch\[cli\]"):
        map_of("telef").plot()


def test_long_ranges_of_labels_are_abbreviated():
    assert ranges([3, 1, 2, 7]) == "1–3, 7"
    assert ranges([5, 4]) == "4, 5"
    assert ranges(range(0, 40, 2)) == "0, 2, 4, 6, 8 +15"
    assert ranges([*range(10), 20, 22, 24, 26, 28, 30]) == "0–9, 20, 22, 24, 26 +2"


def test_points_connected_by_short_distances_share_a_label():
    page = np.array([[0.0, 0.0], [100.0, 0.0], [10.0, 0.0], [20.0, 5.0], [101.0, 30.0]])
    assert [sorted(group) for group in linked_groups(page, [1, 0, 2, 3, 4])] == [[1], [0, 2, 3], [4]]


def test_a_label_overlaps_nothing_or_is_left_out():
    point: Tensor = np.array([[50.0, 50.0]])
    above = free_place(point, "7", 8.0, [])
    assert above.middle[1] > 50.0
    below = free_place(point, "7", 8.0, [above])
    assert below.middle[1] < 50.0
    assert not below.overlaps(above)
    assert free_place(point, "7", 8.0, [Box(0.0, 0.0, 100.0, 100.0)]) is None
