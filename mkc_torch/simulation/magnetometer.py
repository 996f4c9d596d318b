"""The magnetometer: a constant ambient field, an offset and a matrix; what else it senses is for effects to say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.calibration import prepared
from mkc_torch.coverage import coverage
from mkc_torch.ellipsoid import MIN_INFORMATION, EllipsoidFit, NotIdentifiableError
from mkc_torch.linear import LeastTrimmedSquares
from mkc_torch.linear._problem import RankDeficientError
from mkc_torch.nonlinear import GaussianPrior, beside
from mkc_torch.recording import Recording
from mkc_torch.simulation.heading import HeadingJump, heading_jumps
from mkc_torch.simulation.protocol import Changes, FreeChange, Port
from mkc_torch.simulation.rotation import from_quaternion, rotation_since

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["Magnetometer", "MagnetometerCorrection"]

WINDOW = 2.0
"""Length in s over which a gyroscope's rotation is trusted; each window has its own unknown direction of the field."""

_QUATERNION = ("q_w", "q_x", "q_y", "q_z")
_GYRO = ("gyro_x", "gyro_y", "gyro_z")
_ACCEL = ("accel_x", "accel_y", "accel_z")
_AXES = ("x", "y", "z")
_CHANNELS = ("along", "across_1", "across_2")
_INDEPENDENT = (True, False, False)  # the error of a rotation is across the field, in residual and signal alike

SOFT_IRON = 0.1
"""Standard deviation, before the data speak, of what soft iron, gains and misalignment add to the unit matrix. Weak
against a sensor that is turned through all directions; it decides for the identity where a vehicle never tilts."""

GYRO_BIAS = 0.02
"""Standard deviation of a gyroscope's bias in rad/s before the data speak."""

_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_MIN_ROWS = 50
_REWEIGHTED, _RIDGE = 10, 1e-4
_TURNED = 1e-3
_AT_REST = 0.1
_ENOUGH = 1500


@dataclass(frozen=True)
class Magnetometer:
    """``matrix @ (measured - offset)`` is the ambient field in the sensor's axes, of constant strength and direction.

    What is compared depends on the recording. With an attitude, the vector with the world's field. Otherwise, its
    length with the field's, as a distance in the units of the measurement; and where the turns of the sensor do not
    determine it from the length, but there is a gyroscope, the vector with the field of the same two seconds turned
    along.

    Attributes:
        use: "attitude", "norm" or "gyro"; None takes the first of these that the recording allows. The length goes
            before the gyroscope because the drift of a gyroscope enters the vector as structure of its own.

    Example:
        >>> from mkc_torch.demo import simulated_recording
        >>> prepared_simulation = Magnetometer().prepare(simulated_recording()[0])
        >>> prepared_simulation.channels, prepared_simulation.unit
        (('norm',), 'µT')
    """

    use: str | None = None
    name: str = "magnetometer"

    @property
    def joins_experiments(self) -> bool:
        return False

    @property
    def columns(self) -> frozenset[str]:
        return frozenset({"time", *(f"mag_{a}" for a in _AXES), *_GYRO, *_ACCEL, *_QUATERNION})

    def prepare(self, recording: Recording) -> NormView | AttitudeView | GyroView:
        """The magnetometer of a recording.

        Raises:
            MissingColumnError: a column of the magnetometer, or of what ``use`` asks for, is not there.
            RecordingError: too few usable samples.
            NotIdentifiableError: no view determines the sensor; the message names the directions that are missing.
            ValueError: ``use`` is none of the three.
        """
        if self.use not in (None, "attitude", "gyro", "norm"):
            raise ValueError(f"Expected argument `use` to be 'attitude', 'gyro', 'norm' or None but got {self.use!r}.")
        has_attitude = all(name in recording for name in _QUATERNION)
        has_gyro = all(name in recording for name in _GYRO) and recording.time is not None
        if self.use == "attitude" or (self.use is None and has_attitude):
            return AttitudeView(prepared(_with_attitude(recording)))
        if self.use == "gyro":
            recording["time"]
            return GyroView(prepared(recording.finite(*_GYRO)))
        try:
            return NormView(prepared(recording))
        except NotIdentifiableError:
            if self.use == "norm" or not has_gyro:
                raise
        return GyroView(prepared(recording.finite(*_GYRO)))


class _View:
    """What the three comparisons share: the measured field and the sensor's model."""

    name = "magnetometer"
    view: str
    ports: dict[str, Port]
    strength: float
    bounds: tuple[Tensor, Tensor] | None = None

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.measured = recording.magnetometer()
        _refuse_at_rest(self.measured)
        self.unit = recording.units["mag_x"]
        self.state = {"view": self.view}
        self.warnings: tuple[str, ...] = ()

    @cached_property
    def time(self) -> Float[Tensor, " N"]:
        known = self.recording.time
        return torch.arange(len(self.recording), dtype=torch.float64) if known is None else known

    def signals(self, theta: Float[Tensor, " p"], changes: Changes) -> Mapping[str, Float[Tensor, "N 3"]]:  # noqa: ARG002
        """At the port "sensor", the simulated field as the sensor's own axes and gains show it."""
        # not the measured one: its noise is the residual's too, and would pass for a nonlinearity
        return {"sensor": self.simulated(theta)}

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        """The measurement as simulated, less its offset."""
        raise NotImplementedError

    def matrix(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "3 3"]:
        """Calibration matrix of the parameters."""
        return _MATRIX_OF_VIEW[self.view](theta)

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The calibrated field, with what changes the sensor taken off the measurement."""
        return self._away(theta, changes) @ self.matrix(theta).mT

    def _away(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The measurement from the offset, with what changes the sensor taken off it."""
        away = beside(self.measured, theta[0])
        if "sensor" in changes:
            change = changes["sensor"]
            away = away - change(
                torch.zeros_like(self.measured) if isinstance(change, FreeChange) else self.simulated(theta)
            )
        return away - theta[:3]

    def _field_change(self, changes: Changes) -> Tensor | None:
        """What is added to the field, (N, channels of the port), if anything."""
        return changes["field"](self.measured.new_zeros(len(self.measured), 0)) if "field" in changes else None

    def _strength(self, theta: Float[Tensor, " p"]) -> Float[Tensor, ""]:
        """Length of the field."""
        return beside(self.measured.new_tensor(self.strength), theta[0])

    def _ellipsoid(self, rows: Tensor | None) -> EllipsoidFit:
        points = self.measured if rows is None else self.measured[rows]
        return EllipsoidFit(LeastTrimmedSquares(), finish=None).fit(_thinned(points))


class NormView(_View):
    """Length of the field: one channel, the distance from the ellipsoid to first order, in the measurement's units."""

    view = "norm"
    channels = ("norm",)
    independent: tuple[bool, ...] = (True,)
    parameter_names = (
        *(f"offset_{a}" for a in _AXES),
        *(f"matrix_{_AXES[i]}{_AXES[j]}" for i, j in _SYMMETRIC),
    )
    prior: GaussianPrior | None = None

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.ports = {
            "sensor": Port(_AXES, self.unit, wanders=True),
            "field": Port(("strength",), self.unit),
        }
        fit = self._ellipsoid(None)
        self.strength = float(fit.radius_)
        self._full = self._theta(fit)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        return self._full.clone() if rows is None else self._theta(self._ellipsoid(rows))

    def _theta(self, fit: EllipsoidFit) -> Tensor:
        matrix = fit.calibration_matrix_ * (self.strength / float(fit.radius_))
        return torch.cat([fit.center_, torch.stack([matrix[i, j] for i, j in _SYMMETRIC])])

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 1"]:
        length, outward = self._length(theta, self._away(theta, changes).mT)
        distance, added = (length - self._strength(theta)).unsqueeze(-1), self._field_change(changes)
        distance = distance if added is None else distance - added
        return distance * (length / _length(outward)).unsqueeze(-1)

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        away = self._away(theta, {}).mT
        length, outward = self._length(theta, away)
        # a step against the steepest ascent of the length, as far as that is off
        return (away - (length - self._strength(theta)) * length * outward / outward.square().sum(0)).mT

    def _length(self, theta: Tensor, away: Float[Tensor, "3 N"]) -> tuple[Float[Tensor, " N"], Float[Tensor, "3 N"]]:
        """Length of the calibrated field, and that times its gradient by the measurement."""
        matrix = self.matrix(theta)
        field = matrix @ away
        return _length(field), matrix.mT @ field


class AttitudeView(_View):
    """The vector, turned into the world by a recorded attitude: along the world's field, and in two axes across it.

    Errors of the attitude turn the field, so they enter across it alone, as noise that knows nothing of the motion; but
    for jumps of the heading, which a gyroscope shows, and which are for an effect at the port "heading" to say.
    """

    view = "attitude"
    channels = _CHANNELS
    independent = _INDEPENDENT
    parameter_names = (
        *(f"offset_{a}" for a in _AXES),
        *(f"response_{a}{b}" for a in _AXES for b in _AXES),
        "field_tilt_1",
        "field_tilt_2",
    )

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.to_world = from_quaternion(recording.stack(*_QUATERNION))
        self.ports = {
            "sensor": Port(_AXES, self.unit, wanders=True),
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
        offset, ahead = self._offset_and_field()
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
        self.warnings = (*_turned_too_little(self.corrected(self._full, {})), *_told(jumps, self.time))

    def ambient(self, theta: Float[Tensor, " p"]) -> Float[Tensor, " 3"]:
        """The world's field."""
        direction = beside(self._ahead, theta[0]) + theta[12:14] @ self._across
        return self._strength(theta) * direction / torch.linalg.vector_norm(direction)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        if rows is None:
            return self._full.clone()
        if int(rows.sum()) < _MIN_ROWS:
            raise ValueError(f"{int(rows.sum())} samples are too few for the offset and the response.")
        turned = torch.einsum("kij,i->kj", self.to_world[rows], self.strength * self._ahead)
        offset = (self.measured[rows] - turned).median(0).values
        offset, response = _response(self.measured[rows], turned, offset)
        return torch.cat([offset, response.flatten(), offset.new_zeros(2)])

    def _offset_and_field(self) -> tuple[Tensor, Tensor]:
        """Offset and world field by least trimmed squares, the matrix taken for the identity."""
        to_world, measured = _thinned(self.to_world), _thinned(self.measured)
        eye = torch.eye(3, dtype=to_world.dtype).expand(len(to_world), 3, 3)
        try:
            coefficients = LeastTrimmedSquares().fit(torch.cat([eye, to_world.mT], -1), measured).coef_
        except RankDeficientError:
            raise _one_axis(self.to_world) from None
        return coefficients[:3], coefficients[3:]

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        # the simulated vector, not the measured one, goes through the matrix: the noise of what a matrix is fitted to
        # would shrink it. A fixed matrix takes the difference back into the world.
        left = self._away(theta, changes) - self._sensed(self._seen(theta, changes), theta)
        residual = torch.einsum("kij,kj->ki", self._to_frame, left)
        added = self._field_change(changes)
        return residual if added is None else residual - added @ self._frame.mT

    def signals(self, theta: Float[Tensor, " p"], changes: Changes) -> Mapping[str, Float[Tensor, "N k"]]:
        """Beside the others, at the port "heading", 1 from each of the heading's jumps on."""
        since = {} if self._since is None else {"heading": self._since}
        return {**super().signals(theta, changes), **since}

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        return self._sensed(self._seen(theta, {}), theta)

    def _seen(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        """The world's field in the body's axes, turned about the vertical by what the recorded heading is off."""
        ambient = self.ambient(theta)
        if self._since is None or "heading" not in changes:
            return (ambient @ self._from_world).unflatten(0, (-1, 3))
        angle = torch.deg2rad(changes["heading"](self._since)[:, 0])
        cos, sin = torch.cos(angle), torch.sin(angle)
        east, north, up = ambient
        turned = torch.stack([cos * east - sin * north, sin * east + cos * north, up.expand_as(angle)], -1)
        return torch.einsum("ki,kij->kj", turned, self.to_world)

    def _sensed(self, field: Float[Tensor, "N 3"], theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        """What the sensor makes of a field in its axes, less its offset."""
        return field @ theta[3:12].unflatten(0, (3, 3)).mT


class GyroView(_View):
    """The vector, turned by the gyroscope to the first sample of its window: along that window's field, and across."""

    view = "gyro"
    channels = _CHANNELS
    independent = _INDEPENDENT
    parameter_names = (*NormView.parameter_names, *(f"gyro_bias_{a}" for a in _AXES))

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording)
        self.ports = {
            "sensor": Port(_AXES, self.unit, wanders=True, pointwise=False),
            "field": Port(("strength",), self.unit, pointwise=False),
        }
        self.prior = _bias_prior()
        self.window, first = _windows(self.time)
        self.turned = rotation_since(self.time, recording.stack(*_GYRO), first)
        self.summed = _summed(self.turned, self.time, first)
        self.count = int(self.window.max()) + 1
        try:
            fit = self._ellipsoid(None)
        except NotIdentifiableError as error:
            offset = self._offset_by_turns(error)
            self.strength = float(torch.linalg.vector_norm(self.measured - offset, dim=-1).median())
            self._full = torch.cat([offset, offset.new_tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), offset.new_zeros(3)])
            self.warnings = (f"The gyroscope stands in for turns that are missing: {error}",)
        else:
            self.strength = float(fit.radius_)
            self._full = self._theta(fit)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Tensor:
        return self._full.clone() if rows is None else self._theta(self._ellipsoid(rows))

    def _offset_by_turns(self, error: NotIdentifiableError) -> Tensor:
        """The offset that leaves the field of each window steady, by reweighted least squares; the matrix is 1.

        Raises:
            NotIdentifiableError: ``error``, where the turns do not determine the offset either.
        """
        seen = torch.einsum("kij,kj->ki", self.turned, self.measured)
        weight = seen.new_ones(len(seen), 1)
        offset = seen.new_zeros(3)
        for _ in range(_REWEIGHTED):
            mean = self._window_mean(seen, weight)[self.window]
            turned = self._window_mean(self.turned.flatten(1), weight)[self.window].unflatten(-1, (3, 3))
            regressors, target = (self.turned - turned), seen - mean
            gram = torch.einsum("kai,k,kaj->ij", regressors, weight[:, 0], regressors)
            known = torch.linalg.eigvalsh(gram)
            if not bool(known[0] > _TURNED * known[-1]):
                raise error
            offset = torch.linalg.lstsq(
                gram, torch.einsum("kai,k,ka->i", regressors, weight[:, 0], target).unsqueeze(-1)
            ).solution.squeeze(-1)
            left = torch.linalg.vector_norm(target - regressors @ offset, dim=-1, keepdim=True)
            weight = torch.exp(-0.5 * (left / (2.0 * left.median().clamp(min=1e-9))).square()).clamp(min=1e-12)
        return offset

    def _theta(self, fit: EllipsoidFit) -> Tensor:
        matrix = fit.calibration_matrix_ * (self.strength / float(fit.radius_))
        return torch.cat([fit.center_, torch.stack([matrix[i, j] for i, j in _SYMMETRIC]), fit.center_.new_zeros(3)])

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N 3"]:
        along = self._steadied(theta, self.corrected(theta, changes))
        middle = self._window_mean(along, self._weights(along.detach()))
        direction = middle / torch.linalg.vector_norm(middle, dim=-1, keepdim=True)
        strength, added = self._strength(theta), self._field_change(changes)
        ambient = (strength if added is None else strength + added) * direction[self.window]
        frame = _frame(direction.detach())[self.window]
        return torch.einsum("kij,kj->ki", frame, along - ambient)

    def _steadied(self, theta: Tensor, field: Tensor) -> Tensor:
        """The calibrated field in the axes of its window's first sample."""
        along = torch.einsum("kij,kj->ki", self.turned, field)
        # a bias b, small, turns what has been summed up since the window's first sample by the integral of turned · b
        return along - torch.linalg.cross(self.summed @ theta[9:12], along)

    def simulated(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "N 3"]:
        along = self._steadied(theta, self.corrected(theta, {}))
        middle = self._window_mean(along, self._weights(along.detach()))
        direction = middle / torch.linalg.vector_norm(middle, dim=-1, keepdim=True)
        field = torch.einsum("kij,ki->kj", self.turned, self._strength(theta) * direction[self.window])
        return torch.linalg.solve(self.matrix(theta), field.mT).mT

    def _window_mean(self, values: Tensor, weight: Tensor) -> Tensor:
        total = values.new_zeros(self.count, values.shape[-1]).index_add(0, self.window, weight * values)
        return total / weight.new_zeros(self.count, 1).index_add(0, self.window, weight)[:, :1]

    def _weights(self, along: Tensor) -> Tensor:
        """Of each sample in its window's mean: one step of Welsch's estimator from a Huber mean, as constants."""
        weight = along.new_ones(len(along), 1)
        for cut in (2.0, 1.0, 1.0):
            distance = torch.linalg.vector_norm(
                along - self._window_mean(along, weight)[self.window], dim=-1, keepdim=True
            )
            scale = distance.median() + 1e-9 * self.strength
            weight = 1.0 / torch.clamp(distance / (cut * scale), min=1.0).square()
        return weight


class MagnetometerCorrection:
    """``matrix @ (measured - change - offset)`` on any recording of the sensor.

    Args:
        state: of the view that was fitted.
        recording: with ``mag_x``, ``mag_y``, ``mag_z``.
    """

    def __init__(self, state: Mapping[str, Any], recording: Recording) -> None:
        if state.get("view") not in _MATRIX_OF_VIEW:
            raise ValueError(f"The model's view is {state.get('view')!r} and not one of {', '.join(_MATRIX_OF_VIEW)}.")
        self._matrix = _MATRIX_OF_VIEW[state["view"]]
        self.measured = recording.magnetometer()
        self.recording = recording
        known = recording.time
        self.time = torch.arange(len(recording), dtype=torch.float64) if known is None else known
        self.ports = {"sensor": Port(_AXES, recording.units["mag_x"])}

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        away = self.measured - theta[:3]
        if "sensor" in changes:
            away = away - changes["sensor"](away)
        field = away @ self._matrix(theta).mT
        time = {} if self.recording.time is None else {"time": self.recording.time}
        return time | dict(zip(("field_x", "field_y", "field_z"), field.unbind(-1), strict=True))


def _length(vectors: Float[Tensor, "3 N"]) -> Float[Tensor, " N"]:
    return vectors.square().sum(0).sqrt()


def _symmetric(theta: Tensor) -> Tensor:
    xx, yy, zz, xy, xz, yz = theta[3:9].unbind()
    return torch.stack([torch.stack([xx, xy, xz]), torch.stack([xy, yy, yz]), torch.stack([xz, yz, zz])])


def _inverse(theta: Tensor) -> Tensor:
    return torch.linalg.inv(theta[3:12].unflatten(0, (3, 3)))


_MATRIX_OF_VIEW = {"norm": _symmetric, "gyro": _symmetric, "attitude": _inverse}


def _frame(direction: Float[Tensor, "W 3"]) -> Float[Tensor, "W 3 3"]:
    """Orthonormal axes as rows, the first along each direction."""
    smallest = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction)
    second = torch.linalg.cross(direction, smallest)
    second = second / torch.linalg.vector_norm(second, dim=-1, keepdim=True)
    return torch.stack([direction, second, torch.linalg.cross(direction, second)], -2)


def _windows(time: Tensor) -> tuple[Tensor, Tensor]:
    """The window of each sample, and the first sample of that window; a gap of more than a window starts a new one."""
    number = torch.floor((time - time[0]) / WINDOW).long()
    _, window, counts = torch.unique_consecutive(number, return_inverse=True, return_counts=True)
    start = torch.cat([counts.new_zeros(1), counts.cumsum(0)[:-1]])
    return window, start[window]


def _matrix_prior(count: int) -> GaussianPrior:
    mean = torch.zeros(count, dtype=torch.float64)
    precision = torch.zeros(count, dtype=torch.float64)
    mean[3:12] = torch.eye(3, dtype=torch.float64).flatten()
    precision[3:12] = SOFT_IRON**-2
    return GaussianPrior(mean, precision)


def _bias_prior() -> GaussianPrior:
    mean = torch.zeros(12, dtype=torch.float64)
    precision = torch.zeros(12, dtype=torch.float64)
    precision[9:] = GYRO_BIAS**-2
    return GaussianPrior(mean, precision)


def _thinned(values: Float[Tensor, N * rest]) -> Float[Tensor, n * rest]:
    """Evenly, to as many samples as a place to start a fit from needs."""
    return values[:: max(1, len(values) // _ENOUGH)]


def _refuse_at_rest(measured: Tensor) -> None:
    """Refuse a sensor that does not turn: a ball of noise would pass for a small ellipsoid.

    Raises:
        NotIdentifiableError: the measurements lie close together, and those that follow one another no closer.
    """
    middle = measured.median(0).values
    spread = (measured - middle).square().sum(-1).median()
    apart = measured.diff(dim=0).square().sum(-1).median()
    if bool(spread < (_AT_REST * torch.linalg.vector_norm(middle)).square()) and bool(apart > 0.5 * spread):
        raise NotIdentifiableError(
            f"Not identifiable: the sensor is at rest, its measurements stay within {float(spread.sqrt()):.3g} of one "
            "another. Turn the sensor through all directions while recording."
        )


def _with_attitude(recording: Recording) -> Recording:
    """The samples that have an attitude; a quaternion of length zero is none."""
    length = torch.linalg.vector_norm(recording.stack(*_QUATERNION), dim=-1)
    columns = {
        name: torch.where(length > 0.0, values, torch.nan) if name in _QUATERNION else values
        for name, values in recording.columns.items()
    }
    marked = Recording(
        columns, name=recording.name, units=recording.units, warnings=recording.warnings, labels=recording.labels
    )
    return marked.finite(*_QUATERNION)


def _jumps(recording: Recording, to_world: Tensor) -> tuple[HeadingJump, ...]:
    """Of the heading, as far as the recording has a gyroscope that knows."""
    if recording.time is None or not all(name in recording for name in _GYRO):
        return ()
    return heading_jumps(recording.time, to_world, recording.stack(*_GYRO))


def _told(jumps: tuple[HeadingJump, ...], time: Tensor) -> tuple[str, ...]:
    """A sentence about the heading's jumps."""
    if not jumps:
        return ()
    told = ", ".join(
        f"by {jump.size:.1f}° at {float(time[jump.after]):.1f} s (gyroscope: {jump.turned:.1f}°)" for jump in jumps
    )
    return (
        f"The recorded heading jumps where the gyroscope does not: {told}. The attitude is off by as much, before or "
        "after, and an effect that seems to begin there may be that.",
    )


def _one_axis(to_world: Tensor) -> NotIdentifiableError:
    """The refusal of a recording that turns about one axis of the sensor alone, or not at all."""
    turned = (to_world - to_world.mean(0)).square().sum((0, 1))
    axis = _AXES[int(turned.argmin())]
    return NotIdentifiableError(
        f"Not identifiable: the sensor turns about its {axis} axis alone, or not at all, so the offset along +{axis} "
        "cannot be told from the field. Turn it about another axis too."
    )


def _summed(turned: Tensor, time: Tensor, first: Tensor) -> Tensor:
    """Integral of the rotation over time since the first sample of each window, (N, 3, 3), by trapezoids."""
    step = 0.5 * (turned[1:] + turned[:-1]) * time.diff()[:, None, None]
    total = torch.cat([torch.zeros_like(turned[:1]), step.cumsum(0)])
    # between windows the frames differ, but what was summed before a window's first sample is taken off
    return total - total[first]


def _response(measured: Tensor, turned: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Offset and response by reweighted least squares of the measurement on the turned field, near the identity."""
    response = torch.eye(3, dtype=turned.dtype)
    ridge = len(turned) * _RIDGE * turned.square().sum(-1).mean()
    for _ in range(_REWEIGHTED):
        left = torch.linalg.vector_norm(measured - offset - turned @ response.mT, dim=-1)
        scale = left.median().clamp(min=1e-9 * turned.abs().max())
        weight = torch.exp(-0.5 * (left / (2.0 * scale)).square()).unsqueeze(-1)
        regressors = torch.cat([turned, torch.ones_like(turned[:, :1])], -1)
        pull = torch.diag(torch.cat([ridge.expand(3), ridge.new_zeros(1)]))
        gram = regressors.mT @ (weight * regressors) + pull
        known = torch.cat([torch.eye(3, dtype=turned.dtype), turned.new_zeros(1, 3)])
        solved = torch.linalg.solve(gram, regressors.mT @ (weight * measured) + pull @ known)
        response, offset = solved[:3].mT, solved[3]
    return offset, response


def _turned_too_little(field: Tensor) -> tuple[str, ...]:
    found = coverage(field)
    if found.information >= MIN_INFORMATION:
        return ()
    missing = "; ".join(str(gap) for gap in found.gaps)
    return (
        "The ellipsoid alone is not identifiable from this recording; the attitude stands in for the missing turns"
        + (f". Directions not covered: {missing}." if missing else "."),
    )
