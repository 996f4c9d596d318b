"""The ellipsoid of a recording: refused where rest, coarse digits, or single samples would draw one."""

from __future__ import annotations

import torch
from torch import Tensor

from mkc_torch.calibration.clipped_samples import distinct_rows
from mkc_torch.calibration.coverage import Coverage
from mkc_torch.calibration.ellipsoid_fit import MAX_SCATTER, MAX_STANDARD_ERROR, EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.runs import apart, run_slices
from mkc_torch.calibration.turning import refuse_at_rest, thin_at_rest, turning, way
from mkc_torch.linear import MKCRegression
from mkc_torch.recording.recording import Recording

__all__ = ["recorded_ellipsoid"]

_ERRORS = 3.0
"""Standard errors by which two fits to the same samples may differ."""


_MOST_ALONG = 5000
"""Samples of the sensor's way that a second fit takes, at least, evenly: it is compared by several standard errors."""


def recorded_ellipsoid(recording: Recording, seed: int = 0) -> EllipsoidFit:
    """The ellipsoid through the samples of a magnetometer by MKC-EM, a time series in the order of its rows.

    Args:
        recording: finite ``mag_x``, ``mag_y``, ``mag_z``, sorted by ``time`` where there is one; standard errors do not
            reach from one ``experiment`` to the next.
        seed: of the robust start.

    Raises:
        NotIdentifiableError: they do not determine one, or only by rest, coarse digits, or samples that stand apart.

    Example:
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> recorded_ellipsoid(simulated_recording()[0]).center_.round()
        tensor([12., -8., 21.], dtype=torch.float64)
    """
    points, runs = recording.magnetometer(), run_slices(recording)
    turns = [turning(points[run]) for run in runs]
    taken = torch.cat([thin_at_rest(points[run], found) for run, found in zip(runs, turns, strict=True)])
    estimator = MKCRegression(covariance="hac", seed=seed)
    series, weight = apart(runs, points, taken)
    try:
        fit = EllipsoidFit(estimator).fit(series, weight)
        _refuse_lattice(fit, points)
    except NotIdentifiableError:
        # a sensor at rest is the better reason
        refuse_at_rest(points, turns[0] if len(runs) == 1 else turning(points), recording.units["mag_x"])
        raise
    ways = [way(points[run], found) for run, found in zip(runs, turns, strict=True)]
    if all(went is not None for went in ways):
        went = torch.cat([went for went in ways if went is not None])
        series, weight = (part[:: max(1, len(part) // _MOST_ALONG)] for part in apart(runs, went, taken))
        _refuse_other(fit, _along(EllipsoidFit(estimator), series, weight), series)
    return fit


def _refuse_lattice(fit: EllipsoidFit, points: Tensor) -> None:
    """Refuse an ellipsoid no wider than a few steps of the digits: one passes through the points of a lattice.

    Raises:
        NotIdentifiableError: the steps of a column are a large share of the shortest semi-axis.
    """
    steps = [column.unique().diff() for column in points.unbind(-1)]
    share = max(float(step.min()) for step in steps if len(step) > 0) / float(fit.semi_axes_[0])
    # few points can be as far apart without any steps, but hardly two of them are equal then
    if share > MAX_SCATTER and 2 * len(distinct_rows(points)) <= len(points):
        raise NotIdentifiableError(
            f"Not identifiable: the measurements come in steps of {100.0 * share:.0f} % of the ellipsoid's shortest "
            f"semi-axis, more than {100.0 * MAX_SCATTER:.0f} %, as those of a sensor that hardly turns do. Turn the "
            "sensor through all directions."
        )


def _along(fit: EllipsoidFit, went: Tensor, taken: Tensor) -> EllipsoidFit:
    """The fit to the sensor's way, which samples that stand apart do not move."""
    try:
        return fit.fit(went, taken)
    except NotIdentifiableError as error:
        told = f"{error} Single samples that stand apart from those before and after them do not count here."
        raise NotIdentifiableError(told, error.coverage, error.directions) from None


def _refuse_other(fit: EllipsoidFit, along: EllipsoidFit, went: Tensor) -> None:
    """Refuse a fit that the sensor's way does not confirm: outliers to one side can draw a surface of their own.

    Raises:
        NotIdentifiableError: centre or semi-axes are others, by more than errors explain.
    """
    apart = torch.cat([along.center_ - fit.center_, along.semi_axes_ - fit.semi_axes_]).abs() / fit.radius_
    error = torch.cat([fit.center_se_, fit.semi_axes_se_]) / fit.radius_
    if float((apart - _ERRORS * error).max()) <= MAX_STANDARD_ERROR:
        return
    found = along.coverage_
    assert isinstance(found, Coverage)
    missing = "; ".join(str(gap) for gap in found.gaps)
    raise NotIdentifiableError(
        "Not identifiable: single samples decide on the ellipsoid. Without those that stand apart from the ones before "
        f"and after them, its centre or a semi-axis is off by {100.0 * float(apart.max()):.0f} % of the radius."
        f"{f' Directions not covered: {missing}.' if missing else ''} Record again away from what disturbs the sensor, "
        "and turn it through all directions.",
        found,
        along.calibrate(went)[along.weights_ >= 0.5],
    )
