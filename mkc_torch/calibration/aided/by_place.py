"""Fit the response of a sensor that turned about the vertical, given only the field of the place."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.evidence import FittedResponse, judged
from mkc_torch.calibration.aided.length_model import LEVEL, Circle, LengthModel, circle
from mkc_torch.calibration.aided.response import ERRORS, SOFT_IRON, Model, PlaceField
from mkc_torch.calibration.aided.select_response import NAMES, SelectedResponse, rows_of
from mkc_torch.calibration.aided.turns import still
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_MOST_OFF = 3.0 * SOFT_IRON
"""Largest relative difference of the circle's radius from the horizontal field of the place: three standard deviations
of gains and soft iron."""

_CLEARLY = 5.0
"""Advantage in log evidence, in nats, that a simpler response needs over the full matrix, whose prior near the unit
matrix costs little; set on the example's seeds 0 to 29."""

_SURE = 12.0
"""Advantage in log evidence, in nats, from which the side of the circle on which the field lies is certain.
Disturbances added up to ten on draws 100,100 to 100,240 of the example, to either side by chance."""

_REJECTED_BELOW = 0.5
"""Samples with a smaller weight count as rejected."""


def chosen_by_place(measured: Float[Tensor, "N 3"], taken: Tensor, place: PlaceField) -> SelectedResponse:
    """Fit the three responses with the length of the place's field, and select the response with the most evidence.

    The turns are assumed to be about the vertical: the measurements form a circle, whose radius is the horizontal field
    and which lies above or below the offset by the vertical field. Tilts of the vehicle show on which side.

    Args:
        measured: measurements in the order of time.
        taken: mask (N,) of the samples in use; rests are thinned.
        place: the field, in the same unit.

    Raises:
        NotIdentifiableError: the measurements do not form a circle of the radius of the place's horizontal field.
    """
    rows = rows_of(taken)
    points = measured[rows]
    drawn = circle(points)
    _refuse_other_width(drawn, place)
    first = []
    for sign in (1.0, -1.0):
        with suppress(NoFitError):
            first.append(_first(_model(drawn, place, sign), points, place))
    if not first:
        raise NotIdentifiableError(
            "Not identifiable: no ellipsoid with about the field of the place fits the measurements."
        )
    # the residuals of the wrong side are correlated for longer and would be inflated more
    best = max(first, key=lambda fitted: float(fitted.fit.log_likelihood))
    counted = max(best.inflation, _burst(best.fit.weights[:, 0] < _REJECTED_BELOW))
    sides = []
    for fitted in first:
        with suppress(NoFitError):  # residuals beyond the bound of the better side's density
            sides.append(_judged(fitted.model, fitted.fit.theta, points, place, best.fit.bound, counted))
    full = max(sides, key=lambda fitted: fitted.evidence)
    model = full.model
    assert isinstance(model, LengthModel)
    judgements = [full]
    for name in NAMES[:-1]:
        simpler = replace(model, name=name)
        start = simpler.start(full.fit.theta[:3], model.response(full.fit.theta))
        with suppress(NoFitError):
            judgements.append(_judged(simpler, start, points, place, best.fit.bound, counted))
    selected = max(judgements, key=lambda fitted: fitted.evidence - (0.0 if fitted is full else _CLEARLY))
    return SelectedResponse(
        selected,
        full,
        {fitted.model.name: fitted.evidence for fitted in judgements},
        still(len(points)),
        rows,
        points.new_zeros(ERRORS),
        torch.stack([_either_side(full, fitted) for fitted in sides]).sum(0),
    )


def _refuse_other_width(drawn: Circle, place: PlaceField) -> None:
    """Reject a circle that does not come from turns about the vertical in the field of the place."""
    level = place.strength * math.cos(place.inclination)
    leaning = math.hypot(LEVEL, place.inclination_error) * abs(math.sin(place.inclination))
    if abs(drawn.radius - level) <= _MOST_OFF * level + 3.0 * leaning * place.strength:
        return
    raise NotIdentifiableError(
        f"Not identifiable: the measurements form a circle of radius {drawn.radius:.3g} µT, but the horizontal field "
        f"of the place is {level:.3g} µT. Turn the vehicle about its vertical axis, at least once round; check the "
        "place and the unit."
    )


def _model(drawn: Circle, place: PlaceField, sign: float) -> LengthModel:
    """The full matrix model, with the vertical field on the given side of the circle."""
    error = math.hypot(LEVEL, place.inclination_error)
    rises = sign * place.inclination
    return LengthModel("full matrix", place.strength, biased=False, circle=drawn, rises=rises, rises_error=error)


def _first(model: LengthModel, points: Tensor, place: PlaceField) -> FittedResponse:
    """Fit the full matrix, starting from a fit of the offset: a flat response would fit disturbances as tilts."""
    offset = model.circle.center - math.sin(model.rises) * model.scale * model.circle.axis
    alone = replace(model, name="offset")
    start = alone.start(offset, model.scale * torch.eye(3, dtype=points.dtype))
    rough = _judged(alone, start, points, place)
    start = model.start(rough.fit.theta[:3], alone.response(rough.fit.theta))
    return _judged(model, start, points, place, None, rough.inflation)


def _judged(
    model: Model,
    start: Tensor,
    points: Tensor,
    place: PlaceField,
    bound: Tensor | None = None,
    inflation: float | None = None,
) -> FittedResponse:
    weight = points.new_ones(len(points))
    return judged(model, start, points, still(len(points)), weight, place=place, bound=bound, inflation=inflation)


def _burst(rejected: Bool[Tensor, " N"]) -> float:
    """Mean length of the bursts of rejected samples, weighted by samples; a burst is a single disturbance.

    Example:
        >>> _burst(torch.tensor([True, False, True, True, True, False]))
        2.5
    """
    _, lengths = torch.unique_consecutive(rejected, return_counts=True)
    runs = lengths[int(not rejected[0]) :: 2].double()
    return float(runs.square().sum() / runs.sum()) if len(runs) else 1.0


def _either_side(full: FittedResponse, other: FittedResponse) -> Float[Tensor, "p p"]:
    """Addition to the covariance because the field may be on the other side of the circle, (p, p)."""
    if full.evidence - other.evidence > _SURE:
        return torch.zeros_like(full.covariance)
    apart = full.fit.theta - other.fit.theta
    return 0.25 * torch.outer(apart, apart)
