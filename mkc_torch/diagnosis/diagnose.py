"""Diagnose a recording against a simulation: locate the mismatch, name it, model it, measure the improvement."""

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
    checked_effects,
    checked_input_hold,
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
from mkc_torch.diagnosis.model.process_noise import choose_input_hold, estimate_noise, fit_baseline, noise_of_fit
from mkc_torch.diagnosis.partial_diagnosis import cut_short, error_without_fit
from mkc_torch.diagnosis.partial_result import PartialResult
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.settings import Settings, quick_settings
from mkc_torch.diagnosis.stepwise import SearchOptions, first_step, next_step
from mkc_torch.diagnosis.verdict import assess_baseline, impossible_rotations
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

__all__ = ["diagnose"]

LEVEL = 0.05
"""Default rate of false alarms."""

SURROGATES = 99
"""Default number of surrogates for each p-value."""

MAX_FINDINGS = 3
"""Default limit on the number of findings."""


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
    input_hold: Mapping[str, str] | None = None,
    quick: bool = False,
    time_limit: float | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> Diagnosis:
    """Find the physics that a simulation leaves out of a recording, or of several recordings together.

    The simulation's own parameters are refitted with every candidate: effect × driver × shape. The strongest candidate
    has to pass two tests: the same search on surrogates of the fitted noise, and the prediction of held-out blocks. A
    candidate that passes is a finding; it is refitted jointly, and the search continues with it in the model. If no
    candidate of any catalogue passes, a drift that moves a sensor's axes along one direction is reported as "unknown":
    its cause is in no recorded column.

    Several recordings of one system share their parameters and findings. Each has its own initial states, and its own
    offsets of the outputs, as far as these can be determined. Physics repeats from run to run; slow noise and
    disturbances do not. For a simulation without states the recordings follow one another on one clock; a
    magnetometer has one offset for all of them.

    Args:
        simulation: the model of the recorded system, such as :class:`mkc_torch.simulation.Magnetometer`.
        recording: named columns, see :class:`mkc_torch.Recording`; or a sequence of recordings with the same columns
            in the same units.
        effects: the catalogue to search; :data:`mkc_torch.effects.CATALOGUE` and a user's own effects.
        level: rate of false alarms, in (0, 1).
        surrogates: draws of noise for each p-value; at least ``1 / level - 1``.
        max_findings: limit on the number of findings.
        seed: of the random draws.
        settings: thresholds by stage, see :class:`mkc_torch.diagnosis.Settings`. The published rates of false alarms
            and the power were measured with the default.
        noise: known standard deviations of the sensors' white noise, by output, in the output's unit; the others are
            estimated.
        input_hold: known input holds between two samples, "held" or "linear", by input; for the others the more likely
            hold is used. For differential equations only.
        quick: True for a quick look without surrogates: candidates are accepted by likelihood less a penalty, leading
            candidates are refitted from fewer starts, and slow tests of evidence are left out. There are no p-values,
            and the rate of false alarms is unknown.
        time_limit: seconds after which the search stops and returns what is known; ``stop`` lists what was not done.
            None for no limit.
        progress: called with the name of each stage as it begins. If it has a method ``count(thing, done, total)``,
            that method is called with the progress within a stage, such as the number of fitted candidates.

    Returns:
        The diagnosis.

    Raises:
        TypeError: an argument of another kind: the name of a simulation, of a file or of an effect, or a class.
        ValueError: an argument out of range, too few samples, recordings whose columns or units differ, or a recording
            that the simulation rejects.
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
    fixed = checked_input_hold(input_hold, tuple(prepared.input_hold))
    options = SearchOptions(level, surrogates, max_findings, seed, settings, declared, fixed, quick)
    known = PartialResult(simulation, effects, names, options, run_counts(several) if names else ())
    limit = math.inf if time_limit is None else time_limit
    with limited(limit, begin=begin) as deadline, counting(progress):
        try:
            return _diagnosed(known, prepared, where, progress)
        except Stopped as stopped:
            reason, seconds = stopped.reason, deadline.elapsed
    if known.baseline is None:
        raise error_without_fit(reason, limit, where)
    progress("writing down what is known")
    return cut_short(known, reason, seconds)


def _diagnosed(
    known: PartialResult, prepared: PreparedSimulation, where: str, progress: Callable[[str], object]
) -> Diagnosis:
    """Run the diagnosis; ``known`` holds the partial result if the run is stopped."""
    options = known.options
    declared, fixed, settings = options.declared, options.fixed, options.settings
    generator = torch.Generator().manual_seed(options.seed)
    prepared = prepared.with_input_hold(fixed)
    if prepared.dynamics is not None and options.quick:
        known.options = options = replace(options, max_findings=min(options.max_findings, 1), judged=False)
    progress("fitting the simulation alone")
    baseline = fit_baseline(prepared, declared, settings.noise, known.keep_baseline)
    known.baseline = baseline = choose_input_hold(baseline, declared, fixed, settings.noise)
    known.fitted = True
    base = baseline.fit
    _refuse_no_noise(base, where)
    finer = with_smaller_step(base, settings.noise)
    if finer is not None:
        return _diagnosed(known.restart(), finer, where, progress)
    terms = known.candidates[1]
    if poor_fits(assess_baseline(baseline, declared), settings.evidence.followed):
        # a poor fit may lack a single effect; further findings wait until the simulation fits with it
        known.options = options = replace(options, max_findings=min(options.max_findings, 1))
    hopeless = impossible_rotations(baseline)
    progress(f"trying {len(terms)} effects")
    terms = () if hopeless else terms
    search = first_step(base, terms, options, generator, baseline.free, known.keep_search)
    refitted_noise_fit = None if search.first is None else search.first.without_candidate
    noise = (
        None
        if refitted_noise_fit is None
        else estimate_noise(refitted_noise_fit, declared, settings.noise, noise_of_fit(refitted_noise_fit, declared))
    )
    if refitted_noise_fit is not None and noise is not None and noise.observer is not None:
        progress(f"trying {len(terms)} effects under a more likely noise model")
        known.baseline = baseline = replace(baseline, fit=refitted_noise_fit, noise=noise)
        base = refitted_noise_fit
        search = first_step(base, terms, options, generator, baseline.free, known.keep_search)
    finer = with_smaller_step(search.found[-1].fit, settings.noise) if search.found else None
    if finer is not None:
        return _diagnosed(known.restart(), finer, where, progress)
    known.search, tests = search, known.tests
    common = [known.simulation, base, base.model, *common_parts(base.model.prepared.open_loop(), terms)]
    while search.left:
        case = known.case(search)
        # usually there is no further finding, so compute the evidence ahead
        with speculative(precompute(case, tests), [*common, *search.parts]) as done:
            progress(f"trying {len(search.left)} effects in addition to {len(search.found)} found")
            after = next_step(search, options, generator, known.keep_search)
            if after.found == search.found:
                known.search = after
                return known.diagnosis(after, case, done(), tests)
        known.search = search = after
    case = known.case(search)
    progress("checking what was found")
    done_ahead = shared(precompute(case, tests), [*common, *search.parts], "test of evidence")
    return known.diagnosis(search, case, done_ahead, tests)


def _refuse_no_noise(base: FittedModel, where: str) -> None:
    """Raise ValueError for a channel whose residual is constant: no noise is left to test an effect against."""
    same = (base.residual == base.residual[:1]).all(0)
    nothing = base.d.square() < torch.finfo(base.d.dtype).tiny
    exact = (same | nothing).tolist()
    names = [name for name, is_exact in zip(base.model.prepared.channels, exact, strict=True) if is_exact]
    if names:
        raise ValueError(
            f"{where}`{names[0]}` differs from the simulation by the same number in every sample, so no noise is left "
            "to test effects against. Leave it out of the compared channels, or record it with its noise."
        )
