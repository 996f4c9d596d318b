"""Offset alone, and scale, or the full matrix: the response that the recording is evidence of."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.calibration.aided.evidence import FittedResponse, judged
from mkc_torch.calibration.aided.response import ERRORS, Model, ModelName, PlaceField
from mkc_torch.calibration.aided.start import offset_by_turns
from mkc_torch.calibration.aided.turns import Turns
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["NAMES", "SelectedResponse", "chosen_response", "rows_of"]

_MOST = 3000
"""Samples that a fit takes, evenly: the offset is known to a hundredth of the noise from these, and what limits it is
no noise."""

_ROUNDS = 2
"""Times that the errors are taken off the rates, which are summed up anew, and that weights are those of the fit."""

_LEAST_WEIGHT = 1e-6

NAMES: tuple[ModelName, ...] = ("offset", "offset and scale", "full matrix")
"""From the simplest to the one that has the others as special cases."""


@dataclass(frozen=True)
class SelectedResponse:
    """The response that was chosen, and all that were tried.

    Attributes:
        best: the likeliest.
        full: the full matrix, whose standard errors are those of all that could be otherwise.
        tried: evidence of each, in nats, by name; without those that leave far more than the full matrix does.
        turns: with the gyroscope's bias taken off, of the rows.
        rows: which samples the fits took.
        errors: of the gyroscope's rates, bias in rad/s and gains; zero of an attitude.
        input_hold: what it adds to the covariance of ``full`` that its parameters may be altogether others; they would
            make the same headings.
    """

    best: FittedResponse
    full: FittedResponse
    tried: dict[str, float]
    turns: Turns
    rows: Int[Tensor, " n"]
    errors: Float[Tensor, " 12"]
    input_hold: Float[Tensor, "p p"] | None = None


def chosen_response(
    measured: Float[Tensor, "N 3"],
    turns_at: Callable[[Tensor], Turns],
    taken: Tensor,
    *,
    place: PlaceField | None = None,
    upwards: Float[Tensor, " 3"] | None = None,
) -> SelectedResponse:
    """Fit the three responses and keep the one with the most evidence.

    Args:
        measured: in one unit, in the order of time.
        turns_at: the turns of all samples, at errors of the rates.
        taken: (N,), which samples may count: of a rest a few.
        place: what is known of the field; used where ``upwards`` is known too, for a length does not tell above from
            below.
        upwards: the middle direction of the vertical in the body's axes.
    """
    rows = rows_of(taken)
    points, errors = measured[rows], measured.new_zeros(ERRORS)
    turns = turns_at(errors).rows(rows)
    biased = turns.summed is not None
    offset, length, _ = offset_by_turns(points, turns)
    if place is None or upwards is None:
        place, scale = None, length
    else:
        scale = length = place.strength
        # what turns about the vertical leave open is where the field's vertical part begins
        vertical = float((points @ upwards).median()) + scale * math.sin(place.inclination)
        offset = offset + (vertical - offset @ upwards) * upwards
    full = Model("full matrix", scale, biased)
    theta = full.start(offset, length * torch.eye(3, dtype=points.dtype))
    weight = full.first_weight(theta, points, turns)
    best = judged(full, theta, points, turns, weight, place=place, errors=errors)
    inflation = best.inflation
    for _ in range(_ROUNDS):
        theta = best.fit.theta
        if biased:
            errors = errors + theta[-ERRORS:]
            turns = turns_at(errors).rows(rows)
            theta = torch.cat([theta[:-ERRORS], torch.zeros_like(errors)])
        weight = best.fit.weights.amin(-1).clamp(min=_LEAST_WEIGHT)
        inflation = best.inflation
        best = judged(full, theta, points, turns, weight, place=place, errors=errors, inflation=inflation)
    judgements = [best]
    offset, response = best.fit.theta[:3], full.response(best.fit.theta)
    for name in NAMES[:-1]:
        model = Model(name, scale, biased)
        start = model.start(offset, response)
        # what leaves more than the density reaches over is no rival
        with suppress(NoFitError):
            judgements.append(
                judged(
                    model,
                    start,
                    points,
                    turns,
                    weight,
                    place=place,
                    errors=errors,
                    bound=best.fit.bound,
                    inflation=inflation,
                )
            )
    likeliest = max(judgements, key=lambda one: one.evidence)
    return SelectedResponse(
        likeliest, best, {one.model.name: one.evidence for one in judgements}, turns, rows, errors + _errors(likeliest)
    )


def rows_of(taken: Tensor) -> Int[Tensor, " n"]:
    """Of the samples that may count, those that a fit takes."""
    rows = taken.nonzero().flatten()
    return rows[:: max(1, -(-len(rows) // _MOST))]


def _errors(one: FittedResponse) -> Tensor:
    return one.fit.theta[-ERRORS:] if one.model.biased else one.fit.theta.new_zeros(ERRORS)
