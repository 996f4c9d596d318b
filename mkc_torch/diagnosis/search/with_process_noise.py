"""Search with process noise: candidates' gains, each with its own process noise, then fits of the leaders."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress

import torch
from torch import Tensor

from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted, fitted_with_effect
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import (
    estimate_noise,
    has_process_noise,
    noise_of_fit,
    refit_input_hold,
    refit_noise,
    refit_open_loop,
)
from mkc_torch.diagnosis.model.shapes import shape_fitted, with_form_of_grid, with_profiled_shape
from mkc_torch.diagnosis.model.term import Key, Term, continuous, run_parallel
from mkc_torch.diagnosis.search.joint_likelihood import JointLikelihood, joint_likelihood
from mkc_torch.diagnosis.search.own_noise import FreeRuns, free_runs, number_count, priced, with_own_noise
from mkc_torch.diagnosis.search.problem import SearchProblem
from mkc_torch.diagnosis.search.ranking import (
    ModelPrior,
    Ranked,
    by_own_noise,
    in_order,
    schwarz,
    with_lags_of_sensors,
    with_open_loop_gain,
    within_reach,
)
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.search.significance import price
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

_CURVES = 2
"""Number of free curves that are fitted in addition to the leading candidates."""

_PART = 0.3
"""Share of the largest gain below which a candidate is not fitted."""

_CLOSER = 0.95
"""Ratio of open-loop residuals below which a rival goes first."""

_DOUBT = 10.0
"""Nats beyond its penalty that a candidate has to gain to count without surrogates."""

FAR_LESS = 0.3
"""Ratio of open-loop residuals with and without an effect below which the effect is mentioned though no finding.

Set on 38 recordings of a ship, a circuit, a basin and a sled (`python -m tests.thresholds.open_loop`, seeds 0 to 3):
where nothing is hidden and a disturbance acts, no candidate is below it in 10 of 10 (smallest 0.33); the hidden
effect is in 18 of 28.
"""

_FIT = "fit of a leading candidate"
"""Name of the items that progress counts."""

Kind = tuple[Key, str]
"""Identity of a candidate, and for a curve its variable."""


def search_with_process_noise(
    base: FittedModel,
    terms: Sequence[Term],
    *,
    level: float,
    surrogates: int,
    generator: torch.Generator,
    declared: Mapping[str, float],
    fixed: Mapping[str, str],
    free: FittedModel | None = None,
    settings: Settings,
    quick: bool = False,
    keep: Callable[[SearchResult], object] = lambda _: None,
) -> SearchResult:
    """Search the candidates at a fit with process noise.

    Args:
        base: the fit.
        terms: candidates.
        level: p-value up to which candidates are fitted and compared.
        surrogates: number of surrogates.
        generator: of the surrogates.
        declared: known standard deviations of the outputs' white noise.
        fixed: known input holds.
        free: the open-loop fit; None if it loses the recording.
        settings: thresholds.
        quick: draw no surrogates, and refit each leading candidate from one start.
        keep: called with the result so far, before the leading candidates are refitted.

    Raises:
        NoFitError: the fit's trajectory is lost.
    """
    terms = tuple(terms)
    tangents = tangents_of(base.model, base.parameters, settings.noise, terms)
    values, counts = base.pseudo(settings.noise)
    channels = base.model.prepared.channels
    found = joint_likelihood(
        base,
        terms,
        tangents,
        counts,
        surrogates,
        generator,
        level=level,
        declared=[name in declared for name in channels],
        quick=quick,
        price=settings.noise.disturbance_gain,
    )
    if found is None:
        raise NoFitError("The simulation has no finite trajectory at the fitted values.")
    prefer = ModelPrior(terms, base.model.prepared, settings.naming)
    look = SearchProblem(base, base, terms, tangents, values, counts, settings).under()
    ranking = _ranked(found, terms, prefer)
    best = _fit_of(base, terms[ranking[0].number], found, ranking[0].number)
    located = SearchResult(
        best.model.terms[-1],
        best,
        found.p_value,
        found.beyond,
        ranking,
        look.noise,
        look,
        look.linearised,
        longer=found.longer,
        with_noise=True,
    )
    keep(located)
    fits: Sequence[FittedModel] = ()
    p_value = found.p_value
    runs, behind = FreeRuns([]) if quick or free is None else free_runs(free, terms, settings)
    if p_value > level and _plain(base, [fit for _, fit in runs], terms, declared, settings):
        p_value = 1.0 / (1.0 + surrogates)
    if p_value <= level:
        chosen = _chosen(found, ranking, terms, settings.search.own_noise)
        common = base.model.prepared, [terms[number] for number in chosen]
        first = run_parallel([partial(_fit_of, base, terms[number], found, number) for number in chosen], *common, _FIT)
        near = within_reach([prefer.score_with_shape(fit, base) for fit in first], settings.search)
        chosen, first = list(compress(chosen, near)), list(compress(first, near))
        known = {terms[number].key: fit for number, fit in runs}
        works = []
        for number, fit in zip(chosen, first, strict=True):
            gamma, running = found.start(number).gamma, known.pop(terms[number].key, None)
            own = None if terms[number].key in behind else free
            works.append(
                partial(_best_start, base, own, terms[number], fit, gamma, declared, settings, running, quick=quick)
            )
        more = [(number, fit) for number, fit in runs if terms[number].key in known]
        works += [partial(_under_own_noise, fit, base, declared, settings) for _, fit in more]
        works = [partial(_no_less_likely, base, work, declared, settings) for work in works]
        works = works if quick else [partial(_in_best_form, work, declared, settings) for work in works]
        chosen += [number for number, _ in more]
        fits = run_parallel(works, base.model.prepared, [terms[number] for number in chosen], _FIT)
        best, ranking = by_own_noise(base, ranking, chosen, fits, terms, prefer, settings)
        best, ranking = _by_free_run(best, ranking, fits, terms, settings)
        if free is not None and not quick:
            paying = [fit for fit in fits if _pays(base, fit, prefer, settings)]
            best, ranking = with_open_loop_gain(best, ranking, paying, free, dict(runs), terms)
            ranking, fits = with_lags_of_sensors(best, ranking, fits, dict(runs), terms)
        best = best if quick else with_profiled_shape(best)
        best = refit_noise(best, noise_of_fit(best, declared), declared, settings.noise)
        best = best if quick else refit_input_hold(best, declared, fixed, settings.noise)
    bare = _without(base, best, declared, settings) if fits and has_process_noise(best) else None
    better_noise = (
        bare is not None and priced(bare, settings) > priced(base, settings) + settings.noise.disturbance_gain
    )
    needless = bare is not None and _needless(best, bare, settings, drawn=not better_noise)
    return replace(
        located,
        term=best.model.terms[-1],
        fit=best,
        p_value=1.0 if needless else p_value,
        ranking=ranking,
        compared=fits,
        without_candidate=bare if needless and better_noise else None,
        follow=_follow(free, runs) if p_value > level else (),
    )


def _ranked(found: JointLikelihood, terms: tuple[Term, ...], prefer: ModelPrior) -> tuple[Ranked, ...]:
    """Rank the effects at their best shapes by gain less Akaike's penalty of their numbers and their own penalties."""
    numbers = found.gain.new_tensor([float(len(continuous(term))) for term in terms])
    penalty = [prefer.penalty(term, float(nats)) for term, nats in zip(terms, found.gain, strict=True)]
    score = found.gain - found.dof - numbers - found.gain.new_tensor(penalty)
    score = torch.where(found.dof > 0, score, -torch.inf)
    best: dict[Key, int] = {}
    for number in in_order(score.tolist(), terms):
        best.setdefault(terms[number].key, number)
    return tuple(Ranked(n, float(found.gain[n]), float(score.max() - score[n])) for n in best.values())


def _chosen(found: JointLikelihood, ranking: Sequence[Ranked], terms: tuple[Term, ...], most: int) -> list[int]:
    """Return the leading candidates at their best shapes, and at their ports the best free curve over each variable."""
    chosen: dict[Kind, int] = {}
    least = _PART * max(candidate.gain for candidate in ranking[:most])
    for candidate in ranking[:most]:
        if candidate.gain >= least:
            chosen[_kind(terms[candidate.number])] = candidate.number
    places = {terms[number].port for number in chosen.values()}
    curves = [n for n, term in enumerate(terms) if term.effect.is_curve and term.port in places]
    for number in sorted(curves, key=lambda n: -float(found.gain[n]))[:_CURVES]:
        if found.gain[number] >= least:
            chosen.setdefault(_kind(terms[number]), number)
    return list(chosen.values())


def _kind(term: Term) -> Kind:
    return term.key, term.effect.plot_axis if term.effect.is_curve else ""


def _fit_of(base: FittedModel, term: Term, found: JointLikelihood, number: int) -> FittedModel:
    """Return the joint fit of a candidate, under its remaining process noise by the search."""
    begin = found.start(number)
    smaller = base.model.prepared.observed(begin.observer)
    start = torch.cat([_inside(base, base.parameters + begin.shift), begin.gamma])
    model = JointModel(smaller, (*base.model.terms, term), base.model.near)
    size_zero = torch.cat([base.parameters, torch.zeros_like(begin.gamma)])
    # far along the tangents there may be no finite trajectory
    for parameters in (start, size_zero):
        there = fitted_with_effect(base, model, parameters, graduate=False)
        if there.model.prepared is smaller:
            return there
    return fitted_with_effect(base, base.model.with_term(term), start, graduate=False)


def _inside(base: FittedModel, parameters: Tensor) -> Tensor:
    """Clip parameters to their bounds; keep a parameter that would more than double, beyond the linear range."""
    bounds = base.model.bounds
    if bounds is not None:
        parameters = parameters.clamp(*bounds)
    own = base.model.base
    far = (parameters - base.parameters).abs() > base.parameters.abs().clamp(min=1e-12)
    return torch.where(far & (torch.arange(len(parameters)) < own), base.parameters, parameters)


def _best_start(
    base: FittedModel,
    free: FittedModel | None,
    term: Term,
    fit: FittedModel,
    gamma: Tensor,
    declared: Mapping[str, float],
    settings: Settings,
    running: FittedModel | None = None,
    *,
    quick: bool = False,
) -> FittedModel:
    """Return the better joint fit of a candidate under its remaining noise: from its first fit or from open loop.

    Process noise of the first fit has absorbed part of the effect, and keeps some of it. A quick look starts from open
    loop only if the first fit is no more likely than the simulation alone. ``free`` is None where the open loop is
    not tried: no such fit exists, or the candidate is much less likely than others in it. ``running`` is the
    candidate's open-loop fit, if known.
    """
    under = with_own_noise(fit, declared, settings)
    if free is None or not has_process_noise(under):
        return under
    if quick and priced(under, settings) > priced(base, settings):
        return under
    if running is None:
        model = free.model.with_term(term)
        starts = (torch.cat([free.parameters, gamma]), torch.cat([free.parameters, torch.zeros_like(gamma)]))
        works = [partial(fitted_with_effect, free, model, start, graduate=False) for start in starts]
        tried = run_parallel(works, model.prepared, [term])
        running = shape_fitted(max(tried, key=lambda open_loop_fit: open_loop_fit.log_likelihood))
    running = _under_own_noise(running, base, declared, settings)
    return running if priced(running, settings) > priced(under, settings) else under


def _under_own_noise(
    running: FittedModel, base: FittedModel, declared: Mapping[str, float], settings: Settings
) -> FittedModel:
    """Return a fit under newly selected noise around it; unchanged if that is less likely or loses the recording."""
    noise = estimate_noise(running, declared, settings.noise)
    if noise is None or noise.observer is None:
        return with_own_noise(running, declared, settings)
    observed = JointModel(running.model.prepared.observed(noise.observer), running.model.terms, running.model.near)
    try:
        under = fitted(observed, running.parameters, base.bound, graduate=False, fresh=True)
    except NoFitError:
        return running
    under = with_own_noise(under, declared, settings)
    # an observer undoes a sensor's lag with the recorded outputs, which is exact for short lags only
    return under if priced(under, settings) > priced(running, settings) else running


def _no_less_likely(
    base: FittedModel, work: Callable[[], FittedModel], declared: Mapping[str, float], settings: Settings
) -> FittedModel:
    """Return a candidate's fit, or if it is less likely than the simulation alone, a fit from that one's noise.

    A candidate includes the simulation alone, so such a fit has missed the most likely noise: a slow error of the
    sensor, for example, in place of process noise.
    """
    fit = work()
    if priced(fit, settings) >= priced(base, settings):
        return fit
    model = base.model.with_term(fit.model.terms[-1])
    zero = fit.parameters.new_zeros(len(fit.parameters) - len(base.parameters))
    starts = (fit.parameters, torch.cat([base.parameters, zero]))
    tried = [fitted_with_effect(base, model, start, graduate=False) for start in starts]
    return with_own_noise(max(tried, key=lambda found: found.log_likelihood), declared, settings)


def _follow(free: FittedModel | None, runs: Sequence[tuple[int, FittedModel]]) -> tuple[FittedModel, ...]:
    """Return the open-loop fits with far smaller residuals than the simulation's, most likely first.

    General forms, such as a power law, are left out if there are others.
    """
    if free is None:
        return ()
    far = [fit for _, fit in runs if (size_of(fit.residual) / size_of(free.residual)).log().mean() < math.log(FAR_LESS)]
    named = [fit for fit in far if not fit.model.terms[-1].effect.is_generalisation] or far
    return tuple(sorted(named, key=lambda fit: schwarz(fit) * number_count(fit) - fit.log_likelihood))


def _in_best_form(work: Callable[[], FittedModel], declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Return a candidate's fit in its most likely form, under its remaining noise."""
    fit = work()
    moved = with_form_of_grid(fit)
    return fit if moved is fit else with_own_noise(moved, declared, settings)


def _plain(
    base: FittedModel,
    runs: Sequence[FittedModel],
    terms: Sequence[Term],
    declared: Mapping[str, float],
    settings: Settings,
) -> bool:
    """Whether a candidate's fit is so much more likely than the simulation alone that no surrogates are needed.

    Without the effect, a likelihood ratio exceeds k with a probability of at most 1/k (Markov's inequality; Wasserman,
    Ramdas & Balakrishnan, PNAS 117 (2020), 16880), if the simulation alone has its most likely noise too. Each
    candidate leads to another noise, also one that gains nothing, so the simulation alone has the most likely of all
    of them and of its own, each selected again as for a candidate. The expected gain of fitting the effect's numbers
    and of choosing among the candidates is subtracted.
    """
    if not runs:
        return False
    known = base.model.prepared, [fit.model.terms[-1] for fit in runs]
    works = [partial(with_own_noise, base, declared, settings)]
    works += [partial(_under_own_noise, fit, base, declared, settings) for fit in runs]
    alone, *fits = run_parallel(works, *known)
    samples, kinds = int(alone.residual.numel()), len({term.key for term in terms})
    beyond = [priced(fit, settings) - _DOUBT - price(number_count(fit), samples, kinds) for fit in fits]
    if max(beyond) <= priced(alone, settings):
        return False
    without = run_parallel([partial(_without_at_best, base, fit, declared, settings) for fit in fits], *known)
    most_likely = max(priced(fit, settings) for fit in (alone, *without) if fit is not None)
    return any(value > most_likely for value, bare in zip(beyond, without, strict=True) if bare is not None)


def _without(
    base: FittedModel, fit: FittedModel, declared: Mapping[str, float], settings: Settings
) -> FittedModel | None:
    """Fit the simulation without a candidate, from the noise found with the candidate; None if it fails."""
    model = JointModel(fit.model.prepared, base.model.terms, base.model.near)
    try:
        without = fitted(model, base.parameters, base.bound, graduate=False, fresh=True)
    except NoFitError:
        return None
    return with_own_noise(without, declared, settings)


def _without_at_best(
    base: FittedModel, fit: FittedModel, declared: Mapping[str, float], settings: Settings
) -> FittedModel | None:
    """Fit the simulation without a candidate, under noise selected again from that found with it; None if it fails."""
    bare = _without(base, fit, declared, settings)
    return None if bare is None else _under_own_noise(bare, base, declared, settings)


def _needless(best: FittedModel, bare: FittedModel, settings: Settings, *, drawn: bool) -> bool:
    """Whether the noise found with an effect is as likely without the effect.

    A candidate that only led to a better noise model is no finding: its size is 0 or arbitrary. Its numbers are
    penalised by Schwarz's criterion, or by Akaike's if the surrogates were of that noise, because then the p-value
    includes the search.
    """
    numbers = best.model.size - bare.model.size + len(best.model.terms[-1].effect.fitted_shape)
    penalty_per_number = 1.0 if drawn else 0.5 * math.log(len(best.residual))
    return priced(best, settings) - priced(bare, settings) < numbers * penalty_per_number


def _pays(base: FittedModel, fit: FittedModel, prefer: ModelPrior, settings: Settings) -> bool:
    """Whether a candidate under its own noise is more likely than the simulation alone by more than its penalties."""
    noise = priced(fit, settings) - fit.log_likelihood - (priced(base, settings) - base.log_likelihood)
    return prefer.score_with_shape(fit, base) + noise > 0.0


def _by_free_run(
    best: FittedModel,
    ranking: tuple[Ranked, ...],
    fits: Sequence[FittedModel],
    terms: tuple[Term, ...],
    settings: Settings,
) -> tuple[FittedModel, tuple[Ranked, ...]]:
    """Among candidates with inseparable likelihoods, put that with the smallest open-loop residual first.

    A candidate with more numbers than the most likely always follows better, and is not put first for that.
    """
    gaps = {terms[rival.number].key: rival.gap for rival in ranking}
    alike = [fit for fit in fits if gaps[fit.model.terms[-1].key] < settings.naming.separable]
    near = [fit for fit in alike if fit is best or number_count(fit) <= number_count(best)]
    keys = list(dict.fromkeys(fit.model.terms[-1].key for fit in near))
    if len(keys) < 2:
        return best, ranking
    runs = run_parallel(
        [partial(refit_open_loop, fit) for fit in near], best.model.prepared, [fit.model.terms[-1] for fit in near]
    )
    sizes = [math.inf if run is None else float(size_of(run.residual).log().sum()) for run in runs]
    first = min(range(len(near)), key=sizes.__getitem__)
    own = next(size for fit, size in zip(near, sizes, strict=True) if fit is best)
    if not sizes[first] < own + len(best.d) * math.log(_CLOSER):
        return best, ranking
    key = near[first].model.terms[-1].key
    return near[first], tuple(sorted(ranking, key=lambda rival: (terms[rival.number].key != key, rival.gap)))
