"""Which view of a magnetometer's recording is compared: by what each leaves of the field."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from torch import Tensor

from mkc_torch.calibration.calibrate import prepared
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer.attitude import AttitudeView, with_attitude
from mkc_torch.simulation.magnetometer.gyro import GyroView
from mkc_torch.simulation.magnetometer.mend import LAG, Mend, mend_of_attitude, mend_of_gyroscope
from mkc_torch.simulation.magnetometer.misfit import left_by_attitude, left_by_gyroscope, robust_size, stretches
from mkc_torch.simulation.magnetometer.norm import NormView
from mkc_torch.simulation.magnetometer.view import GYRO, QUATERNION, View

__all__ = ["chosen_view"]

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
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_left(view), left_by_attitude(unbent, view.to_world, stretches(view.time)))

    def mend() -> Mend | None:
        return mend_of_attitude(_calibrated(view, length), view.time, usable.stack(*QUATERNION), left)

    return _settled("attitude", view, length, left, mend)


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
    unbent = view.measured @ _matrix(view, length).mT
    left = min(_left(view), left_by_gyroscope(unbent, view.turned, view.window, stretches(view.time)))

    def mend() -> Mend | None:
        rate = usable.stack(*GYRO)
        return mend_of_gyroscope(_calibrated(view, length), view.time, rate, view.window, view.first, left)

    return _settled("gyroscope", view, length, left, mend)


def _settled(what: str, view: V, length: NormView | None, left: float, mend: Callable[[], Mend | None]) -> V | NormView:
    """The view, or the length where the view's turns are wrong; with a warning of turns that are."""
    if length is None:
        if left < USELESS * view.strength:
            return view
        return _warned(
            view,
            f"The {what} hardly explains the field, but its length alone does not determine the sensor either: with "
            f"the {what} {_two(left)} {view.unit} of {_two(view.strength)} {view.unit} are left in each axis, so what "
            f"is found here need not hold. {_reason(what, mend(), view.unit)}",
        )
    if left < TIMES_THE_LENGTH * _left(length) or left < DOUBTFUL * length.strength:
        return view
    reason = mend()
    if reason is None and left < USELESS * length.strength:
        return view
    return _warned(
        length,
        f"The {what} is left out and the field's length is compared alone: with the {what} {_two(left)} {length.unit} "
        f"of the field of {_two(length.strength)} {length.unit} are left in each axis, of the length "
        f"{_two(_left(length))} {length.unit}. {_reason(what, reason, length.unit)}",
    )


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


def _reason(what: str, mend: Mend | None, unit: str) -> str:
    if mend is None:
        return (
            f"{_TRIED[what]} nor a shift in time of up to {LAG:g} s mends it; see that it is of this recording and of "
            "this sensor."
        )
    return f"{mend.sentence} Without that {_two(mend.left)} {unit} would be left; mend it to use it."


def _two(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):.10g}"
