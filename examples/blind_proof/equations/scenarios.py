"""Scenarios of differential equations: process noise, held inputs, far starting values, and wrong simulations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from torch import Generator

from examples.blind_proof import aims, draws
from examples.blind_proof.equations.best_fit import Guess, best_shares, right, wrong
from examples.blind_proof.equations.cases import hide, key_effect, key_of, measured_by
from examples.blind_proof.equations.disturbances import (
    KINDS,
    LASTING_ALONE,
    LASTING_RUNS,
    SHORT,
    DisturbedErrors,
    DisturbedState,
    draw_disturbance,
)
from examples.blind_proof.equations.errors import Errors, Slow, Whitening, draw_errors
from examples.blind_proof.equations.integrate import Course, SystemScene, simulate
from examples.blind_proof.equations.plant import Array, Plant, RunSet, Setting
from examples.blind_proof.equations.simulations import (
    OTHER,
    UNRELATED,
    WRONG_SIGN,
    class_of,
    far_starts,
    right_source,
    wrong_source,
)
from examples.blind_proof.equations.systems import SYSTEMS
from examples.blind_proof.key import KeyDisturbance
from examples.blind_proof.proof import Case, Proof, Scenario
from mkc_torch.recording.recording import Recording

OUTSIDE_SHARE = 0.25
"""Share of hidden effects that are outside the catalogue."""

CORRELATION = (0.3, 0.9)
"""Correlation of coloured noise from sample to sample."""

RUNS = (3, 5)
"""Number of runs in the scenario of several runs."""

SLOW_SENSOR = "slow_sensor"
"""Scenario whose sensors drift in addition to white noise."""

SLOW_SIZE = (1.0, 5.0)
"""Standard deviation of a drift over that of the white noise."""

SLOW_TIME = (0.01, 0.1)
"""Correlation time of a drift, as a share of a run."""

LEAST_SLOW = 3.0
"""Shortest correlation time of a drift, in samples; a shorter time is coloured noise."""

LASTING_COUNT = 4
"""Number of runs that distinguishes a lasting disturbance from physics, which is the same in each run."""

MOST_EXPLAINED = 0.25
"""Largest share of an output's variation that the best fit of an unusable simulation may explain."""

_TRIED = 400
"""Most draws of an unusable case."""

_FITS = 4
"""Fits of an unusable simulation, each from its own starts."""


def equations_scenarios() -> Proof:
    """Return twelve scenarios of the systems with states. Noise is white except in ``coloured`` and ``slow_sensor``.

    Example:
        >>> [scenario.name for scenario in equations_scenarios().scenarios][:3]
        ['white', 'coloured', 'pushed_white']
    """
    return Proof(
        "equations_scenarios",
        (
            _scenario("white", "white sensor noise", aims.WHITE, aims.QUIET),
            _scenario("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            _scenario("pushed_white", "white process noise in one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario("pushed_slowly", "slow process noise in one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario("gusts", "gusts in the rate of one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario(
                "held", "inputs held between samples; the simulation assumes linear ones", aims.WHITE, aims.QUIET
            ),
            _scenario(
                "far_starts", "starting values of the parameters ten times too large or small", aims.WHITE, aims.QUIET
            ),
            _scenario("runs", "three to five runs", aims.WHITE, aims.QUIET),
            Scenario(
                SLOW_SENSOR,
                "white noise, and a drift of the sensor with a correlation time of 1 to 10 % of a run",
                partial(draw, SLOW_SENSOR),
                aims.ORDINARY,
                right="nothing hidden: no name, and the drift attributed to the sensor; else the hidden physics",
                wrong=aims.CLAIMED,
                share=1.0,
            ),
            Scenario(
                LASTING_ALONE,
                "one run; process noise in one state with a correlation time of 0.3 to 1 of the run",
                partial(draw, LASTING_ALONE),
                aims.LASTING,
                right="undecided: unexplained, or a name with alternatives; a second run would decide",
                wrong="a single name other than the hidden one; unfit",
                share=1.0,
                apart=True,
            ),
            Scenario(
                LASTING_RUNS,
                "four runs; process noise in one state with a correlation time of 0.3 to 1 of a run, new in each",
                partial(draw, LASTING_RUNS),
                aims.DISTURBED_STATE,
                right=aims.DISTURBED,
                wrong=aims.CLAIMED,
                share=1.0,
            ),
            Scenario(
                "useless",
                "an unusable simulation, whose best fit explains at most a quarter of any output",
                draw_useless,
                aims.USELESS,
                hides=False,
                right="unfit",
                wrong="adequate",
            ),
        ),
        empty=60,
        totals=aims.TOTALS,
    )


def _scenario(name: str, sentence: str, asked: tuple[aims.Threshold, ...], right: str) -> Scenario:
    return Scenario(name, sentence, partial(draw, name), asked, right=right, wrong=aims.CLAIMED)


def draw(scenario: str, seed: int, index: int, hidden: bool, number: int) -> Case:
    """Draw the case at an address.

    Args:
        scenario: a key of ``disturbances.KINDS``, or white, coloured, slow_sensor, held, far_starts, runs.
        seed: seed of the proof.
        index: number of the case among those of its scenario, hidden or empty.
        hidden: hide physics. In every second such case a disturbance acts, too, except with drifting sensors.
        number: number in the recording's name; nothing else depends on it.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, "worlds", "dynamics", scenario, "hidden" if hidden else "empty", index, what)

    system, setting = _setting(stream, scenario)
    plant, trial = setting.plant, _trial(stream, scenario, system, setting)
    scene = SystemScene(plant, trial, simulate(plant, trial))
    errors = _errors(stream, scenario, scene.course.outputs)
    if scenario == SLOW_SENSOR:
        errors = replace(errors, slow=_slow(stream("slow"), plant, trial))
    disturbance = _disturbance(stream, scenario, index, hidden, scene, errors)
    rates = None if disturbance is None else disturbance.rates
    name = f"{system}_{number:05d}"
    simulation = right_source(class_of(system), far_starts(stream("starts")) if scenario == "far_starts" else None)
    if not hidden:
        course = scene.course if rates is None else simulate(plant, trial, disturbance=rates)
        return _case(stream, scenario, index, name, scene, course, errors, disturbance, simulation)
    weighing: Whitening = errors if disturbance is None else DisturbedErrors(scene, errors, disturbance)
    kind, effect, size, seen = hide(stream, SYSTEMS[system], scene, weighing, OUTSIDE_SHARE)
    course = simulate(plant, trial, effect, size, rates)
    case = _case(stream, scenario, index, name, scene, course, errors, disturbance, simulation)
    return replace(case, key=replace(case.key, kind=kind, effects=(key_effect(effect, size, seen),)))


def draw_useless(seed: int, index: int, hidden: bool, number: int) -> Case:
    """Draw a recording and an unusable simulation: a wrong sign, another system, or an unrelated output.

    Cases are drawn until the best of several fits explains at most ``MOST_EXPLAINED`` of every output's variation.
    """
    for again in range(_TRIED):

        def stream(what: str, again: int = again) -> Generator:
            return draws.generator(seed, "worlds", "dynamics", "useless", index, again, what)

        system, setting = _setting(stream, "useless")
        plant, trial = setting.plant, setting.trial
        scene = SystemScene(plant, trial, simulate(plant, trial))
        # the index determines the kind, so that each kind has its share
        kind = (WRONG_SIGN, OTHER, UNRELATED)[index % 3]
        course = scene.course
        if kind == UNRELATED:
            course = replace(course, outputs=_unrelated(stream("unrelated"), system, scene))
        guess = right(plant) if kind == UNRELATED else wrong(plant, kind)
        explained = _explained(stream, guess, trial, course.outputs)
        if explained > MOST_EXPLAINED:
            continue
        errors = _errors(stream, "useless", course.outputs)
        name = class_of(system)
        simulation = right_source(name) if kind == UNRELATED else wrong_source(name, kind)
        case = _case(stream, "useless", index, f"{system}_{number:05d}", scene, course, errors, None, simulation)
        return replace(case, key=replace(case.key, kind="useless", useless=kind, explained=explained))
    raise RuntimeError(f"No unusable case for seed {seed}, index {index} in {_TRIED} draws; increase MOST_EXPLAINED.")


def _explained(stream: Callable[[str], Generator], guess: Guess, trial: RunSet, outputs: Array) -> float:
    """Return the largest explained share of any output over several fits; stops at a share above the limit."""
    most = -np.inf
    for again in range(_FITS):
        most = max(most, *best_shares(stream(f"fit {again}"), guess, trial, outputs))
        if most > MOST_EXPLAINED:
            break
    return float(most)


def _setting(stream: Callable[[str], Generator], scenario: str) -> tuple[str, Setting]:
    """Draw a system with states and its runs. A throw has no inputs to hold and no starting values."""
    without = {"servo", "projectile"} if scenario in ("held", "far_starts") else {"servo"}
    system = draws.choose(stream("system"), [name for name in SYSTEMS if name not in without])
    return system, SYSTEMS[system].draw(stream("setting"))


def _trial(stream: Callable[[str], Generator], scenario: str, system: str, setting: Setting) -> RunSet:
    if scenario not in ("runs", LASTING_ALONE, LASTING_RUNS):
        return replace(setting.trial, held=scenario == "held")
    g = stream("runs")
    runs = draws.whole(g, *RUNS) if scenario == "runs" else 1 if scenario == LASTING_ALONE else LASTING_COUNT
    return SYSTEMS[system].trial(g, setting.plant, runs, setting.trial.samples * setting.trial.runs // runs)


def _errors(stream: Callable[[str], Generator], scenario: str, outputs: Array) -> Errors:
    correlation = draws.uniform(stream("colour"), *CORRELATION) if scenario == "coloured" else 0.0
    return replace(draw_errors(stream("noise"), outputs), correlation=correlation)


def _slow(g: Generator, plant: Plant, trial: RunSet) -> tuple[Slow, ...]:
    """Draw a drift of one output, and of each other output with probability 1/2."""
    first = draws.choose(g, plant.outputs)
    longest = trial.samples - 1
    return tuple(
        Slow(
            draws.log_uniform(g, *SLOW_SIZE) if name == first or draws.happens(g, 0.5) else 0.0,
            max(draws.log_uniform(g, *SLOW_TIME) * longest, LEAST_SLOW),
        )
        for name in plant.outputs
    )


def _disturbance(
    stream: Callable[[str], Generator], scenario: str, index: int, hidden: bool, scene: SystemScene, errors: Errors
) -> DisturbedState | None:
    """Draw the disturbance of a case, if it has one.

    Its scenario has one, or physics is hidden and the index is even, except with drifting sensors.
    """
    always = scenario in (LASTING_ALONE, LASTING_RUNS) or (scenario in KINDS and not hidden)
    additional = hidden and index % 2 == 0 and scenario != SLOW_SENSOR
    if not (always or additional):
        return None
    g = stream("push")
    return draw_disturbance(g, scenario if scenario in KINDS else draws.choose(g, SHORT), scene, errors)


def _unrelated(g: Generator, system: str, scene: SystemScene) -> Array:
    """Return outputs of other runs, or smooth paths of the same size. A throw, without inputs, gets paths only."""
    plant, trial, outputs = scene.plant, scene.trial, scene.course.outputs
    if plant.inputs and draws.happens(g, 0.5):
        return simulate(plant, SYSTEMS[system].trial(g, plant, trial.runs, trial.samples)).outputs
    middle, reach = outputs.mean((1, 2)), outputs.std((1, 2))
    if not plant.inputs:
        middle, reach = np.zeros_like(middle), np.array([draws.uniform(g, 2.0, 10.0) for _ in plant.outputs])
    length = (trial.samples - 1) * trial.step
    paths = [
        draws.smooth(g, trial.samples, len(plant.outputs), trial.step, draws.uniform(g, 0.15, 0.4) * length)
        for _ in range(trial.runs)
    ]
    return np.stack([middle[:, None] + path.numpy().T * reach[:, None] for path in paths], -1)


def _case(
    stream: Callable[[str], Generator],
    scenario: str,
    index: int,
    name: str,
    scene: SystemScene,
    course: Course,
    errors: Errors,
    disturbance: DisturbedState | None,
    simulation: str,
) -> Case:
    measured = measured_by(stream, "", scene.plant, scene.trial, course, errors)
    noted = _key_slow(scene, errors) if errors.slow else None if disturbance is None else _key_disturbance(disturbance)
    key = replace(
        key_of(name, "empty", scene.plant, errors, measured), scenario=scenario, index=index, disturbance=noted
    )
    return Case(Recording(measured.columns, name=name), key, simulation=simulation)


def _key_disturbance(disturbance: DisturbedState) -> KeyDisturbance:
    words = {**disturbance.words, "over noise, true parameters": disturbance.free_over_noise}
    return KeyDisturbance(
        disturbance.kind, disturbance.state, disturbance.size, disturbance.unit, disturbance.over_noise, words
    )


def _key_slow(scene: SystemScene, errors: Errors) -> KeyDisturbance:
    """Return the largest drift over its white noise, with the correlation times of all drifts."""
    plant = scene.plant
    at = max(range(len(errors.slow)), key=lambda k: errors.slow[k].size)
    slow, unit = errors.slow[at], plant.units[plant.outputs[at]]
    times = {
        f"correlation time, {name}": drift.lasting * scene.trial.step
        for name, drift in zip(plant.outputs, errors.slow, strict=True)
        if drift.size
    }
    return KeyDisturbance(SLOW_SENSOR, "sensor", slow.size * errors.deviations[at], unit, slow.size, times)
