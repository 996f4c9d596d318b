"""Calibrate a magnetometer from a recording: offset, matrix, standard errors and warnings."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number
from mkc_torch._support.note import Note
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.aided.fallback import with_aid
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.clipped_samples import CLIPPED, without_clipped
from mkc_torch.calibration.coverage import Coverage
from mkc_torch.calibration.ellipsoid import ellipsoid_from_coefficients
from mkc_torch.calibration.ellipsoid_fit import MIN_POINTS, EllipsoidFit
from mkc_torch.calibration.file import Matrix, Vector
from mkc_torch.calibration.frozen_samples import without_frozen
from mkc_torch.calibration.impossible_samples import without_impossible
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.offset_change import offset_change
from mkc_torch.calibration.other_sensors import GRAVITY, accelerometer, rest_bias
from mkc_torch.calibration.places import disturbed_places, numbered, places
from mkc_torch.calibration.plain_values import ResidualSpread, matrix_of, spread_of, vector_of
from mkc_torch.calibration.recorded_ellipsoid import recorded_ellipsoid
from mkc_torch.calibration.result import Calibration
from mkc_torch.calibration.runs import in_each_run, run_slices
from mkc_torch.calibration.turning import thin_at_rest
from mkc_torch.calibration.warning_order import NOT_COVERED, by_weight, is_fault
from mkc_torch.density.tails import time_series_tails
from mkc_torch.functional import mkc_weight
from mkc_torch.linear import MKCRegression
from mkc_torch.recording.recording import Recording, RecordingError
from mkc_torch.recording.unit_warnings import RECORDED, converted_from, field_warning, time_warning

__all__ = ["Calibration", "Matrix", "ResidualSpread", "Vector", "calibrate", "prepared"]

REJECTED_BELOW = 0.5
"""Samples with a smaller weight count as rejected."""

MAX_REJECTED = 0.2
"""Share of rejected samples above which a warning questions the model of a single ellipsoid."""

MUCH_SCATTER = 0.1
"""Scatter of the calibrated field's length, as a share of the radius, above which there is a warning."""

UNUSUAL_RATIO = 1.5
"""Ratio of the longest to the shortest semi-axis above which there is a warning."""

ENOUGH_INFORMATION = 0.1
"""Information, as a share of even coverage, from which missing directions do no harm."""

_LEAST = 1e-60
"""Smallest magnitude of a field, in any unit; its reciprocal is the largest."""

FEW_SAMPLES = 50
"""Number of samples below which there is a warning."""

MOST_SAMPLES = 50_000
"""Most samples of a fit; a longer recording is thinned evenly, so that time and memory do not grow with it."""

_AXES = ("mag_x", "mag_y", "mag_z")


def thinned(recording: Recording) -> Recording:
    """Every k-th sample of a long recording, with a note; a recording of at most ``MOST_SAMPLES`` is unchanged.

    Example:
        >>> len(thinned(Recording({"mag_x": torch.zeros(250_000)})))
        50000
    """
    every = math.ceil(len(recording) / MOST_SAMPLES)
    if every <= 1:
        return recording
    note = Note(f"Of the {len(recording):,} usable samples, one in {every} is used, evenly over the recording.")
    return recording.rows(torch.arange(0, len(recording), every), note)


def prepared(recording: Recording) -> Recording:
    """The samples that a calibration uses: finite and possible fields, sorted by time if there is a time.

    Clipped samples and samples of a frozen sensor are left out too.

    Raises:
        MissingColumnError: no ``mag_x``, ``mag_y`` or ``mag_z``.
        RecordingError: fewer than nine samples remain, or values whose squares overflow or underflow.

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
            f"{where}the largest value of {', '.join(_AXES)} is {largest:.3g}, not a magnetic field in any unit; "
            "check these columns."
        )
    return usable


def _refuse_few(usable: Recording) -> None:
    """Check that there are enough samples for an ellipsoid.

    Raises:
        RecordingError: too few samples; the message lists what was dropped.
    """
    if len(usable) >= MIN_POINTS:
        return
    where = f"{usable.name}: " if usable.name else ""
    found = "1 sample is" if len(usable) == 1 else f"{len(usable)} samples are"
    reasons = " ".join(usable.warnings)
    raise RecordingError(
        f"{where}{found} too few; an ellipsoid needs at least {MIN_POINTS}. Record while turning the sensor "
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

    Samples that are not finite, impossible, frozen, or clipped are left out, and the others are sorted by time;
    ``warnings`` lists this. Without a time, rows are taken to be in the order of time. Standard errors allow for
    autocorrelation within a run (``experiment``), not between runs. Of a recording of more than ``MOST_SAMPLES`` usable
    samples, every second, third, … is used. If the radius does not fit the unit, the unit is
    "recorded units", and a warning states why.

    If the turns do not determine an ellipsoid, as for a vehicle that hardly tilts, an attitude ``q_*`` or a gyroscope
    ``gyro_*`` supplies the missing information; ``aid`` lists what it determined and what remains undetermined.

    Args:
        recording: recording with ``mag_x``, ``mag_y``, ``mag_z`` in the same unit, and optionally ``time`` in s.
        field_strength: length of the corrected field in µT; default the radius of the ellipsoid, in its own unit.
        name: name of the sensor; default the recording's name.
        seed: seed of the robust start.
        earth: the field at the place of the recording, from :func:`mkc_torch.calibration.earth_field`. Its length is
            the default of ``field_strength``. If the turns do not determine an ellipsoid, its length adds information
            and its inclination selects the starting point of the aided fit.
        sensor: "mag", or "accel" for an accelerometer ``accel_*``; its field is gravity, and ``field_strength`` is in
            m/s², 9.80665 by default.

    Raises:
        MissingColumnError: a column of the magnetometer is missing.
        RecordingError: fewer than nine usable samples.
        NotIdentifiableError: the samples do not determine an ellipsoid, and no aiding data makes up for it.
        TypeError, ValueError: ``field_strength`` is not a number or not positive, or ``sensor`` is unknown.

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
    return dataclasses.replace(
        found,
        name=recording.name if name is None else name,
        rest_bias=rest_bias(recording),
        warnings=by_weight(found.warnings),
    )


def _of_magnetometer(recording: Recording, field_strength: float | None, seed: int, earth: Field | None) -> Calibration:
    if earth is not None and field_strength is None:
        field_strength = earth.strength
    recording.stack(*_AXES)  # check before a column is added
    usable = thinned(prepared(numbered(recording)))
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
    taken = in_each_run(points, run_slices(usable), thin_at_rest)
    assert taken is not None
    changed = offset_change(points[taken], places(usable)[taken], fit.center_, fit.calibration_matrix_, radius)
    strength = radius if field_strength is None else field_strength
    scale = strength / radius
    matrix_se = fit.calibration_matrix_se_ if field_strength is None else strength * fit.root_se_
    density = _density(fit)
    length = torch.linalg.vector_norm(fit.calibrate(points), dim=-1)
    # counts all samples, including those thinned out while the sensor rested
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
            *(sentence for sentence in (size, time_warning(usable)) if sentence),
            *_warnings(fit, found, length - radius, float(rejected.double().mean())),
            *usable.warnings,
        ),
        notes=usable.notes,
        used=usable,
        tails=next(iter(time_series_tails(((length / radius).square() - 1.0)[taken].unsqueeze(-1))), None),
        offset_change=changed,
    )


def _density(fit: EllipsoidFit) -> tuple[float, float, float]:
    """σ, d and bound of the algebraic residual about the centre.

    The estimator's residual is about another origin, which only scales it.
    """
    estimator = fit.estimator_
    assert isinstance(estimator, MKCRegression)
    local = ellipsoid_from_coefficients(estimator.coef_)
    factor = float(1.0 - local.center @ local.shape @ local.center)
    return float(estimator.sigma_), factor * float(estimator.d_), factor * float(estimator.bound_)


def _with_faults(error: NotIdentifiableError, usable: Recording) -> NotIdentifiableError:
    """Put the warnings about frozen and clipped samples, which may have removed the needed samples, first."""
    faults = [sentence for sentence in by_weight(usable.warnings) if is_fault(sentence)]
    if not faults:
        return error
    if any(CLIPPED in sentence for sentence in faults):
        faults.append("Set the sensor to a wider range, or remove what magnetises it, and record again.")
    prefix, reason = "Not identifiable: ", str(error)
    consequence = reason.removeprefix(prefix)
    sentences = [*faults, consequence[:1].upper() + consequence[1:]]
    return NotIdentifiableError(prefix + " ".join(sentences), error.coverage, error.directions)


def _warnings(fit: EllipsoidFit, found: Coverage, residual: Tensor, rejected_share: float) -> list[str]:
    warnings = []
    if rejected_share > MAX_REJECTED:
        warnings.append(
            f"{100.0 * rejected_share:.0f} % of the samples do not fit the ellipsoid: the sensor's offset may have "
            "changed during the recording, or a magnetic object was near for a long time. `mkc diagnose` reports what "
            "changed and when. Record again away from the object, or calibrate the parts of the recording separately."
        )
    scatter = float(robust_scale(residual.unsqueeze(-1))) / float(fit.radius_)
    if scatter > MUCH_SCATTER:
        warnings.append(
            f"The length of the calibrated field scatters by {100.0 * scatter:.0f} % of the radius; in a steady field "
            "1 to 3 % is usual. Offset and semi-axes may be wrong by more than their standard errors; `mkc diagnose` "
            "reports what disturbs the field."
        )
    ratio = float(fit.semi_axes_[2] / fit.semi_axes_[0])
    if ratio > UNUSUAL_RATIO:
        warnings.append(
            f"The longest semi-axis is {ratio:.2g} times the shortest. The gains of a chip differ by a few per cent, "
            "and iron nearby seldom adds more than about 10 %: check that all three columns are in the same unit, that "
            "no column is clipped, and which directions are covered."
        )
    if len(residual) < FEW_SAMPLES:
        warnings.append(
            f"{len(residual)} samples are few for nine unknowns: the true errors can be far larger than the "
            f"standard errors. Record at least {FEW_SAMPLES}."
        )
    if found.gaps:
        warnings.append(_gaps(fit, found))
    if not bool(torch.as_tensor(getattr(fit.estimator_, "converged_", True)).all()):
        warnings.append("The fit did not converge; its last digits are uncertain.")
    return warnings


def _gaps(fit: EllipsoidFit, found: Coverage) -> str:
    """The warning about missing directions and their consequence for the result."""
    missing = "; ".join(str(gap) for gap in found.gaps)
    worst = 100.0 * float((torch.cat([fit.center_se_, fit.semi_axes_se_]) / fit.radius_).max())
    known = f"to {worst:.1g} % of the radius" if worst < math.inf else "with unknown accuracy"
    if found.information >= ENOUGH_INFORMATION:
        means = f"The covered directions determine offset and semi-axes {known}, so the calibration is still valid"
    else:
        means = (
            f"The covered directions determine offset and semi-axes {known}, if nothing changed during the recording. "
            f"Their least determined combination is {found.information**-0.5:.1g} times less accurate than from all "
            "directions, and disturbances have that much more influence"
        )
    return f"{NOT_COVERED}: {missing}. {means}. To be sure, turn the sensor so that the field points there too."
