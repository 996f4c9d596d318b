"""The order of candidates: the prior of their models, ties, and the ranking by penalised gains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import refit_open_loop
from mkc_torch.diagnosis.model.term import ANY, Driver, Key, Term, continuous, run_parallel
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.search.own_noise import priced
from mkc_torch.diagnosis.search.problem import CandidateSearch
from mkc_torch.diagnosis.settings import NamingSettings, SearchSettings, Settings
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float


AKAIKE = 1.0
"""Nats per number (Akaike's criterion)."""

_TIE = 1e-6
"""Nats within which scores are equal: rounding changes them by 1e-12, a sample by 1e-3 and more."""

NO_LESS = 0.95
"""Ratio of open-loop residuals with and without a candidate above which it does not improve the open loop.

Judgement, checked on 38 recordings of a ship, a circuit, a basin and a sled (`python -m tests.thresholds.open_loop`,
seeds 0 to 3). The hidden effect, where most likely, is above it in 0 of 23, and above 0.9 in 1. Where nothing is
hidden, some candidate is below it in 7 of 10.
"""

CLEARLY_LESS = 0.7
"""Ratio of open-loop residuals of a rival and of such a candidate below which the rival takes its place.

Judgement, checked on the same recordings: fitted in open loop, the hidden effect is not below it in 2 of 28. Where
nothing is hidden, some candidate is below it in 3 of 4 under a disturbance of a state, and in 0 of 6 with a slow error
of the sensor. So this ratio alone names nothing: the rival has to pay its price too.
"""

VISIBLE = 0.1
"""Share of an offset that a length has to show: a small offset in random directions shows 1 / √3. By reasoning."""

LARGER = 1.05
"""Ratio of open-loop residuals with and without a candidate above which it enlarges the open-loop residual: the ratio
at which held-out blocks reject a finding."""


class ModelPrior:
    """Penalties of candidates, in nats.

    Args:
        terms: all candidates; their drivers of known role are the reference for other columns.
        prepared: the simulation of the recording.
        settings: the penalties.
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
        """Return the penalty of a candidate, to be subtracted from its gain before a comparison."""
        share, give = 0.0, self._settings
        fixed = self._of_form(term)
        if term.effect.is_curve:
            fixed, share = give.nameless, give.over_motion if term.driver is None else give.over_driver
        if term.driver is not None and term.driver.role == ANY:
            follows = self._alike(term.driver.values[:, 0]) > give.alike_columns
            share += give.follower if follows else give.roleless
        elif term.driver is None and term.effect.has_waveform and not term.effect.follows_signal:
            course = term.effect.waveform(term.shape, term.context(self._prepared, None))
            share += give.event if self._alike(course) > give.alike_event else 0.0
        return fixed + share * max(gain, 0.0)

    def score(self, fit: FittedModel, base: FittedModel) -> float:
        """Return the gain in nats less Schwarz's penalty and the candidate's penalty."""
        gain = fit.log_likelihood - base.log_likelihood
        score = gain - schwarz(fit) * fit.model.sizes[-1]
        return score - self.penalty(fit.model.terms[-1], gain)

    def score_with_shape(self, fit: FittedModel, base: FittedModel) -> float:
        """Return the score less Schwarz's penalty of the fitted shape numbers."""
        return self.score(fit, base) - schwarz(fit) * _fitted_numbers(fit.model.terms[-1])

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
            agreed_innovation_gain(first.residual, other.residual)
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


def by_own_noise(
    base: FittedModel,
    ranking: tuple[Ranked, ...],
    chosen: Sequence[int],
    fits: Sequence[FittedModel],
    terms: tuple[Term, ...],
    prefer: ModelPrior,
    settings: Settings,
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """Return the most likely fit, and the ranking by distance to it; candidates that were not fitted come last."""
    scores = [prefer.score_with_shape(fit, base) + (priced(fit, settings) - fit.log_likelihood) for fit in fits]
    best = in_order(scores, [fit.model.terms[-1] for fit in fits])[0]
    behind: dict[Key, tuple[float, int]] = {}
    for number, score in zip(chosen, scores, strict=True):
        key, gap = terms[number].key, scores[best] - score
        behind[key] = min((gap, number), behind.get(key, (gap, number)))
    last = max(gap for gap, _ in behind.values())
    moved = []
    for rival in ranking:
        key = terms[rival.number].key
        gap, number = behind.get(key, (max(last, rival.gap), rival.number))
        moved.append(replace(rival, number=number, gap=gap))
    return fits[best], tuple(sorted(moved, key=lambda rival: rival.gap))


def with_open_loop_gain(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    rivals: Sequence[FittedModel],
    free: FittedModel,
    runs: Mapping[int, FittedModel],
    terms: tuple[Term, ...],
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """Return the most likely rival that clearly improves the open loop if the first candidate does not; and ranking.

    Process noise together with a resonance or a lag can follow any residual one step ahead. What physics explains, it
    also explains in an open-loop simulation. Where no rival does that clearly, the most likely candidate stays.

    Args:
        best: the most likely candidate, under its own noise.
        ranking: of the candidates, best first.
        rivals: candidates that are more likely than the simulation alone by more than their penalties.
        free: the open-loop fit of the simulation alone.
        runs: open-loop fits of candidates by their number, as far as they are known.
        terms: all candidates.
    """
    alone, known = _size(free), {terms[number].key: fit for number, fit in runs.items()}
    own = _open_loop_size(best, known)
    if not alone - own < -math.log(NO_LESS):
        return best, ranking
    others = [fit for fit in rivals if fit.model.terms[-1].key != best.model.terms[-1].key]
    others = [fit for fit in others if not fit.model.terms[-1].effect.is_curve]
    works = [partial(_open_loop_size, fit, known) for fit in others]
    sizes = run_parallel(works, best.model.prepared, [fit.model.terms[-1] for fit in others])
    gaps = {terms[rival.number].key: rival.gap for rival in ranking}
    better = [fit for fit, size in zip(others, sizes, strict=True) if size - min(own, alone) < math.log(CLEARLY_LESS)]
    if not better:
        return best, ranking
    chosen = min(better, key=lambda fit: gaps[fit.model.terms[-1].key])
    key, lead = chosen.model.terms[-1].key, gaps[chosen.model.terms[-1].key]
    behind = {fit.model.terms[-1].key for fit in better}
    moved = [
        replace(rival, gap=rival.gap - lead)
        if terms[rival.number].key in behind
        else replace(rival, gap=rival.gap + lead)
        for rival in ranking
    ]
    return chosen, tuple(sorted(moved, key=lambda rival: (terms[rival.number].key != key, rival.gap)))


def with_lags_of_sensors(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    fits: Sequence[FittedModel],
    runs: Mapping[int, FittedModel],
    terms: tuple[Term, ...],
) -> tuple[tuple[Ranked, ...], tuple[FittedModel, ...]]:
    """Return ranking and fits with lags and delays of sensors as far behind the first as in the open loop, if nearer.

    A filter undoes a sensor's memory with the recorded outputs, which is exact for short lags only; in the open loop,
    the lag of a sensor and that of an actuator can be the same.

    Args:
        best: the first candidate.
        ranking: of the candidates.
        fits: of the leading candidates, each under its own noise; the open-loop fit takes the place of such a fit.
        runs: open-loop fits of candidates by their number, as far as they are known.
        terms: all candidates.
    """
    known = {terms[number].key: fit for number, fit in runs.items()}
    first = known.get(best.model.terms[-1].key)
    gaps = {terms[rival.number].key: rival.gap for rival in ranking[1:]}
    nearer = {
        key: max(first.log_likelihood - fit.log_likelihood, 0.0)
        for key, fit in known.items()
        if first is not None and fit.model.terms[-1].effect.remembers and key[2] == "output" and key in gaps
    }
    nearer = {key: gap for key, gap in nearer.items() if gap < gaps[key]}
    moved = [replace(rival, gap=nearer.get(terms[rival.number].key, rival.gap)) for rival in ranking[1:]]
    kept = tuple(known[key] if (key := fit.model.terms[-1].key) in nearer else fit for fit in fits)
    return ranking[:1] + tuple(sorted(moved, key=lambda rival: rival.gap)), kept


def improves_open_loop(fit: FittedModel, less: FittedModel) -> bool:
    """Whether a joint fit has a clearly smaller open-loop residual than the fit without one of its effects."""
    runs = refit_open_loop(fit), refit_open_loop(less)
    if runs[0] is None or runs[1] is None:
        return False
    return _size(runs[0]) - _size(runs[1]) < math.log(CLEARLY_LESS)


def enlarges_open_loop(fit: FittedModel, less: FittedModel) -> bool:
    """Whether a joint fit has a clearly larger open-loop residual than the fit without one of its effects.

    The root mean square counts every sample: a robust fit can be more likely because it rejects a stretch that the
    simulation no longer follows. Outliers of the recording enlarge both residuals alike. False without states.
    """
    if fit.model.prepared.dynamics is None:
        return False
    runs = refit_open_loop(fit), refit_open_loop(less)
    if runs[0] is None or runs[1] is None:
        return False
    mean_squares = [run.residual.square().mean(0) for run in runs if run is not None]
    return 0.5 * float((mean_squares[0] / mean_squares[1]).log().mean()) > math.log(LARGER)


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


def _open_loop_size(fit: FittedModel, known: Mapping[Key, FittedModel]) -> float:
    """Mean log size of the open-loop residual of a candidate; infinite if it loses the recording."""
    runs = (refit_open_loop(fit), known.get(fit.model.terms[-1].key))
    return min((_size(run) for run in runs if run is not None), default=math.inf)


def _size(fit: FittedModel) -> float:
    """Mean over the outputs of the log size of the residual."""
    return float(size_of(fit.residual).log().mean())


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
