"""The response of a sensor that turned about the vertical, by the field of the place alone."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.choose import NAMES, SelectedResponse, rows_of
from mkc_torch.calibration.aided.evidence import FittedResponse, judged
from mkc_torch.calibration.aided.lengths import LEVEL, Circle, LengthModel, circle
from mkc_torch.calibration.aided.response import ERRORS, SOFT_IRON, Model, PlaceField
from mkc_torch.calibration.aided.turns import still
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["chosen_by_place"]

_MOST_OFF = 3.0 * SOFT_IRON
"""Share by which the circle may be wider or narrower than the field of the place makes it: gains and soft iron are off
by a third of that."""

_CLEARLY = 5.0
"""Nats by which a simpler response has to be likelier than the full matrix, which costs little, as it is near the unit
matrix beforehand; set on the example's seeds 0 to 29."""

_SURE = 12.0
"""Nats from which it is known to which side of the circle the field stands: disturbances were worth up to ten on draws
100,100 to 100,240 of the example, to whatever side they happened to fit."""

_REJECTED_BELOW = 0.5
"""A sample of less than this weight counts as rejected."""


def chosen_by_place(measured: Float[Tensor, "N 3"], taken: Tensor, place: PlaceField) -> SelectedResponse:
    """Fit the three responses so that the field has the length of the place's, and keep the one with most evidence.

    The turns are taken to be about the vertical, so that the circle of the measurements has the field's horizontal part
    for its radius and stands above or below the offset by the vertical one. Which of the two shows where the vehicle
    tilts.

    Args:
        measured: in one unit, in the order of time.
        taken: (N,), which samples may count: of a rest a few.
        place: the field, in the same unit.

    Raises:
        NotIdentifiableError: the measurements draw no circle of the width that the field of the place has.
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
            "Not identifiable: no ellipsoid near the field of the place goes through the measurements."
        )
    # the errors of the wrong side follow one another for longer, and each would count for less
    best = max(first, key=lambda one: float(one.fit.log_likelihood))
    counted = max(best.inflation, _burst(best.fit.weights[:, 0] < _REJECTED_BELOW))
    sides = []
    for one in first:
        with suppress(NoFitError):  # what leaves more than the density of the other reaches over
            sides.append(_judged(one.model, one.fit.theta, points, place, best.fit.bound, counted))
    full = max(sides, key=lambda one: one.evidence)
    model = full.model
    assert isinstance(model, LengthModel)
    judgements = [full]
    for name in NAMES[:-1]:
        simpler = replace(model, name=name)
        start = simpler.start(full.fit.theta[:3], model.response(full.fit.theta))
        with suppress(NoFitError):
            judgements.append(_judged(simpler, start, points, place, best.fit.bound, counted))
    likeliest = max(judgements, key=lambda one: one.evidence - (0.0 if one is full else _CLEARLY))
    return SelectedResponse(
        likeliest,
        full,
        {one.model.name: one.evidence for one in judgements},
        still(len(points)),
        rows,
        points.new_zeros(ERRORS),
        torch.stack([_either_side(full, one) for one in sides]).sum(0),
    )


def _refuse_other_width(drawn: Circle, place: PlaceField) -> None:
    """Refuse a circle that is no turn about the vertical in the field of the place."""
    level = place.strength * math.cos(place.inclination)
    leaning = math.hypot(LEVEL, place.inclination_error) * abs(math.sin(place.inclination))
    if abs(drawn.radius - level) <= _MOST_OFF * level + 3.0 * leaning * place.strength:
        return
    raise NotIdentifiableError(
        f"Not identifiable: the measurements draw a circle of radius {drawn.radius:.3g} µT, and the horizontal field "
        f"of the place is {level:.3g} µT. Turn the vehicle about its vertical axis, once round at least; check the "
        "place and the unit."
    )


def _model(drawn: Circle, place: PlaceField, sign: float) -> LengthModel:
    """The full matrix, with the field's vertical part to one side of the circle."""
    error = math.hypot(LEVEL, place.inclination_error)
    rises = sign * place.inclination
    return LengthModel("full matrix", place.strength, biased=False, circle=drawn, rises=rises, rises_error=error)


def _first(model: LengthModel, points: Tensor, place: PlaceField) -> FittedResponse:
    """The full matrix, from the offset alone: a flat response would take disturbances for tilts."""
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
    """Samples that a rejected one is rejected together with, in the mean: what disturbs them is one event.

    Example:
        >>> _burst(torch.tensor([True, False, True, True, True, False]))
        2.5
    """
    _, lengths = torch.unique_consecutive(rejected, return_counts=True)
    runs = lengths[int(not rejected[0]) :: 2].double()
    return float(runs.square().sum() / runs.sum()) if len(runs) else 1.0


def _either_side(one: FittedResponse, other: FittedResponse) -> Float[Tensor, "p p"]:
    """What it adds to the covariance that the field may stand to the other side of the circle."""
    if one.evidence - other.evidence > _SURE:
        return torch.zeros_like(one.covariance)
    apart = one.fit.theta - other.fit.theta
    return 0.25 * torch.outer(apart, apart)
