"""A case of one world of differential equations."""

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
from mkc_torch.challenge.dynamics.scenarios.noise import DisturbedErrors, DisturbedState, draw_push
from mkc_torch.challenge.dynamics.scenarios.simulations import far_starts, right_source, wrong_source
from mkc_torch.challenge.dynamics.scenarios.wrong import OTHER, UNRELATED, WRONG_SIGN, right, wrong
from mkc_torch.challenge.dynamics.scene import SystemScene
from mkc_torch.challenge.dynamics.subject import simulation_class
from mkc_torch.challenge.scenario import KeyDisturbance, ScenarioCase, ScenarioKey
from mkc_torch.recording.recording import Recording

OUTSIDE_SHARE = 0.25
"""Share of the hidden effects that no diagnosis with the catalogue can name."""

CORRELATION = (0.3, 0.9)
"""Of coloured noise from sample to sample."""

RUNS = (3, 5)
"""How many runs the world of several runs has."""

SLOW_SENSOR = "slow_sensor"
"""World whose sensors err slowly beside white noise."""

SLOW_SIZE, SLOW_TIME = (1.0, 5.0), (0.01, 0.1)
"""Of a slow error: its standard deviation over that of the white noise, its correlation time over a run."""

LEAST_SLOW = 3.0
"""Correlation time in samples; a shorter one is coloured noise."""

LASTING_COUNT = 4
"""Runs of a recording in which a push that lasts a run can be told from physics, which is the same in each."""

MOST_FOLLOWED = 0.25
"""Share of any output's variation that the best fit of a useless simulation may explain."""

_TRIED, _FITS = 400, 4

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


def draw(world: str, seed: int, index: int, hidden: bool, number: int) -> ScenarioCase:
    """The case at that address.

    Args:
        world: a key of ``pushes.KINDS``, or white, coloured, slow_sensor, held, far_starts, runs.
        seed: of the proof.
        index: of the case among those of its world, hidden or empty.
        hidden: hide something; in every second case of those a push acts too, but for sensors that err slowly.
        number: in the recording's name, which alone depends on it.
    """

    def stream(what: str) -> Generator:
        return draws.generator(seed, "worlds", "dynamics", world, "hidden" if hidden else "empty", index, what)

    system, setting = _setting(stream, world)
    plant, trial = setting.plant, _trial(stream, world, system, setting)
    scene = SystemScene(plant, trial, simulate(plant, trial))
    errors = _errors(stream, world, scene.course.outputs)
    if world == SLOW_SENSOR:
        errors = replace(errors, slow=_slow(stream("slow"), plant, trial))
    push = _push(stream, world, index, hidden, scene, errors)
    rates = None if push is None else push.rates
    name, simulation = f"{system}_{number:05d}", _simulation(stream, world, system)
    if not hidden:
        course = scene.course if rates is None else simulate(plant, trial, push=rates)
        return _case(stream, world, index, name, scene, course, errors, push, simulation)
    weighing: Whitening = errors if push is None else DisturbedErrors(scene, errors, push)
    kind, effect, size, seen = hide(stream, SYSTEMS[system], scene, weighing, OUTSIDE_SHARE)
    course = simulate(plant, trial, effect, size, rates)
    case = _case(stream, world, index, name, scene, course, errors, push, simulation)
    key = replace(case.key.key, kind=kind, effects=(key_effect(effect, size, seen),))
    return replace(case, key=replace(case.key, key=key))


def draw_useless(seed: int, index: int, hidden: bool, number: int) -> ScenarioCase:  # noqa: ARG001 - nothing to hide
    """A recording and a simulation that cannot follow it: a wrong sign, another system, or an unrelated output.

    What is drawn is drawn again until the best of many fits explains too little of every output to be of any use.
    """
    for again in range(_TRIED):

        def stream(what: str, again: int = again) -> Generator:
            return draws.generator(seed, "worlds", "dynamics", "useless", index, again, what)

        system, setting = _setting(stream, "useless")
        plant, trial = setting.plant, setting.trial
        scene = SystemScene(plant, trial, simulate(plant, trial))
        # the first draw decides of which kind the case is, so that each kind has its share
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
    raise RuntimeError(f"No useless case of seed {seed}, index {index} in {_TRIED} draws; loosen MOST_FOLLOWED.")


def _followed(stream: Callable[[str], Generator], guess: Guess, trial: RunSet, outputs: Array) -> float:
    """The largest share of any output in several fits, each from starts of its own, as far as the first too large."""
    most = -np.inf
    for again in range(_FITS):
        most = max(most, *best_shares(stream(f"fit {again}"), guess, trial, outputs))
        if most > MOST_FOLLOWED:
            break
    return float(most)


def _setting(stream: Callable[[str], Generator], world: str) -> tuple[str, Setting]:
    """A system with states and its runs; a throw has neither inputs to hold nor parameters to start far from."""
    without = {"servo", "projectile"} if world in ("held", "far_starts") else {"servo"}
    system = draws.choose(stream("system"), [name for name in SYSTEMS if name not in without])
    return system, SYSTEMS[system].draw(stream("setting"))


def _trial(stream: Callable[[str], Generator], world: str, system: str, setting: Setting) -> RunSet:
    if world == "runs":
        g = stream("runs")
        runs = draws.whole(g, *RUNS)
        samples = setting.trial.samples * setting.trial.runs // runs
        return _TRIALS[system](g, setting.plant, runs, samples)
    if world in (LASTING_ALONE, LASTING_RUNS):
        runs = 1 if world == LASTING_ALONE else LASTING_COUNT
        return _TRIALS[system](stream("runs"), setting.plant, runs, setting.trial.samples * setting.trial.runs // runs)
    return replace(setting.trial, held=world == "held")


def _errors(stream: Callable[[str], Generator], world: str, outputs: Array) -> Errors:
    correlation = draws.uniform(stream("colour"), *CORRELATION) if world == "coloured" else 0.0
    return replace(draw_errors(stream("noise"), outputs), correlation=correlation)


def _slow(g: Generator, plant: Plant, trial: RunSet) -> tuple[Slow, ...]:
    """Of one output, and of each other one in half of the cases."""
    first = draws.choose(g, plant.outputs)
    longest = trial.samples - 1
    return tuple(
        Slow(
            draws.log_uniform(g, *SLOW_SIZE) if name == first or draws.happens(g, 0.5) else 0.0,
            max(draws.log_uniform(g, *SLOW_TIME) * longest, LEAST_SLOW),
        )
        for name in plant.outputs
    )


def _push(
    stream: Callable[[str], Generator], world: str, index: int, hidden: bool, scene: SystemScene, errors: Errors
) -> DisturbedState | None:
    """In worlds that have one; where something is hidden, in every second case of any world but that of slow errors."""
    always = world in (LASTING_ALONE, LASTING_RUNS) or (world in KINDS and not hidden)
    beside = hidden and index % 2 == 0 and world != SLOW_SENSOR
    if not (always or beside):
        return None
    g = stream("push")
    return draw_push(g, world if world in KINDS else draws.choose(g, SHORT), scene, errors)


def _unrelated(g: Generator, system: str, scene: SystemScene) -> Array:
    """Outputs of other runs, or smooth paths as large; of a throw, which has no inputs to belong to, paths alone."""
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


def _simulation(stream: Callable[[str], Generator], world: str, system: str) -> str:
    return right_source(_class_of(system), far_starts(stream("starts")) if world == "far_starts" else None)


def _class_of(system: str) -> str:
    return simulation_class(Path(f"{system}_0.csv"))


def _case(
    stream: Callable[[str], Generator],
    world: str,
    index: int,
    name: str,
    scene: SystemScene,
    course: Course,
    errors: Errors,
    push: DisturbedState | None,
    simulation: str,
) -> ScenarioCase:
    measured = measured_by(stream, "", scene.plant, scene.trial, course, errors)
    key = key_of(name, "empty", scene.plant, errors, measured)
    told = _key_slow(scene, errors) if errors.slow else None if push is None else _key_push(push)
    return ScenarioCase(Recording(measured.columns, name=name), simulation, ScenarioKey(world, index, key, told))


def _key_push(push: DisturbedState) -> KeyDisturbance:
    words = {**push.words, "over noise, true parameters": push.free_over_noise}
    return KeyDisturbance(push.kind, push.state, push.size, push.unit, push.over_noise, words)


def _key_slow(scene: SystemScene, errors: Errors) -> KeyDisturbance:
    """The largest of the slow errors, over its white noise; the times of all in the words."""
    plant = scene.plant
    at = max(range(len(errors.slow)), key=lambda k: errors.slow[k].size)
    slow, unit = errors.slow[at], plant.units[plant.outputs[at]]
    times = {
        f"correlation time, {name}": one.lasting * scene.trial.step
        for name, one in zip(plant.outputs, errors.slow, strict=True)
        if one.size
    }
    return KeyDisturbance(SLOW_SENSOR, "sensor", slow.size * errors.deviations[at], unit, slow.size, times)
