"""The order of candidates: the prior of their models, ties, and the ranking by penalised gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.term import ANY, PAIR, Driver, Key, Term, continuous
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.search.problem import CandidateSearch
from mkc_torch.diagnosis.settings import NamingSettings, SearchSettings, Settings
from mkc_torch.diagnosis.thresholds import VISIBLE
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float


AKAIKE = 1.0
"""Nats per number (Akaike's criterion)."""

_TIE = 1e-6
"""Nats within which scores are equal: rounding changes them by 1e-12, a sample by 1e-3 and more."""


class ModelPrior:
    """Penalties of candidates, in nats.

    Args:
        terms: all candidates; their drivers of known role are the reference for other columns.
        prepared: the simulation of the recording.
        settings: the penalties.
    """

    def __init__(self, terms: Sequence[Term], prepared: PreparedSimulation, settings: NamingSettings) -> None:
        drivers = {
            id(t.driver): t.driver
            for t in terms
            if t.driver is not None and t.driver.role not in (ANY, PAIR, "position")
        }
        courses = [_unit(driver.values[:, 0]) for driver in drivers.values()]
        self._known = torch.stack(courses) if courses else prepared.time.new_zeros(0, len(prepared.time))
        self._prepared = prepared
        self._settings = settings

    def penalty(self, term: Term, gain: float) -> float:
        """Return the penalty of a candidate, to be subtracted from its gain before a comparison."""
        share, give = 0.0, self._settings
        fixed = self._of_form(term)
        if term.effect.is_curve:
            fixed, share = give.nameless, give.over_motion if term.driver is None else give.over_driver
        if term.driver is not None and term.driver.role == ANY:
            follows = self._alike(term.driver.values[:, 0]) > give.alike_columns
            share += give.follower if follows else give.roleless
        elif term.driver is not None and term.driver.role == PAIR:
            share += give.roleless  # its columns may be of unknown role, and a pair contains each of them alone
        elif term.driver is None and term.effect.has_waveform and not term.effect.follows_signal:
            course = term.effect.waveform(term.shape, term.context(self._prepared, None))
            share += give.event if self._alike(course) > give.alike_event else 0.0
        return fixed + share * max(gain, 0.0)

    def score(self, fit: FittedModel, base: FittedModel) -> float:
        """Return the gain in nats less Schwarz's penalty and the candidate's penalty."""
        gain = fit.log_likelihood - base.log_likelihood
        score = gain - schwarz(fit) * fit.model.sizes[-1]
        return score - self.penalty(fit.model.terms[-1], gain)

    def by_innovations(self, first: FittedModel, other: FittedModel, price: float = AKAIKE) -> float:
        """Return the nats by which ``other`` is preferred for coloured noise, which a joint fit takes for white.

        Each fit is penalised for every number, and for a form that includes others as special cases. 0 if either
        candidate has another penalty, because those are defined for likelihoods.
        """
        terms = [fit.model.terms[-1] for fit in (first, other)]
        forms = [self._of_form(term) for term in terms]
        if any(self.penalty(term, 1.0) > form for term, form in zip(terms, forms, strict=True)):
            return 0.0
        sizes = [fit.model.sizes[-1] + _fitted_numbers(fit.model.terms[-1]) for fit in (first, other)]
        return (
            agreed_innovation_gain(first.residual, other.residual, first.recorded)
            - price * (sizes[1] - sizes[0])
            - (forms[1] - forms[0])
        )

    def _of_form(self, term: Term) -> float:
        """Return the penalty of a form that includes named forms as special cases."""
        return self._settings.is_generalisation if term.effect.is_generalisation else 0.0

    def _alike(self, course: Float[Tensor, " N"]) -> float:
        """Return the largest absolute correlation with a known driver."""
        return float((self._known @ _unit(course)).abs().max()) if len(self._known) else 0.0


def _fitted_numbers(term: Term) -> int:
    """Number of fitted shape numbers."""
    return len({*continuous(term), *term.effect.fitted_shape})


def schwarz(fit: FittedModel) -> float:
    """Nats per number by Schwarz's criterion."""
    return 0.5 * math.log(len(fit.residual))


def alike(first: Driver, other: Driver) -> float:
    """Return the absolute correlation of two drivers of first column each; 0 for other drivers."""
    if first.values.shape[1] != 1 or other.values.shape[1] != 1:
        return 0.0
    return abs(float(_unit(first.values[:, 0]) @ _unit(other.values[:, 0])))


def _unit(course: Tensor) -> Tensor:
    centred = course - course.mean()
    return centred / torch.linalg.vector_norm(centred).clamp(min=1e-300)


def in_order(scores: Sequence[float], terms: Sequence[Term]) -> list[int]:
    """Return places by descending score; among equal scores the candidate with the fewest shape numbers comes first.

    A body that is always under water and a constant force have the same effect: the simpler name is reported.

    Args:
        scores: of each candidate, in nats.
        terms: the candidates.
    """

    def key(place: int) -> tuple[float, int, int]:
        score = scores[place]
        return -round(score / _TIE) if math.isfinite(score) else -score, len(terms[place].shape), place

    return sorted(range(len(terms)), key=key)


def best_first(fits: Sequence[FittedModel], base: FittedModel, prefer: ModelPrior) -> list[FittedModel]:
    """Return joint fits by descending score."""
    scores = [prefer.score(fit, base) for fit in fits]
    return [fits[place] for place in in_order(scores, [fit.model.terms[-1] for fit in fits])]


def within_reach(scores: Sequence[float], settings: SearchSettings) -> list[bool]:
    """Return whether each score is so close to the best that a refit may come near it.

    Example:
        >>> within_reach([400.0, 160.0, 140.0], SearchSettings())
        [True, True, False]
    """
    best = max(scores, default=0.0)
    least = best - settings.behind - settings.behind_share * max(best, 0.0)
    return [score >= least for score in scores]


@dataclass(frozen=True)
class Ranked:
    """A candidate at its best shape: its number in the list of candidates, gain in nats, and nats behind the first."""

    number: int
    gain: float
    gap: float


def ranked(look: CandidateSearch, prefer: ModelPrior) -> tuple[Ranked, ...]:
    """Rank effects at their best possible shapes by gain, less 1 nat per parameter and shape number, less penalties."""
    terms, found = look.scene.terms, look.gains
    gain = 0.5 * found.ratio[:, 0]
    numbers = gain.new_tensor([float(len(continuous(term))) for term in terms])
    penalty = [prefer.penalty(term, float(nats)) for term, nats in zip(terms, gain, strict=True)]
    score = gain - found.dof - numbers - gain.new_tensor(penalty)
    score = torch.where((found.dof > 0) & look.possible, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in in_order(score.tolist(), terms):
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(number, float(gain[number]), float(score.max() - score[number])) for number in best.values())


def is_hardly_visible(fit: FittedModel) -> bool:
    """Whether the last effect moves a sensor's vector far more than the compared length of the vector.

    An offset can mirror all later vectors with nearly the same length. Such a fit does not determine the offset, and
    makes every vector that it corrects wrong. False where each component of the vector is compared.
    """
    model, term = fit.model, fit.model.terms[-1]
    port = model.prepared.ports[term.port]
    if len(port.channels) <= fit.residual.shape[1] or not port.pointwise or not term.effect.has_waveform:
        return False
    size = model.sizes[-1]
    gone = torch.cat([fit.parameters[:-size], torch.zeros_like(fit.parameters[-size:])])
    seen = model.residual(fit.parameters) - model.residual(gone)
    context = term.context(model.prepared, model.signals(gone)[term.port])
    moved = term.effect.change(fit.parameters[-size:], term.shape, context)
    return bool(seen.square().sum() < VISIBLE**2 * moved.square().sum())


def near_onset(fit: FittedModel, settings: Settings) -> float:
    """Seconds within which two steps count as the same step."""
    time = fit.model.prepared.time
    return settings.confirmation.near * float(time[-1] - time[0])


def is_repeated(term: Term, found: Term, near: float, settings: Settings) -> bool:
    """Whether a candidate repeats the found effect, or is a curve over its driver.

    A step more than ``near`` seconds away is another step; a closer step would only correct the shape of the first.
    """
    if "onset" in term.shape and "onset" in found.shape:
        return abs(term.shape["onset"] - found.shape["onset"]) < near
    if term.key == found.key or (term.effect.is_curve and term.columns == found.columns):
        return True
    # a column that correlates with a found driver would only share its amplitude
    if term.driver is None or found.driver is None:
        return False
    return alike(term.driver, found.driver) > settings.naming.alike_columns
