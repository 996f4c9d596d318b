"""Beam search over sets of effects: every model is fitted in open loop and compared by its score."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest

import torch

from mkc_torch._parallel.progress import report_bound, report_found
from mkc_torch.diagnosis.model.fit import FULL, SEARCH, Effort, FittedModel, fitted
from mkc_torch.diagnosis.model.process_noise import fit_with_process_noise, has_process_noise
from mkc_torch.diagnosis.model.shapes import candidate_terms, shape_fitted, with_profiled_shape
from mkc_torch.diagnosis.model.suspect import suspect_id
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.score import Score, ScoreBasis, is_implausible, score, separation
from mkc_torch.diagnosis.search.along_noise import TRIED, add_along_noise
from mkc_torch.diagnosis.search.at_given_values import AtGivenValues, add_at_given_values
from mkc_torch.diagnosis.search.candidate import Candidate, ModelKey, in_order, model_key, place_of, predicts_better
from mkc_torch.diagnosis.search.in_words import leading
from mkc_torch.diagnosis.search.move_fits import (
    by_both_estimators,
    by_squares,
    fitted_exchanged,
    fitted_held,
    fitted_in_form,
    fitted_reordered,
    fitted_simpler,
    fitted_with,
    fitted_without,
    other_starts,
)
from mkc_torch.diagnosis.search.moves import (
    Addition,
    additions,
    at_size_zero,
    in_other_orders,
    one_form_each,
    special_cases,
    with_wide_grid,
)
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import HOLD, IMPROVING, LARGER, LEAST_WIDTH, MOST_MODELS, MOST_TERMS, PAYS, WIDTH
from mkc_torch.nonlinear import NoFitError

_ADDITIONS = (12, 5, 3, 2, 2, 2)
"""Number of effects that are tried in addition to the best model of the beam, the second, and so on."""

_TWINS = (2, 1, 0)
"""Number of these that repeat an effect of the model at another place, whatever their linear gain."""

_EXCHANGES = 2
"""Number of effects of the same channels that are tried in place of each effect of the best model."""

_LEADERS = (3, 1, 0)
"""Number of these that lead the screening of the simulation alone, whatever their linear gain."""

_NOISY = 3
"""Number of leading models that are also fitted under their process noise."""


@dataclass
class BeamSearch:
    """The models of a recording, each fitted once.

    Attributes:
        terms: the candidates, with the shapes of their grids.
        basis: what all scores share.
        settings: thresholds.
        declared: known standard deviations of the outputs' white noise.
        models: the scored models by identity, in the order in which they were tried.
        most_terms: largest number of effects of a model.
        most_models: largest number of models that the search tries.
        noisy: the simulation alone under its process noise; None without.
        fixed: inputs whose hold is known.
        at_given: the model with unlikely numbers held at the values given; None without any.
    """

    terms: tuple[Term, ...]
    basis: ScoreBasis
    settings: Settings
    declared: Mapping[str, float]
    models: dict[ModelKey, Candidate] = field(default_factory=dict)
    most_terms: int = MOST_TERMS
    most_models: int = MOST_MODELS
    noisy: FittedModel | None = None
    fixed: Mapping[str, str] = field(default_factory=dict)
    at_given: AtGivenValues | None = None
    _running: bool = False
    _scores: dict[int, tuple[FittedModel, Score | None]] = field(default_factory=dict)

    def run(self, start: FittedModel, further: Sequence[Term] = ()) -> Candidate:
        """Search from the simulation alone; return the model with the highest score.

        Args:
            start: the simulation alone, in open loop if that is found.
            further: candidates that lead the screening, strongest first; they are tried first.
        """
        self._running = True
        self.keep([Candidate(start, score(start, self.basis, self.settings), "")])
        terms = with_wide_grid(self.terms, start.model.prepared)
        self.at_given = add_at_given_values(self, start, terms)
        expanded: set[ModelKey] = set()
        held: set[ModelKey] = set()
        most = self.most_models - int(IMPROVING * self.most_models)
        whole = True
        while whole and (waiting := [pair for pair in enumerate(self.beam()) if pair[1].key not in expanded]):
            for rank, model in waiting:
                whole = whole and self._expand(model, rank, terms, further, most)
                if whole:
                    expanded.add(model.key)
            self._hold_best(held)
        self._improve(terms, further, expanded)
        self._under_noise()
        add_along_noise(self, terms)
        self._running = False
        return self.best

    @property
    def best(self) -> Candidate:
        """The model with the highest score whose open-loop residual is not larger than with a part of its effects."""
        return max((m for m in self.models.values() if not self.enlarges(m)), key=lambda model: model.value)

    def enlarges(self, model: Candidate) -> bool:
        """Whether a model's open-loop residual is clearly larger than that of a known model with a part of its effects.

        The root mean square counts every sample: a robust fit can score higher because it takes a stretch that the
        simulation no longer follows for outliers. A recording that is sensitive to small forces may lose it alone.
        """
        own = {term.key for term in model.fit.model.terms}
        rates = len(self.basis.largest) - len(self.basis.span)
        least = self.settings.naming.separable * self.basis.kappa
        parts = [other for other in self.models.values() if {term.key for term in other.fit.model.terms} < own]
        return any(
            model.log_size > other.log_size + math.log(LARGER) and not predicts_better(model, other, rates, least)
            for other in parts
        )

    def beam(self) -> list[Candidate]:
        """Return the leading models, best first."""
        ranked = sorted(self.models.values(), key=lambda model: -model.value)
        alone = self.models[()].value
        least = ranked[0].value - 0.5 * (ranked[0].value - alone) - self.basis.number
        return [model for rank, model in enumerate(ranked[:WIDTH]) if rank < LEAST_WIDTH or model.value >= least]

    def fitted_set(
        self, groups: Sequence[Sequence[Term]], start: FittedModel, move: str, *, thorough: bool = True
    ) -> Candidate:
        """Return the model of given effects with the highest score of several fits; the models stay as they are.

        The effects are added in the given order and in the reverse order, each from the best shapes of its grid; for
        effects in series every order is tried. The best fit is repeated under its process noise, as in the search.

        Args:
            groups: for each effect its candidates, one for each shape.
            start: the simulation alone.
            move: how the search came to it.
            thorough: False for the given order only.
        """
        prepared = start.model.prepared
        orders = [tuple(groups), tuple(reversed(groups))] if thorough and len(groups) > 1 else [tuple(groups)]
        works = [partial(self.scored, move, partial(self._added_in_turn, order, start)) for order in orders]
        found = [model for model in run_parallel(works, prepared, self.terms, "model") if model is not None]
        best = max(found, key=lambda model: model.value)
        if thorough:
            others = [partial(fitted_reordered, best.fit, order) for order in in_other_orders(best.fit)]
            works = [partial(self.scored, move, other) for other in others]
            found = [model for model in run_parallel(works, prepared, self.terms, "model") if model is not None]
            best = max([best, *found], key=lambda model: model.value)
        best = self.under_noise(best)
        return in_order(best, sorted(best.fit.model.terms, key=lambda term: place_of(term, groups)))

    def _added_in_turn(self, groups: Sequence[Sequence[Term]], start: FittedModel) -> FittedModel:
        """Return a fit with more effects, added one after the other."""
        fit = start
        for group in groups:
            wide = with_wide_grid(group, fit.model.prepared) or tuple(group)
            found = additions(fit, wide, self.settings.noise)
            fit = self._fitted_with(fit, found[0] if found else at_size_zero(fit, wide))
        return fit

    def _fitted_with(
        self, fit: FittedModel, addition: Addition, others: Sequence[Callable[[], FittedModel | None]] = ()
    ) -> FittedModel:
        implausible = partial(is_implausible, basis=self.basis)
        return fitted_with(fit, addition, others, implausible=implausible, better=self.is_better)

    def distinct(
        self, fit: FittedModel, addition: Addition, others: Sequence[Callable[[], FittedModel | None]] = ()
    ) -> FittedModel | None:
        """Return the fit with one more effect; None if what it is mistaken for cannot be separated from it."""
        found, rival = self._fitted_with(fit, addition, others), addition.starts[0][0].effect.mistaken_for
        if rival is None:
            return found
        shapes = candidate_terms(fit.model.prepared, (), (rival,))
        other = self._fitted_with(fit, additions(fit, shapes, self.settings.noise)[0])
        own, others_score = (score(model, self.basis, self.settings) for model in (found, other))
        return found if separation(own, others_score, self.basis) > self.settings.naming.separable else None

    def _expand(self, model: Candidate, rank: int, terms: Sequence[Term], further: Sequence[Term], most: int) -> bool:
        """Fit and score the models that one move leads to, up to a number of models in all; return whether all are."""
        fit, have = model.fit, len(model.fit.model.terms)
        works: list[tuple[ModelKey, str, Callable[[], FittedModel | None]]] = []
        if have < self.most_terms and not any(term.effect.is_curve for term in fit.model.terms):
            others = other_starts(fit, terms, further, self.noisy, self.fixed, self.settings) if not have else {}
            for base, addition in self._proposed(model, rank, terms, further):
                key = model_key([*fit.model.terms, addition.starts[0][0]])
                work = partial(self.distinct, base, addition, () if base.sigma_held else others.get(addition.key, ()))
                works.append((key, f"add {self.id_of(addition.starts[0][0])}", work))
        for number, term in enumerate(fit.model.terms):
            if have > 1:
                rest = [other for other in fit.model.terms if other is not term]
                works.append((model_key(rest), f"drop {self.id_of(term)}", partial(fitted_without, fit, number)))
            for other in special_cases(term, self.terms, fit.model.prepared):
                if other.family in {known.family for known in fit.model.terms if known is not term}:
                    continue
                rest = [*fit.model.terms[:number], *fit.model.terms[number + 1 :]]
                move = f"exchange {self.id_of(term)} for {self.id_of(other)}"
                group = self._all(other, term)
                if other.family == term.family:
                    known = self.models.get(model_key(rest))
                    less = None if known is None else known.fit
                    work = partial(fitted_in_form, fit, number, group, self.settings.noise, less)
                else:
                    work = partial(fitted_exchanged, fit, number, group, self.settings.noise, self.is_better)
                works.append((model_key([*rest, other]), move, work))
        orders = in_other_orders(fit)
        works += [(model_key(o), "another order in series", partial(fitted_reordered, fit, o)) for o in orders]
        return self._fit(works, fit, most)

    def _hold_best(self, held: set[ModelKey]) -> None:
        """Exchange the holds of the inputs of the best model, and if that scores higher those of all other models.

        Missing physics can resemble the error of a hold, so the hold that the simulation alone prefers can be wrong.
        """
        best = self.best
        if not best.fit.model.terms or best.key in held:
            return
        held.add(best.key)
        other = self.with_best_hold(best)
        if other is not best:
            self.keep([other])
            others = {key: model for key, model in self.models.items() if key and key not in held}
            held.update(others)
            works = [partial(self.with_best_hold, model) for model in others.values()]
            self.keep(run_parallel(works, best.fit.model.prepared, self.terms, "model"))

    def _improve(self, terms: Sequence[Term], further: Sequence[Term], expanded: set[ModelKey]) -> None:
        """Expand the models near the best, and exchange the best's effects for others of the same channels."""
        best, most = None, self.most_models - (2 * TRIED if self.most_models > 10 * TRIED else 0)
        while self.best.fit.model.terms and len(self.models) < most:
            near = self.best.value - self.settings.naming.separable * self.basis.kappa
            waiting = [model for model in self.beam() if model.value >= near and model.key not in expanded]
            if waiting:
                expanded.add(waiting[0].key)
                self._expand(waiting[0], 0, terms, further, most)
            elif best is self.best:
                return
            else:
                best = self.best
                self._exchange(best, terms, most)

    def _exchange(self, model: Candidate, terms: Sequence[Term], most: int) -> None:
        """Fit the model with another effect of the same channels in place of each of its effects."""
        fit, ports, works = model.fit, model.fit.model.prepared.ports, []
        for term in fit.model.terms:
            rest = self.models.get(model_key([other for other in fit.model.terms if other is not term]))
            if rest is None:
                continue
            near = [other for other in terms if ports[other.port].channels == ports[term.port].channels]
            found = one_form_each(additions(rest.fit, near, self.settings.noise), self.worth)
            found = sorted(found, key=self.worth, reverse=True)
            for addition in [other for other in found if other.key != term.key][:_EXCHANGES]:
                other = addition.starts[0][0]
                key = model_key([*rest.fit.model.terms, other])
                move = f"exchange {self.id_of(term)} for {self.id_of(other)}"
                works.append((key, move, partial(self.distinct, rest.fit, addition)))
        self._fit(works, fit, most)

    def with_one_less(self, model: Candidate) -> list[Candidate]:
        """Return the models without one of a model's effects, fitted if they are not known."""
        fit = model.fit
        rests = [
            (model_key([other for other in fit.model.terms if other is not term]), number, term)
            for number, term in enumerate(fit.model.terms)
        ]
        works = [(key, f"drop {self.id_of(term)}", partial(fitted_without, fit, number)) for key, number, term in rests]
        self._fit(works, fit, len(self.models) + len(works))
        return [self.models[key] for key, _, _ in rests if key in self.models]

    def _proposed(
        self, model: Candidate, rank: int, terms: Sequence[Term], further: Sequence[Term]
    ) -> list[tuple[FittedModel, Addition]]:
        """Return the additions to fit with the fit to add them to: in turn to the model's own and to least squares."""
        fits = [replace(model.fit, squares=False), by_squares(model.fit, self.settings.noise)]
        chosen = [
            [
                (fit, addition)
                for addition in self._chosen(additions(fit, terms, self.settings.noise), model, rank, further)
            ]
            for fit in fits
            if fit is not None
        ]
        return [pair for pairs in zip_longest(*chosen) for pair in pairs if pair is not None]

    def _chosen(
        self, found: Sequence[Addition], model: Candidate, rank: int, further: Sequence[Term]
    ) -> list[Addition]:
        """Return the additions to fit: the largest linear gains, less the price of the effect's numbers."""
        most = _ADDITIONS[min(rank, len(_ADDITIONS) - 1)]
        found = one_form_each(found, self.worth)
        ranked = sorted(found, key=self.worth, reverse=True)
        if model.fit.model.terms:
            own = {term.effect.id for term in model.fit.model.terms}
            # an effect at two places, as two vessels that overflow, may show only with both
            twins = [a for a in ranked if a.starts[0][0].effect.id in own][: _TWINS[min(rank, len(_TWINS) - 1)]]
            # far from the solution an open loop shows a lag or a delay less than the screening under process noise did
            led = [a for term in further for a in ranked if a.key == term.key][: _LEADERS[min(rank, len(_LEADERS) - 1)]]
            ranked = [a for a in ranked if a.gain >= PAYS * self.price_of(*a.starts[0])]
            return list({a.key: a for a in [*ranked[:most], *twins, *led]}.values())
        first = [addition for term in further for addition in found if addition.key == term.key]
        first = list({addition.key: addition for addition in first}.values())
        others = [addition for addition in ranked if addition.key not in {a.key for a in first}]
        return [*first, *others[: max(most - len(first), most // 2)]]

    def worth(self, addition: Addition) -> float:
        return addition.gain - self.price_of(*addition.starts[0])

    def price_of(self, term: Term, size: torch.Tensor) -> float:
        """Return the price of an effect next to a linear gain, a likelihood of one horizon."""
        naming = self.settings.naming
        form = naming.is_generalisation * term.effect.is_generalisation + naming.nameless * term.effect.is_curve
        numbers = len(size) + len(term.effect.fitted_shape)
        return self.basis.number / self.basis.kappa * numbers + self.basis.choice + form

    def id_of(self, term: Term) -> str:
        return suspect_id(term, self.terms)

    def _all(self, term: Term, near: Term) -> tuple[Term, ...]:
        """Return an effect at all shapes of its grid, first at the shape of another where both have its numbers."""
        known = {name: value for name, value in near.shape.items() if name in term.shape}
        own = tuple(other for other in self.terms if other.key == term.key)
        return (replace(term, shape={**term.shape, **known}), *own) if known else own

    def _fit(
        self, works: Sequence[tuple[ModelKey, str, Callable[[], FittedModel | None]]], near: FittedModel, most: int
    ) -> bool:
        """Fit and score unknown models in parallel, up to a number of models in all; return whether that allows all."""
        new: dict[ModelKey, tuple[str, list[Callable[[], FittedModel | None]]]] = {}
        for key, move, work in works:
            if key in new:
                new[key][1].append(work)
            elif key not in self.models and len(self.models) + len(new) < most:
                new[key] = (move, [work])
        tried = [partial(self.scored, move, *several) for move, several in new.values()]
        if self._running:
            report_bound("model", len(self.models), self.most_models)
        found = run_parallel(tried, near.model.prepared, self.terms, "model")
        self.keep([model for model in found if model is not None])
        return all(key in self.models or key in new for key, _, _ in works)

    def score_of(self, fit: FittedModel) -> Score | None:
        """Return the score of a fit; it is computed once."""
        known = self._scores.get(id(fit))
        if known is None or known[0] is not fit:
            known = self._scores[id(fit)] = fit, score(fit, self.basis, self.settings)
        return known[1]

    def value_of(self, fit: FittedModel) -> float:
        """Return the score of a fit in nats; minus infinity where it loses the recording."""
        found = self.score_of(fit)
        return -math.inf if found is None else found.value

    def is_better(self, other: FittedModel, fit: FittedModel) -> bool:
        """Whether the recording separates a fit from another that scores lower."""
        return self.value_of(other) > self.value_of(fit) + self.settings.naming.separable * self.basis.kappa

    def scored(self, move: str, *works: Callable[[], FittedModel | None]) -> Candidate | None:
        """Return the fit of a model that scores highest, of several fits and of least squares from these."""
        self._scores.clear()
        fits = [fit for work in works if (fit := work()) is not None]
        fits = [other for fit in fits for other in by_both_estimators(fit, self.settings.noise)]
        if not fits:
            return None
        best = max(fits, key=self.value_of)
        return Candidate(best, self.score_of(best), move)

    def keep(self, models: Iterable[Candidate]) -> None:
        for model in models:
            self.models[model.key] = model
        if self._running and len(self.models) > 1:
            report_found(leading(self.best.fit.model.terms))

    def _under_noise(self) -> None:
        """Fit the leading models under their process noise too; keep the fit that scores higher."""
        leading = sorted(self.models.values(), key=lambda model: -model.value)[:_NOISY]
        works = [partial(self.under_noise, model, effort=SEARCH) for model in leading]
        self.keep(run_parallel(works, leading[0].fit.model.prepared, self.terms, "model"))

    def under_noise(self, model: Candidate, less: float = 0.0, effort: Effort = FULL) -> Candidate:
        """Return a model fitted under its process noise, unless that scores lower by more than ``less`` nats."""
        if has_process_noise(model.fit):
            return model
        try:
            under = fit_with_process_noise(model.fit, self.declared, self.settings.noise, effort=effort)
            noisy = shape_fitted(under.fit, effort)
        except NoFitError:
            return model
        return self._better(model, replace(noisy, squares=model.fit.squares), less)

    def with_best_hold(self, model: Candidate) -> Candidate:
        """Return a model with the hold of each input that scores highest; the simulation's own within ``HOLD``."""
        dynamics = model.fit.model.prepared.dynamics
        assert dynamics is not None
        for name, how in dynamics.input_hold.items():
            for other in ("held", "linear"):
                if name not in self.fixed and other != how:
                    held = fitted_held(model.fit, name, other)
                    less = HOLD if other == dynamics.system.input_hold else -HOLD
                    model = model if held is None else self._better(model, held, less)
        return model

    def simplified(self, model: Candidate) -> Candidate:
        """Return a model with the simpler forms of its effects that this recording cannot separate from it."""
        less = self.settings.naming.separable * self.basis.kappa
        for number in range(len(model.fit.model.terms)):
            other = fitted_simpler(model.fit, number)
            model = model if other is None else self._better(model, other, less)
        return model

    def to_the_end(self, model: Candidate) -> Candidate:
        """Return a model fitted to the end; a delay or lag of its last effect on an input is profiled.

        Raises:
            NoFitError: the fit loses the recording.
        """
        fit = model.fit
        whole = fitted(fit.model, fit.parameters, fit.bound, graduate=False)
        return self._better(model, with_profiled_shape(shape_fitted(whole)))

    def _better(self, model: Candidate, fit: FittedModel, less: float = 0.0) -> Candidate:
        if fit is model.fit:
            return model
        fits = by_both_estimators(fit, self.settings.noise)
        others = [replace(model, fit=each, score=score(each, self.basis, self.settings)) for each in fits]
        best = max(others, key=lambda other: other.value, default=model)
        return best if best.value > model.value - less else model
