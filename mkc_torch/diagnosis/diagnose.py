"""Diagnose a recording against a simulation: locate the mismatch, name it, model it, show the fit improve."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._arguments import checked_number, checked_whole, told
from mkc_torch._forked import meanwhile, shared
from mkc_torch.diagnosis.advice import advice_of
from mkc_torch.diagnosis.candidates import candidate_terms, described
from mkc_torch.diagnosis.density_check import density_warnings
from mkc_torch.diagnosis.diagnosed_model import model_of
from mkc_torch.diagnosis.drivers import Drivers, find_drivers
from mkc_torch.diagnosis.ending import Ending, ending_parts, nameless
from mkc_torch.diagnosis.estimate import Estimate
from mkc_torch.diagnosis.evidence import Evidence, HeldOutBlocks, blocks_of, gain_interval, held_out
from mkc_torch.diagnosis.extrapolation import extrapolation_warning
from mkc_torch.diagnosis.findings import finding_of
from mkc_torch.diagnosis.first_look import p_value_beside
from mkc_torch.diagnosis.innovations import innovation_gain
from mkc_torch.diagnosis.locate import Located, locate
from mkc_torch.diagnosis.model import JointModel, Term
from mkc_torch.diagnosis.noise import correlation_time
from mkc_torch.diagnosis.noise_summary import noise_summary
from mkc_torch.diagnosis.preference import ALIKE_COLUMNS, UNKNOWN, alike
from mkc_torch.diagnosis.refit import FittedModel, fitted
from mkc_torch.diagnosis.rejected import rejected_warning
from mkc_torch.diagnosis.remaining import remaining_warning
from mkc_torch.diagnosis.result import Candidate, Diagnosis, HeldOut, Separability, Spread, Traces, Verdict
from mkc_torch.diagnosis.separability import separability
from mkc_torch.diagnosis.shifts import shift_warning
from mkc_torch.diagnosis.side_by_side import known_of, learn, with_memory
from mkc_torch.diagnosis.simplified import simplified
from mkc_torch.diagnosis.unrecorded import course_without, located_cause
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.protocol import Effect, FormedEffect
from mkc_torch.effects.unrecorded import Unrecorded
from mkc_torch.recording import Recording
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation, refuse_no_recording
from mkc_torch.units import unit_warnings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["diagnose"]

LEVEL = 0.05
SURROGATES = 99
MAX_FINDINGS = 3

_BESIDE = "Judged beside the other findings: while those are left out, they hide it."

FEWEST = 40
"""With fewer samples nothing can be said about structure."""

_WIDER, _NEAR = 3.0, 0.05

_BEYOND_DOUBT, _FURTHER = 8.0, 20.0
"""Nats beyond all draws of noise from which unseen blocks need only not to be clearly worse with a first finding, and
from which they need only to lean the way of a further one."""

_QUIET, _GLANCE = 0.1, 49
"""A p-value at a first look beside a finding above which nothing further is searched, and the draws that it takes."""

_IN_USE = 0.5
"""Weight from which a sample is one that the fit believes."""


def diagnose(
    simulation: Simulation,
    recording: Recording,
    *,
    effects: Sequence[Effect] = CATALOGUE,
    level: float = LEVEL,
    surrogates: int = SURROGATES,
    max_findings: int = MAX_FINDINGS,
    seed: int = 0,
) -> Diagnosis:
    """What a simulation lacks, by one recording of what it simulates.

    The simulation's own parameters are fitted together with every candidate: effect × driver × shape. The strongest
    one is judged by the same search on draws of the fitted noise, and by whether it predicts blocks that the fit has
    not seen; what passes is kept, refitted jointly, and the search goes on beside it. Where nothing passes, whatever
    the catalogue, a wander that moves a sensor's axes along one direction is told as "unknown": a cause that no column
    recorded.

    Args:
        simulation: of the recording, such as :class:`mkc_torch.simulation.Magnetometer`.
        recording: with named columns; see :class:`mkc_torch.Recording`.
        effects: the catalogue to search; :data:`mkc_torch.effects.CATALOGUE` and whatever a user adds.
        level: rate of false alarms, in (0, 1).
        surrogates: draws of noise for each p-value; at least ``1 / level - 1``.
        max_findings: findings at most.
        seed: of the draws.

    Returns:
        The diagnosis.

    Raises:
        TypeError: an argument of another kind: the name of a simulation, of a file or of an effect, or a class.
        ValueError: an argument out of range, too few samples, or a recording that the simulation refuses.
        MissingColumnError: the recording lacks a column that the simulation needs.

    Example:
        >>> from mkc_torch.demo import simulated_recording
        >>> from mkc_torch.simulation import Magnetometer
        >>> result = diagnose(Magnetometer(), simulated_recording()[0])
        >>> result.verdict in ("adequate", "explained", "unexplained")
        True
    """
    _refuse_no_simulation(simulation)
    refuse_no_recording("recording", recording)
    effects = _checked_effects(effects)
    _check(level, surrogates, max_findings, seed)
    where = f"{recording.name}: " if recording.name else ""
    if len(recording) < FEWEST:
        raise ValueError(
            f"{where}{len(recording)} samples are too few for a diagnosis; it needs {FEWEST} at least. Record longer."
        )
    prepared = simulation.prepare(recording)
    if len(prepared.time) < FEWEST:
        raise ValueError(
            f"{where}{len(prepared.time)} usable samples are too few for a diagnosis; it needs {FEWEST} at least."
        )
    roles = frozenset(role for effect in effects for role in effect.roles)
    measured: frozenset[str] = getattr(simulation, "measured", frozenset())
    drivers = find_drivers(prepared.recording, simulation.columns, roles, measured)
    terms = candidate_terms(prepared, drivers.drivers, effects)
    asked = _Asked(level, surrogates, max_findings, seed)
    generator = torch.Generator().manual_seed(seed)
    base = _base(prepared)
    search = _begun(base, terms, asked, generator)

    def told(search: _Search, parts: Sequence[Any]) -> Diagnosis:
        return _assembled(simulation, prepared, drivers, len(terms), base, search, Ending(*parts), asked)

    def following() -> _Search:
        after = _continued(search, asked, generator)
        fit = after.found[-1].fit
        fit.model.residual(fit.parameters)
        return after

    known = [simulation, base, base.model, *known_of(prepared, terms)]

    def ending(search: _Search) -> list[Callable[[], Any]]:
        return ending_parts(base, search.found, search.evidence, search.blocks, drivers.drivers, seed)

    while search.left:
        # most often there is nothing more
        with meanwhile(ending(search), [*known, *search.parts]) as ended:
            after, newest = with_memory(prepared, following)()
            if after.found == search.found:
                return _with_rest(told(replace(search, cut=after.cut), ended()), after)
        learn(prepared, newest)
        search = after
    return _with_rest(told(search, shared(ending(search), [*known, *search.parts])), search)


@dataclass(frozen=True)
class _Asked:
    """The arguments of :func:`diagnose` that are numbers."""

    level: float
    surrogates: int
    max_findings: int
    seed: int


def _holds(
    located: Located, before: Evidence, after: Evidence, blocks: HeldOutBlocks, seed: int, *, first: bool
) -> bool:
    """Whether what was found counts.

    Blocks weigh samples as if their noise was white, and miss what is plain in coloured noise: of the first finding,
    which the draws of noise have judged, they need only to lean its way, or not clearly the other way where it is plain
    beyond all draws; or to confirm it, by more than its number of parameters is worth, once the noise is filtered
    white. What comes after a finding also has what that one's form left over, and they have to confirm it, or to lean
    its way where it is plain beyond all draws.
    """
    difference = after.log_likelihood - before.log_likelihood
    gain, (low, high) = gain_interval(difference, blocks.block, torch.Generator().manual_seed(seed))
    if first:
        plain = located.beyond > _BEYOND_DOUBT and high > 0.0
        price = 0.5 * located.fit.model.sizes[-1] * math.log(len(after.log_likelihood))
        return gain > 0.0 or plain or innovation_gain(before.residual, after.residual) > price
    return low > 0.0 or (gain > 0.0 and located.beyond > _FURTHER)


def _base(prepared: PreparedSimulation) -> FittedModel:
    """The simulation alone, on the domain that all models share: wide enough for whatever effect reshapes residuals."""
    rough = fitted(JointModel(prepared), prepared.start())
    bound = _WIDER * torch.maximum(rough.bound, rough.bound.mean())
    return fitted(rough.model, rough.parameters, bound, graduate=False)


def _refuse_no_simulation(simulation: object) -> None:
    if not isinstance(simulation, type) and all(hasattr(simulation, name) for name in ("columns", "prepare")):
        return
    mend = "pass one, such as Magnetometer()"
    if isinstance(simulation, type):
        mend = f"make one, {simulation.__name__}()"
    elif isinstance(simulation, Recording):
        mend = "it comes first, diagnose(simulation, recording)"
    elif isinstance(simulation, str):
        mend += f", or name it on the command line, mkc diagnose REC.csv --simulation {simulation} --output DIR"
    raise TypeError(f"Expected argument `simulation` to be a Simulation but got {told(simulation)}; {mend}.")


def _checked_effects(effects: object) -> tuple[Effect, ...]:
    if isinstance(effects, str) or not isinstance(effects, Iterable):
        raise TypeError(
            f"Expected argument `effects` to be a sequence of Effects but got {told(effects)}; it is a tuple such as "
            "mkc_torch.effects.CATALOGUE, which holds all, and () for none."
        )
    # an iterator would be empty when it is asked again
    checked = tuple(effects)
    for effect in checked:
        _refuse_no_effect(effect)
    return checked


def _refuse_no_effect(effect: object) -> None:
    lacking = [name for name in ("id", "port", "roles", "quantities", "shapes", "change") if not hasattr(effect, name)]
    roles = getattr(effect, "roles", ())
    if isinstance(effect, type):
        mend = f"make one, {effect.__name__}()"
    elif isinstance(effect, str):
        mend = f"mkc_torch.effects.CATALOGUE holds them, [e for e in CATALOGUE if e.id == {effect!r}]"
    elif lacking:
        mend = f"it lacks {', '.join(lacking)}, which mkc_torch.effects.Effect explains"
    elif isinstance(roles, str):
        mend = f"its roles are names, ({roles!r},)"
    else:
        return
    raise TypeError(f"Expected argument `effects` to hold Effects but got {told(effect)}; {mend}.")


def _check(level: float, surrogates: int, max_findings: int, seed: int) -> None:
    checked_number("level", level, 0.0, 1.0, advice="0.05 is usual")
    checked_whole("surrogates", surrogates, 0, "99 is usual")
    checked_whole("max_findings", max_findings, 0, "3 is usual")
    checked_whole("seed", seed)
    if surrogates < math.ceil(1.0 / level - 1.0 - 1e-9):
        raise ValueError(
            f"Expected argument `surrogates` to be at least {math.ceil(1.0 / level - 1.0 - 1e-9)} at level {level}, "
            f"for no p-value can be smaller than 1 / (surrogates + 1), but got {surrogates}."
        )


@dataclass(frozen=True)
class _Search:
    """One search after the other: the first one, what was found, and what unseen blocks did not confirm.

    ``evidence`` is that of the simulation alone and with one finding more each; ``left`` are candidates that are still
    to be searched beside what was found, none once the search is over; ``given_up`` says why there was no next one, and
    ``cut`` that there was a further finding when as much was found as was asked for.
    """

    first: Located | None
    found: tuple[Located, ...]
    unconfirmed: Located | None
    blocks: HeldOutBlocks
    evidence: tuple[Evidence, ...]
    left: tuple[Term, ...]
    given_up: str = ""
    cut: bool = False

    @property
    def parts(self) -> tuple[object, ...]:
        """What the next search goes on with."""
        fits = [located.fit for located in self.found]
        return self.first, *self.found, *fits, *(fit.model for fit in fits), self.blocks, *self.evidence


def _begun(base: FittedModel, terms: tuple[Term, ...], asked: _Asked, generator: torch.Generator) -> _Search:
    """The first search, and its finding, if unseen blocks confirm it."""
    prepared = base.model.prepared
    correlation = max(correlation_time(one) for one in base.pseudo[0].unbind(1))
    blocks = blocks_of(len(base.residual), math.ceil(correlation))
    alone = with_memory(prepared, partial(held_out, base, blocks))

    def searched() -> Located:
        located = locate(base, terms, level=asked.level, surrogates=asked.surrogates, generator=generator)
        located.fit.model.residual(located.fit.parameters)  # to be the newest that a simulation remembers
        return located

    with meanwhile([alone], known_of(prepared, ())) as judged:
        first, newest = with_memory(prepared, searched)() if terms else (None, None)
        [(evidence, newest_alone)] = judged()
    learn(prepared, newest_alone)
    begun = _Search(first, (), None, blocks, (evidence,), terms)
    if first is None:
        return begun
    learn(prepared, newest)
    taken = _taken_up(begun, first, asked)
    if taken.found:
        return taken
    cause = located_cause(base, first, asked.level, asked.surrogates)
    if cause is None:
        return taken
    after = held_out(cause.fit, blocks, partial(course_without, base, cause))
    # beside a course that may be any, little is left to be told
    return replace(_taken_up(replace(taken, first=cause), cause, asked, after), left=())


def _continued(search: _Search, asked: _Asked, generator: torch.Generator) -> _Search:
    """The next search, beside what was found; none where a first look shows nothing."""
    if _quiet(search, asked):
        return replace(search, left=())
    fit = search.found[-1].fit
    try:
        located = locate(
            fit, search.left, level=asked.level, surrogates=asked.surrogates, generator=generator, parts=False
        )
        return _taken_up(search, located, asked)
    except ValueError as error:
        return replace(search, left=(), given_up=str(error))  # what was found before is not to be lost


def _quiet(search: _Search, asked: _Asked) -> bool:
    """Whether what is beside the last finding is far from anything that could count."""
    return _beside(search, asked) > max(_QUIET, asked.level)


def _beside(search: _Search, asked: _Asked) -> float:
    """The p-value of a first look beside the last finding."""
    last, near = search.found[-1], _near(search.found[-1].fit)
    others = [all(not _same(term, one.term, near) for one in search.found) for term in last.terms]
    return p_value_beside(last, others, _GLANCE, torch.Generator().manual_seed(asked.seed))


def _taken_up(search: _Search, located: Located, asked: _Asked, after: Evidence | None = None) -> _Search:
    """With what was located, if it counts; ``after`` is its evidence, where that is not the fit's own."""
    over = replace(search, left=())
    if located.p_value > asked.level or asked.max_findings == 0:
        return over
    before = search.evidence[-1]
    if after is None:
        after = held_out(located.fit, search.blocks)

    def holds(fit: FittedModel, evidence: Evidence) -> bool:
        one = replace(located, fit=fit)
        return _holds(one, before, evidence, search.blocks, asked.seed, first=not search.found)

    if not holds(located.fit, after):
        return replace(over, unconfirmed=located)
    if len(search.found) == asked.max_findings:
        return replace(over, cut=True)
    fit, after = simplified(located.fit, after, search.blocks, holds)
    found = (*search.found, replace(located, fit=fit))
    near = _near(located.fit)
    left = tuple(t for t in search.left if not _same(t, located.term, near))
    taken = replace(search, found=found, evidence=(*search.evidence, after), left=left)
    # a p-value of 0 is that of a look that sees nothing
    full = len(found) == asked.max_findings and not 0.0 < _beside(taken, asked) <= asked.level
    return replace(taken, left=()) if full else taken


def _near(fit: FittedModel) -> float:
    """Seconds within which a step is the same one."""
    time = fit.model.prepared.time
    return _NEAR * float(time[-1] - time[0])


def _same(term: Term, found: Term, near: float) -> bool:
    """Whether a candidate is the found effect again, or a curve over its driver.

    A step further away than ``near``, in s, is another one; closer by, it would only mend how the first one rises.
    """
    if "onset" in term.shape and "onset" in found.shape:
        return abs(term.shape["onset"] - found.shape["onset"]) < near
    if term.key == found.key or (term.effect.id == UNKNOWN and term.columns == found.columns):
        return True
    # beside a driver that was found, a column that goes the same way would only share its amplitude
    return term.driver is not None and found.driver is not None and alike(term.driver, found.driver) > ALIKE_COLUMNS


def _assembled(
    simulation: Simulation,
    prepared: PreparedSimulation,
    drivers: Drivers,
    tried: int,
    base: FittedModel,
    search: _Search,
    ending: Ending,
    asked: _Asked,
) -> Diagnosis:
    generator = torch.Generator().manual_seed(asked.seed)
    found, blocks, evidence, first = search.found, search.blocks, search.evidence, search.first
    final = ending.final
    inliers = (evidence[-1].residual.abs() <= 3.0 * evidence[-1].d) & (final.fit.weights > _IN_USE)

    def judged(k: int, term: Term, without: Evidence | None) -> tuple[HeldOut | None, str]:
        if without is None:
            return _held(evidence[k], evidence[k + 1], blocks, inliers, term, prepared, generator)
        held, note = _held(without, evidence[-1], blocks, inliers, term, prepared, generator)
        return held, note if held is None else _BESIDE

    findings = [
        replace(
            finding_of(s, final, k, *judged(k, s.term, more.without)),
            extrapolation=more.extrapolation,
            driver_shift=more.driver_shift,
            onset_interval=more.onset_interval,
        )
        for k, (s, more) in enumerate(zip(found, ending.beyond, strict=True))
    ]
    noise = noise_summary(final)
    diagnosis = Diagnosis(
        recording=prepared.recording.name,
        simulation=prepared.name,
        samples=len(prepared.time),
        level=asked.level,
        noise=noise,
        candidates_tried=tried,
        surrogates=asked.surrogates,
        seed=asked.seed,
        p_value=first.p_value if first else 1.0,
        verdict=_verdict(first, found, final.fit, ending.left, search.cut, asked),
        findings=tuple(findings),
        baseline=_spread(evidence[0], inliers),
        corrected=_spread(evidence[-1], inliers),
        ceiling=_spread(ending.reach.evidence, inliers),
        advice=(),
        warnings=(
            *prepared.recording.warnings,
            *unit_warnings(prepared.recording),
            *prepared.warnings,
            *drivers.warnings,
            *_time_warnings(prepared),
            *remaining_warning(ending.left),
            *_in_one_stretch(first, prepared.time),
            *(() if prepared.recording.time is None else rejected_warning(prepared.time, final.fit.weights)),
            *ending.stand_in,
            *(sentence for finding in findings for sentence in shift_warning(finding)),
            *(sentence for finding in findings for sentence in extrapolation_warning(finding)),
            *density_warnings(noise.checks),
        ),
        candidates=_candidates(first),
        separability=separability(first) if first else _nothing_to_separate(),
        traces=_traces(prepared, drivers, base, final),
        remaining=ending.left,
        model=model_of(final, simulation),
    )
    return replace(diagnosis, advice=advice_of(diagnosis))


def _verdict(
    first: Located | None,
    found: Sequence[Located],
    final: FittedModel,
    left: Sequence[str],
    cut: bool,
    asked: _Asked,
) -> Verdict:
    """Whether there is structure beyond the noise, and whether the findings account for it."""
    if not found:
        there = bool(left) or (first is not None and first.p_value <= asked.level)
        return "unexplained" if there else "adequate"
    return "unexplained" if nameless(final) or left or cut else "explained"


def _with_rest(diagnosis: Diagnosis, search: _Search) -> Diagnosis:
    """With what the last search found that does not count, and why there was no other."""
    more = [_not_confirmed(search.unconfirmed)] if search.unconfirmed else []
    if search.given_up:
        more.append(f"The search beside what was found was given up. {search.given_up}")
    if search.cut:
        more.append(
            f"There is more structure beside the {len(search.found)} findings, which are as many as were asked for; "
            "ask for more with `max_findings`."
        )
    return replace(diagnosis, warnings=(*diagnosis.warnings, *more))


def _held(
    before: Evidence,
    after: Evidence,
    blocks: HeldOutBlocks,
    inliers: Bool[Tensor, "N m"],
    term: Term,
    prepared: PreparedSimulation,
    generator: torch.Generator,
) -> tuple[HeldOut | None, str]:
    """The held-out evidence of one effect, or why there is none."""
    onset, time = term.shape.get("onset"), prepared.time
    if onset is not None:
        shorter = min(int((time < onset).sum()), int((time >= onset).sum()))
        if shorter < 2 * len(time) // (int(blocks.block.max()) + 1):
            return None, "one side of the step is shorter than two of the held-out blocks"
    difference = after.log_likelihood - before.log_likelihood
    gain, interval = gain_interval(difference, blocks.block, generator)
    return HeldOut(gain, interval, _rms(before, inliers), _rms(after, inliers), prepared.unit), ""


def _rms(evidence: Evidence, inliers: Bool[Tensor, "N m"]) -> float:
    return float(evidence.residual[inliers].square().mean().sqrt())


def _spread(evidence: Evidence, inliers: Bool[Tensor, "N m"]) -> Spread:
    return Spread(
        float(evidence.log_likelihood.mean()),
        _rms(evidence, inliers),
        tuple(evidence.sigma.tolist()),
        tuple(evidence.d.tolist()),
    )


def _candidates(first: Located | None) -> tuple[Candidate, ...]:
    if first is None:
        return ()
    return tuple(
        Candidate(
            first.terms[r.number].effect.id,
            first.terms[r.number].columns,
            _shape(first.terms[r.number]),
            r.gain,
            math.sqrt(2.0 * max(r.gain, 0.0)),
            first.terms[r.number].at,
            r.gap,
        )
        for r in first.ranking
    )


def _shape(term: Term) -> str:
    """What of an effect's shape is told: not what chooses its form."""
    chosen = term.effect.choices if isinstance(term.effect, FormedEffect) else ()
    return described({name: value for name, value in term.shape.items() if name not in chosen})


def _nothing_to_separate() -> Separability:
    return Separability((), torch.zeros(0, 0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))


def _not_confirmed(located: Located) -> str:
    shape = _shape(located.term)
    what = f"{_called(located.term)} ({shape})" if shape else _called(located.term)
    return (
        f"{what}: p = {located.p_value:.2g} after the whole search, but it does not predict blocks better that the fit "
        "has not seen, so it does not count as a finding."
    )


def _in_one_stretch(located: Located | None, time: Float[Tensor, " N"]) -> tuple[str, ...]:
    if located is None or located.stretch is None:
        return ()
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    return (
        f"From {begin:.1f} to {end:.1f} s the recording is off as {_called(located.term)} would have it, but hardly "
        "elsewhere. Other stretches are off too and no effect explains them, so this one counts as another burst of "
        "outliers. Record again, for longer.",
    )


def _called(term: Term) -> str:
    if isinstance(term.effect, Unrecorded):
        return "a cause that no column recorded"
    along = "a curve along" if term.effect.id == UNKNOWN else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "a curve without a name" if term.effect.id == UNKNOWN else term.effect.id


def _time_warnings(prepared: PreparedSimulation) -> tuple[str, ...]:
    if prepared.recording.time is not None:
        return ()
    return (
        "The recording has no column `time`: sample numbers stand in for seconds, and samples count as evenly spaced.",
    )


def _traces(prepared: PreparedSimulation, drivers: Drivers, base: FittedModel, final: Estimate) -> Traces:
    shown = {
        name: driver.values[:, k] + driver.reference[k]
        for driver in drivers.drivers
        for k, name in enumerate(driver.columns)
    }
    units = {name: unit for driver in drivers.drivers for name, unit in zip(driver.columns, driver.units, strict=True)}
    return Traces(
        time=prepared.time,
        has_time=prepared.recording.time is not None,
        before=base.residual,
        after=final.fit.residual,
        weight=final.fit.weights,
        channels=prepared.channels,
        unit=prepared.unit,
        drivers=shown,
        driver_units=units,
    )
