"""A magnetometer compared by the field vector, where the attitude is recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.rotation import from_quaternion, rotated
from mkc_torch.calibration.coverage import coverage
from mkc_torch.calibration.ellipsoid_fit import MIN_INFORMATION
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.linear import LeastTrimmedSquares
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.nonlinear import GaussianPrior, NoFitError
from mkc_torch.recording.recording import Recording, RecordingError
from mkc_torch.simulation.magnetometer.heading import HeadingJump, heading_jumps
from mkc_torch.simulation.magnetometer.matrix import SOFT_IRON
from mkc_torch.simulation.magnetometer.view import AXES, GYRO, INDEPENDENT, QUATERNION, VECTOR, View, thinned
from mkc_torch.simulation.ports import Changes, Nearby, Port

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_MISFIT = 0.3
"""Median error, as a share of the field, from which the attitude is checked."""

_FAR_BETTER = 0.5
"""Ratio of median errors below which the inverse of the attitude counts as recorded."""

_MIN_ROWS = 50
"""Fewest samples of a fit to a part of the recording."""

_REWEIGHTED = 10
"""Number of reweighted least-squares iterations."""

_RIDGE = 1e-4
"""Ridge of the response towards the identity, as a share of the field's mean square."""


class AttitudeView(View):
    """The field vector in the world frame by a recorded attitude: along the ambient field, and in two axes across it.

    Errors of the attitude rotate the field, so they enter only across it, as noise that is independent of the motion;
    except for jumps of the heading, which a gyroscope shows and an effect at the port "heading" describes.
    """

    view = "attitude"
    channels = VECTOR
    independent = INDEPENDENT
    parameter_names = (
        *(f"offset_{a}" for a in AXES),
        *(f"response_{a}{b}" for a in AXES for b in AXES),
        "field_tilt_1",
        "field_tilt_2",
    )

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.to_world = from_quaternion(recording.stack(*QUATERNION))
        self.ports = {
            "sensor": Port(AXES, self.unit, allows_drift=True),
            "field": Port(("east", "north", "up"), self.unit),
        }
        jumps = _jumps(recording, self.to_world)
        number = torch.arange(len(recording))
        self._since = torch.stack([number > jump.after for jump in jumps], -1).to(self.measured) if jumps else None
        if jumps:
            carries = tuple(f"since_{k}" for k in range(1, len(jumps) + 1))
            self.ports["heading"] = Port(("heading",), "°", carries=carries)
        self.prior = _matrix_prior(len(self.parameter_names))
        self.strength, self._ahead = 1.0, self.measured.new_zeros(3)
        offset, ahead = self._offset_and_field(self.to_world)
        self._refuse_inverse(offset, ahead)
        self.strength = float(torch.linalg.vector_norm(ahead))
        self._ahead = ahead / self.strength
        self._across = torch.linalg.svd(self._ahead.unsqueeze(0)).Vh[1:]
        self._frame = torch.cat([self._ahead.unsqueeze(0), self._across])
        turned = torch.einsum("kij,i->kj", self.to_world, ahead)
        offset, response = _response(self.measured, turned, offset)
        self._unbent = torch.linalg.inv(response)
        self._to_frame = self._frame @ self.to_world @ self._unbent
        self._from_world = self.to_world.movedim(1, 0).flatten(1).contiguous()
        self._full = torch.cat([offset, response.flatten(), offset.new_zeros(2)])
        self.warnings = (
            *self.warnings,
            *_coverage_warning(self.corrected(self._full, {})),
            *_jump_warning(jumps, self.time),
        )

    def ambient(self, theta: Float[Tensor, " p"]) -> Float[Tensor, " 3"]:
        """The ambient field in the world frame, (3,)."""
        direction = self._ahead + theta[12:14] @ self._across
        return self._strength(theta) * direction / torch.linalg.vector_norm(direction)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        if rows is None:
            return self._full.clone()
        if int(rows.sum()) < _MIN_ROWS:
            raise NoFitError(f"{int(rows.sum())} samples are too few for the offset and the response.")
        turned = torch.einsum("kij,i->kj", self.to_world[rows], self.strength * self._ahead)
        offset = (self.measured[rows] - turned).median(0).values
        offset, response = _response(self.measured[rows], turned, offset)
        return torch.cat([offset, response.flatten(), offset.new_zeros(2)])

    def _offset_and_field(self, attitude: Float[Tensor, "N 3 3"]) -> tuple[Tensor, Tensor]:
        """Offset and ambient field in the world frame by least trimmed squares, with the identity as matrix."""
        chosen = thinned(self.thin)
        to_world, measured = attitude[chosen], self.measured[chosen]
        eye = torch.eye(3, dtype=to_world.dtype).expand(len(to_world), 3, 3)
        try:
            coefficients = LeastTrimmedSquares().fit(torch.cat([eye, to_world.mT], -1), measured).coef_
        except RankDeficientError:
            raise _one_axis(self.to_world) from None
        return coefficients[:3], coefficients[3:]

    def _refuse_inverse(self, offset: Tensor, ahead: Tensor) -> None:
        """Refuse quaternions from the world frame to the sensor frame; warn if neither direction fits.

        Raises:
            RecordingError: the inverse of the attitude fits far better.
        """
        error, strength = self._median_error(self.to_world, offset, ahead), float(torch.linalg.vector_norm(ahead))
        if error <= _MISFIT * strength:
            return
        inverse = self._median_error(self.to_world.mT, *self._offset_and_field(self.to_world.mT))
        misfit = f"with the attitude as recorded the median error is {error:.3g} {self.unit}"
        if inverse < _FAR_BETTER * error:
            raise RecordingError(
                f"The quaternions are the inverse of the expected ones: {misfit}, with the inverse {inverse:.3g} "
                f"{self.unit}. They must rotate from the sensor frame to the world frame; give the conjugate, with the "
                "other sign of q_x, q_y and q_z."
            )
        self.warnings = (
            *self.warnings,
            f"The attitude hardly explains the field: {misfit}. Check that it has the axes and times of the "
            "magnetometer, and the order w, x, y, z.",
        )

    def _median_error(self, attitude: Float[Tensor, "N 3 3"], offset: Tensor, ahead: Tensor) -> float:
        """The median distance of the measurements from an offset plus the rotated field."""
        turned = torch.einsum("kij,i->kj", attitude, ahead)
        return float(torch.linalg.vector_norm(self.measured - offset - turned, dim=-1).median())

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        # the fitted matrix multiplies the simulated field: with the measured field, noise would shrink the matrix. A
        # fixed matrix maps the difference back to the world frame.
        difference = self._away(theta, changes) - self._sensed(self._seen(theta, changes), theta)
        residual = rotated(difference, self._to_frame)
        added = self._field_change(changes)
        return residual if added is None else residual - added @ self._frame.mT

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "N k"]]:
        """The signals at the ports; at the port "heading" a unit step at each jump of the heading."""
        since = {} if self._since is None else {"heading": self._since}
        return {**super().signals(theta, changes, near), **since}

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        return self._sensed(self._seen(theta, {}), theta)

    def _seen(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The ambient field in the sensor frame, rotated about the vertical by the error of the recorded heading."""
        ambient = self.ambient(theta)
        if self._since is None or "heading" not in changes:
            return (ambient @ self._from_world).unflatten(0, (-1, 3))
        angle = torch.deg2rad(changes["heading"](self._since)[:, 0])
        cos, sin = torch.cos(angle), torch.sin(angle)
        east, north, up = ambient
        turned = torch.stack([cos * east - sin * north, sin * east + cos * north, up.expand_as(angle)], -1)
        return rotated(turned, self.to_world.mT)

    def _sensed(self, field: Float[Tensor, "N 3"], theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        """The measurement of a field in the sensor frame, without the offset."""
        return field @ theta[3:12].unflatten(0, (3, 3)).mT


def with_attitude(recording: Recording) -> Recording:
    """The samples with an attitude, whose quaternion is not zero.

    Raises:
        RecordingError: no sample has an attitude.
    """
    known = recording.finite(*QUATERNION)
    has = torch.linalg.vector_norm(known.stack(*QUATERNION), dim=-1) > 0.0
    if bool(has.all()):
        return known
    if not bool(has.any()):
        where = f"{recording.name}: " if recording.name else ""
        raise RecordingError(
            f"{where}all quaternions {', '.join(QUATERNION)} are zero: there is no attitude. Leave out these columns, "
            "or record the attitude."
        )
    zero = int((~has).sum())
    return known.rows(has, f"Left out {zero} of {len(known)} samples whose quaternion is zero: they have no attitude.")


def _matrix_prior(count: int) -> GaussianPrior:
    """The prior of the response about the identity."""
    mean = torch.zeros(count, dtype=torch.float64)
    precision = torch.zeros(count, dtype=torch.float64)
    mean[3:12] = torch.eye(3, dtype=torch.float64).flatten()
    precision[3:12] = SOFT_IRON**-2
    return GaussianPrior(mean, precision)


def _response(measured: Tensor, turned: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Offset and response by reweighted least squares of the measurement on the rotated field, near the identity."""
    response = torch.eye(3, dtype=turned.dtype)
    ridge = len(turned) * _RIDGE * turned.square().sum(-1).mean()
    for _ in range(_REWEIGHTED):
        distance = torch.linalg.vector_norm(measured - offset - turned @ response.mT, dim=-1)
        scale = distance.median().clamp(min=1e-9 * turned.abs().max())
        weight = torch.exp(-0.5 * (distance / (2.0 * scale)).square()).unsqueeze(-1)
        regressors = torch.cat([turned, torch.ones_like(turned[:, :1])], -1)
        penalty = torch.diag(torch.cat([ridge.expand(3), ridge.new_zeros(1)]))
        gram = regressors.mT @ (weight * regressors) + penalty
        known = torch.cat([torch.eye(3, dtype=turned.dtype), turned.new_zeros(1, 3)])
        solved = torch.linalg.solve(gram, regressors.mT @ (weight * measured) + penalty @ known)
        response, offset = solved[:3].mT, solved[3]
    return offset, response


def _jumps(recording: Recording, to_world: Tensor) -> tuple[HeadingJump, ...]:
    """The jumps of the heading; none without a gyroscope and times."""
    if recording.time is None or not all(name in recording for name in GYRO):
        return ()
    return heading_jumps(recording.time, to_world, recording.stack(*GYRO), recording.magnetometer())


def _jump_warning(jumps: tuple[HeadingJump, ...], time: Tensor) -> tuple[str, ...]:
    """A sentence about the heading's jumps; empty without jumps."""
    if not jumps:
        return ()
    listed = ", ".join(
        f"by {jump.size:.1f}° at {float(time[jump.after]):.1f} s (gyroscope: {jump.turned:.1f}°)" for jump in jumps
    )
    return (
        f"The recorded heading jumps where the gyroscope does not: {listed}. The attitude has these errors before or "
        "after the jumps, and an effect that seems to begin there may be such an error.",
    )


def _one_axis(to_world: Tensor) -> NotIdentifiableError:
    """The error for a recording in which the sensor turns about one of its axes only, or not at all."""
    turned = (to_world - to_world.mean(0)).square().sum((0, 1))
    axis = AXES[int(turned.argmin())]
    return NotIdentifiableError(
        f"Not identifiable: the sensor turns about its {axis} axis only, or not at all, so the offset along +{axis} "
        "cannot be distinguished from the field. Turn it about another axis too."
    )


def _coverage_warning(field: Tensor) -> tuple[str, ...]:
    """A sentence about directions that the recording does not cover; empty if it covers enough."""
    found = coverage(field)
    if found.information >= MIN_INFORMATION:
        return ()
    missing = "; ".join(str(gap) for gap in found.gaps)
    return (
        "The ellipsoid alone is not identifiable from this recording; the attitude replaces the missing turns"
        + (f". Directions not covered: {missing}." if missing else "."),
    )
