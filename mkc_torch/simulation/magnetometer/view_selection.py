"""Selection of the view by which a magnetometer is compared, by the residuals of the views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from mkc_torch.calibration.aided.fault import LAG, Fault, attitude_fault, gyroscope_fault
from mkc_torch.calibration.aided.misfit import misfit_of_attitude, misfit_of_gyroscope, robust_size, stretches
from mkc_torch.calibration.calibrate import prepared
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.attitude import AttitudeView, with_attitude
from mkc_torch.simulation.magnetometer.gyro import GyroView
from mkc_torch.simulation.magnetometer.norm import NormView
from mkc_torch.simulation.magnetometer.view import GYRO, QUATERNION, View

V = TypeVar("V", bound=View)

TIMES_THE_LENGTH = 3.0
"""Ratio to the residual of the length from which turns are checked; the sensor's noise is the same in both."""

DOUBTFUL = 0.03
"""Residual, as a share of the field or an angle in rad, up to which turns are not checked: 2°, the error of a
gyroscope's gain over 2 s, or of an attitude filter in a calm flight. Above it a fault is searched; turns with a fault
are not used."""

USELESS = 0.1
"""Residual, as a share of the field, from which turns are not used even without a fault: 6°, which filters reach only
if something is wrong. At twice this, errors of the angle also appear along the field, like errors of the sensor."""


def chosen_view(recording: Recording) -> NormView | AttitudeView | GyroView:
    """The attitude's view if there is an attitude, else the length's, or the gyroscope's if the length is insufficient.

    Turns with a far larger residual than the length's are not used if the length determines the sensor, alone or
    together with a change of it; a warning states the probable fault of the turns. Noise of the attitude, and a change
    of the sensor, which is in the residual of every view, are no reasons to exclude turns.

    Raises:
        NotIdentifiableError: no view determines the sensor.
    """
    if all(name in recording for name in QUATERNION):
        return _attitude_or_length(recording)
    if recording.time is None or not all(name in recording for name in GYRO):
        return NormView(prepared(recording))
    return _length_or_gyroscope(recording)


def requested_view(recording: Recording, use: str) -> NormView | AttitudeView | GyroView:
    """The view ``use``: "attitude", "gyro" or "norm", the length.

    The fault of turns with a far larger residual than the length's is in the view's ``faults``.

    Raises:
        NotIdentifiableError: this view does not determine the sensor.
    """
    if use == "norm":
        return NormView(prepared(recording))
    if use == "attitude":
        usable = prepared(with_attitude(recording))
        return _compared_by_attitude(usable, AttitudeView(usable), _length(usable)).with_fault()
    usable = prepared(recording.finite(*GYRO))
    return _compared_by_gyroscope(usable, GyroView(usable), _length(usable)).with_fault()


def _attitude_or_length(recording: Recording) -> NormView | AttitudeView:
    usable = prepared(with_attitude(recording))
    length = _length(usable)
    try:
        view = AttitudeView(usable)
    except NotIdentifiableError as error:
        if length is None:
            raise
        # a constant attitude has no information on a sensor that turns
        return _warned(length, f"The attitude is left out, because it does not turn as the field does. {error}")
    return _compared_by_attitude(usable, view, length).settled()


def _length_or_gyroscope(recording: Recording) -> NormView | GyroView:
    length = _length(prepared(recording))
    if length is not None and length.alone:
        return length
    usable = prepared(recording.finite(*GYRO))
    try:
        view = GyroView(usable)
    except NotIdentifiableError:
        if length is None:
            raise
        return length
    return _compared_by_gyroscope(usable, view, length).settled()


@dataclass(frozen=True)
class _Compared(Generic[V]):
    """A view by turns, and the length's view to compare it with."""

    what: str
    view: V
    length: NormView | None
    residual: float
    find_fault: Callable[[], Fault | None]

    def settled(self) -> V | NormView:
        """The view, or the length's view if the turns have a fault, with a warning about the fault."""
        fault = self.fault()
        if not fault:
            return self.view
        if self.length is None:
            return _warned(
                self.view,
                f"The {self.what} hardly explains the field, but its length alone does not determine the sensor "
                f"either: {fault}",
            )
        return _warned(self.length, f"The {self.what} is left out and the field's length is compared alone: {fault}")

    def with_fault(self) -> V:
        """The view, with the fault of its turns in ``faults``."""
        fault = self.fault()
        self.view.faults = (fault[:1].upper() + fault[1:],) if fault else ()
        return self.view

    def fault(self) -> str:
        """Sentences about the fault of the turns; empty if there is no fault."""
        known, unit = self.view if self.length is None else self.length, self.view.unit
        limit = USELESS * known.strength
        if self.length is not None and self.residual < TIMES_THE_LENGTH * _residual_size(self.length):
            return ""
        if self.residual < (limit if self.length is None else DOUBTFUL * known.strength):
            return ""
        reason = self.find_fault()
        if reason is None and self.residual < limit:
            return ""
        length = "" if self.length is None else f", with the length {_two_digits(_residual_size(self.length))} {unit}"
        return (
            f"with the {self.what} the residual in each axis is {_two_digits(self.residual)} {unit} of the field of "
            f"{_two_digits(known.strength)} {unit}{length}. {_reason(self.what, reason, unit)}"
        )


def _compared_by_attitude(usable: Recording, view: AttitudeView, length: NormView | None) -> _Compared[AttitudeView]:
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_residual_size(view), misfit_of_attitude(unbent, view.to_world, stretches(view.time)))

    def find_fault() -> Fault | None:
        return attitude_fault(_calibrated(view, length), view.time, usable.stack(*QUATERNION), left)

    return _Compared("attitude", view, length, left, find_fault)


def _compared_by_gyroscope(usable: Recording, view: GyroView, length: NormView | None) -> _Compared[GyroView]:
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_residual_size(view), misfit_of_gyroscope(unbent, view.turned, view.window, stretches(view.time)))

    def find_fault() -> Fault | None:
        rate = usable.stack(*GYRO)
        return gyroscope_fault(_calibrated(view, length), view.time, rate, view.window, view.first, left)

    return _Compared("gyroscope", view, length, left, find_fault)


def _length(recording: Recording) -> NormView | None:
    try:
        return NormView(prepared(recording), sphere=True)
    except NotIdentifiableError:
        return None


def _residual_size(view: View) -> float:
    return robust_size(view.residual(view.start(), {}))


def _matrix(view: View, length: NormView | None) -> Tensor:
    """The calibration matrix of the length's view, which wrong turns do not affect; without a length, of the view."""
    known = view if length is None else length
    return known.matrix(known.start())


def _calibrated(view: View, length: NormView | None) -> Tensor:
    offset = (view if length is None else length).start()[:3]
    return (view.measured - offset) @ _matrix(view, length).mT


def _warned(view: V, sentence: str) -> V:
    view.warnings = (sentence, *view.warnings)
    return view


_TRIED = {
    "attitude": "Neither its inverse, another order of the quaternion",
    "gyroscope": "Neither another sign, degrees for radians, other axes",
}
"""Corrections that were tried, except shifts in time."""


def _reason(what: str, fault: Fault | None, unit: str) -> str:
    if fault is None:
        return (
            f"{_TRIED[what]} nor a shift in time of up to {LAG:g} s corrects it; check that it belongs to this "
            "recording and this sensor."
        )
    size = f"{_two_digits(fault.left)} {unit}"
    return f"{fault.sentence} Without this fault the residual would be {size}; correct it to use it."


def _two_digits(value: float) -> str:
    """A number to two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):.10g}"
