"""The calibration of a magnetometer: one recording in, offset, matrix, their errors and what was noticed out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.coverage import Coverage
from mkc_torch.disturbance import Interval, disturbed_intervals
from mkc_torch.ellipsoid import (
    MIN_POINTS,
    EllipsoidFit,
    ellipsoid_from_coefficients,
    symmetric_root,
)
from mkc_torch.functional import mkc_weight
from mkc_torch.linear import MKCRegression
from mkc_torch.linear.covariance import CovarianceKind
from mkc_torch.recording import Recording, RecordingError

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Calibration", "Spread", "calibrate", "prepared"]

REJECTED_BELOW = 0.5
"""A sample of less than this weight counts as rejected."""

MAX_REJECTED = 0.2
"""Above this share of rejected samples one ellipsoid is a doubtful model, and a warning says so."""

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

_LEAST = 1e-60
FEW_SAMPLES = 50
_AXES = ("mag_x", "mag_y", "mag_z")


class Spread(NamedTuple):
    """The size of residuals: 1.4826 times their median absolute value, and their root mean square."""

    robust: float
    rms: float


@dataclass(frozen=True)
class Calibration:
    """What a recording says about its magnetometer: ``field = matrix @ (measured - center)``.

    Lengths are in ``unit``, the recording's, but for the corrected field, which is in ``field_unit``.

    Attributes:
        recording: name of the recording.
        samples: samples in the fit.
        unit: of what was measured.
        center, center_se: offset (hard iron) and its standard errors.
        semi_axes, semi_axes_se: of the ellipsoid, ascending.
        rotation: columns along the semi-axes, determinant +1.
        matrix, matrix_se: the calibration matrix, symmetric.
        radius: geometric mean of the semi-axes.
        field_strength, field_unit: the length of the corrected field: the radius, unless it was given.
        sigma, d, bound: MKC density of :meth:`algebraic_residual`, no units; ``sigma`` is inf for Gaussian residuals.
        before: of the measured norm about its median.
        after: of :meth:`norm_residual`, rejected samples included.
        rejected: number of samples of weight below one half.
        disturbed: where rejected samples stand close together in time.
        coverage: of directions, by the samples in use.
        warnings: sentences about the recording and the fit.
    """

    recording: str
    samples: int
    unit: str
    center: Vector
    center_se: Vector
    semi_axes: Vector
    semi_axes_se: Vector
    rotation: Matrix
    matrix: Matrix
    matrix_se: Matrix
    radius: float
    field_strength: float
    field_unit: str
    sigma: float
    d: float
    bound: float
    before: Spread
    after: Spread
    rejected: int
    disturbed: tuple[Interval, ...]
    coverage: Coverage
    warnings: tuple[str, ...]

    @property
    def rejected_share(self) -> float:
        return self.rejected / self.samples

    def corrected(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The field in ``field_unit`` from measurements in ``unit``."""
        center, matrix = points.new_tensor(self.center), points.new_tensor(self.matrix)
        return (points - center) @ matrix.mT

    def norm_residual(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Length of the corrected field less what it should be, in ``unit``."""
        relative = torch.linalg.vector_norm(self.corrected(points), dim=-1) / self.field_strength
        return self.radius * (relative - 1.0)

    def algebraic_residual(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """``(|field| / field_strength)² - 1``, twice the relative error of the length to first order."""
        return (self.corrected(points) / self.field_strength).square().sum(-1) - 1.0

    def weight(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The weight in [0, 1] with which measurements enter the fit."""
        return mkc_weight(self.algebraic_residual(points), self.sigma, self.d)

    def apply(self, recording: Recording) -> dict[str, Float[Tensor, " N"]]:
        """The corrected field of a recording, row by row: ``time`` where it has one, ``field_x``, ``field_y``,
        ``field_z`` in ``field_unit``. No row is dropped; where a measurement is missing, so is the field.

        Raises:
            MissingColumnError: the recording has no ``mag_x``, ``mag_y`` or ``mag_z``.

        Example:
            >>> from mkc_torch.demo import simulated_recording
            >>> recording, _ = simulated_recording()
            >>> calibration = calibrate(recording, field_strength=48.0)
            >>> field = calibration.apply(recording)
            >>> list(field), round(float(torch.stack(list(field.values())[1:]).norm(dim=0).median()), 1)
            (['time', 'field_x', 'field_y', 'field_z'], 48.0)
        """
        field = self.corrected(recording.magnetometer())
        time = {} if recording.time is None else {"time": recording.time}
        return time | dict(zip(("field_x", "field_y", "field_z"), field.unbind(-1), strict=True))

    def to_json(self) -> str:
        """The calibration as JSON of the schema "mkc-calibration/1", from which :meth:`from_json` makes it again.

        Numbers round-trip exactly. JSON has no infinity and no NaN: ``sigma`` is the string "inf" where the residuals
        are Gaussian, and a standard error that is not known is null.
        """
        from mkc_torch.calibration_file import calibration_to_json

        return calibration_to_json(self)

    @staticmethod
    def from_json(text: str) -> Calibration:
        """The calibration of a JSON text.

        Raises:
            CalibrationFileError: not JSON, of another schema, or a value that is missing or of the wrong kind.

        Example:
            >>> Calibration.from_json('{"schema": "mkc-model/1"}')
            Traceback (most recent call last):
            mkc_torch.calibration_file.CalibrationFileError: this is no calibration: its schema is "mkc-model/1", ...
        """
        from mkc_torch.calibration_file import calibration_from_json

        return calibration_from_json(text)


def prepared(recording: Recording) -> Recording:
    """The samples a calibration uses: those with a finite field, in the order of time where there is a time.

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
    if len(usable) < MIN_POINTS:
        where = f"{recording.name}: " if recording.name else ""
        found = "1 sample is" if len(usable) == 1 else f"{len(usable)} samples are"
        reasons = " ".join(usable.warnings)
        raise RecordingError(
            f"{where}{found} too few, an ellipsoid needs at least {MIN_POINTS}; record while turning the sensor "
            f"through all directions.{' ' + reasons if reasons else ''}"
        )
    largest = float(usable.magnetometer().abs().max())
    if largest > 1.0 / _LEAST or 0.0 < largest < _LEAST:
        where = f"{recording.name}: " if recording.name else ""
        raise RecordingError(
            f"{where}the largest value of {', '.join(_AXES)} is {largest:.3g}, which is no magnetic field in any unit; "
            "check these columns."
        )
    return usable


def calibrate(recording: Recording, *, field_strength: float | None = None, seed: int = 0) -> Calibration:
    """Calibrate the magnetometer of a recording by MKC-EM on the linear ellipsoid fit.

    Samples that are not finite are dropped and the rest is sorted by time, which the warnings tell. Standard errors
    allow for autocorrelation where there is a time; without one, samples count as independent.

    Args:
        recording: with columns ``mag_x``, ``mag_y``, ``mag_z``, in any one unit, and ``time`` in s where it has one.
        field_strength: length of the corrected field in µT; default the radius of the ellipsoid, in its own unit.
        seed: of the robust start.

    Raises:
        MissingColumnError: a column of the magnetometer is not there.
        RecordingError: fewer than nine usable samples.
        NotIdentifiableError: the samples do not determine an ellipsoid.
        ValueError: a field strength that is not positive.

    Example:
        >>> from mkc_torch.coverage import fibonacci_sphere
        >>> points = fibonacci_sphere(200) * torch.tensor([40.0, 50.0, 60.0]) + torch.tensor([1.0, 2.0, 3.0])
        >>> points[:20] += 25.0
        >>> names = ("mag_x", "mag_y", "mag_z")
        >>> result = calibrate(Recording(dict(zip(names, points.unbind(-1)))))
        >>> [round(v, 3) for v in result.center], result.rejected
        ([1.0, 2.0, 3.0], 20)
    """
    if field_strength is not None and not (math.isfinite(field_strength) and field_strength > 0):
        raise ValueError(f"Expected argument `field_strength` to be positive but got {field_strength}.")
    usable = prepared(recording)
    points = usable.magnetometer()
    kind: CovarianceKind = "sandwich" if usable.time is None else "hac"
    fit = EllipsoidFit(MKCRegression(covariance=kind, seed=seed)).fit(points)
    radius = float(fit.radius_)
    strength = radius if field_strength is None else field_strength
    scale = strength / radius
    matrix_se = fit.calibration_matrix_se_ if field_strength is None else strength * _root_se(fit)
    density = _density(fit)
    rejected = fit.weights_ < REJECTED_BELOW
    found = fit.coverage_
    assert isinstance(found, Coverage)
    norm = torch.linalg.vector_norm(points, dim=-1)
    return Calibration(
        recording=usable.name,
        samples=len(points),
        unit=usable.units[_AXES[0]],
        center=_vector(fit.center_),
        center_se=_vector(fit.center_se_),
        semi_axes=_vector(fit.semi_axes_),
        semi_axes_se=_vector(fit.semi_axes_se_),
        rotation=_matrix(fit.rotation_),
        matrix=_matrix(scale * fit.calibration_matrix_),
        matrix_se=_matrix(matrix_se),
        radius=radius,
        field_strength=strength,
        field_unit=usable.units[_AXES[0]] if field_strength is None else "µT",
        sigma=density[0],
        d=density[1],
        bound=density[2],
        before=_spread(norm - norm.median()),
        after=_spread(fit.residual_),
        rejected=int(rejected.sum()),
        disturbed=() if usable.time is None else disturbed_intervals(usable.time, rejected),
        coverage=found,
        warnings=(*usable.warnings, *_warnings(fit, found, float(rejected.double().mean()))),
    )


def _density(fit: EllipsoidFit) -> tuple[float, float, float]:
    """σ, d and bound of the algebraic residual about the centre.

    The estimator's residual is about another origin, which only multiplies it.
    """
    estimator = fit.estimator_
    assert isinstance(estimator, MKCRegression)
    local = ellipsoid_from_coefficients(estimator.coef_)
    factor = float(1.0 - local.center @ local.shape @ local.center)
    return float(estimator.sigma_), factor * float(estimator.d_), factor * float(estimator.bound_)


def _root_se(fit: EllipsoidFit) -> Tensor:
    """Standard errors (3, 3) of the root W of the shape matrix A₁, in the unit of the points: dW W + W dW = dA₁."""
    estimator = fit.estimator_
    assert isinstance(estimator, MKCRegression)
    coef = estimator.coef_
    jacobian = torch.func.jacrev(lambda c: ellipsoid_from_coefficients(c).shape.flatten())(coef)
    local = ellipsoid_from_coefficients(coef)
    root = symmetric_root(local.shape)
    eye = torch.eye(3, dtype=root.dtype)
    d_root = torch.linalg.solve(torch.kron(root, eye) + torch.kron(eye, root), jacobian)
    variance = torch.einsum("ij,jk,ik->i", d_root, estimator.covariance_, d_root)
    size = local.shape.det().pow(-1 / 6) / fit.radius_
    return (variance.clamp(min=0.0).sqrt() * size).unflatten(0, (3, 3))


def _warnings(fit: EllipsoidFit, found: Coverage, rejected_share: float) -> list[str]:
    warnings = []
    if rejected_share > MAX_REJECTED:
        per_cent = f"{100.0 * rejected_share:.0f} %"
        warnings.append(
            f"{per_cent} of the samples do not fit one ellipsoid: the sensor's offset may have changed "
            "during the recording, or something magnetic was near for long. Record again away from it, or calibrate "
            "the parts of the recording separately."
        )
    if len(fit.weights_) < FEW_SAMPLES:
        warnings.append(
            f"{len(fit.weights_)} samples are few for nine unknowns: the true errors can be far larger than the "
            f"standard errors say. Record {FEW_SAMPLES} at least."
        )
    if found.gaps:
        missing = "; ".join(str(gap) for gap in found.gaps)
        warnings.append(f"Directions not covered: {missing}. Turn the sensor so that the field points there too.")
    if not bool(torch.as_tensor(getattr(fit.estimator_, "converged_", True)).all()):
        warnings.append("The fit stopped before it came to rest; its last digits are uncertain.")
    return warnings


def _spread(residual: Tensor) -> Spread:
    return Spread(1.4826 * float(residual.abs().median()), float(residual.square().mean().sqrt()))


def _vector(values: Tensor) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _matrix(values: Tensor) -> Matrix:
    a, b, c = values
    return _vector(a), _vector(b), _vector(c)
