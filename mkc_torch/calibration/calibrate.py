"""The calibration of a magnetometer: one recording in, offset, matrix, their errors and what was noticed out."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.aided.fallback import with_aid
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.clipped_samples import CLIPPED, without_clipped
from mkc_torch.calibration.coverage import Coverage
from mkc_torch.calibration.ellipsoid import ellipsoid_from_coefficients
from mkc_torch.calibration.ellipsoid_fit import MIN_POINTS, EllipsoidFit
from mkc_torch.calibration.file import Matrix, Vector
from mkc_torch.calibration.frozen_samples import FROZEN, without_frozen
from mkc_torch.calibration.impossible_samples import without_impossible
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.other_sensors import GRAVITY, accelerometer, rest_bias
from mkc_torch.calibration.places import disturbed_places, numbered
from mkc_torch.calibration.plain_values import ResidualSpread, matrix_of, spread_of, vector_of
from mkc_torch.calibration.recorded_ellipsoid import recorded_ellipsoid
from mkc_torch.calibration.result import Calibration
from mkc_torch.calibration.runs import in_each_run, run_slices
from mkc_torch.calibration.turning import thin_at_rest
from mkc_torch.density.tails import ChannelTails, time_series_tails
from mkc_torch.functional import mkc_weight
from mkc_torch.linear import MKCRegression
from mkc_torch.recording.recording import Recording, RecordingError
from mkc_torch.recording.unit_warnings import RECORDED, converted_from, field_warning, time_warning

__all__ = ["Calibration", "Matrix", "ResidualSpread", "Vector", "calibrate", "prepared"]

REJECTED_BELOW = 0.5
"""A sample of less than this weight counts as rejected."""

MAX_REJECTED = 0.2
"""Above this share of rejected samples one ellipsoid is a doubtful model, and a warning says so."""

MUCH_SCATTER = 0.1
"""Scatter of the calibrated field's length, as a share of the radius, above which a warning says so."""

UNUSUAL_RATIO = 1.5
"""Longest over shortest semi-axis above which a warning says so."""

ENOUGH_INFORMATION = 0.1
"""Information, as a share of even coverage, at which directions that are missing do no harm."""

_LEAST = 1e-60
FEW_SAMPLES = 50
_AXES = ("mag_x", "mag_y", "mag_z")


def prepared(recording: Recording) -> Recording:
    """The samples a calibration uses: those with a finite and possible field, in the order of time if there is a time.

    Samples of a frozen sensor and clipped ones are left out too.

    Raises:
        MissingColumnError: no ``mag_x``, ``mag_y`` or ``mag_z``.
        RecordingError: fewer than nine samples are left, or values whose squares no number holds.

    Example:
        >>> angle = torch.linspace(0.0, 6.0, 30)
        >>> angle[3] = math.nan
        >>> len(prepared(Recording({"mag_x": angle.cos(), "mag_y": angle.sin(), "mag_z": angle})))
        29
    """
    usable = recording.finite(*_AXES)
    if usable.time is not None:
        usable = usable.sorted_by_time()
    _refuse_few(usable)
    usable = without_clipped(without_frozen(without_impossible(usable, *_AXES), *_AXES), *_AXES)
    _refuse_few(usable)
    largest = float(usable.magnetometer().abs().max())
    if largest > 1.0 / _LEAST or 0.0 < largest < _LEAST:
        where = f"{recording.name}: " if recording.name else ""
        raise RecordingError(
            f"{where}the largest value of {', '.join(_AXES)} is {largest:.3g}, which is no magnetic field in any unit; "
            "check these columns."
        )
    return usable


def _refuse_few(usable: Recording) -> None:
    """Refuse samples that are too few for an ellipsoid.

    Raises:
        RecordingError: with what was dropped.
    """
    if len(usable) >= MIN_POINTS:
        return
    where = f"{usable.name}: " if usable.name else ""
    found = "1 sample is" if len(usable) == 1 else f"{len(usable)} samples are"
    reasons = " ".join(usable.warnings)
    raise RecordingError(
        f"{where}{found} too few, an ellipsoid needs at least {MIN_POINTS}; record while turning the sensor "
        f"through all directions.{' ' + reasons if reasons else ''}"
    )


def calibrate(
    recording: Recording,
    *,
    field_strength: float | None = None,
    name: str | None = None,
    seed: int = 0,
    earth: Field | None = None,
    sensor: str = "mag",
) -> Calibration:
    """Calibrate the magnetometer of a recording by MKC-EM on the linear ellipsoid fit.

    Samples that are not finite, that no field explains, of a frozen sensor, or at the end of its range are left out and
    the rest is sorted by time, which the warnings tell. Without a time, rows count as in the order of time. Standard
    errors allow for autocorrelation, but not from one ``experiment`` to the next. Where the radius does not fit the
    unit, it is called "recorded units", and a warning says why.

    Where the turns do not determine an ellipsoid, as those of a vehicle that hardly tilts, an attitude ``q_*`` or a
    gyroscope ``gyro_*`` stands in for them; ``aid`` says what it determined, and what not.

    Args:
        recording: with columns ``mag_x``, ``mag_y``, ``mag_z``, in any one unit, and ``time`` in s where it has one.
        field_strength: length of the corrected field in µT; default the radius of the ellipsoid, in its own unit.
        name: what the sensor is called; default the recording's name.
        seed: of the robust start.
        earth: the field at the place of the recording, as :func:`mkc_torch.calibration.earth_field` has it: its length
            is that of the corrected field, unless ``field_strength`` is given, and helps where the turns do not
            determine an ellipsoid; its inclination chooses where that fit starts.
        sensor: "mag", or "accel" for an accelerometer ``accel_*``, in whose place the field is gravity and
            ``field_strength`` its length in m/s², 9.80665 if not given.

    Raises:
        MissingColumnError: a column of the magnetometer is not there.
        RecordingError: fewer than nine usable samples.
        NotIdentifiableError: the samples do not determine an ellipsoid, and nothing stands in for what is missing.
        TypeError, ValueError: a field strength that is no number, or not positive.

    Example:
        >>> from mkc_torch.calibration.coverage import fibonacci_sphere
        >>> points = fibonacci_sphere(200) * torch.tensor([40.0, 50.0, 60.0]) + torch.tensor([1.0, 2.0, 3.0])
        >>> points[:20] += 25.0
        >>> names = ("mag_x", "mag_y", "mag_z")
        >>> result = calibrate(Recording(dict(zip(names, points.unbind(-1)))))
        >>> [round(v, 3) for v in result.center], result.rejected
        ([1.0, 2.0, 3.0], 20)
    """
    if field_strength is not None:
        field_strength = checked_number("field_strength", field_strength, advice="it is a length in µT")
    if sensor not in ("mag", "accel"):
        raise ValueError(f"Expected argument `sensor` to be 'mag' or 'accel' but got {sensor!r}.")
    if sensor == "accel":
        strength = GRAVITY if field_strength is None else field_strength
        return accelerometer(recording, lambda table: calibrate(table, field_strength=strength, name=name, seed=seed))
    found = _of_magnetometer(recording, field_strength, seed, earth)
    return dataclasses.replace(found, name=recording.name if name is None else name, rest_bias=rest_bias(recording))


def _of_magnetometer(recording: Recording, field_strength: float | None, seed: int, earth: Field | None) -> Calibration:
    if earth is not None and field_strength is None:
        field_strength = earth.strength
    recording.stack(*_AXES)  # refused before a column is added
    usable = prepared(numbered(recording))
    try:
        fit = recorded_ellipsoid(usable, seed)
    except NotIdentifiableError as error:
        refusal = _with_faults(error, usable)
    else:
        return _of_ellipsoid(fit, usable, field_strength)
    return dataclasses.replace(with_aid(usable, refusal, field_strength=field_strength, earth=earth), used=usable)


def _of_ellipsoid(fit: EllipsoidFit, usable: Recording, field_strength: float | None) -> Calibration:
    points = usable.magnetometer()
    radius = float(fit.radius_)
    strength = radius if field_strength is None else field_strength
    scale = strength / radius
    matrix_se = fit.calibration_matrix_se_ if field_strength is None else strength * fit.root_se_
    density = _density(fit)
    length = torch.linalg.vector_norm(fit.calibrate(points), dim=-1)
    # of all samples, those that were left out while the sensor rested among them
    rejected = mkc_weight((length / radius).square() - 1.0, density[0], density[1]) < REJECTED_BELOW
    found = fit.coverage_
    assert isinstance(found, Coverage)
    unit = usable.units[_AXES[0]]
    size = field_warning(radius, unit, "radius of the ellipsoid is", "all numbers", converted_from(usable))
    unit = unit if size is None else RECORDED
    norm = torch.linalg.vector_norm(points, dim=-1)
    return Calibration(
        recording=usable.name,
        samples=len(points),
        unit=unit,
        center=vector_of(fit.center_),
        center_se=vector_of(fit.center_se_),
        semi_axes=vector_of(fit.semi_axes_),
        semi_axes_se=vector_of(fit.semi_axes_se_),
        rotation=matrix_of(fit.rotation_),
        matrix=matrix_of(scale * fit.calibration_matrix_),
        matrix_se=matrix_of(matrix_se),
        radius=radius,
        field_strength=strength,
        field_unit=unit if field_strength is None else "µT",
        sigma=density[0],
        d=density[1],
        bound=density[2],
        before=spread_of(norm - norm.median()),
        after=spread_of(length - radius),
        rejected=int(rejected.sum()),
        disturbed=disturbed_places(usable, rejected),
        disturbed_unit="row" if usable.time is None else "s",
        coverage=found,
        warnings=(
            *usable.warnings,
            *(sentence for sentence in (size, time_warning(usable)) if sentence),
            *_warnings(fit, found, length - radius, float(rejected.double().mean())),
        ),
        used=usable,
        tails=_tails(usable, (length / radius).square() - 1.0),
    )


def _tails(usable: Recording, residual: Tensor) -> ChannelTails | None:
    """The tails of the residual of the samples that the ellipsoid was fitted to; None of an exact fit."""
    taken = in_each_run(usable.magnetometer(), run_slices(usable), thin_at_rest)
    assert taken is not None
    return next(iter(time_series_tails(residual[taken].unsqueeze(-1))), None)


def _density(fit: EllipsoidFit) -> tuple[float, float, float]:
    """σ, d and bound of the algebraic residual about the centre.

    The estimator's residual is about another origin, which only multiplies it.
    """
    estimator = fit.estimator_
    assert isinstance(estimator, MKCRegression)
    local = ellipsoid_from_coefficients(estimator.coef_)
    factor = float(1.0 - local.center @ local.shape @ local.center)
    return float(estimator.sigma_), factor * float(estimator.d_), factor * float(estimator.bound_)


def _with_faults(error: NotIdentifiableError, usable: Recording) -> NotIdentifiableError:
    """The refusal, and which faults of the sensor took samples away that might have been enough."""
    faults = [sentence for sentence in usable.warnings if FROZEN in sentence or CLIPPED in sentence]
    if any(CLIPPED in sentence for sentence in faults):
        faults.append("Set the sensor to a wider range, or take away what magnetises it, and record again.")
    return NotIdentifiableError(" ".join([str(error), *faults]), error.coverage, error.directions)


def _warnings(fit: EllipsoidFit, found: Coverage, residual: Tensor, rejected_share: float) -> list[str]:
    warnings = []
    if rejected_share > MAX_REJECTED:
        warnings.append(
            f"{100.0 * rejected_share:.0f} % of the samples do not fit one ellipsoid: the sensor's offset may have "
            "changed during the recording, or something magnetic was near for long. `mkc diagnose` says what changed, "
            "and when; or record again away from it, or calibrate the parts of the recording separately."
        )
    scatter = float(robust_scale(residual.unsqueeze(-1))) / float(fit.radius_)
    if scatter > MUCH_SCATTER:
        warnings.append(
            f"The length of the calibrated field scatters by {100.0 * scatter:.0f} % of the radius; that of a sensor "
            "which is calibrated in a steady field scatters by one to three. Offset and semi-axes may be off by more "
            "than their standard errors say; `mkc diagnose` says what disturbs it."
        )
    ratio = float(fit.semi_axes_[2] / fit.semi_axes_[0])
    if ratio > UNUSUAL_RATIO:
        warnings.append(
            f"The longest semi-axis is {ratio:.2g} times the shortest. The gains of one chip differ by some per cent, "
            "and iron nearby seldom adds more than some ten: check that all three columns are in one unit, that none "
            "is cut off at the end of its range, and the directions covered."
        )
    if len(residual) < FEW_SAMPLES:
        warnings.append(
            f"{len(residual)} samples are few for nine unknowns: the true errors can be far larger than the "
            f"standard errors say. Record {FEW_SAMPLES} at least."
        )
    if found.gaps:
        warnings.append(_gaps(fit, found))
    if not bool(torch.as_tensor(getattr(fit.estimator_, "converged_", True)).all()):
        warnings.append("The fit stopped before it came to rest; its last digits are uncertain.")
    return warnings


def _gaps(fit: EllipsoidFit, found: Coverage) -> str:
    """Which directions are missing, and what that means for the result."""
    missing = "; ".join(str(gap) for gap in found.gaps)
    worst = 100.0 * float((torch.cat([fit.center_se_, fit.semi_axes_se_]) / fit.radius_).max())
    known = f"to {worst:.1g} % of the radius" if worst < math.inf else "but how well is not known"
    if found.information >= ENOUGH_INFORMATION:
        means = f"The others determine offset and semi-axes {known}, so the calibration holds all the same"
    else:
        means = (
            f"The others determine offset and semi-axes {known}, if nothing changed meanwhile: what is known worst is "
            f"known {found.information**-0.5:.1g} times less well than from all directions, and a disturbance counts "
            "as much more"
        )
    return (
        f"Directions not covered: {missing}. {means}. To be sure, turn the sensor so that the field points there too."
    )
