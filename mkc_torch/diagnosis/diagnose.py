"""Diagnose a recording against a simulation: locate the mismatch, name it, model it, measure the improvement."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import monotonic

from mkc_torch._parallel.deadline import Stopped, limited
from mkc_torch._parallel.progress import counting
from mkc_torch.diagnosis.model.suspect import texts_of
from mkc_torch.diagnosis.optional import optional, optional_steps
from mkc_torch.diagnosis.pipeline.partial import (
    PartialResult,
    after_error,
    build_result,
    cut_short,
    estimate,
    run_tests,
)
from mkc_torch.diagnosis.pipeline.prepare import Problem, SearchOptions, prepare
from mkc_torch.diagnosis.pipeline.restarts import restarted_problem, with_restarts_stated, without_restarts_stated
from mkc_torch.diagnosis.pipeline.search import fit_baseline, stepwise_search
from mkc_torch.diagnosis.result import Diagnosis
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.thresholds import LEVEL
from mkc_torch.diagnosis.validation.whole import with_whole_recording
from mkc_torch.diagnosis.verdict import EACH_OUTPUT, UNFIT, failed_rules
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.protocol import Simulation

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
    settings: Settings = Settings(),  # noqa: B008 - frozen
    noise: Mapping[str, float] | None = None,
    input_hold: Mapping[str, str] | None = None,
    suspect: str | Sequence[str] = (),
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
        suspect: sets of effects to score in addition to those that the search finds, such as
            "coulomb_friction@speed + input_lag@command"; ``suspected`` of the result compares them with the findings.
            They do not change the search. For differential equations only.
        quick: True for a quick look without surrogates: candidates are accepted by likelihood less a penalty, leading
            candidates are refitted from fewer starts, and slow tests of evidence are left out. There are no p-values,
            and the rate of false alarms is unknown.
        time_limit: seconds after which the search stops and returns what is known; ``stop`` lists what was not done.
            None for no limit.
        progress: called with the name of each stage as it begins. If it has a method ``count(thing, done, total)``,
            that method is called with the progress within a stage, such as the number of fitted candidates. A method
            ``found(text)`` is called with what was found so far.

    Returns:
        The diagnosis.

    Raises:
        TypeError: an argument of another kind: the name of a simulation, of a file or of an effect, or a class.
        ValueError: an argument out of range, too few samples, recordings whose columns or units differ, a recording
            that the simulation rejects, or a suspected effect that the simulation does not have.
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
    declared, holds = {} if noise is None else noise, {} if input_hold is None else input_hold
    options = SearchOptions(
        level, surrogates, max_findings, seed, settings, declared, holds, quick, suspect=texts_of(suspect)
    )
    problem = prepare(simulation, recording, effects, options, time_limit, progress)
    limit = math.inf if time_limit is None else time_limit
    with optional_steps() as failed:
        result = _with_or_without_restarts(problem, recording, limit, begin)
        on_all = partial(with_whole_recording, result, problem.whole)
        result = optional("predicting the whole recording", on_all, lambda: result)
    return replace(result, warnings=(*result.warnings, *failed))


def _with_or_without_restarts(
    problem: Problem, recording: Recording | Sequence[Recording], limit: float, begin: float
) -> Diagnosis:
    """Return the diagnosis of the free run; where it does not follow and one with restarts explains it, that.

    Segments can follow a simulation that is wrong, by their initial states. So if a fit of the free run is found, only
    named physics that explains the segments replaces its verdict; a column with a wrong sign or unit explains it.
    """
    known = PartialResult(problem)
    try:
        result = _result_of(problem, known, limit, begin)
    except NoFitError:
        again = restarted_problem(problem, recording, limit, begin)
        if again is None:
            raise
        return with_restarts_stated(_result_of(again, PartialResult(again), limit, begin), again, found=False)
    wrong_column = known.search is not None and known.search.column
    if not {UNFIT, EACH_OUTPUT} & set(failed_rules(result.decisions)) or result.stop is not None or wrong_column:
        return result
    again = restarted_problem(problem, recording, limit, begin)
    if again is None:
        return without_restarts_stated(result, problem, None)
    try:
        restarted = _result_of(again, PartialResult(again), limit, begin)
    except NoFitError:
        return without_restarts_stated(result, problem, again)
    if restarted.verdict != "explained":
        return without_restarts_stated(result, problem, again)
    return with_restarts_stated(restarted, again, found=True)


def _result_of(problem: Problem, known: PartialResult, limit: float, begin: float) -> Diagnosis:
    """Return the result of the stages, or of those before the time limit or an internal error."""
    with limited(limit, begin=begin) as deadline, counting(problem.progress):
        step = ""
        try:
            baseline = fit_baseline(problem, known)
            step = "searching for effects"
            steps = stepwise_search(problem, known, baseline)
            step = "checking what was found"
            final = estimate(known, steps)
            step = "running the tests of evidence"
            evidence = run_tests(known, steps, final)
            step = "describing the result"
            return build_result(known, steps, evidence)
        except Stopped as stopped:
            ended: Callable[[], Diagnosis] = partial(cut_short, known, stopped.reason, deadline.elapsed, limit)
        except NoFitError:
            raise  # the simulation is tried with restarts
        except Exception as error:
            if not step:
                raise
            ended = partial(after_error, known, step, error, deadline.elapsed)
    return ended()
