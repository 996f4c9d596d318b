"""Which view of a magnetometer's recording is compared: by what each leaves of the field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

from mkc_torch.calibration.aided.fault import LAG, Fault, mend_of_attitude, mend_of_gyroscope
from mkc_torch.calibration.aided.misfit import left_by_attitude, left_by_gyroscope, robust_size, stretches
from mkc_torch.calibration.calibrate import prepared
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.attitude import AttitudeView, with_attitude
from mkc_torch.simulation.magnetometer.gyro import GyroView
from mkc_torch.simulation.magnetometer.norm import NormView
from mkc_torch.simulation.magnetometer.view import GYRO, QUATERNION, View

__all__ = ["chosen_view", "requested_view"]

V = TypeVar("V", bound=View)

TIMES_THE_LENGTH = 3.0
"""Times what the length leaves, from which turns are looked into: noise of the sensor is the same in both."""

DOUBTFUL = 0.03
"""Share of the field, which is the angle in rad, by which turns may be off unasked: two degrees, what the gain of a
gyroscope makes of two seconds, or an attitude's filter of a calm flight. Beyond, a reason is sought; turns with one
are not used."""

USELESS = 0.1
"""Share of the field from which turns are not used, reason or not: six degrees, what filters do not reach but where
something is wrong. At twice that an error of the angle shows along the field too, where it passes for the sensor's."""


def chosen_view(recording: Recording) -> NormView | AttitudeView | GyroView:
    """The attitude's view where there is one, the length's, or the gyroscope's where the length determines nothing.

    Turns that leave far more of the field than its length does are not used, where the length determines the sensor,
    alone or together with what changes it; a warning says so, and what seems to be wrong with them. An attitude may be
    off by its own noise, and a change of the sensor is left in every view: neither is a reason.

    Raises:
        NotIdentifiableError: no view determines the sensor.
    """
    if all(name in recording for name in QUATERNION):
        return _attitude_or_length(recording)
    if recording.time is None or not all(name in recording for name in GYRO):
        return NormView(prepared(recording))
    return _length_or_gyroscope(recording)


def requested_view(recording: Recording, use: str) -> NormView | AttitudeView | GyroView:
    """The attitude's view, the gyroscope's or the length's, as it is asked for.

    Turns that leave far more of the field than its length does are told in the view's ``wrong_turns``.

    Raises:
        NotIdentifiableError: that view does not determine the sensor.
    """
    if use == "norm":
        return NormView(prepared(recording))
    if use == "attitude":
        usable = prepared(with_attitude(recording))
        return _compared_by_attitude(usable, AttitudeView(usable), _length(usable)).told()
    usable = prepared(recording.finite(*GYRO))
    return _compared_by_gyroscope(usable, GyroView(usable), _length(usable)).told()


def _attitude_or_length(recording: Recording) -> NormView | AttitudeView:
    usable = prepared(with_attitude(recording))
    length = _length(usable)
    try:
        view = AttitudeView(usable)
    except NotIdentifiableError as error:
        if length is None:
            raise
        # an attitude that stands still says nothing of a sensor that turns
        return _warned(length, f"The attitude is left out, for it does not turn as the field does. {error}")
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
    """A view by turns beside the length; what both leave."""

    what: str
    view: V
    length: NormView | None
    left: float
    mend: Callable[[], Fault | None]

    def settled(self) -> V | NormView:
        """The view, or the length where the view's turns are wrong; with a warning of turns that are."""
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

    def told(self) -> V:
        """The view, which knows what is wrong with its turns."""
        fault = self.fault()
        self.view.wrong_turns = fault[:1].upper() + fault[1:]
        return self.view

    def fault(self) -> str:
        """What is wrong with the turns, as sentences; empty where nothing is."""
        known, unit = self.view if self.length is None else self.length, self.view.unit
        most = USELESS * known.strength
        if self.length is not None and self.left < TIMES_THE_LENGTH * _left(self.length):
            return ""
        if self.left < (most if self.length is None else DOUBTFUL * known.strength):
            return ""
        reason = self.mend()
        if reason is None and self.left < most:
            return ""
        beside = "" if self.length is None else f", of the length {_two(_left(self.length))} {unit}"
        return (
            f"with the {self.what} {_two(self.left)} {unit} of the field of {_two(known.strength)} {unit} are left in "
            f"each axis{beside}. {_reason(self.what, reason, unit)}"
        )


def _compared_by_attitude(usable: Recording, view: AttitudeView, length: NormView | None) -> _Compared[AttitudeView]:
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_left(view), left_by_attitude(unbent, view.to_world, stretches(view.time)))

    def mend() -> Fault | None:
        return mend_of_attitude(_calibrated(view, length), view.time, usable.stack(*QUATERNION), left)

    return _Compared("attitude", view, length, left, mend)


def _compared_by_gyroscope(usable: Recording, view: GyroView, length: NormView | None) -> _Compared[GyroView]:
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_left(view), left_by_gyroscope(unbent, view.turned, view.window, stretches(view.time)))

    def mend() -> Fault | None:
        rate = usable.stack(*GYRO)
        return mend_of_gyroscope(_calibrated(view, length), view.time, rate, view.window, view.first, left)

    return _Compared("gyroscope", view, length, left, mend)


def _length(recording: Recording) -> NormView | None:
    try:
        return NormView(prepared(recording), sphere=True)
    except NotIdentifiableError:
        return None


def _left(view: View) -> float:
    return robust_size(view.residual(view.start(), {}))


def _matrix(view: View, length: NormView | None) -> Tensor:
    """The calibration matrix of the length, which no wrong turn spoils; without a length, that of the view."""
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


def _reason(what: str, mend: Fault | None, unit: str) -> str:
    if mend is None:
        return (
            f"{_TRIED[what]} nor a shift in time of up to {LAG:g} s mends it; see that it is of this recording and of "
            "this sensor."
        )
    return f"{mend.sentence} Without that {_two(mend.left)} {unit} would be left; mend it to use it."


def _two(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):.10g}"
