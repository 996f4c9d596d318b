"""Which of two accounts goes first where both fit: physics with a known driver, unless another is clearly better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.drivers import ANY, Driver
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import Term, continuous
from mkc_torch.diagnosis.noise.innovations import either_way
from mkc_torch.diagnosis.settings import NamingSettings
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ModelPrior", "alike", "schwarz"]

AKAIKE = 1.0
"""Nats for every number (Akaike's criterion)."""


class ModelPrior:
    """Handicaps of candidates, in nats.

    Args:
        terms: all candidates; their drivers of known role are what others are compared with.
        prepared: the simulation of the recording.
        settings: the handicaps.
    """

    def __init__(self, terms: Sequence[Term], prepared: PreparedSimulation, settings: NamingSettings) -> None:
        drivers = {
            id(t.driver): t.driver for t in terms if t.driver is not None and t.driver.role not in (ANY, "position")
        }
        courses = [_unit(driver.values[:, 0]) for driver in drivers.values()]
        self._known = torch.stack(courses) if courses else prepared.time.new_zeros(0, len(prepared.time))
        self._prepared = prepared
        self._settings = settings

    def penalty(self, term: Term, gain: float) -> float:
        """What a candidate's gain is lessened by before it is compared with others."""
        share, give = 0.0, self._settings
        fixed = self._of_form(term)
        if term.effect.is_curve:
            fixed, share = give.nameless, give.over_motion if term.driver is None else give.over_driver
        if term.driver is not None and term.driver.role == ANY:
            follows = self._alike(term.driver.values[:, 0]) > give.alike_columns
            share += give.follower if follows else give.roleless
        elif term.driver is None and term.effect.has_course and not term.effect.follows_signal:
            course = term.effect.waveform(term.shape, term.context(self._prepared, None))
            share += give.event if self._alike(course) > give.alike_event else 0.0
        return fixed + share * max(gain, 0.0)

    def score(self, fit: FittedModel, base: FittedModel) -> float:
        """Gain in nats less Schwarz's penalty, and less the handicap."""
        gain = fit.log_likelihood - base.log_likelihood
        score = gain - schwarz(fit) * fit.model.sizes[-1]
        return score - self.penalty(fit.model.terms[-1], gain)

    def score_with_shape(self, fit: FittedModel, base: FittedModel) -> float:
        """The same less Schwarz's penalty for the numbers of the shape that were fitted too."""
        return self.score(fit, base) - schwarz(fit) * _fitted_numbers(fit.model.terms[-1])

    def by_innovations(self, one: FittedModel, other: FittedModel, price: float = AKAIKE) -> float:
        """Nats by which the other of two fits is preferred, their noise taken for coloured: as a joint fit does not.

        Each pays a price for every number it has, and for a form that has others as special cases. 0 where one has
        another handicap, which is meant for likelihoods.
        """
        terms = [fit.model.terms[-1] for fit in (one, other)]
        forms = [self._of_form(term) for term in terms]
        if any(self.penalty(term, 1.0) > form for term, form in zip(terms, forms, strict=True)):
            return 0.0
        sizes = [fit.model.sizes[-1] + _fitted_numbers(fit.model.terms[-1]) for fit in (one, other)]
        return either_way(one.residual, other.residual) - price * (sizes[1] - sizes[0]) - (forms[1] - forms[0])

    def _of_form(self, term: Term) -> float:
        """What it gives for a form that has named ones as special cases."""
        return self._settings.is_generalisation if term.effect.is_generalisation else 0.0

    def _alike(self, course: Float[Tensor, " N"]) -> float:
        """Largest correlation with one of the known drivers, either sign."""
        return float((self._known @ _unit(course)).abs().max()) if len(self._known) else 0.0


def _fitted_numbers(term: Term) -> int:
    """Of its shape."""
    return len({*continuous(term), *term.effect.fitted_shape})


def schwarz(fit: FittedModel) -> float:
    """Nats for every number by Schwarz's criterion."""
    return 0.5 * math.log(len(fit.residual))


def alike(one: Driver, other: Driver) -> float:
    """Correlation of two drivers of one column each, either sign; 0 for others."""
    if one.values.shape[1] != 1 or other.values.shape[1] != 1:
        return 0.0
    return abs(float(_unit(one.values[:, 0]) @ _unit(other.values[:, 0])))


def _unit(course: Tensor) -> Tensor:
    centred = course - course.mean()
    return centred / torch.linalg.vector_norm(centred).clamp(min=1e-300)
