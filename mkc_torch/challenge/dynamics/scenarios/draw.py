"""Draw cases of a scenario of differential equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from torch import Generator

from mkc_torch.challenge import draws
from mkc_torch.challenge.dynamics import cart_pole, motor, pendulum, projectile, tanks, thermal
from mkc_torch.challenge.dynamics.errors import Errors, Slow, Whitening, draw_errors
from mkc_torch.challenge.dynamics.generator import SYSTEMS, hide, key_effect, key_of, measured_by
from mkc_torch.challenge.dynamics.integrate import Course, simulate
from mkc_torch.challenge.dynamics.plant import Array, Plant, RunSet, Setting
from mkc_torch.challenge.dynamics.scenarios.disturbances import KINDS, LASTING_ALONE, LASTING_RUNS, SHORT
from mkc_torch.challenge.dynamics.scenarios.follows import Guess, best_shares
from mkc_torch.challenge.dynamics.scenarios.noise import DisturbedErrors, DisturbedState, draw_disturbance
from mkc_torch.challenge.dynamics.scenarios.simulations import far_starts, right_source, wrong_source
from mkc_torch.challenge.dynamics.scenarios.wrong import OTHER, UNRELATED, WRONG_SIGN, right, wrong
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.subject import simulation_class
from mkc_torch.challenge.scenario import KeyDisturbance, ScenarioCase, ScenarioKey
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

MOST_FOLLOWED = 0.25
"""Largest share of an output's variation that the best fit of an unusable simulation may explain."""

_TRIED = 400
"""Most draws of an unusable case."""

_FITS = 4
"""Fits of an unusable simulation, each from its own starts."""

_TRIALS: Mapping[str, Callable[[Generator, Plant, int, int], RunSet]] = MappingProxyType(
    {
        "pendulum": pendulum.trial,
        "cart_pole": cart_pole.trial,
        "tanks": lambda g, plant, runs, samples: tanks.trial(g, runs, samples),  # noqa: ARG005 - one signature
        "motor": lambda g, plant, runs, samples: motor.trial(g, runs, samples),  # noqa: ARG005
        "projectile": lambda g, plant, runs, samples: projectile.trial(g, runs),  # noqa: ARG005
        "thermal": lambda g, plant, runs, samples: thermal.trial(g, runs, samples),  # noqa: ARG005
    }
)


def draw(scenario: str, seed: int, index: int, hidden: bool, number: int) -> ScenarioCase:
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
    name, simulation = f"{system}_{number:05d}", _simulation(stream, scenario, system)
    if not hidden:
        course = scene.course if rates is None else simulate(plant, trial, disturbance=rates)
        return _case(stream, scenario, index, name, scene, course, errors, disturbance, simulation)
    weighing: Whitening = errors if disturbance is None else DisturbedErrors(scene, errors, disturbance)
    kind, effect, size, seen = hide(stream, SYSTEMS[system], scene, weighing, OUTSIDE_SHARE)
    course = simulate(plant, trial, effect, size, rates)
    case = _case(stream, scenario, index, name, scene, course, errors, disturbance, simulation)
    key = replace(case.key.key, kind=kind, effects=(key_effect(effect, size, seen),))
    return replace(case, key=replace(case.key, key=key))


def draw_useless(seed: int, index: int, hidden: bool, number: int) -> ScenarioCase:  # noqa: ARG001 - nothing to hide
    """Draw a recording and an unusable simulation: a wrong sign, another system, or an unrelated output.

    Cases are drawn until the best of several fits explains at most ``MOST_FOLLOWED`` of every output's variation.
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
        follows = _followed(stream, guess, trial, course.outputs)
        if follows > MOST_FOLLOWED:
            continue
        errors = _errors(stream, "useless", course.outputs)
        name = _class_of(system)
        simulation = right_source(name) if kind == UNRELATED else wrong_source(name, kind)
        case = _case(stream, "useless", index, f"{system}_{number:05d}", scene, course, errors, None, simulation)
        key = replace(case.key.key, kind="useless")
        return replace(case, key=replace(case.key, key=key, useless=kind, follows=follows))
    raise RuntimeError(f"No unusable case for seed {seed}, index {index} in {_TRIED} draws; increase MOST_FOLLOWED.")


def _followed(stream: Callable[[str], Generator], guess: Guess, trial: RunSet, outputs: Array) -> float:
    """Return the largest explained share of any output over several fits; stops at a share above the limit."""
    most = -np.inf
    for again in range(_FITS):
        most = max(most, *best_shares(stream(f"fit {again}"), guess, trial, outputs))
        if most > MOST_FOLLOWED:
            break
    return float(most)


def _setting(stream: Callable[[str], Generator], scenario: str) -> tuple[str, Setting]:
    """Draw a system with states and its runs. A throw has no inputs to hold and no starting values."""
    without = {"servo", "projectile"} if scenario in ("held", "far_starts") else {"servo"}
    system = draws.choose(stream("system"), [name for name in SYSTEMS if name not in without])
    return system, SYSTEMS[system].draw(stream("setting"))


def _trial(stream: Callable[[str], Generator], scenario: str, system: str, setting: Setting) -> RunSet:
    if scenario == "runs":
        g = stream("runs")
        runs = draws.whole(g, *RUNS)
        samples = setting.trial.samples * setting.trial.runs // runs
        return _TRIALS[system](g, setting.plant, runs, samples)
    if scenario in (LASTING_ALONE, LASTING_RUNS):
        runs = 1 if scenario == LASTING_ALONE else LASTING_COUNT
        return _TRIALS[system](stream("runs"), setting.plant, runs, setting.trial.samples * setting.trial.runs // runs)
    return replace(setting.trial, held=scenario == "held")


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
        return simulate(plant, _TRIALS[system](g, plant, trial.runs, trial.samples)).outputs
    middle, reach = outputs.mean((1, 2)), outputs.std((1, 2))
    if not plant.inputs:
        middle, reach = np.zeros_like(middle), np.array([draws.uniform(g, 2.0, 10.0) for _ in plant.outputs])
    length = (trial.samples - 1) * trial.step
    paths = [
        draws.smooth(g, trial.samples, len(plant.outputs), trial.step, draws.uniform(g, 0.15, 0.4) * length)
        for _ in range(trial.runs)
    ]
    return np.stack([middle[:, None] + path.numpy().T * reach[:, None] for path in paths], -1)


def _simulation(stream: Callable[[str], Generator], scenario: str, system: str) -> str:
    return right_source(_class_of(system), far_starts(stream("starts")) if scenario == "far_starts" else None)


def _class_of(system: str) -> str:
    return simulation_class(Path(f"{system}_0.csv"))


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
) -> ScenarioCase:
    measured = measured_by(stream, "", scene.plant, scene.trial, course, errors)
    key = key_of(name, "empty", scene.plant, errors, measured)
    noted = _key_slow(scene, errors) if errors.slow else None if disturbance is None else _key_disturbance(disturbance)
    return ScenarioCase(Recording(measured.columns, name=name), simulation, ScenarioKey(scenario, index, key, noted))


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
