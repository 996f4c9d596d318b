"""A scored model of the beam, and its identity."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.diagnosis.score import Score

ModelKey = tuple[tuple[Key, bool], ...]
"""Identity of a model: its effects with their places in series, in a fixed order."""


@dataclass(frozen=True)
class Candidate:
    """A fitted and scored model.

    Attributes:
        fit: in open loop, or along the simulation's observer if no open loop is found.
        score: None where the model loses the recording.
        move: how the search came to it.
        together: whether its effects were chosen together, because none of them is a gain alone.
    """

    fit: FittedModel
    score: Score | None
    move: str
    together: bool = False

    @property
    def value(self) -> float:
        """The score in nats."""
        return -float("inf") if self.score is None else self.score.value

    @property
    def price(self) -> float:
        """The price of the model's numbers, effects and noise in nats."""
        return float("inf") if self.score is None else self.score.log_likelihood - self.score.value

    @property
    def key(self) -> ModelKey:
        """Identity of the model."""
        return model_key(self.fit.model.terms)

    @cached_property
    def log_size(self) -> float:
        """Mean over the outputs of the log RMS of the open-loop residual; infinite if it loses the recording."""
        free = self.fit.open_loop
        if free is None:
            return math.inf
        return float(free.residual.square().mean(0).clamp(min=1e-300).sqrt().log().mean())

    @cached_property
    def log_typical_size(self) -> float:
        """As :attr:`log_size`, of the median of the absolute residual: outliers do not count."""
        free = self.fit.open_loop
        if free is None:
            return math.inf
        return float(free.residual.abs().median(0).values.clamp(min=1e-300).log().mean())


def model_key(terms: Iterable[Term]) -> ModelKey:
    """Return the identity of a model with these effects."""
    return tuple(sorted((term.key, term.first) for term in terms))


def in_order(model: Candidate, terms: Sequence[Term]) -> Candidate:
    """Return a model with its effects in another order of their numbers; effects in series keep the order they act in.

    Args:
        model: the model.
        terms: effects of the same identities, in the wanted order.
    """
    fit = model.fit
    own = {term.key: number for number, term in enumerate(fit.model.terms)}
    order = [own[term.key] for term in terms]
    if order == sorted(order):
        return model
    gammas = fit.model.gammas(fit.parameters)
    ordered = JointModel(fit.model.prepared, [fit.model.terms[number] for number in order], fit.model.near)
    parameters = torch.cat([fit.parameters[: fit.model.base], *[gammas[number] for number in order]])
    return replace(model, fit=replace(fit, model=ordered, parameters=parameters))


def predicts_better(model: Candidate, other: Candidate, rates: int, least: float) -> bool:
    """Whether a model under process noise of states alone predicts better over every horizon but the free run.

    Args:
        model, other: the models.
        rates: number of rates that a disturbance can act on; a larger place is the drift of an output.
        least: nats that it has to gain over each horizon.
    """
    if model.fit.model.prepared.observer is None or model.score is None or other.score is None:
        return False
    if not all(place < rates for place, _, _ in model.score.noise.components):
        return False
    gains = [own - behind for own, behind in zip(model.score.by_horizon, other.score.by_horizon, strict=True)]
    return len(gains) > 1 and min(gains[:-1]) > least


def place_of(term: Term, groups: Sequence[Sequence[Term]]) -> int:
    """Return the number of the group that has the effect of a term."""
    return next(number for number, group in enumerate(groups) if term.key in {other.key for other in group})
