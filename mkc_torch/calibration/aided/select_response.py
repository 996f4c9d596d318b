"""Select the sensor's response by its evidence: offset, offset and scale, or full matrix."""

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

_MOST = 3000
"""Most samples of a fit, taken evenly; they determine the offset to a hundredth of the noise, and noise is not what
limits it."""

_ROUNDS = 2
"""Number of refits after the rates are corrected and integrated again and the weights are updated."""

_LEAST_WEIGHT = 1e-6
"""Smallest weight of a sample."""

NAMES: tuple[ModelName, ...] = ("offset", "offset and scale", "full matrix")
"""Responses from the simplest to the most general."""


@dataclass(frozen=True)
class SelectedResponse:
    """The selected response, and all candidates.

    Attributes:
        best: the selected response.
        full: the full matrix; its standard errors allow for every possible response.
        tried: log evidence in nats by name; without responses whose residuals are far larger than the full matrix'.
        turns: turns of ``rows``, corrected for the gyroscope's errors.
        rows: indices of the samples in the fits.
        errors: errors of the gyroscope's rates, bias in rad/s and gains; zero for an attitude.
        side_covariance: addition to the covariance of ``full``, (p, p), because the field may be on the other side of
            the circle; None if that is not in question. Headings are the same on either side.
    """

    best: FittedResponse
    full: FittedResponse
    tried: dict[str, float]
    turns: Turns
    rows: Int[Tensor, " n"]
    errors: Float[Tensor, " 12"]
    side_covariance: Float[Tensor, "p p"] | None = None


def select_response(
    measured: Float[Tensor, "N 3"],
    turns_at: Callable[[Tensor], Turns],
    taken: Tensor,
    *,
    place: PlaceField | None = None,
    upwards: Float[Tensor, " 3"] | None = None,
) -> SelectedResponse:
    """Fit the three responses and select the response with the most evidence.

    Args:
        measured: measurements in the order of time.
        turns_at: computes the turns of all samples from errors of the rates.
        taken: mask (N,) of the samples in use; rests are thinned.
        place: prior of the field; only used with ``upwards``, because a length does not distinguish up from down.
        upwards: mean upward direction in the body's axes.
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
        # turns about the vertical leave the vertical offset undetermined
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
        # a response whose residuals exceed the density's bound is not a candidate
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
    best_fit = max(judgements, key=lambda fitted: fitted.evidence)
    return SelectedResponse(
        best_fit,
        best,
        {fitted.model.name: fitted.evidence for fitted in judgements},
        turns,
        rows,
        errors + _errors(best_fit),
    )


def rows_of(taken: Tensor) -> Int[Tensor, " n"]:
    """Indices of the samples of a fit, evenly thinned from the mask of usable samples."""
    rows = taken.nonzero().flatten()
    return rows[:: max(1, -(-len(rows) // _MOST))]


def _errors(fitted: FittedResponse) -> Tensor:
    return fitted.fit.theta[-ERRORS:] if fitted.model.biased else fitted.fit.theta.new_zeros(ERRORS)
