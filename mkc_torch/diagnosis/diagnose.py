"""Diagnose a recording against a simulation: locate the mismatch, name it, model it, show the fit improve."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import monotonic

import torch

from mkc_torch._parallel.deadline import Stopped, limited
from mkc_torch._parallel.pool import shared, speculative
from mkc_torch._parallel.progress import counting
from mkc_torch.diagnosis.arguments import (
    check_limits,
    check_numbers,
    checked_between,
    checked_effects,
    checked_noise,
    refuse_no_settings,
    refuse_no_simulation,
)
from mkc_torch.diagnosis.evidence.run import precompute
from mkc_torch.diagnosis.goodness_of_fit import poor_fits
from mkc_torch.diagnosis.joined import joined, run_counts, with_own_offsets
from mkc_torch.diagnosis.linearised.smaller_step import with_smaller_step
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.parallel import common_parts
from mkc_torch.diagnosis.model.process_noise import choose_input_hold, estimate_noise, fit_baseline, open_loop
from mkc_torch.diagnosis.partial_diagnosis import cut_short, nothing_known
from mkc_torch.diagnosis.partial_result import PartialResult
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.search.own_noise import noise_of_fit
from mkc_torch.diagnosis.settings import Settings, quick_settings
from mkc_torch.diagnosis.stepwise import SearchOptions, first_step, next_step
from mkc_torch.diagnosis.verdict import assess_baseline, lost_from_the_start
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

__all__ = ["diagnose"]

LEVEL = 0.05
"""Rate of false alarms, if none is asked for."""

SURROGATES = 99
"""Draws of noise for each p-value, if no number is asked for."""

MAX_FINDINGS = 3
"""Findings at most, if no number is asked for."""


def diagnose(
    simulation: Simulation,
    recording: Recording | Sequence[Recording],
    *,
    effects: Sequence[Effect] = CATALOGUE,
    level: float = LEVEL,
    surrogates: int = SURROGATES,
    max_findings: int = MAX_FINDINGS,
    seed: int = 0,
    settings: Settings = Settings(),  # noqa: B008
    noise: Mapping[str, float] | None = None,
    between: Mapping[str, str] | None = None,
    quick: bool = False,
    time_limit: float | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> Diagnosis:
    """What a simulation lacks, by one recording of what it simulates, or by several together.

    The simulation's own parameters are fitted together with every candidate: effect × driver × shape. The strongest
    one is judged by the same search on draws of the fitted noise, and by whether it predicts blocks that the fit has
    not seen; what passes is kept, refitted jointly, and the search goes on beside it. Where nothing passes, whatever
    the catalogue, a wander that moves a sensor's axes along one direction is told as "unknown": a cause that no column
    recorded.

    Several recordings of one system are diagnosed together: one set of parameters and of findings for all of them, and
    states at the start for each, and offsets of the outputs, as far as they are determined. Physics repeats from run to
    run, slow noise and disturbances do not. Of a simulation without states the recordings follow one another on one
    clock; a magnetometer has one offset in all of them.

    Args:
        simulation: of the recording, such as :class:`mkc_torch.simulation.Magnetometer`.
        recording: with named columns, see :class:`mkc_torch.Recording`; or a sequence of recordings with the same
            columns in the same units.
        effects: the catalogue to search; :data:`mkc_torch.effects.CATALOGUE` and whatever a user adds.
        level: rate of false alarms, in (0, 1).
        surrogates: draws of noise for each p-value; at least ``1 / level - 1``.
        max_findings: findings at most.
        seed: of the draws.
        settings: the numbers that decide, by stages; see :class:`mkc_torch.diagnosis.Settings`. What was measured of
            false alarms and power was measured with the default.
        noise: standard deviation of the sensor's white noise, by the output's name and in its unit, where it is known;
            estimated otherwise.
        between: what an input does between two samples, "held" or "linear", where it is known; otherwise whichever is
            likelier. Of differential equations only.
        quick: a first look that draws no noise: candidates count by their likelihood's price alone, leading ones are
            refitted from fewer starts, and tests of evidence that take long are left out. There are no p-values then,
            and nobody knows the rate of false alarms.
        time_limit: seconds after which the search is stopped; what is known then is returned, and ``stop`` says what
            was not done. None for no limit.
        progress: called with what is being done, as each stage begins. Where it has a method
            ``count(thing, done, total)`` too, that is called with how many of the things that a stage is made of are
            done: candidates that are fitted, say.

    Returns:
        The diagnosis.

    Raises:
        TypeError: an argument of another kind: the name of a simulation, of a file or of an effect, or a class.
        ValueError: an argument out of range, too few samples, recordings whose columns or units differ, or a recording
            that the simulation refuses.
        MissingColumnError: the recording lacks a column that the simulation needs.
        TimeoutError: the time limit was over before the simulation's first fit had ended.

    Example:
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> from mkc_torch.simulation import Magnetometer
        >>> result = diagnose(Magnetometer(), simulated_recording()[0])
        >>> result.verdict in ("adequate", "explained", "unexplained")
        True
    """
    begin = monotonic()
    refuse_no_simulation(simulation)
    several = () if isinstance(recording, Recording) else tuple(recording)
    recording, names = joined(simulation, recording)
    effects = checked_effects(effects)
    check_numbers(level, surrogates, max_findings, seed)
    check_limits(quick, time_limit)
    refuse_no_settings(settings)
    settings = quick_settings(settings) if quick else settings
    fewest = settings.search.fewest_samples
    where = f"{recording.name}: " if recording.name else ""
    if len(recording) < fewest:
        raise ValueError(
            f"{where}{len(recording)} samples are too few for a diagnosis; it needs {fewest} at least. Record longer."
        )
    progress("reading the recording")
    prepared = simulation.prepare(recording)
    if len(prepared.time) < fewest:
        raise ValueError(
            f"{where}{len(prepared.time)} usable samples are too few for a diagnosis; it needs {fewest} at least."
        )
    prepared = with_own_offsets(prepared, several)
    declared = checked_noise(noise, prepared.channels)
    fixed = checked_between(between, tuple(getattr(prepared, "between", ())))
    asked = SearchOptions(level, surrogates, max_findings, seed, settings, declared, fixed, quick)
    known = PartialResult(simulation, effects, names, asked, run_counts(several) if names else ())
    limit = math.inf if time_limit is None else time_limit
    with limited(limit, begin=begin) as deadline, counting(progress):
        try:
            return _diagnosed(known, prepared, where, progress)
        except Stopped as stopped:
            reason, seconds = stopped.reason, deadline.elapsed
    if known.world is None:
        raise nothing_known(reason, limit, where)
    progress("writing down what is known")
    return cut_short(known, reason, seconds)


def _diagnosed(
    known: PartialResult, prepared: PreparedSimulation, where: str, progress: Callable[[str], object]
) -> Diagnosis:
    """The diagnosis, unless it is stopped; ``known`` has what is known then."""
    asked = known.asked
    declared, fixed, settings = asked.declared, asked.fixed, asked.settings
    generator = torch.Generator().manual_seed(asked.seed)
    if isinstance(prepared, PreparedDynamics):
        prepared = prepared.holding(fixed)
        if asked.quick:
            known.asked = asked = replace(asked, max_findings=min(asked.max_findings, 1), judged=False)
    progress("fitting the simulation alone")
    world = fit_baseline(prepared, declared, settings.noise, known.keep_world)
    known.world = world = choose_input_hold(world, declared, fixed, settings.noise)
    known.fitted = True
    base = world.fit
    _refuse_no_noise(base, where)
    finer = with_smaller_step(base, settings.noise)
    if finer is not None:
        return _diagnosed(known.anew(), finer, where, progress)
    terms = known.candidates[1]
    if poor_fits(assess_baseline(world, declared), settings.evidence.followed):
        # one effect may be what it lacks to follow; what it lacks beside that is told once it follows
        known.asked = asked = replace(asked, max_findings=min(asked.max_findings, 1))
    hopeless = lost_from_the_start(world)
    progress(f"trying {len(terms)} effects")
    terms = () if hopeless else terms
    search = first_step(base, terms, asked, generator, world.free, known.keep_search)
    likelier = None if search.first is None else search.first.alone
    noise = (
        None
        if likelier is None
        else estimate_noise(likelier, declared, settings.noise, noise_of_fit(likelier, declared))
    )
    if likelier is not None and noise is not None and noise.observer is not None:
        progress(f"trying {len(terms)} effects under a likelier noise")
        known.world = world = replace(world, fit=likelier, noise=noise)
        base = likelier
        search = first_step(base, terms, asked, generator, world.free, known.keep_search)
    finer = with_smaller_step(search.found[-1].fit, settings.noise) if search.found else None
    if finer is not None:
        return _diagnosed(known.anew(), finer, where, progress)
    known.search, tests = search, known.tests
    common = [known.simulation, base, base.model, *common_parts(open_loop(base.model.prepared), terms)]
    while search.left:
        case = known.case(search)
        # most often there is nothing more
        with speculative(precompute(case, tests), [*common, *search.parts]) as done:
            progress(f"trying {len(search.left)} effects beside {len(search.found)} found")
            after = next_step(search, asked, generator, known.keep_search)
            if after.found == search.found:
                known.search = after
                return known.diagnosis(after, case, done(), tests)
        known.search = search = after
    case = known.case(search)
    progress("checking what was found")
    done_ahead = shared(precompute(case, tests), [*common, *search.parts], "test of evidence")
    return known.diagnosis(search, case, done_ahead, tests)


def _refuse_no_noise(base: FittedModel, where: str) -> None:
    """Refuse a channel that the simulation answers exactly: there is no noise that structure could be told from."""
    same = (base.residual == base.residual[:1]).all(0)
    nothing = base.d.square() < torch.finfo(base.d.dtype).tiny
    exact = (same | nothing).tolist()
    names = [name for name, one in zip(base.model.prepared.channels, exact, strict=True) if one]
    if names:
        raise ValueError(
            f"{where}`{names[0]}` differs from the simulation by the same number in every sample, so it has no noise "
            "to tell structure from. Leave it out of what is compared, or record it with its noise."
        )
