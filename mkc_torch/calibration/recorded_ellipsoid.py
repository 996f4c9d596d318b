"""Fit the ellipsoid of a recording; reject fits that only rest, coarse digits or single samples determine."""

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

_ERRORS = 3.0
"""Largest difference between two fits to the same samples, in standard errors."""


_MOST_ALONG = 5000
"""Fewest samples of the sensor's path in the second fit, taken evenly; its standard errors must stay small."""


def recorded_ellipsoid(recording: Recording, seed: int = 0) -> EllipsoidFit:
    """Fit an ellipsoid to the samples of a magnetometer by MKC-EM, as a time series in the order of its rows.

    Args:
        recording: finite ``mag_x``, ``mag_y``, ``mag_z``, sorted by ``time`` if there is a time; standard errors treat
            the runs of ``experiment`` as independent.
        seed: seed of the robust start.

    Raises:
        NotIdentifiableError: the samples do not determine an ellipsoid, or only by rest, coarse digits or outliers.

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
        # a sensor at rest is the better explanation
        refuse_at_rest(points, turns[0] if len(runs) == 1 else turning(points), recording.units["mag_x"])
        raise
    ways = [way(points[run], found) for run, found in zip(runs, turns, strict=True)]
    if all(went is not None for went in ways):
        went = torch.cat([went for went in ways if went is not None])
        series, weight = (part[:: max(1, len(part) // _MOST_ALONG)] for part in apart(runs, went, taken))
        _refuse_other(fit, _along(EllipsoidFit(estimator), series, weight), series)
    return fit


def _refuse_lattice(fit: EllipsoidFit, points: Tensor) -> None:
    """Reject an ellipsoid only a few digital steps wide: an ellipsoid passes through the points of any small lattice.

    Raises:
        NotIdentifiableError: the steps of a column are a large share of the shortest semi-axis.
    """
    steps = [column.unique().diff() for column in points.unbind(-1)]
    share = max(float(step.min()) for step in steps if len(step) > 0) / float(fit.semi_axes_[0])
    # a few points can be as far apart without digital steps, but then hardly two of them are equal
    if share > MAX_SCATTER and 2 * len(distinct_rows(points)) <= len(points):
        raise NotIdentifiableError(
            f"Not identifiable: the measurements come in steps of {100.0 * share:.0f} % of the ellipsoid's shortest "
            f"semi-axis, more than {100.0 * MAX_SCATTER:.0f} %, as those of a sensor that hardly turns do. Turn the "
            "sensor through all directions."
        )


def _along(fit: EllipsoidFit, went: Tensor, taken: Tensor) -> EllipsoidFit:
    """Fit an ellipsoid to the sensor's path, on which single outliers have no influence."""
    try:
        return fit.fit(went, taken)
    except NotIdentifiableError as error:
        message = f"{error} Single samples that differ from their neighbours are not used here."
        raise NotIdentifiableError(message, error.coverage, error.directions) from None


def _refuse_other(fit: EllipsoidFit, along: EllipsoidFit, went: Tensor) -> None:
    """Reject a fit that the fit to the sensor's path does not confirm: one-sided outliers can form their own surface.

    Raises:
        NotIdentifiableError: centre or semi-axes differ by more than their errors explain.
    """
    apart = torch.cat([along.center_ - fit.center_, along.semi_axes_ - fit.semi_axes_]).abs() / fit.radius_
    error = torch.cat([fit.center_se_, fit.semi_axes_se_]) / fit.radius_
    if float((apart - _ERRORS * error).max()) <= MAX_STANDARD_ERROR:
        return
    found = along.coverage_
    assert isinstance(found, Coverage)
    missing = "; ".join(str(gap) for gap in found.gaps)
    raise NotIdentifiableError(
        "Not identifiable: single samples determine the ellipsoid. Without samples that differ from their neighbours, "
        f"its centre or a semi-axis changes by {100.0 * float(apart.max()):.0f} % of the radius."
        f"{f' Directions not covered: {missing}.' if missing else ''} Record again away from what disturbs the sensor, "
        "and turn it through all directions. If the sensor's offset changed during the recording, `mkc diagnose` "
        "reports when.",
        found,
        along.calibrate(went)[along.weights_ >= 0.5],
    )
