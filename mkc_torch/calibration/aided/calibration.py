"""Calibrate with a gyroscope, an attitude or the place's field, which replace the missing tilts."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.note import Note, notes_of, warnings_of
from mkc_torch.calibration.aided.by_place import chosen_by_place
from mkc_torch.calibration.aided.evidence import FittedResponse
from mkc_torch.calibration.aided.heading import heading_errors, turning_axis
from mkc_torch.calibration.aided.length_model import LengthModel
from mkc_torch.calibration.aided.misfit import robust_size
from mkc_torch.calibration.aided.mounting import mounting, nearest_rotation, without_exchange
from mkc_torch.calibration.aided.response import ERRORS, SOFT_IRON, PlaceField
from mkc_torch.calibration.aided.rotation import from_quaternion
from mkc_torch.calibration.aided.select_response import SelectedResponse, select_response
from mkc_torch.calibration.aided.start import offset_by_turns
from mkc_torch.calibration.aided.turns import Turns, still, turns_of_attitude, turns_of_gyroscope
from mkc_torch.calibration.aided_result import AidedResult
from mkc_torch.calibration.coverage import coverage
from mkc_torch.calibration.ellipsoid import axes_of
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.places import disturbed_places
from mkc_torch.calibration.plain_values import matrix_of, spread_of, vector_of
from mkc_torch.calibration.result import Calibration
from mkc_torch.calibration.runs import in_each_run, run_slices
from mkc_torch.calibration.turning import thin_at_rest
from mkc_torch.density import fit_density
from mkc_torch.density.tails import time_series_tails
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

GYRO = ("gyro_x", "gyro_y", "gyro_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
QUATERNION = ("q_w", "q_x", "q_y", "q_z")

MAX_HEADING_ERROR = 5.0
"""Largest standard error of heading changes, in °, of a calibration that is good enough for a compass."""

MAX_MISFIT = 0.1
"""Largest residual per axis, as a share of the field, of turns that agree with the field."""

HARDLY_TURNS = 0.1
"""Radius, as a share of the field, that holds half of the measurements of a sensor that has hardly turned."""

MAX_UNEXPLAINED = 0.3
"""Largest median residual before gains are fitted, as a share of the field; soft iron of 10 % and a bias of 1 °/s cause
0.1."""

_FEW = 1500
"""Number of samples on which that median is computed."""

_KNOWN = 0.5
"""Largest standard error, as a share of the prior's standard deviation, of a matrix entry that the data determine."""

_OFFSET_KNOWN = 0.25
"""Largest standard error of an offset that the data determine, as a share of the field."""

MISALIGNED = 3.0
"""Smallest angle in ° between the axes of two sensors that a warning reports."""

_REJECTED_BELOW = 0.5
"""Samples with a smaller weight count as rejected."""

_AXES = "xyz"


def aids(recording: Recording) -> tuple[str, ...]:
    """The aids in a recording that can replace tilts: attitude before gyroscope.

    Example:
        >>> aids(Recording({name: torch.zeros(3) for name in ("time", *GYRO)}))
        ('gyroscope',)
    """
    found = []
    if all(name in recording for name in QUATERNION):
        found.append("attitude")
    if recording.time is not None and all(name in recording for name in GYRO):
        found.append("gyroscope")
    return tuple(found)


def aided_calibration(
    recording: Recording, by: str, *, field_strength: float | None = None, place: PlaceField | None = None
) -> Calibration:
    """Calibrate a sensor that hardly tilts by its recorded turns or by the place's field.

    The measurement is ``offset + response @ field``. The field is constant in the world frame; with a gyroscope it is
    constant for ten seconds or half a turn, once rotated by the integrated rates. Offset, response and the gyroscope's
    errors are fitted jointly by maximum likelihood of the MKC density. Of three responses, a multiple of the identity,
    a diagonal and a full matrix, the response with the most evidence is selected. Parameters that the recording does
    not determine keep their prior values, zero offset and the unit matrix, and have no standard error.

    Args:
        recording: recording as prepared for a calibration.
        by: "attitude", "gyroscope" or "place".
        field_strength: length of the corrected field in µT; default the geometric mean of the semi-axes.
        place: prior of the field in the recording's unit; required for "place".

    Raises:
        NotIdentifiableError: the turns do not explain the field, or leave a heading uncertain by more than 5°.

    References:
        Kok & Schön, "Magnetometer calibration using inertial sensors", IEEE Sensors Journal 16 (2016); Wu, Zou, Liu &
        Hu, "Dynamic magnetometer calibration and alignment to inertial sensors by Kalman filtering", IEEE Transactions
        on Control Systems Technology 26 (2018), for what a gyroscope determines.
    """
    usable = recording if by == "place" else recording.finite(*(QUATERNION if by == "attitude" else GYRO))
    upwards = None if place is None else _upwards(usable, by)
    points, runs = usable.magnetometer(), run_slices(usable)
    taken = in_each_run(points, runs, thin_at_rest)
    assert taken is not None
    moved = taken.nonzero().flatten()
    if by == "place":
        assert place is not None
        whole = still(len(points))
        chosen = chosen_by_place(points, taken, place)
    elif by == "attitude":
        whole = turns_of_attitude(usable.stack(*QUATERNION))
        _refuse_other_turns(points[moved], whole.rows(moved), by)
        chosen = select_response(points, lambda _: whole, taken, place=place, upwards=upwards)
    else:
        assert usable.time is not None
        at = partial(turns_of_gyroscope, usable.time, usable.stack(*GYRO), runs)
        _refuse_other_turns(points[moved], at(points.new_zeros(ERRORS)).rows(moved), by)
        chosen = select_response(points, at, taken, place=place, upwards=upwards)
        whole = at(chosen.errors)
    best = chosen.best
    theta, model = best.fit.theta, best.model
    response = model.response(theta)
    # the second channel holds tilts, which are not a misfit
    off = best.fit.residual[:, :1] if by == "place" else best.fit.residual
    misfit = robust_size(off) / float(torch.linalg.det(response).abs()) ** (1.0 / 3.0)
    if misfit > MAX_MISFIT:
        reason = (
            "the measurements do not have the length of the place's field"
            if by == "place"
            else f"the {by} does not turn like the field"
        )
        advice = (
            "Check the place and the unit."
            if by == "place"
            else "Check that both belong to the same sensor and the same times."
        )
        raise NotIdentifiableError(
            f"Not identifiable: {reason}; the residual in each axis is {100.0 * misfit:.0f} % of the field, more than "
            f"{100.0 * MAX_MISFIT:.0f} %. {advice}"
        )
    errors = _heading(chosen, points, whole, usable, by)
    if errors[0] > MAX_HEADING_ERROR:
        raise NotIdentifiableError(
            f"Not identifiable: with the {by} the standard error of a heading is {errors[0]:.0f}°, more than "
            f"{MAX_HEADING_ERROR:g}°. Turn the vehicle about its vertical axis, at least once round."
        )
    return _result(usable, chosen, whole, by, errors, field_strength)


def _upwards(usable: Recording, by: str) -> Float[Tensor, " 3"] | None:
    """The mean upward direction in the body's axes, by an attitude or an accelerometer; None without either."""
    if by == "attitude":
        return torch.nn.functional.normalize(from_quaternion(usable.stack(*QUATERNION))[:, 2, :].mean(0), dim=0)
    if not all(name in usable for name in ACCEL):
        return None
    return torch.nn.functional.normalize(usable.stack(*ACCEL).nanmedian(0).values, dim=0)


def _refuse_other_turns(points: Tensor, turns: Turns, by: str) -> None:
    """Reject turns that disagree with the field, before anything is fitted to them.

    Raises:
        NotIdentifiableError: with the probable reason.
    """
    few = torch.arange(0, len(points), max(1, len(points) // _FEW))
    points, turns = points[few], turns.rows(few)
    _, length, misfit = offset_by_turns(points, turns)
    reach = float(torch.linalg.vector_norm(points - points.median(0).values, dim=-1).median())
    if reach < HARDLY_TURNS * length:
        raise NotIdentifiableError(
            f"Not identifiable: half of the measurements are within {100.0 * reach / length:.0f} % of the field of a "
            "single value. Turn the vehicle about its vertical axis, at least once round."
        )
    if misfit <= MAX_UNEXPLAINED * length:
        return
    # a single window, because the offset is constant
    found = mounting(points, turns, torch.zeros_like(turns.window), length, by)
    if found is not None:
        reason = f"{found.sentence} Correct that to use it."
    elif by == "gyroscope":
        reason = "Check that the rates are in rad/s and belong to this sensor."
    else:
        reason = (
            "Check that the quaternions rotate the body to the world frame, are in the order w, x, y, z, and belong to "
            "this sensor."
        )
    raise NotIdentifiableError(
        f"Not identifiable: the {by} does not turn like the field; the residual of half of the samples is "
        f"{100.0 * misfit / length:.0f} % of the field or more. {reason}"
    )


def _heading(chosen: SelectedResponse, points: Tensor, whole: Turns, usable: Recording, by: str) -> tuple[float, float]:
    best = chosen.full
    theta = best.fit.theta
    if isinstance(best.model, LengthModel):
        vertical = torch.nn.functional.normalize(best.model.response(theta).mT @ best.model.circle.axis, dim=0)
    elif by == "attitude":
        vertical = torch.nn.functional.normalize(whole.to_frame[chosen.rows][:, 2, :].mean(0), dim=0)
    else:
        vertical = turning_axis(usable.stack(*GYRO)[chosen.rows] - chosen.errors[:3])
    field = torch.linalg.solve(best.model.response(theta), (points[chosen.rows] - theta[:3]).mT).mT
    return heading_errors(best.model, theta, best.covariance, field, vertical)


def _result(
    usable: Recording,
    chosen: SelectedResponse,
    whole: Turns,
    by: str,
    errors: tuple[float, float],
    field_strength: float | None,
) -> Calibration:
    best, points = chosen.best, usable.magnetometer()
    theta = best.fit.theta
    root = torch.linalg.inv(best.model.response(theta))
    semi_axes, rotation = axes_of(root.mT @ root)
    radius = float(semi_axes.log().mean().exp())
    strength = radius if field_strength is None else field_strength
    field = (points - theta[:3]) @ root.mT

    # errors of the full matrix: a simpler response is more likely, but not certain
    full = chosen.full

    def derived(at: Tensor) -> Tensor:
        inverse = torch.linalg.inv(full.model.response(at))
        size = torch.linalg.det(inverse).abs().pow(-1.0 / 3.0)
        axes = torch.linalg.eigvalsh(inverse.mT @ inverse).flip(-1).rsqrt()
        return torch.cat([at[:3], axes * size.reciprocal(), (size * inverse).flatten()])

    with torch.enable_grad():
        slopes = torch.autograd.functional.jacobian(derived, full.fit.theta)
    covariance = full.covariance if chosen.side_covariance is None else full.covariance + chosen.side_covariance
    spread = torch.einsum("ip,pq,iq->i", slopes, covariance, slopes).clamp(min=0.0).sqrt()
    unknown = torch.cat([spread[:3] > _OFFSET_KNOWN * radius, spread[3:] > _KNOWN * SOFT_IRON])
    known = torch.where(unknown, torch.inf, spread)
    names = [f"offset_{a}" for a in _AXES] + [""] * 3 + [f"matrix_{a}{b}" for a in _AXES for b in _AXES]
    residual = best.model.residual(
        torch.cat([theta[:-ERRORS], torch.zeros(ERRORS, dtype=theta.dtype)]) if best.model.biased else theta,
        points,
        whole,
        _weights(chosen, points, whole),
    )
    weight = torch.exp(-0.5 * (residual / (best.fit.d * best.fit.sigma)).square())
    weight = (weight[:, :1] if by == "place" else weight).amin(-1)
    rejected = weight < _REJECTED_BELOW
    length = torch.linalg.vector_norm(field, dim=-1)
    norm = torch.linalg.vector_norm(points, dim=-1)
    algebraic = (length.square() - 1.0).unsqueeze(-1)
    density = fit_density(algebraic)
    found = coverage(field[~rejected] if bool((~rejected).any()) else field)
    unit = usable.units["mag_x"]
    bias = chosen.errors[:3] if best.model.biased else None
    bias_se = full.covariance.diagonal()[-ERRORS:][:3].sqrt()
    turned = _misaligned(best, spread, by)
    return Calibration(
        recording=usable.name,
        samples=len(points),
        unit=unit,
        center=vector_of(theta[:3]),
        center_se=vector_of(known[:3]),
        semi_axes=vector_of(semi_axes),
        semi_axes_se=vector_of(radius * known[3:6]),
        rotation=matrix_of(rotation),
        matrix=matrix_of(strength * root),
        matrix_se=matrix_of((strength / radius) * known[6:].unflatten(0, (3, 3))),
        radius=radius,
        field_strength=strength,
        field_unit=unit if field_strength is None else "µT",
        sigma=float(density.sigma),
        d=float(density.d),
        bound=float(density.bound),
        before=spread_of(norm - norm.median()),
        after=spread_of(radius * (length - 1.0)),
        rejected=int(rejected.sum()),
        disturbed=disturbed_places(usable, rejected),
        disturbed_unit="row" if usable.time is None else "s",
        coverage=found,
        warnings=(*warnings_of(turned), *usable.warnings),
        notes=(*usable.notes, *notes_of(turned)),
        aid=AidedResult(
            by=by,
            response=best.model.name,
            evidence=tuple((name, value - best.evidence) for name, value in chosen.tried.items()),
            undetermined=tuple(n for n, u in zip(names, unknown.tolist(), strict=True) if n and u),
            heading_error=errors[0],
            constant_error=math.inf if by == "place" else errors[1],
            gyro_bias=None if bias is None else vector_of(bias),
            gyro_bias_se=None if bias is None else vector_of(bias_se),
        ),
        tails=next(iter(time_series_tails(algebraic)), None),
    )


def _misaligned(best: FittedResponse, spread: Tensor, by: str) -> tuple[str, ...]:
    """A warning about exchanged axes of the magnetometer, or a note on axes that the matrix turns back."""
    sentence, response = without_exchange(best.model.response(best.fit.theta), by)
    if sentence:
        return (f"{sentence} The matrix corrects this: the corrected field is in the axes of the {by}.",)
    angle, axis = nearest_rotation(response)
    sure = math.degrees(float(spread[6:].square().mean().sqrt()))
    if best.model.name != "full matrix" or angle < max(MISALIGNED, 3.0 * sure):
        return ()
    x, y, z = axis.tolist()
    about = f"({x:+.2f}, {y:+.2f}, {z:+.2f})"
    return (
        Note(
            f"The magnetometer seems to be turned by {angle:.1f}° about {about} against the {by}; the matrix turns it "
            "back."
        ),
    )


def _weights(chosen: SelectedResponse, points: Tensor, whole: Turns) -> Float[Tensor, " N"]:
    """Weights of all samples in the mean direction of their window, (N,)."""
    theta, model = chosen.best.fit.theta, chosen.best.model
    at = torch.cat([theta[:-ERRORS], torch.zeros(ERRORS, dtype=theta.dtype)]) if model.biased else theta
    return model.first_weight(at, points, whole)
